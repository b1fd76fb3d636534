"""Terms of rotors, coupled motors, torque ripple, springs and constant offsets."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Joints, Vector, matching, one_or_each
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from .dry_friction_transitions import AbstractTransition, Tanh
from .term import AbstractTerm, JointParameter, on_drives


class RotorInertia(AbstractTerm):
    r"""Inertia of the rotors through the gears, $i_{Gk}^2 C_{M,k}$ (Eq. 17)."""

    joint_parameters = (
        JointParameter(
            "Ia",
            "inertia of the motor's rotor, reflected to the joint",
            ("kg m²", "kg"),
            "inertia",
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of accelerations."""
        return on_drives(robot, qdd)


class TorqueRipple(AbstractTerm):
    r"""Forces that repeat with the turns of the motors or of the joints.

    Cogging, commutation and gears that run out of true: $\sin k\varphi_i$ and $\cos
    k\varphi_i$ for each multiple $k$ of a turn, where $\varphi_i$ is the motor's angle
    $(A q)_i$ (Eq. 19) or the joint's. The parameters of motor 1 at $k$ = 2 are `sm2_1`
    and `cm2_1`, those of joint 1 `sj2_1` and `cj2_1` [N m or N], all on the side of the
    joints.

    Attributes:
        motor: Multiples of a motor's turn.
        joint: Multiples of a joint's turn.
    """

    motor: tuple[int, ...] = eqx.field(static=True, default=(1,))
    joint: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        multiples = (*self.motor, *self.joint)
        if not multiples or not all(isinstance(k, int) and k > 0 for k in multiples):
            raise InputError(
                f"`TorqueRipple` needs positive whole multiples, not {multiples}."
            )

    @property
    def meanings(self):
        """Meanings of the sines and cosines of each multiple."""
        meanings = {}
        for side, multiples in (("motor", self.motor), ("joint", self.joint)):
            for k in multiples:
                # Symbols such as `sm2`: sine, motor, twice a turn.
                symbol = f"{side[0]}{k}"
                turns = f"{k} times a turn of the {side}"
                meanings[f"s{symbol}"] = f"ripple: sine, {turns}"
                meanings[f"c{symbol}"] = f"ripple: cosine, {turns}"
        return meanings

    def parameters(self, robot):
        """Return names and units: for each multiple the sines, then the cosines."""
        return tuple(
            (f"{wave}_{robot.numbers[i]}", robot.force_unit(i))
            for wave in self.meanings
            for i in robot.driven
        )

    def columns(self, robot, q, qd, qdd):
        """Return sines and cosines, on all axes that a motor turns."""
        A = np.asarray(robot.drives.reduction)
        diagonal = np.where(np.diag(A) == 0, 1.0, np.diag(A))
        # Relative to the motor's own joint, on whose side the parameters are.
        ratios = A / diagonal[:, None]
        blocks = []
        drives = np.array(robot.driven)
        for k in self.motor:
            angles = k * (A @ q)
            for wave in (jnp.sin(angles), jnp.cos(angles)):
                blocks.append((ratios.T * wave[None])[:, drives])
        for k in self.joint:
            blocks += [
                on_drives(robot, jnp.sin(k * q)),
                on_drives(robot, jnp.cos(k * q)),
            ]
        return jnp.concatenate(blocks, axis=1)


class CoupledDrives(AbstractTerm):
    r"""Contributions beside the diagonal of motors that turn more than one axis.

    A motor whose row of the reduction has further entries beside that of its own joint
    feels its rotor inertia and friction on all of these axes. The diagonal parts belong
    to `RotorInertia`, `ViscousFriction` and `CoulombFriction` of the axes; this term
    has the parts beside the diagonal, and the Coulomb friction of the motor's own
    motion.

    Attributes:
        transition: Transition of the Coulomb friction, at speeds measured on the side
            of the motor's own joint [rad/s or m/s].
    """

    transition: AbstractTransition = Tanh()

    def couplings(self, robot: Robot) -> tuple[tuple[int, np.ndarray], ...]:
        """Return the motors that turn several axes, with their relative ratios.

        Raises:
            InputError: If the motors are not in the order of their joints.
        """
        A = np.asarray(robot.drives.reduction)
        scale = np.abs(A).max()
        if not np.diag(A).all():
            motor = int(np.flatnonzero(np.diag(A) == 0)[0]) + 1
            raise InputError(
                f"`drives.reduction`: motor {motor} does not "
                f"turn joint {motor}: reorder its rows."
            )
        couplings = []
        for i in range(robot.joints):
            other_axes = np.abs(np.delete(A[i], i))
            if (other_axes > 1e-12 * scale).any():
                couplings.append((i, A[i] / A[i, i]))
        return tuple(couplings)

    @property
    def meanings(self):
        """Meanings of `Iam`, `fvm` and `fcm`."""
        return {
            "Iam": "inertia of the rotor of a coupled motor",
            "fvm": "viscous friction of a coupled motor",
            "fcm": "Coulomb friction of a coupled motor",
        }

    def parameters(self, robot):
        """Return `Iam6`, `fvm6`, `fcm6` for a coupled motor 6."""
        kinds = (
            ("Iam", "kg m²", "kg"),
            ("fvm", "N m s", "N s/m"),
            ("fcm", "N m", "N"),
        )
        couplings = self.couplings(robot)
        if not couplings:
            raise InputError(
                f"the drives of `{robot.name}` are not coupled: leave `CoupledDrives` "
                "out, or give `drives.reduction` entries off its diagonal."
            )
        return tuple(
            (f"{name}{i + 1}", unit_r if robot.revolute[i] else unit_p)
            for name, unit_r, unit_p in kinds
            for i, _ in couplings
        )

    def columns(self, robot, q, qd, qdd):
        """Return inertia and viscous friction off the diagonal, and Coulomb parts."""
        inertia = []
        viscous_friction = []
        dry_friction = []
        for i, ratios in self.couplings(robot):
            coupling_ratios = _off_diagonal(ratios)
            inertia.append(coupling_ratios.astype(qdd.dtype) @ qdd)
            viscous_friction.append(coupling_ratios.astype(qd.dtype) @ qd)
            # The width of the transition is that of the motor's own joint: the motor's
            # speed is put in its place.
            r = ratios.astype(qd.dtype)
            speeds = [qd[j] for j in range(len(r))]
            speeds[i] = jnp.dot(r, qd)
            dry_friction.append(r * self.transition.of_motors(jnp.stack(speeds))[i])
        return jnp.stack([*inertia, *viscous_friction, *dry_friction], axis=1)

    def lower_bounds(self, robot):
        """Return zeros: inertia and friction of the motors are positive."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """Return the matrices beside the diagonals of the coupled motors."""
        couplings = self.couplings(robot)
        n = robot.joints
        count = len(couplings)
        matrices = np.zeros((2, n, n, 3 * count))
        for k, (_, ratios) in enumerate(couplings):
            coupling_ratios = _off_diagonal(ratios)
            matrices[0, :, :, k] = coupling_ratios
            matrices[1, :, :, count + k] = coupling_ratios
        return matrices


class ConstantOffset(AbstractTerm):
    """A constant force `fo1`, … at each joint: an offset, or uneven friction."""

    joint_parameters = (
        JointParameter(
            "fo", "constant offset of the sensor or of friction", ("N m", "N")
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the identity."""
        return on_drives(robot, jnp.ones_like(q))


class LinearSpring(AbstractTerm):
    """A spring at each joint that pulls it to a position of rest.

    Its parameters are the stiffnesses `ks1`, … [N m/rad or N/m].

    Attributes:
        rest: Position without force [rad or m]; an unknown one appears as a
            `ConstantOffset`.
    """

    rest: float | Joints = eqx.field(converter=one_or_each, default=0.0)
    is_switch = True
    choice = "springs"
    joint_parameters = (
        JointParameter("ks", "stiffness of the spring", ("N m/rad", "N/m")),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of deflections."""
        return on_drives(robot, q - matching("rest", self.rest, q))

    def potential_columns(self, robot, q):
        """Return half the squares of the deflections."""
        return 0.5 * ((q - self.rest) ** 2)[np.array(robot.driven)]


def _off_diagonal(ratios: Vector):
    """Return the products of the ratios of two different axes."""
    return np.outer(ratios, ratios) * (1.0 - np.eye(len(ratios)))
