"""Limits of joint forces and motor torques, by nominal parameters and what is uncertain of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import on_samples
from jaxid.dynamics.model import Coordinates
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.constraint import AbstractConstraint, Entry
from jaxid.robot.robot import Robot
from jaxid.types import AnyArray, Array, Float, Numbers

SMALL = 1e-12
"""Part of a limit below which a standard deviation is rounded, so that it is smooth at zero."""


class NominalForces(eqx.Module):
    """The forces that a motion is expected to need, and how uncertain they are.

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
            ValueError: If there is not one number for each base parameter, the covariance is not
                positive, or `deviations` negative.
        """
        p = np.array(parameters, np.float64)
        if p.shape != (base.size,) or not np.isfinite(p).all():
            raise ValueError(
                f"`parameters` must hold one finite number for each base parameter ({base.size}), "
                f"but has shape {p.shape}: `base.from_standard` makes them of standard ones."
            )
        if not 0 <= deviations < np.inf:
            raise ValueError(f"`deviations` must not be negative, but is {deviations:g}.")
        C = None
        if covariance is not None:
            C = np.array(covariance, np.float64)
            if C.shape != (base.size, base.size) or not np.isfinite(C).all():
                raise ValueError(
                    f"`covariance` must be a finite matrix of {base.size} rows and columns, but "
                    f"has shape {C.shape}."
                )
            least = np.linalg.eigvalsh(0.5 * (C + C.T))[0]
            if least < -1e-9 * np.abs(C).max():
                raise ValueError(f"`covariance` has a negative eigenvalue ({least:.3g}).")
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
        size = jnp.abs(on_samples(self, self.forces, motion.q, motion.qd, motion.qdd) @ to_motors)
        if self.covariance is None:
            return size
        rows = jnp.einsum("...jb,jm->...mb", self.base.regressor(motion), to_motors)
        variance = jnp.einsum("...mb,bc,...mc->...m", rows, self.covariance, rows)
        smooth = jnp.broadcast_to((SMALL * scale) ** 2, variance.shape)
        return size + self.deviations * jnp.sqrt(jnp.maximum(variance, 0.0) + smooth)

    def forces(self, q: Coordinates, qd: Coordinates, qdd: Coordinates) -> Float[Array, " joints"]:
        """The expected forces of one sample."""
        forces = self.base.forces(jnp.asarray(self.parameters), q, qd, qdd)
        if self.base.model.robot.tool is not None:
            forces = forces + self.base.model.known_forces(q, qd, qdd)
        return jnp.asarray(forces)


class JointForces(AbstractConstraint):
    r"""Keeps the joints' forces below the robot's limits, with room for what is uncertain of them.

    $$|Q_i| + k\,\sigma_i \le (1 - m)\,Q_{i,max}$$

    The forces are those of nominal parameters; their standard deviation is that of the nominal
    parameters, carried through the regressor. Joints without a limit are left out.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Share of the limits that stays unused.
    """

    nominal: NominalForces
    margin: float = 0.1

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Relative excess of each limited joint."""
        limits = (1 - self.margin) * np.asarray(robot.limits.force)
        return _excess(self.nominal(motion, np.eye(robot.joints), limits), limits)

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """The joints with a limit."""
        limits = (1 - self.margin) * np.asarray(robot.limits.force)
        return tuple(
            Entry(f"the force of joint `{name}`", float(limit), robot.force_unit(j))
            for j, (name, limit) in enumerate(zip(robot.joint_names, limits, strict=True))
            if np.isfinite(limit)
        )


class MotorTorques(AbstractConstraint):
    """Keeps the motors' torques below those of the robot's drives, on the motors' side.

    Like `JointForces`, for robots whose drives are known: where a motor turns several joints, its
    torque is not that of one of them.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Share of the limits that stays unused.
    """

    nominal: NominalForces
    margin: float = 0.1

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Relative excess of each limited motor."""
        limits = (1 - self.margin) * np.asarray(robot.drives.max_torques)
        to_motors = np.linalg.inv(np.asarray(robot.drives.reduction))
        return _excess(self.nominal(motion, to_motors, limits), limits)

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """The motors with a limit."""
        limits = (1 - self.margin) * np.asarray(robot.drives.max_torques)
        return tuple(
            Entry(f"the torque of motor {j + 1}", float(limit), "N m")
            for j, limit in enumerate(limits)
            if np.isfinite(limit)
        )


def _excess(forces: Array, limits: np.ndarray) -> Array:
    """Relative excess where there is a limit."""
    limited = np.flatnonzero(np.isfinite(limits))
    size = jnp.broadcast_to(limits[limited], (*forces.shape[:-1], len(limited)))
    return forces[..., limited] / size - 1.0
