"""The term of the rigid bodies, by the Projection Equation or by spatial vectors."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bodies, Indices
from jaxid.dynamics import projection_equation, spatial_dynamics
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.robot.robot import Robot

from .term import AbstractTerm, NamesAndUnits, TermParameters

PRINCIPAL_PARAMETERS = 7
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
        return PRINCIPAL_PARAMETERS if self.principal_axes else len(INERTIAL_NAMES)

    def bodies(self, robot: Robot) -> Indices:
        """Return the indices of the bodies whose parameters are unknown."""
        return robot.solid_bodies

    @property
    def meanings(self):
        """Meanings of the ten parameters of a body."""
        return {
            "m": "mass",
            "mx": "mass times x of the centre of mass",
            "my": "mass times y of the centre of mass",
            "mz": "mass times z of the centre of mass",
            "A": "moment of inertia about x",
            "B": "moment of inertia about y",
            "C": "moment of inertia about z",
            "D": "product of inertia in y, z",
            "E": "product of inertia in x, z",
            "F": "product of inertia in x, y",
        }

    def parameters(self, robot: Robot) -> NamesAndUnits:
        """Return `m1`, `mx1`, … `F1`, then those of the next body."""
        pairs = zip(INERTIAL_NAMES, INERTIAL_UNITS, strict=True)
        body_pairs = list(pairs)[: self.body_parameters]
        numbers = [robot.numbers[body] for body in self.bodies(robot)]
        return tuple((f"{name}{i}", unit) for i in numbers for name, unit in body_pairs)

    def columns(self, robot, q, qd, qdd):
        r"""Return the columns $[\Theta_1 \dots \Theta_n]$ (Eq. 11)."""
        theta = projection_equation.rigid_body_regressor(robot, q, qd, qdd)
        return self._as_columns(robot, theta)

    def _as_columns(self, robot: Robot, theta: AnyArray) -> AnyArray:
        """Return the columns of bodies that have a mass, side by side."""
        if robot.virtual:
            theta = theta[:, np.array(self.bodies(robot))]
        return theta[:, :, : self.body_parameters].reshape(robot.joints, -1)

    def inertial_parameters(self, robot: Robot, p: TermParameters) -> Bodies:
        """Return ten parameters of each body, with zeros where they are left out."""
        solid_bodies = self.bodies(robot)
        bodies = p.reshape(len(solid_bodies), self.body_parameters)
        if self.principal_axes:
            missing = len(INERTIAL_NAMES) - PRINCIPAL_PARAMETERS
            zeros = np.zeros((len(solid_bodies), missing))
            bodies = jnp.concatenate([bodies, zeros.astype(bodies.dtype)], axis=1)
        if not robot.virtual:
            return bodies
        zero = jnp.zeros(len(INERTIAL_NAMES), bodies.dtype)
        rows = [zero] * robot.bodies
        for body, parameters in zip(solid_bodies, bodies, strict=True):
            rows[body] = parameters
        return jnp.stack(rows)

    def forces(self, robot, p, q, qd, qdd):
        """Return the projected wrenches of all bodies (Eq. 11)."""
        return projection_equation.rigid_body_forces(
            robot, self.inertial_parameters(robot, p), q, qd, qdd
        )

    def mass_matrix(self, robot, p, q):
        """Return the mass matrix of the bodies (Eq. 38)."""
        return projection_equation.rigid_body_mass_matrix(
            robot, self.inertial_parameters(robot, p), q
        )

    @property
    def spatial_form(self) -> "RigidBodies":
        """The same bodies by spatial vectors."""
        return SpatialBodies(self.principal_axes)

    def potential_columns(self, robot, q):
        """Return the potential energy of masses and first moments."""
        columns = projection_equation.potential_energy_columns(robot, q)
        columns = columns[np.array(self.bodies(robot))]
        return columns[:, : self.body_parameters].ravel()


class SpatialBodies(RigidBodies):
    """The same bodies by spatial vectors: few operations on whole arrays."""

    def columns(self, robot, q, qd, qdd):
        """Return the columns of all bodies (Eq. 11)."""
        theta = spatial_dynamics.spatial_regressor(robot, q, qd, qdd)
        return self._as_columns(robot, theta)

    def forces(self, robot, p, q, qd, qdd):
        """Return the generalised forces of all bodies (Eq. 11)."""
        return spatial_dynamics.spatial_forces(
            robot, self.inertial_parameters(robot, p), q, qd, qdd
        )

    def mass_matrix(self, robot, p, q):
        """Return the mass matrix of the bodies (Eq. 38)."""
        return spatial_dynamics.spatial_mass_matrix(
            robot, self.inertial_parameters(robot, p), q
        )


class SensorLoad(RigidBodies):
    """The body behind the force sensor at the end-effector, and no other.

    For logs of the wrench alone, which hold nothing of the arm.
    """

    def bodies(self, robot):
        """Return the index of the body behind the sensor."""
        return robot.sensor_bodies[-1:]

    @property
    def spatial_form(self) -> "SensorLoad":
        """The term itself."""
        return self
