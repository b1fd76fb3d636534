"""Terms of rotors, coupled motors, torque ripple, springs and constant offsets."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Float, Joints, matching, one_or_each
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from .dry_friction_transitions import AbstractTransition, Tanh
from .term import AbstractTerm, JointParameter


class RotorInertia(AbstractTerm):
    r"""Inertia `Ia1`, … of the motors' rotors through the gear: $i_{Gk}^2 C_{M,k}$ (Eq. 17)."""

    joint_parameters = (
        JointParameter(
            "Ia",
            "inertia of the motor's rotor, seen from the joint",
            ("kg m²", "kg"),
            "inertia",
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of accelerations."""
        return jnp.diag(qdd)


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
        for side, turn, multiples in (
            ("m", "motor", self.motor),
            ("j", "joint", self.joint),
        ):
            for k in multiples:
                for letter, wave in (("s", "sine"), ("c", "cosine")):
                    meaning = f"ripple: {wave}, {k} times a turn of the {turn}"
                    meanings[f"{letter}{side}{k}"] = meaning
        return meanings

    def parameters(self, robot):
        """Return names and units: for each multiple the sines, then the cosines."""
        waves = [("m", k) for k in self.motor] + [("j", k) for k in self.joint]
        return tuple(
            (f"{wave}{side}{k}_{i + 1}", "N m" if turns else "N")
            for side, k in waves
            for wave in "sc"
            for i, turns in enumerate(robot.revolute)
        )

    def columns(self, robot, q, qd, qdd):
        """Return sines and cosines of the angles; coupled motors act on all axes they turn."""
        A, eye = np.asarray(robot.drives.reduction), np.eye(robot.joints)
        ratios = A / np.where(np.diag(A) == 0, 1.0, np.diag(A))[:, None]
        waves = [(A @ q, ratios.T, k) for k in self.motor] + [
            (q, eye, k) for k in self.joint
        ]
        parts = [
            matrix * wave(k * angles)[None]
            for angles, matrix, k in waves
            for wave in (jnp.sin, jnp.cos)
        ]
        return jnp.concatenate(parts, axis=1)


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
        """Return the motors that turn several axes, with ratios relative to their own joint.

        Raises:
            InputError: If the motors are not in the order of their joints.
        """
        A = np.asarray(robot.drives.reduction)
        scale = np.abs(A).max()
        if not np.diag(A).all():
            motor = int(np.flatnonzero(np.diag(A) == 0)[0]) + 1
            raise InputError(
                f"`drives.reduction`: motor {motor} does not turn joint {motor}: "
                "reorder its rows."
            )
        return tuple(
            (i, A[i] / A[i, i])
            for i in range(robot.joints)
            if (np.abs(np.delete(A[i], i)) > 1e-12 * scale).any()
        )

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
        kinds = (("Iam", "kg m²", "kg"), ("fvm", "N m s", "N s/m"), ("fcm", "N m", "N"))
        couplings = self.couplings(robot)
        if not couplings:
            raise InputError(
                f"the drives of `{robot.name}` are not coupled: leave `CoupledDrives` "
                "out, or give "
                "`drives.reduction` entries beside its diagonal."
            )
        return tuple(
            (f"{name}{i + 1}", unit_r if robot.revolute[i] else unit_p)
            for name, unit_r, unit_p in kinds
            for i, _ in couplings
        )

    def columns(self, robot, q, qd, qdd):
        """Return inertia and viscous parts beside the diagonal, and Coulomb parts of motors."""
        inertia, viscous, dry = [], [], []
        for i, ratios in self.couplings(robot):
            beside = _beside_diagonal(ratios)
            inertia.append(beside.astype(qdd.dtype) @ qdd)
            viscous.append(beside.astype(qd.dtype) @ qd)
            r = ratios.astype(qd.dtype)
            # The motor's speed takes the place of its joint's, whose transition width
            # it has.
            speeds = jnp.stack(
                [jnp.dot(r, qd) if j == i else qd[j] for j in range(len(r))]
            )
            dry.append(r * self.transition.of_motors(speeds)[i])
        return jnp.stack([*inertia, *viscous, *dry], axis=1)

    def lower_bounds(self, robot):
        """Return zeros: inertia and friction of the motors are positive."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """Return the matrices beside the diagonals of the coupled motors."""
        couplings = self.couplings(robot)
        n, found = robot.joints, len(couplings)
        matrices = np.zeros((2, n, n, 3 * found))
        for place, (_, ratios) in enumerate(couplings):
            beside = _beside_diagonal(ratios)
            matrices[0, :, :, place] = matrices[1, :, :, found + place] = beside
        return matrices


class ConstantOffset(AbstractTerm):
    """A constant force `fo1`, … at each joint: a sensor's offset, or uneven friction."""

    joint_parameters = (
        JointParameter(
            "fo", "constant offset: of the sensor, or of friction", ("N m", "N")
        ),
    )

    def columns(self, robot, q, qd, qdd):
        """Return the identity."""
        return jnp.eye(robot.joints, dtype=q.dtype)


class LinearSpring(AbstractTerm):
    """A spring at each joint that pulls it to a rest position, such as a counterbalance.

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
        return jnp.diag(q - matching("rest", self.rest, q))

    def potential_columns(self, robot, q):
        """Return half the squares of the deflections."""
        return 0.5 * (q - self.rest) ** 2


def _beside_diagonal(ratios: np.ndarray) -> Float[np.ndarray, "joints joints"]:
    return np.outer(ratios, ratios) * (1.0 - np.eye(len(ratios)))
