"""Terms of rigid bodies, rotors, springs and constant offsets."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints, matching, one_or_each
from jaxid.dynamics import projection_equation, spatial_dynamics
from jaxid.errors import InputError
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.robot.robot import Robot

from .term import AbstractTerm

PRINCIPAL = 7
"""Number of inertial parameters of a body without products of inertia (Eq. 12)."""


class RigidBodies(AbstractTerm):
    r"""Inertia and gravity of the bodies by the Projection Equation (Eqs. 1-12).

    Ten parameters for each body: mass $m$ [kg], first moment $m r_c$ [kg m], and the
    moments $A, B, C, D, E, F$ [kg m²] of $J^o$ about the origin of the body's frame
    (Eq. 9).

    Attributes:
        principal_axes: Whether $D, E, F$ are left out, as in the paper (Eq. 12), which
            leaves seven for each body.
    """

    principal_axes: bool = eqx.field(static=True, default=False)

    @property
    def body_parameters(self) -> int:
        """Number of inertial parameters of each body: ten, or seven."""
        return PRINCIPAL if self.principal_axes else len(INERTIAL_NAMES)

    def parameters(self, robot: Robot) -> tuple[tuple[str, str], ...]:
        """Return `m1`, `mx1`, … `F1`, then those of the next body."""
        each = list(zip(INERTIAL_NAMES, INERTIAL_UNITS, strict=True))[
            : self.body_parameters
        ]
        return tuple(
            (f"{name}{i + 1}", unit) for i in range(robot.joints) for name, unit in each
        )

    def columns(self, robot, q, qd, qdd):
        r"""Return the columns $[\Theta_1 \dots \Theta_n]$ (Eq. 11)."""
        theta = projection_equation.rigid_body_regressor(robot, q, qd, qdd)
        return theta[:, :, : self.body_parameters].reshape(robot.joints, -1)

    def all_ten(
        self, robot: Robot, p: Float[AnyArray, " columns"]
    ) -> Float[AnyArray, "joints 10"]:
        """Return ten parameters of all bodies, with zeros for those that are left out."""
        bodies = p.reshape(robot.joints, self.body_parameters)
        if not self.principal_axes:
            return bodies
        zeros = np.zeros((robot.joints, len(INERTIAL_NAMES) - PRINCIPAL))
        return jnp.concatenate([bodies, zeros.astype(bodies.dtype)], axis=1)

    def forces(self, robot, p, q, qd, qdd):
        """Return the projected wrenches of all bodies, without forming the regressor (Eq. 11)."""
        return projection_equation.rigid_body_forces(
            robot, self.all_ten(robot, p), q, qd, qdd
        )

    def mass_matrix(self, robot, p, q):
        """Return the mass matrix of the bodies (Eq. 38)."""
        return projection_equation.rigid_body_mass_matrix(
            robot, self.all_ten(robot, p), q
        )

    @property
    def spatial_form(self) -> "SpatialBodies":
        """The same bodies by spatial vectors."""
        return SpatialBodies(self.principal_axes)

    def potential_columns(self, robot, q):
        """Return the potential energy of masses and first moments."""
        return projection_equation.potential_energy_columns(robot, q)[
            :, : self.body_parameters
        ].ravel()


class SpatialBodies(RigidBodies):
    """The same bodies by spatial vectors: few operations on whole arrays."""

    def columns(self, robot, q, qd, qdd):
        """Return the columns of all bodies (Eq. 11)."""
        theta = spatial_dynamics.spatial_regressor(robot, q, qd, qdd)
        return theta[:, :, : self.body_parameters].reshape(robot.joints, -1)

    def forces(self, robot, p, q, qd, qdd):
        """Return the generalised forces of all bodies (Eq. 11)."""
        return spatial_dynamics.spatial_forces(
            robot, self.all_ten(robot, p), q, qd, qdd
        )

    def mass_matrix(self, robot, p, q):
        """Return the mass matrix of the bodies (Eq. 38)."""
        return self.mass_and_bias(robot, p, q, jnp.zeros_like(q))[0]

    def mass_and_bias(self, robot, p, q, qd):
        """Return the mass matrix of the bodies and their bias forces (Eq. 38)."""
        return spatial_dynamics.spatial_mass_and_bias(
            robot, self.all_ten(robot, p), q, qd
        )


class RotorInertia(AbstractTerm):
    r"""Inertia `Ia1`, … of the motors' rotors through the gear: $i_{Gk}^2 C_{M,k}$ (Eq. 17)."""

    symbols = (("Ia", "kg m²", "kg"),)
    roles = ("inertia",)

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


class ConstantOffset(AbstractTerm):
    """A constant force `fo1`, … at each joint: a sensor's offset, or uneven friction."""

    symbols = (("fo", "N m", "N"),)

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
    symbols = (("ks", "N m/rad", "N/m"),)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of deflections."""
        return jnp.diag(q - matching("rest", self.rest, q))

    def potential_columns(self, robot, q):
        """Return half the squares of the deflections."""
        return 0.5 * (q - self.rest) ** 2
