"""Abstract term of a model, and the terms of bodies, rotors, springs and offsets."""

import functools
from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints, matching, one_or_each
from jaxid.dynamics import projection_equation
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.robot.robot import Robot

PRINCIPAL = 7
"""Number of inertial parameters of a body without products of inertia (Eq. 12)."""

Role = Literal["inertia", "viscous", "dry", "load"] | None


class NonlinearParameter(NamedTuple):
    """Positive number of a friction law in which forces are not linear, one for each joint.

    Attributes:
        name: Name without the joint's number.
        units: Units for a revolute and a prismatic joint.
        path: Attributes that lead to it, from the term (or transition) that declares it.
        default: Whether it is identified unless `NonlinearFriction` names others.
    """

    name: str
    units: tuple[str, str]
    path: tuple[str, ...]
    default: bool = True

    def value(self, owner: Any) -> Any:
        """Return the current value in its term: a scalar, or one number for each joint."""
        return functools.reduce(getattr, self.path, owner)

    def inside(self, attribute: str) -> "NonlinearParameter":
        """Return the parameter as seen from a term that holds its owner as an attribute."""
        return self._replace(path=(attribute, *self.path))


class AbstractTerm(eqx.Module):
    """One effect in the equations of motion that is linear in unknown parameters.

    A new effect is one class with `columns`, and with `symbols` or the method `parameters`;
    regressor, inverse dynamics, mass matrix, base parameters and compiled forms follow from them.

    Attributes:
        symbols: For each block of parameters with one for each joint the name without the joint's
            number, and the units for a revolute and a prismatic joint.
        roles: Physical role of each block of parameters, if the term has one or more blocks with
            one parameter for each joint: rotor inertia, viscous or dry friction, or friction by
            load. Parameters with a role cannot be negative.
    """

    symbols: ClassVar[tuple[tuple[str, str, str], ...]] = ()
    roles: ClassVar[tuple[Role, ...]] = ()

    def parameters(self, robot: Robot) -> tuple[tuple[str, str], ...]:
        """Return name and unit of each parameter, in the order of the columns."""
        return tuple(
            (f"{name}{i + 1}", turning if revolute else sliding)
            for name, turning, sliding in self.symbols
            for i, revolute in enumerate(robot.revolute)
        )

    @abstractmethod
    def columns(
        self, robot: Robot, q: Joints, qd: Joints, qdd: Joints
    ) -> Float[AnyArray, "joints columns"]:
        """Return the generalised forces [N m or N] of unit parameters, for one sample."""

    def forces(
        self, robot: Robot, p: Float[AnyArray, " columns"], q: Joints, qd: Joints, qdd: Joints
    ) -> Joints:
        """Return the generalised forces [N m or N] of given parameters, for one sample."""
        return self.columns(robot, q, qd, qdd) @ p

    def mass_matrix(
        self, robot: Robot, p: Float[AnyArray, " columns"], q: Joints
    ) -> Float[AnyArray, "joints joints"]:
        """Return the factor of the accelerations in these forces (Eq. 38)."""
        rest = jnp.zeros_like(q)
        return jax.jacfwd(lambda qdd: self.forces(robot, p, q, rest, qdd))(rest)

    def potential_columns(self, robot: Robot, q: Joints) -> Float[AnyArray, " columns"]:
        """Return the potential energy [J] of unit parameters; zero unless energy is stored."""
        return jnp.zeros(len(self.parameters(robot)), q.dtype)

    @property
    def nonlinear_parameters(self) -> tuple[NonlinearParameter, ...]:
        """Parameters that `identify_nonlinear` can identify; none for most terms."""
        return ()

    @property
    def body_parameters(self) -> int:
        """Number of inertial parameters of each body in this term; zero unless it has bodies."""
        return 0

    def lower_bounds(self, robot: Robot) -> Float[np.ndarray, " columns"]:
        """Return lower bounds of the parameters: 0, or -inf where both signs are possible."""
        bounds = np.full(len(self.parameters(robot)), -np.inf)
        for k, role in enumerate(self.roles):
            if role is not None:
                bounds[k * robot.joints : (k + 1) * robot.joints] = 0.0
        return bounds

    def drive_matrices(self, robot: Robot) -> Float[np.ndarray, "2 joints joints columns"]:
        """Return the drives' inertia and viscous friction of unit parameters.

        Both are symmetric and cannot be negative for any motion.
        """
        n = robot.joints
        matrices = np.zeros((2, n, n, len(self.parameters(robot))))
        for k, role in enumerate(self.roles):
            if role in ("inertia", "viscous"):
                own = np.arange(n)
                kind = int(role == "viscous")
                matrices[kind, own, own, k * n + own] = 1.0 / self.roles.count(role)
        return matrices


class RigidBodies(AbstractTerm):
    r"""Inertia and gravity of the bodies by the Projection Equation (Eqs. 1-12).

    Ten parameters for each body: mass $m$ [kg], first moment $m r_c$ [kg m], and the moments
    $A, B, C, D, E, F$ [kg m²] of $J^o$ about the origin of the body's frame (Eq. 9).

    Attributes:
        principal_axes: Whether $D, E, F$ are left out, as in the paper (Eq. 12), which leaves seven
            for each body.
    """

    principal_axes: bool = eqx.field(static=True, default=False)

    @property
    def body_parameters(self) -> int:
        """Number of inertial parameters of each body: ten, or seven."""
        return PRINCIPAL if self.principal_axes else len(INERTIAL_NAMES)

    def parameters(self, robot: Robot) -> tuple[tuple[str, str], ...]:
        """Return `m1`, `mx1`, … `F1`, then those of the next body."""
        each = list(zip(INERTIAL_NAMES, INERTIAL_UNITS, strict=True))[: self.body_parameters]
        return tuple((f"{name}{i + 1}", unit) for i in range(robot.joints) for name, unit in each)

    def columns(self, robot, q, qd, qdd):
        r"""Return the columns $[\Theta_1 \dots \Theta_n]$ (Eq. 11)."""
        theta = projection_equation.rigid_body_regressor(robot, q, qd, qdd)
        return theta[:, :, : self.body_parameters].reshape(robot.joints, -1)

    def all_ten(
        self,
        robot: Robot,
        p: Float[AnyArray, " columns"],
    ) -> Float[AnyArray, "joints 10"]:
        """Return ten parameters of all bodies, with zeros for those that are left out."""
        bodies = p.reshape(robot.joints, self.body_parameters)
        if not self.principal_axes:
            return bodies
        zeros = np.zeros((robot.joints, len(INERTIAL_NAMES) - PRINCIPAL))
        return jnp.concatenate([bodies, zeros.astype(bodies.dtype)], axis=1)

    def forces(self, robot, p, q, qd, qdd):
        """Return the projected wrenches of all bodies, without forming the regressor (Eq. 11)."""
        return projection_equation.rigid_body_forces(robot, self.all_ten(robot, p), q, qd, qdd)

    def mass_matrix(self, robot, p, q):
        """Return the mass matrix of the bodies (Eq. 38)."""
        return projection_equation.rigid_body_mass_matrix(robot, self.all_ten(robot, p), q)

    def potential_columns(self, robot, q):
        """Return the potential energy of masses and first moments."""
        return projection_equation.potential_energy_columns(robot, q)[
            :, : self.body_parameters
        ].ravel()


class RotorInertia(AbstractTerm):
    r"""Inertia `Ia1`, … of the motors' rotors through the gear: $i_{Gk}^2 C_{M,k}$ (Eq. 17)."""

    symbols = (("Ia", "kg m²", "kg"),)
    roles = ("inertia",)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of accelerations."""
        return jnp.diag(qdd)


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
        rest: Position without force [rad or m]; an unknown one appears as a `ConstantOffset`.
    """

    rest: float | Joints = eqx.field(converter=one_or_each, default=0.0)
    symbols = (("ks", "N m/rad", "N/m"),)

    def columns(self, robot, q, qd, qdd):
        """Return the diagonal matrix of deflections."""
        return jnp.diag(q - matching("rest", self.rest, q))

    def potential_columns(self, robot, q):
        """Return half the squares of the deflections."""
        return 0.5 * (q - self.rest) ** 2
