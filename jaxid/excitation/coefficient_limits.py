"""Limits of the joints as matrices: linear in the coefficients, for all times.

The coefficients x of a trajectory are scaled, x = scale * y, so that each y alone meets
a limit near one. All rows are scaled alike: a motion keeps its limits if |R y - c| <= 1
in every row.
"""

from typing import Any, NamedTuple

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
ScaledMotions = Float[AnyArray, "starts scaled"]
"""Scaled coefficients of several motions."""
PerJoint = AnyArray
"""One number for each joint."""
RowValues = Float[AnyArray, "*batch joints rows"]
"""Rows of the limits of each joint, for a motion or several."""

FILLED_FRACTION = 0.95
"""Fraction of its limits that a motion of full size uses."""


class Extent(NamedTuple):
    """Positions of motions, and the use of the limits about their means."""

    positions: AnyArray  # of each joint
    use: PerJoint


class Grid(NamedTuple):
    """Limits of all joints on a grid of times.

    Its functions take one motion or several, in NumPy or JAX.
    """

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
        """Return the rows of motions, R y."""
        motion = self._by_joint(y)
        return (_lead(self.R, motion.ndim + 1) @ motion[..., None])[..., 0]

    def use(self, y: ScaledMotion) -> RowValues:
        """Return the used fractions of the limits, with the sign of the direction."""
        rows = self.rows(y)
        return (rows - _lead(self.c, rows.ndim)) / self.bound

    def scale_into_limits(
        self,
        y: ScaledMotion,
        bound: Any = None,
    ) -> AnyArray:
        """Return the nearest motions of the same shape that keep |R y - c| <= bound.

        Each joint's motion is scaled about its mean, then shifted into its range.
        """
        bound = self.bound if bound is None else bound
        xp = namespace(y)
        extent = self._measure(y)
        factors = xp.minimum(1.0, bound / xp.maximum(extent.use, 1e-12))
        return self._scale(y, extent.positions, factors, bound)

    def shrink(self, y: ScaledMotion, factor: float) -> AnyArray:
        """Return smaller motions, each joint's about its mean position."""
        extent = self._measure(y)
        factors = np.full(extent.use.shape, factor)
        return self._scale(y, extent.positions, factors, np.inf)

    def fill(
        self, y: ScaledMotion, places: PerJoint, size: PerJoint | float
    ) -> AnyArray:
        """Return motions of the same shape that fill a fraction of all limits.

        Args:
            y: Motions whose shape is kept.
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

    def _by_joint(self, y: ScaledMotion):
        """Return scaled coefficients [*batch, joints, coefficients]."""
        return y.reshape(*y.shape[:-1], *self.constant.shape)

    def _measure(self, y: ScaledMotion):
        """Return the positions, and the largest use of a limit by each joint."""
        xp = namespace(y)
        rows = self.rows(y)
        positions = rows[..., : len(self.kinds[0])]
        rates = rows[..., len(self.kinds[0]) :]
        half_swing = 0.5 * (positions.max(axis=-1) - positions.min(axis=-1))
        return Extent(positions, xp.maximum(xp.abs(rates).max(axis=-1), half_swing))

    def _scale(
        self,
        y: ScaledMotion,
        positions: AnyArray,
        factors: PerJoint,
        bound: Any,
    ):
        """Return motions scaled about their means, then shifted into the ranges."""
        xp = namespace(y)
        low, high = self._shift_range(positions, factors, bound)
        shifts = (1.0 - factors) * positions.mean(axis=-1)
        return self._move(y, factors, xp.clip(shifts, low, xp.maximum(low, high)))

    def _shift_range(
        self,
        positions: AnyArray,
        factors: PerJoint,
        bound: Any,
    ):
        """Return the shifts between which scaled positions keep their range."""
        centre = _lead(self.c[:, 0], factors.ndim)
        low = centre - bound - factors * positions.min(axis=-1)
        high = centre + bound - factors * positions.max(axis=-1)
        return low, high

    def _move(self, y: ScaledMotion, factors: PerJoint, shifts: PerJoint):
        """Return the motion of each joint times a factor, and shifted."""
        scaled_motion = factors[..., None] * self._by_joint(y)
        constant = _lead(self.constant, scaled_motion.ndim)
        moved_motion = scaled_motion + shifts[..., None] * constant
        return moved_motion.reshape(y.shape)


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
        self.assumed = unknown_limits(limits)
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
        scale = _lead(np.asarray(self.scale), y.ndim + 1)
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
        return self.grid().fill(shapes, places, 1.0)


def _lead(x: np.ndarray, axes: int) -> np.ndarray:
    """Return an array with leading axes of length one, up to this number of axes."""
    return x[(None,) * (axes - x.ndim)]


def unknown_limits(limits: Limits):
    """Return fields and joints (from 0) whose numbers were not given."""
    fields = []
    for name in ("position_min", "position_max", "velocity", "acceleration"):
        is_known = np.isfinite(np.asarray(getattr(limits, name)))
        fields += [(name, joint) for joint in np.flatnonzero(~is_known).tolist()]
    return tuple(fields)


def scale_samples(samples: int, basis: AbstractBasis) -> int:
    """Return a number of samples that grows with the coefficients of a basis."""
    return samples * max(11, basis.variables) // 11
