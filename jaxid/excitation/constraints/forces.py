"""Limits of joint forces and motor torques, by nominal parameters and what is uncertain of them."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Numbers
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import on_samples
from jaxid.dynamics.model import Coordinates, Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.transitions import AbstractTransition, Reversal
from jaxid.errors import InputError
from jaxid.excitation.constraints.constraint import AbstractConstraint, Entry
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import complete_limits

REVERSING = 0.02
"""Share of a joint's largest speed below which its dry friction may have either direction."""
SMALL = 1e-12
"""Part of a limit below which a standard deviation is rounded, so that it is smooth at zero."""


class NominalForces(eqx.Module):
    """The forces that a motion is expected to need, and how uncertain they are.

    Near standstill dry friction counts in the direction that is worse: a joint that turns round
    passes through both, between any two samples.

    Attributes:
        base: The base parameters' model.
        parameters: Nominal values of the base parameters: of a CAD model, or of an earlier fit.
        covariance: Of the nominal values; None if they count as known.
        deviations: Standard deviations of the force that the limit must leave room for.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"]
    covariance: Float[AnyArray, "base base"] | None
    deviations: float

    @classmethod
    def of(
        cls,
        base: BaseParameters,
        parameters: Numbers,
        covariance: Numbers | None = None,
        deviations: float = 2.0,
    ) -> "NominalForces":
        """Checks nominal parameters.

        Args:
            base: The base parameters' model.
            parameters: Nominal values of its parameters.
            covariance: Of the nominal values; None if they count as known.
            deviations: Standard deviations that must fit below the limit, of 1.

        Raises:
            InputError: If there is not one number for each base parameter, the covariance is not
                positive, or `deviations` negative.
        """
        p = np.array(parameters, np.float64)
        if p.shape != (base.size,) or not np.isfinite(p).all():
            raise InputError(
                f"`parameters` must hold one finite number for each base parameter ({base.size}), "
                f"but has shape {p.shape}: `base.from_standard` makes them of standard ones."
            )
        if not 0 <= deviations < np.inf:
            raise InputError(f"`deviations` must not be negative, but is {deviations:g}.")
        C = None
        if covariance is not None:
            C = np.array(covariance, np.float64)
            if C.shape != (base.size, base.size) or not np.isfinite(C).all():
                raise InputError(
                    f"`covariance` must be a finite matrix of {base.size} rows and columns, but "
                    f"has shape {C.shape}."
                )
            least = np.linalg.eigvalsh(0.5 * (C + C.T))[0]
            if least < -1e-9 * np.abs(C).max():
                raise InputError(f"`covariance` has a negative eigenvalue ({least:.3g}).")
        return cls(base, p, C, float(deviations))

    def __call__(
        self, motion: Motion, to_motors: Float[AnyArray, "joints joints"], scale: AnyArray
    ) -> Float[Array, "*batch joints"]:
        """Absolute forces, with the standard deviations that belong to them.

        Args:
            motion: Joint motion.
            to_motors: From forces to what is limited.
            scale: The limits, by which small numbers are judged.
        """
        forces = on_samples(self, self.forces, motion.q, motion.qd, motion.qdd)
        size = jnp.max(jnp.abs(forces @ to_motors), axis=-2)
        if self.covariance is None:
            return size
        rows = jnp.einsum("...jb,jm->...mb", self.base.regressor(motion), to_motors)
        variance = jnp.einsum("...mb,bc,...mc->...m", rows, self.covariance, rows)
        smooth = jnp.broadcast_to((SMALL * scale) ** 2, variance.shape)
        return size + self.deviations * jnp.sqrt(jnp.maximum(variance, 0.0) + smooth)

    def forces(self, q: Coordinates, qd: Coordinates, qdd: Coordinates) -> Float[Array, "3 joints"]:
        """The expected forces of one sample: as they are, and with dry friction to either side."""
        model = self.base.model
        p = self.base.to_standard(jnp.asarray(self.parameters))
        width = REVERSING * np.asarray(complete_limits(model.robot).velocity)
        found = jnp.stack(
            [
                jnp.asarray(m.forces(p, q, qd, qdd))
                for m in (model, _reversing(model, 1.0, width), _reversing(model, -1.0, width))
            ]
        )
        return found if model.robot.tool is None else found + model.known_forces(q, qd, qdd)[None]


def _reversing(model: Model, side: float, width: Float[np.ndarray, " joints"]) -> Model:
    """The model whose dry friction near standstill holds to one side."""

    def is_transition(part: Any) -> bool:
        return isinstance(part, AbstractTransition)

    terms = jax.tree.map(
        lambda part: Reversal(part, side, width) if is_transition(part) else part,
        model.terms,
        is_leaf=is_transition,
    )
    return eqx.tree_at(lambda m: m.terms, model, terms)


class AbstractForceLimits(AbstractConstraint):
    """Keeps forces, or what motors make of them, below limits.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Share of the limits that stays unused.
    """

    nominal: NominalForces
    margin: float = 0.1

    @abstractmethod
    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """What must not be exceeded, without the margin [N m or N]; infinite where open."""

    @abstractmethod
    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """From forces of the joints to what is limited."""

    @abstractmethod
    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """What is limited, in words, and its unit."""

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Relative excess where there is a limit."""
        limits = (1 - self.margin) * self.limits(robot)
        forces = self.nominal(motion, self.to_limited(robot), limits)
        limited = np.flatnonzero(np.isfinite(limits))
        size = jnp.broadcast_to(limits[limited], (*forces.shape[:-1], len(limited)))
        return forces[..., limited] / size - 1.0

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """What has a limit."""
        found = []
        for number, whole in enumerate(self.limits(robot).tolist()):
            if np.isfinite(whole):
                name, unit = self.named(robot, number)
                note = f"{whole:.4g} less a margin of {100 * self.margin:.4g} %"
                limit = (1 - self.margin) * whole
                found.append(Entry(name, limit, unit, limit, note=note if self.margin else ""))
        return tuple(found)


class JointForces(AbstractForceLimits):
    r"""Keeps the joints' forces below the robot's limits, with room for what is uncertain of them.

    $$|Q_i| + k\,\sigma_i \le (1 - m)\,Q_{i,max}$$

    The forces are those of nominal parameters; their standard deviation is that of the nominal
    parameters, carried through the regressor. Joints without a limit are left out.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Share of the limits that stays unused.
    """

    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """The robot's largest forces."""
        return np.asarray(robot.limits.force)

    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """The forces themselves."""
        return np.eye(robot.joints)

    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """The joint."""
        return f"the force of joint `{robot.joint_names[number]}`", robot.force_unit(number)


class MotorTorques(AbstractForceLimits):
    """Keeps the motors' torques below those of the robot's drives, on the motors' side.

    Like `JointForces`, for robots whose drives are known: where a motor turns several joints, its
    torque is not that of one of them.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Share of the limits that stays unused.
    """

    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """The drives' largest torques."""
        return np.asarray(robot.drives.max_torques)

    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """From the joints to the motors."""
        return np.linalg.inv(np.asarray(robot.drives.reduction))

    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """The motor."""
        return f"the torque of motor {number + 1}", "N m"
