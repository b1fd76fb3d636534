"""Limits of the joints' forces and of the motors' torques, by nominal parameters."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, as_array, namespace
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Coordinates
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTransition, Reversal
from jaxid.errors import InputError
from jaxid.program.sample_methods import evaluate_samples
from jaxid.robot.limits_and_drives import complete_limits
from jaxid.robot.robot import Robot

from .constraint import (
    AbstractConstraint,
    Finding,
    ValuesAndSlopes,
    pull_back_samples,
)

REVERSAL_SPEED = 0.02
"""Fraction of a joint's largest speed below which it may be about to reverse."""
SMOOTHING = 1e-12
"""Standard deviation at zero, where it is made smooth, as a fraction of the limit."""


def _numbers(name: str, x: Any) -> Any:
    """Return an argument as numbers; None stays None."""
    return None if x is None else np.array(as_array(name, x), np.float64)


class ForceLimits(AbstractConstraint):
    r"""Limits of the joints' forces and the motors' torques, with uncertainty.

    $$|Q_i| + k\,\sigma_i \le (1 - m)\,Q_{i,max}$$

    The forces are those of nominal parameters; their standard deviation is that of the
    nominal parameters, propagated through the regressor. Near standstill dry friction
    counts in the direction that is worse: a joint that reverses passes through both,
    between any two samples. Joints and motors without a limit are left out.

    Attributes:
        base: Base parameters.
        parameters: Nominal values of the base parameters: of a CAD model, or of an
            earlier fit.
        covariance: Covariance of the nominal values; None if they count as known.
        margin: Unused fraction $m$ of the limits, from 0 to 1.
        deviations: Number $k$ of standard deviations that must fit below the limits.

    Raises:
        InputError: If there is not one number for each base parameter, or the
            covariance is not finite.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"] = eqx.field(
        converter=lambda x: _numbers("parameters", x)
    )
    covariance: Float[AnyArray, "base base"] | None = eqx.field(
        converter=lambda x: _numbers("covariance", x), default=None
    )
    margin: float = 0.1
    deviations: float = eqx.field(converter=float, default=2.0)

    def __check_init__(self):
        size = self.base.size
        parameters = np.asarray(self.parameters)
        if parameters.shape != (size,) or not np.isfinite(parameters).all():
            raise InputError(
                "`parameters` must hold one finite number for each base parameter "
                f"({size}), but has shape {parameters.shape}: `base.from_standard` "
                "computes them from standard parameters."
            )
        covariance = self.covariance
        if covariance is None:
            return
        is_finite = covariance.shape == (size, size) and np.isfinite(covariance).all()
        rounding = 1e-9 * np.abs(covariance).max()
        if not is_finite or np.linalg.eigvalsh(covariance)[0] < -rounding:
            raise InputError(
                f"`covariance` must be a finite matrix of {size} "
                "rows and columns without negative eigenvalues."
            )

    def __call__(self, robot, motion):
        """Return the relative excess over each limit."""
        limits, combinations = self._limited(robot)
        forces = self._forces(motion)
        xp = namespace(forces)
        size = xp.max(xp.abs(forces @ combinations), axis=-2)
        if self.covariance is not None:
            # Deviations of the forces follow from the covariance of the parameters.
            regressor = self.base.regressor(motion)
            rows = xp.einsum("...jb,jm->...mb", regressor, combinations)
            variance = xp.einsum("...mb,bc,...mc->...m", rows, self.covariance, rows)
            variance = xp.maximum(variance, 0.0)
            # A square root has no derivative at zero, hence the smoothing.
            smoothing = xp.broadcast_to((SMOOTHING * limits) ** 2, variance.shape)
            size = size + self.deviations * xp.sqrt(variance + smoothing)
        return size / xp.broadcast_to(limits, size.shape) - 1.0

    def _limited(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return all limits, and the matrix from joint forces to what they limit."""
        limits = self._all_limits(robot)
        has_limit = np.isfinite(limits)
        motor_combinations = np.linalg.inv(np.asarray(robot.drives.reduction))
        combinations = np.concatenate(
            [np.eye(robot.joints), motor_combinations], axis=1
        )
        return (1 - self.margin) * limits[has_limit], combinations[:, has_limit]

    def _forces(self, motion: Motion) -> AnyArray:
        """Return `forces` at all samples."""
        return evaluate_samples(self, self.forces, *_arrays(motion))

    def linearisation(self, robot):
        """Return a function of relative excesses and their derivatives, in NumPy."""
        limits, combinations = self._limited(robot)

        def linearise(motion, entries):
            shares = combinations[:, entries].T
            sample_limits = limits[entries]
            size, slopes = self._largest_forces(motion, shares, sample_limits)
            if self.covariance is not None:
                spread = self._deviations(motion, shares, sample_limits)
                size = size + spread[0]
                slopes = [x + y for x, y in zip(slopes, spread[1], strict=True)]
            return size / sample_limits - 1.0, slopes

        return linearise

    def _largest_forces(
        self,
        motion: Motion,
        shares: np.ndarray,
        limits: np.ndarray,
    ) -> ValuesAndSlopes:
        """Return the largest force of each sample, and slopes over the limit."""
        forces = np.einsum("tsj,tj->ts", self._forces(motion), shares)
        sides = np.abs(forces).argmax(axis=1)
        samples = np.arange(len(limits))
        peak_forces = forces[samples, sides]

        slopes = np.sign(peak_forces) / limits
        weights = np.zeros((len(limits), 3, shares.shape[1]))
        weights[samples, sides] = shares * slopes[:, None]
        motion_slopes = pull_back_samples(self, self.forces, weights, *_arrays(motion))
        return np.abs(peak_forces), motion_slopes

    def _deviations(
        self,
        motion: Motion,
        shares: np.ndarray,
        limits: np.ndarray,
    ) -> ValuesAndSlopes:
        """Return the uncertainty of each sample, and slopes over the limit."""
        base = self.base
        regressor = np.asarray(base.regressor(motion))
        rows = np.einsum("tjb,tj->tb", regressor, shares)
        products = rows @ self.covariance
        variance = np.maximum((rows * products).sum(axis=1), 0.0)
        smoothing = (SMOOTHING * limits) ** 2
        deviation = np.sqrt(variance + smoothing)

        slopes = self.deviations / deviation / limits
        row_slopes = products * slopes[:, None]
        weights = shares[:, :, None] * row_slopes[:, None]
        arrays = base.model.arguments(motion)
        motion_slopes = pull_back_samples(base, base.columns, weights, *arrays)
        return self.deviations * deviation, motion_slopes

    def forces(self, q: Coordinates, qd: Coordinates, qdd: Coordinates) -> Array:
        """Return the forces of one sample, also with friction to either side."""
        model = self.base.model
        p = self.base.to_standard(jnp.asarray(self.parameters))
        speeds = REVERSAL_SPEED * np.asarray(complete_limits(model.robot).velocity)

        def is_transition(part):
            return isinstance(part, AbstractTransition)

        def reverse(side):
            def replace(part):
                return Reversal(part, side, speeds) if is_transition(part) else part

            return jax.tree.map(replace, model, is_leaf=is_transition)

        models = (model, reverse(1.0), reverse(-1.0))
        forces = [jnp.asarray(x.forces(p, q, qd, qdd)) for x in models]
        return jnp.stack(forces) + model.known_forces(q, qd, qdd)[None]

    def entries(self, robot):
        """Return the forces and torques that have a limit."""
        quantities = [
            (f"the force of joint `{name}`", robot.force_unit(joint))
            for joint, name in enumerate(robot.joint_names)
        ]
        for motor in range(1, robot.joints + 1):
            quantities.append((f"the torque of motor {motor}", "N m"))
        entries = []
        limits = self._all_limits(robot).tolist()
        for (name, unit), limit in zip(quantities, limits, strict=True):
            margin = f"{limit:.4g} less a margin of {100 * self.margin:.4g} %"
            note = margin if self.margin else ""
            limit_with_margin = (1 - self.margin) * limit
            if np.isfinite(limit):
                entries.append(
                    Finding(name, limit_with_margin, unit, limit_with_margin, note=note)
                )
        return tuple(entries)

    @staticmethod
    def _all_limits(robot: Robot) -> np.ndarray:
        """Return the limits of all joints, then of all motors [N m or N]."""
        return np.concatenate([robot.limits.force, robot.drives.max_torques])


def _arrays(motion: Motion) -> tuple[AnyArray, ...]:
    return motion.q, motion.qd, motion.qdd
