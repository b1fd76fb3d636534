"""Abstract term of a model, and the parameters of which it has one for each joint."""

from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bodies, Float, JointMatrix, Joints
from jaxid.robot.robot import Robot

TermParameters = Float[AnyArray, " columns"]
"""One number for each parameter of a term."""
NamesAndUnits = tuple[tuple[str, str], ...]
"""Name and unit of each parameter."""


class JointParameter(NamedTuple):
    """Parameter of which a term has one for each joint.

    Attributes:
        name: Name without the joint's number.
        meaning: Meaning in a few words, for reports.
        units: Units for a revolute and a prismatic joint.
        role: Role in the physics of a drive: inertia of the rotor, viscous or dry
            friction, or friction by load. A parameter with a role cannot be negative.
    """

    name: str
    meaning: str
    units: tuple[str, str]
    role: Literal["inertia", "viscous", "dry", "load"] | None = None


def on_drives(robot: Robot, values: Joints) -> AnyArray:
    """Return the diagonal matrix of some values, in the columns of driven joints."""
    matrix = jnp.diag(values)
    return matrix[:, np.array(robot.driven)] if robot.virtual else matrix


class AbstractTerm(eqx.Module):
    """One effect in the equations of motion that is linear in unknown parameters.

    A new effect is one class with `columns`, and with `joint_parameters` or the methods
    `parameters` and `meanings`; regressor, inverse dynamics, mass matrix, base
    parameters and compiled forms follow from them.

    Attributes:
        joint_parameters: Parameters of which the term has one for each joint, in the
            order of the columns: the first one for all joints, then the second one.
        is_switch: Whether the experiment file adds the term by its name in `TERMS`,
            like `springs = true`, beside any other terms.
        choice: Name of the effect in the comparison of models by `jaxid choose`; empty
            if it is not tried there.
        choice_keys: Keys of the file's table `[model]` that add the effect there; those
            of a switch if empty.
        is_of_sensors: Whether the parameters belong to force sensors.
        shares_friction: Whether the term is a part of the friction beside which other
            parts may be negative, since only the sum of all parts cannot.
    """

    joint_parameters: ClassVar[tuple[JointParameter, ...]] = ()
    is_switch: ClassVar[bool] = False
    choice: ClassVar[str] = ""
    choice_keys: ClassVar[dict[str, Any]] = {}
    shares_friction: ClassVar[bool] = False
    is_of_sensors: ClassVar[bool] = False

    @classmethod
    def with_transition(cls, transition: Any) -> "AbstractTerm":
        """Return the term as a switch adds it; dry friction takes the transition."""
        return cls()

    def parameters(self, robot: Robot) -> NamesAndUnits:
        """Return name and unit of each parameter, in the order of the columns."""
        parameters = []
        for parameter in self.joint_parameters:
            revolute_unit, prismatic_unit = parameter.units
            for i in robot.driven:
                unit = revolute_unit if robot.revolute[i] else prismatic_unit
                parameters.append((f"{parameter.name}{robot.numbers[i]}", unit))
        return tuple(parameters)

    @property
    def meanings(self) -> dict[str, str]:
        """Meanings of the parameters in words, by their names without numbers."""
        return {x.name: x.meaning for x in self.joint_parameters}

    @abstractmethod
    def columns(self, robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> AnyArray:
        """Return the forces [N m or N] of unit parameters for one sample."""

    def forces(
        self,
        robot: Robot,
        p: TermParameters,
        q: Joints,
        qd: Joints,
        qdd: Joints,
    ) -> Joints:
        """Return the forces [N m or N] of parameters for one sample."""
        return self.columns(robot, q, qd, qdd) @ p

    def mass_matrix(self, robot: Robot, p: TermParameters, q: Joints) -> JointMatrix:
        """Return the factor of the accelerations in these forces (Eq. 38)."""
        # Forces are affine in the accelerations: their slope is the mass matrix.
        standstill = jnp.zeros_like(q)
        return jax.jacfwd(lambda qdd: self.forces(robot, p, q, standstill, qdd))(
            standstill
        )

    def inertial_parameters(self, robot: Robot, p: TermParameters) -> Bodies | None:
        """Return ten parameters of each body; None if the term is another effect."""
        return None

    def potential_columns(self, robot: Robot, q: Joints) -> TermParameters:
        """Return the potential energy [J] of unit parameters."""
        return jnp.zeros(len(self.parameters(robot)), q.dtype)

    @property
    def body_parameters(self) -> int:
        """Number of inertial parameters of each body; zero without bodies."""
        return 0

    def lower_bounds(self, robot: Robot) -> TermParameters:
        """Return lower bounds: 0, or -inf where both signs are possible."""
        bounds = np.full(len(self.parameters(robot)), -np.inf)
        joints = len(robot.driven)
        for k, parameter in enumerate(self.joint_parameters):
            if parameter.role is not None:
                bounds[k * joints : (k + 1) * joints] = 0.0
        return bounds

    def drive_matrices(self, robot: Robot) -> np.ndarray:
        """Return the drives' inertia and viscous friction of unit parameters.

        Both are symmetric and cannot be negative for any motion.
        """
        n = robot.joints
        matrices = np.zeros((2, n, n, len(self.parameters(robot))))
        joints = np.array(robot.driven)
        places = np.arange(len(joints))
        roles = [parameter.role for parameter in self.joint_parameters]
        for kind, role in enumerate(("inertia", "viscous")):
            for k in range(len(roles)):
                if roles[k] == role:
                    # Parameters of several directions of motion share the friction.
                    share = 1.0 / roles.count(role)
                    matrices[kind, joints, joints, k * len(places) + places] = share
        return matrices
