"""Limits of the joints as matrices: linear in the coefficients, for all times.

The coefficients x of a trajectory are scaled, x = scale * y, so that each y alone meets
a limit near one. All rows are scaled alike: a motion keeps its limits if |R y - c| <= 1
in every row.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, PRNGKeyArray, namespace
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits, complete_limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractBasis, Coefficients

ScaledMotion = Float[AnyArray, " scaled"]
"""Scaled coefficients of a motion, joint by joint."""
ScaledMotions = Float[np.ndarray, "starts scaled"]
"""Scaled coefficients of several motions."""
PerJoint = np.ndarray
"""One number for each joint."""
RowValues = Float[AnyArray, "joints rows"]
"""Rows of the limits of each joint, for a motion."""

FILLED_FRACTION = 0.95
"""Fraction of its limits that a motion of full size uses."""


class Extent(NamedTuple):
    """Positions of a motion, and the use of the limits about their means."""

    positions: np.ndarray  # of each joint
    use: PerJoint


class Grid(NamedTuple):
    """Limits of all joints on a grid of times."""

    # rows by scaled coefficients: of each joint first positions, then higher orders
    R: np.ndarray
    # centres of the ranges, for positions; zero for the rest
    c: np.ndarray
    # rows of positions, velocities, accelerations, and jerks if these are limited
    kinds: tuple[range, ...]
    bound: float  # bound of |R y - c| with which the limits hold at all times
    # scaled coefficients of a constant motion at half of each joint's range
    constant: np.ndarray

    def rows(self, y: ScaledMotion) -> RowValues:
        """Return the rows of a motion, R y, in NumPy or JAX."""
        by_joint = y.reshape(self.constant.shape)
        return namespace(y).einsum("jrk,jk->jr", self.R, by_joint)

    def use(self, y: ScaledMotion) -> RowValues:
        """Return the used fractions of the limits, with the sign of the direction."""
        return (self.rows(y) - self.c) / self.bound

    def scale_into_limits(
        self,
        y: ScaledMotion,
        bound: float | None = None,
    ) -> np.ndarray:
        """Return the nearest motion of the same shape that keeps |R y - c| <= bound.

        Each joint's motion is scaled about its mean, then shifted into its range.
        """
        bound = self.bound if bound is None else bound
        extent = self._measure(y)
        factors = np.minimum(1.0, bound / np.maximum(extent.use, 1e-12))
        return self._scale(y, extent.positions, factors, bound)

    def shrink(self, y: ScaledMotion, factor: float) -> np.ndarray:
        """Return a smaller motion, each joint's about its mean position."""
        positions = self._measure(y).positions
        return self._scale(y, positions, np.full(len(positions), factor), np.inf)

    def fill(
        self, y: ScaledMotion, places: PerJoint, size: PerJoint | float
    ) -> np.ndarray:
        """Return a motion of the same shape that fills a fraction of all limits.

        Args:
            y: Motion whose shape is kept.
            places: Where each joint moves within its range: 0 at the lower, 1 at the
                upper end.
            size: Size of the motion, or of that of each joint; at 1 it uses 95 % of a
                limit.
        """
        bound = FILLED_FRACTION * self.bound
        positions, use = self._measure(y)
        factors = size * bound / use
        low, high = self._shift_range(positions, factors, bound)
        return self._move(y, factors, low + (high - low) * np.asarray(places))

    def _measure(self, y: ScaledMotion):
        """Return the positions, and the largest use of a limit by each joint."""
        rows = self.rows(np.asarray(y))
        positions, rates = np.split(rows, [len(self.kinds[0])], axis=1)
        half_swing = 0.5 * np.ptp(positions, axis=1)
        return Extent(positions, np.maximum(np.abs(rates).max(axis=1), half_swing))

    def _scale(
        self,
        y: ScaledMotion,
        positions: np.ndarray,
        factors: PerJoint,
        bound: float,
    ):
        """Return the motion scaled about its means, then shifted into the ranges."""
        low, high = self._shift_range(positions, factors, bound)
        shifts = (1.0 - factors) * positions.mean(axis=1)
        return self._move(y, factors, np.clip(shifts, low, np.maximum(low, high)))

    def _shift_range(
        self,
        positions: np.ndarray,
        factors: PerJoint,
        bound: float,
    ):
        """Return the shifts between which scaled positions keep their range."""
        centre = self.c[:, 0]
        low = centre - bound - factors * positions.min(axis=1)
        high = centre + bound - factors * positions.max(axis=1)
        return low, high

    def _move(self, y: ScaledMotion, factors: PerJoint, shifts: PerJoint):
        """Return the motion of each joint times a factor, and shifted."""
        motion = np.asarray(y).reshape(self.constant.shape)
        moved_motion = factors[:, None] * motion + shifts[:, None] * self.constant
        return moved_motion.reshape(-1)


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
    scale: Coefficients
    constant: Coefficients
    assumed: tuple[tuple[str, int], ...] = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        basis: AbstractBasis,
        limits: Limits | None = None,
    ):
        limits = robot.limits if limits is None else limits
        self.basis = basis
        self.limits = complete_limits(robot.replace(limits=limits))
        self.assumed = _unknown_limits(limits)
        rows, _ = basis.envelope(scale_samples(512, basis))
        peaks = np.array([np.abs(part).max(axis=0) for part in rows])
        sizes = self._sizes
        with np.errstate(divide="ignore"):
            self.scale = np.min(sizes[:, :, None] / peaks[:, None, :], axis=0)

        # A constant: its positions are one, its velocities zero.
        ones = np.ones(len(rows[0]))
        constant = np.linalg.lstsq(rows[0], ones, rcond=None)[0]
        error = np.abs(rows[0] @ constant - 1.0).max()
        speed = np.abs(rows[1] @ constant).max()
        if max(error, speed) > 1e-9:
            raise InputError(
                "`basis` must hold a constant, "
                "for motions that stand still at any position."
            )
        self.constant = sizes[0][:, None] * constant[None] / self.scale

    @property
    def shape(self) -> tuple[int, int]:
        """Number of joints, and of coefficients of each."""
        joints, variables = self.scale.shape
        return joints, variables

    @property
    def _sizes(self):
        """Half ranges, speeds, accelerations and jerks."""
        limits = self.limits
        half_ranges = 0.5 * (limits.position_max - limits.position_min)
        sizes = [half_ranges, limits.velocity, limits.acceleration, limits.jerk]
        return np.array(sizes, np.float64)

    def coefficients(self, y: AnyArray) -> AnyArray:
        """Return the coefficients of trajectories from scaled ones."""
        scale = np.asarray(self.scale)[(None,) * (y.ndim - 1)]
        return y.reshape((*y.shape[:-1], *self.shape)) * scale

    def scaled(self, x: Coefficients) -> np.ndarray:
        """Return the scaled coefficients of a trajectory."""
        return (np.asarray(x) / np.asarray(self.scale)).ravel()

    def grid(self, points: int = 512) -> Grid:
        """Return the limits on a grid, which is finer for more coefficients."""
        envelope, factor = self.basis.envelope(scale_samples(points, self.basis))
        sizes = self._sizes
        scale = np.asarray(self.scale)[:, None]
        orders = 4 if np.isfinite(sizes[3]).any() else 3
        parts = []
        kinds = []
        start = 0
        for rows, size in zip(envelope[:orders], sizes[:orders], strict=True):
            parts.append(scale * rows[None] / size[:, None, None])
            kinds.append(range(start, start + len(rows)))
            start += len(rows)

        middle_positions = 0.5 * (self.limits.position_min + self.limits.position_max)
        centres = np.zeros((len(middle_positions), start))
        centres[:, kinds[0]] = (middle_positions / sizes[0])[:, None]
        R = np.concatenate(parts, axis=1)
        return Grid(R, centres, tuple(kinds), 1 / factor, np.asarray(self.constant))

    def use(self, x: Coefficients) -> np.ndarray:
        """Return the largest used fraction of each limit, for all times [4 joints].

        The used fraction of a range is the distance from its middle, over half of the
        range.
        """
        grid = self.grid()
        rows = np.abs(grid.use(self.scaled(x)))
        use = np.zeros((4, len(x)))
        for order, kind in enumerate(grid.kinds):
            use[order] = rows[:, kind].max(axis=1)
        return use

    def random(self, key: PRNGKeyArray, count: int) -> ScaledMotions:
        """Draw motions of random shapes that use 95 % of the limits."""
        joints, variables = self.shape
        # In NumPy: the first draw of JAX would wait for its compiler.
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        shapes = random.standard_normal((count, joints * variables))
        places = random.random((count, joints))
        grid = self.grid()
        pairs = zip(shapes, places, strict=True)
        return np.array([grid.fill(shape, place, 1.0) for shape, place in pairs])


def _unknown_limits(limits: Limits):
    """Return fields and joints (from 0) whose numbers were not given."""
    fields = []
    for name in ("position_min", "position_max", "velocity", "acceleration"):
        is_known = np.isfinite(np.asarray(getattr(limits, name)))
        fields += [(name, joint) for joint in np.flatnonzero(~is_known).tolist()]
    return tuple(fields)


def scale_samples(samples: int, basis: AbstractBasis) -> int:
    """Return a number of samples that grows with the coefficients of a basis."""
    return samples * max(11, basis.variables) // 11
