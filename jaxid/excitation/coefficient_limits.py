"""Limits of the joints as matrices: linear in the coefficients, and certified for all times.

The coefficients x of a trajectory are scaled, x = scale * y, so that each y alone meets
a limit near one. All rows are scaled alike: a motion keeps its limits if |R y - c| <= 1
in every row.
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray, namespace
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import complete_limits
from jaxid.trajectory.trajectory import AbstractBasis


class Grid(NamedTuple):
    """Limits of all joints on a grid of times."""

    # rows by scaled coefficients, for each joint first positions, then the higher
    # orders
    R: Float[np.ndarray, "joints rows variables"]
    c: Float[
        np.ndarray, "joints rows"
    ]  # centres of the ranges, for positions; zero for the rest
    kinds: tuple[
        range, ...
    ]  # rows of positions, velocities, accelerations, and jerks if limited
    bound: float  # bound of |R y - c| with which the limits hold at all times
    # scaled coefficients of a constant motion at half of each joint's range
    constant: Float[np.ndarray, "joints variables"]

    def rows(self, y: Float[AnyArray, " scaled"]) -> Float[AnyArray, "joints rows"]:
        """Return the rows of a motion, R y."""
        return namespace(y).einsum(
            "jrk,jk->jr", self.R, y.reshape(np.shape(self.constant))
        )

    def use(self, y: Float[AnyArray, " scaled"]) -> Float[AnyArray, "joints rows"]:
        """Return the used fractions of the limits, with the sign of the direction."""
        return (self.rows(y) - self.c) / self.bound

    def scale_into_limits(
        self,
        y: Float[AnyArray, " scaled"],
        bound: Any | None = None,
        growth: float = 1.0,
    ) -> Float[AnyArray, " scaled"]:
        """Return the nearest motion of the same shape that keeps |R y - c| <= bound.

        Each joint's motion is scaled about its mean, where limits leave room by up to
        `growth`, then shifted into its range.
        """
        xp, bound = namespace(y), self.bound if bound is None else bound
        q, peak = self._positions(y)
        s = xp.minimum(growth, bound / xp.maximum(peak, 1e-12))
        low, high = self._shifts(q, s, bound)
        shift = xp.clip((1.0 - s) * q.mean(axis=1), low, xp.maximum(low, high))
        return self._moved(y, s, shift)

    def shrink(
        self, y: Float[AnyArray, " scaled"], fraction: Any
    ) -> Float[AnyArray, " scaled"]:
        """Return a motion made smaller by a factor, each joint's about its mean position."""
        q, _ = self._positions(y)
        return self._moved(y, fraction, (1.0 - fraction) * q.mean(axis=1))

    def fill(
        self,
        y: Float[AnyArray, " scaled"],
        places: Float[AnyArray, " joints"],
        size: Any,
    ) -> Float[AnyArray, " scaled"]:
        """Return a motion of the same shape that fills a fraction of 95 % of its limits.

        `places` are those of the joints in the range that is left, from 0 to 1.
        """
        q, peak = self._positions(y)
        bound = 0.95 * self.bound
        s = size * bound / peak
        low, high = self._shifts(q, s, bound)
        return self._moved(y, s, low + (high - low) * places)

    def _positions(self, y: AnyArray) -> tuple[Any, Any]:
        """Return the positions, and the largest use of a limit by each joint."""
        rows, positions = self.rows(y), len(self.kinds[0])
        q, rest = rows[:, :positions], rows[:, positions:]
        half = 0.5 * (q.max(axis=1) - q.min(axis=1))
        xp = namespace(y)
        return q, xp.maximum(xp.abs(rest).max(axis=1), half)

    def _shifts(self, q: Array, s: Array, bound: Any) -> tuple[Any, Any]:
        """Return the least and largest shift that keep scaled positions in their range."""
        centre = self.c[:, 0]
        return centre - bound - s * q.min(axis=1), centre + bound - s * q.max(axis=1)

    def _moved(self, y: AnyArray, s: Any, shift: Array) -> Any:
        """Return the motion of each joint times a factor, and shifted."""
        motion = y.reshape(np.shape(self.constant))
        scaled = namespace(y).reshape(namespace(y).asarray(s), (-1, 1)) * motion
        return (scaled + shift[:, None] * self.constant).reshape(y.shape)


class JointLimits(eqx.Module):
    """Limits of all joints on the trajectories of a basis.

    Args:
        robot: Robot whose joints move.
        basis: Family of trajectories.
        limits: Limits in place of the robot's; unknown ones are assumed.

    Attributes:
        limits: Finite ranges, speeds and accelerations; a jerk may be infinite.
        scale: Scale of the coefficients, x = scale * y.
        constant: Scaled coefficients of a constant motion at half of each joint's
            range.
        assumed: Fields of the limits and joints (from 0) whose numbers were not given.

    Raises:
        InputError: If no trajectory of the basis stands still anywhere else than at
            zero.
    """

    basis: AbstractBasis
    limits: Limits
    scale: Float[AnyArray, "joints variables"]
    constant: Float[AnyArray, "joints variables"]
    assumed: tuple[tuple[str, int], ...] = eqx.field(static=True)

    def __init__(
        self, robot: Robot, basis: AbstractBasis, limits: Limits | None = None
    ):
        limits = robot.limits if limits is None else limits
        self.basis, self.limits = basis, complete_limits(robot.replace(limits=limits))
        self.assumed = tuple(
            (name, int(j))
            for name in ("position_min", "position_max", "velocity", "acceleration")
            for j in np.flatnonzero(~np.isfinite(np.asarray(getattr(limits, name))))
        )
        rows, _ = basis.envelope(scale_samples(512, basis))
        reach = np.array([np.abs(r).max(axis=0) for r in rows])
        with np.errstate(divide="ignore"):
            self.scale = np.min(self._sizes[:, :, None] / reach[:, None, :], axis=0)
        one = np.linalg.lstsq(rows[0], np.ones(len(rows[0])), rcond=None)[0]
        if (
            np.abs(rows[0] @ one - 1.0).max() > 1e-9
            or np.abs(rows[1] @ one).max() > 1e-9
        ):
            raise InputError(
                "`basis` must hold a constant, for motions that stand still at any "
                "position."
            )
        self.constant = self._sizes[0][:, None] * one[None] / self.scale

    @property
    def shape(self) -> tuple[int, int]:
        """Number of joints, and of coefficients of each."""
        joints, variables = self.scale.shape
        return joints, variables

    @property
    def _sizes(self) -> Float[np.ndarray, "4 joints"]:
        """Half ranges, speeds, accelerations and jerks."""
        x = self.limits
        half = 0.5 * (np.asarray(x.position_max) - np.asarray(x.position_min))
        return np.array([half, x.velocity, x.acceleration, x.jerk], np.float64)

    def coefficients(
        self, y: Float[AnyArray, "*batch scaled"]
    ) -> Float[AnyArray, "*batch joints variables"]:
        """Return the coefficients of trajectories from scaled ones."""
        scale = np.asarray(self.scale)[(None,) * (y.ndim - 1)]
        return y.reshape((*y.shape[:-1], *self.shape)) * scale

    def scaled(
        self, x: Float[AnyArray, "joints variables"]
    ) -> Float[np.ndarray, " scaled"]:
        """Return the scaled coefficients of a trajectory."""
        return (np.asarray(x) / np.asarray(self.scale)).ravel()

    def grid(self, points: int = 512) -> Grid:
        """Return the limits on a grid of times; bases with many coefficients get more points."""
        envelope, factor = self.basis.envelope(scale_samples(points, self.basis))
        size, scale = self._sizes, np.asarray(self.scale)
        orders = 4 if np.isfinite(size[3]).any() else 3
        R = [
            scale[:, None] * envelope[k][None] / size[k][:, None, None]
            for k in range(orders)
        ]
        ends = itertools.accumulate((part.shape[1] for part in R), initial=0)
        kinds = tuple(range(a, b) for a, b in itertools.pairwise(ends))
        R = np.concatenate(R, axis=1)
        low, high = (
            np.asarray(self.limits.position_min),
            np.asarray(self.limits.position_max),
        )
        c = np.zeros(R.shape[:2])
        c[:, kinds[0]] = (0.5 * (low + high) / size[0])[:, None]
        return Grid(R, c, kinds, 1 / factor, np.asarray(self.constant))

    def use(
        self, x: Float[AnyArray, "joints variables"]
    ) -> Float[np.ndarray, "4 joints"]:
        """Return the largest used fraction of each limit by coefficients, for all times.

        The used fraction of a range is the distance from its middle, over half of the
        range.
        """
        grid, used = self.grid(), np.zeros((4, len(x)))
        rows = grid.use(self.scaled(x))
        for order, kind in enumerate(grid.kinds):
            used[order] = np.abs(rows[:, kind]).max(axis=1)
        return used

    def random(
        self, key: PRNGKeyArray, count: int, size: float = 1.0
    ) -> Float[np.ndarray, "count scaled"]:
        """Draw motions of random shapes and places, of a size relative to 95 % of the limits."""
        joints, variables = self.shape
        shape, place = jax.random.split(key)
        draws = np.asarray(jax.random.normal(shape, (count, joints * variables), float))
        places = np.asarray(jax.random.uniform(place, (count, joints), float))
        fill = self.grid().fill
        return np.array(
            [fill(y, place, size) for y, place in zip(draws, places, strict=True)]
        )


def scale_samples(samples: int, basis: AbstractBasis) -> int:
    """Return a number of samples that grows with the coefficients beyond five harmonics."""
    return samples * max(11, basis.variables) // 11
