"""Abstract term of a model, and the nonlinear parameters that a term may have."""

import functools
from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints
from jaxid.robot.robot import Robot

Role = Literal["inertia", "viscous", "dry", "load"] | None


class NonlinearParameter(NamedTuple):
    """Positive number of a friction law in which forces are not linear, one for each joint.

    Attributes:
        name: Name without the joint's number.
        units: Units for a revolute and a prismatic joint.
        path: Attributes that lead to it, from the term (or transition) that declares
            it.
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

    A new effect is one class with `columns`, and with `symbols` or the method
    `parameters`; regressor, inverse dynamics, mass matrix, base parameters and compiled
    forms follow from them.

    Attributes:
        symbols: For each block of parameters with one for each joint the name without
            the joint's number, and the units for a revolute and a prismatic joint.
        roles: Physical role of each block of parameters, if the term has one or more
            blocks with one parameter for each joint: rotor inertia, viscous or dry
            friction, or friction by load. Parameters with a role cannot be negative.
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
        self,
        robot: Robot,
        p: Float[AnyArray, " columns"],
        q: Joints,
        qd: Joints,
        qdd: Joints,
    ) -> Joints:
        """Return the generalised forces [N m or N] of given parameters, for one sample."""
        return self.columns(robot, q, qd, qdd) @ p

    def mass_matrix(
        self, robot: Robot, p: Float[AnyArray, " columns"], q: Joints
    ) -> Float[AnyArray, "joints joints"]:
        """Return the factor of the accelerations in these forces (Eq. 38)."""
        rest = jnp.zeros_like(q)
        return jax.jacfwd(lambda qdd: self.forces(robot, p, q, rest, qdd))(rest)

    def mass_and_bias(
        self, robot: Robot, p: Float[AnyArray, " columns"], q: Joints, qd: Joints
    ) -> tuple[Float[AnyArray, "joints joints"], Joints]:
        """Return the mass matrix, and the generalised forces without accelerations (Eq. 38)."""
        return self.mass_matrix(robot, p, q), self.forces(
            robot, p, q, qd, jnp.zeros_like(q)
        )

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

    def drive_matrices(
        self, robot: Robot
    ) -> Float[np.ndarray, "2 joints joints columns"]:
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
