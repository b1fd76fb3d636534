"""Limits of the joints as matrices: linear in a motion's numbers, and certified for all times.

Numbers x of a trajectory are scaled, x = scale * y, so that each y alone meets a limit near one.
All rows are scaled alike: a motion keeps its limits if |R y - c| <= 1 in every row.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.errors import InputError
from jaxid.robot.limits import Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.basis import AbstractBasis
from jaxid.trajectory.fourier import complete_limits

CERTIFIED = 512
"""Rows of each order by which a motion is made to keep its limits at all times."""
FEW = 11
"""Numbers of a joint up to which such counts are enough: those of five harmonics."""
CONSTANT = 1e-9
"""How well a basis must be able to stand still, relative."""


class Grid(NamedTuple):
    """Rows of all joints on a grid of times.

    Attributes:
        R: By scaled numbers, for each joint first positions, then the higher orders.
        c: Centres of the ranges, for positions; zero for the rest.
        kinds: Ranges of the rows of positions, velocities, accelerations, and jerks if limited.
        bound: What |R y - c| must keep so that the limits hold at all times.
    """

    R: Float[np.ndarray, "joints rows variables"]
    c: Float[np.ndarray, "joints rows"]
    kinds: tuple[range, ...]
    bound: float

    @property
    def positions(self) -> int:
        """How many of the rows belong to positions."""
        return len(self.kinds[0])


class JointLimits(eqx.Module):
    """Limits of all joints on the trajectories of a basis.

    Attributes:
        basis: The trajectories.
        limits: Finite ranges, speeds and accelerations; a jerk may be infinite.
        names: Of the joints.
        scale: Of a trajectory's numbers, x = scale * y.
        still: The scaled numbers that move a joint by half of its range, and keep it there.
        assumed: Fields of the limits and joints (from 0) whose numbers were not given.
    """

    basis: AbstractBasis
    limits: Limits
    names: tuple[str, ...] = eqx.field(static=True)
    scale: Float[AnyArray, "joints variables"]
    still: Float[AnyArray, "joints variables"]
    assumed: tuple[tuple[str, int], ...] = eqx.field(static=True, default=())

    @classmethod
    def of(cls, robot: Robot, basis: AbstractBasis, limits: Limits | None = None) -> "JointLimits":
        """The limits of a robot, or others; unknown ones are assumed.

        Raises:
            InputError: If no trajectory of the basis stands still anywhere else than at zero.
        """
        limits = robot.limits if limits is None else limits
        assumed = tuple(
            (name, int(j))
            for name in ("position_min", "position_max", "velocity", "acceleration")
            for j in np.flatnonzero(~np.isfinite(np.asarray(getattr(limits, name))))
        )
        limits = complete_limits(robot.replace(limits=limits))
        size = _sizes(limits)
        rows = basis.envelope(enough(CERTIFIED, basis)).rows
        reach = np.array([np.abs(r).max(axis=0) for r in rows])
        with np.errstate(divide="ignore"):
            scale = np.min(size[:, :, None] / reach[:, None, :], axis=0)
        one = np.linalg.lstsq(rows[0], np.ones(len(rows[0])), rcond=None)[0]
        if np.abs(rows[0] @ one - 1.0).max() > CONSTANT or np.abs(rows[1] @ one).max() > CONSTANT:
            raise InputError(
                "`basis` must hold motions that stand still at any position, but its functions "
                "have no constant among them: add one."
            )
        still = size[0][:, None] * one[None] / scale
        return cls(basis, limits, robot.joint_names, scale, still, assumed)

    @property
    def shape(self) -> tuple[int, int]:
        """Joints and numbers of each."""
        joints, variables = self.scale.shape
        return joints, variables

    def numbers(
        self, y: Float[AnyArray, "*batch scaled"]
    ) -> Float[AnyArray, "*batch joints variables"]:
        """The numbers of trajectories from scaled ones."""
        return y.reshape((*y.shape[:-1], *self.shape)) * self._scale(y.ndim - 1)

    def scaled(
        self, x: Float[AnyArray, "*batch joints variables"]
    ) -> Float[AnyArray, "*batch scaled"]:
        """The scaled numbers of trajectories."""
        y = x / self._scale(x.ndim - 2)
        return y.reshape((*y.shape[:-2], -1))

    def _scale(self, batch: int) -> Float[np.ndarray, "*ones joints variables"]:
        return np.asarray(self.scale)[(None,) * batch]

    def grid(self, points: int) -> Grid:
        """The limits on about so many times, with the bound that certifies all times.

        Args:
            points: How many are enough for few numbers; more numbers get more.
        """
        envelope = self.basis.envelope(enough(points, self.basis))
        size, limits = _sizes(self.limits), self.limits
        orders = 4 if np.isfinite(size[3]).any() else 3
        scale = np.asarray(self.scale)
        R = [
            scale[:, None] * envelope.rows[k][None] / size[k][:, None, None] for k in range(orders)
        ]
        middle = 0.5 * (np.asarray(limits.position_min) + np.asarray(limits.position_max)) / size[0]
        c = [np.tile(middle[:, None], len(envelope.rows[0]))]
        c += [np.zeros((len(size[0]), len(envelope.rows[k]))) for k in range(1, orders)]
        ends = np.cumsum([0, *(part.shape[1] for part in c)])
        kinds = tuple(range(int(a), int(b)) for a, b in itertools.pairwise(ends))
        return Grid(
            np.concatenate(R, axis=1), np.concatenate(c, axis=1), kinds, 1 / envelope.factor
        )

    def use(self, x: Float[AnyArray, "joints variables"]) -> Float[np.ndarray, "4 joints"]:
        """Which share of each limit a motion uses at most, certified; 1 is all of it.

        Of a range it is the distance from its middle, over half of the range.
        """
        envelope, size = self.basis.envelope(enough(CERTIFIED, self.basis)), _sizes(self.limits)
        low, high = np.asarray(self.limits.position_min), np.asarray(self.limits.position_max)
        centre = np.vstack([0.5 * (low + high), np.zeros((3, len(low)))])
        x = np.asarray(x)
        return np.array(
            [
                envelope.factor * np.abs(x @ r.T - c[:, None]).max(axis=1) / s
                for r, c, s in zip(envelope.rows, centre, size, strict=True)
            ]
        )


def enough(samples: int, basis: AbstractBasis) -> int:
    """As many samples as a motion with many numbers needs to be seen like one with few.

    Args:
        samples: That are enough for few numbers.
        basis: Of the motion.
    """
    return samples * max(FEW, basis.variables) // FEW


def held_within(
    grid: Grid,
    still: Float[AnyArray, "joints variables"],
    y: Float[Array, " scaled"],
    bound: Float[Array, ""] | float,
    growth: float = 1.0,
) -> Float[Array, " scaled"]:
    """The nearest motion of the same shape that keeps |R y - c| <= bound.

    Each joint's motion is scaled about its mean, then shifted into its range.

    Args:
        grid: Rows of the limits.
        still: Scaled numbers of half of each joint's range.
        y: Scaled numbers of one trajectory.
        bound: Of the rows.
        growth: Most by which a motion may be enlarged where limits leave room; 1 for never.
    """
    motion = y.reshape(np.shape(still))
    rows = jnp.einsum("jrk,jk->jr", grid.R, motion)
    q, rest = rows[:, : grid.positions], rows[:, grid.positions :]
    peak = jnp.maximum(jnp.abs(rest).max(axis=1), 0.5 * (q.max(axis=1) - q.min(axis=1)))
    s = jnp.minimum(growth, bound / jnp.maximum(peak, 1e-12))
    centre = grid.c[:, 0]
    wanted = (1.0 - s) * q.mean(axis=1)
    low, high = centre - bound - s * q.min(axis=1), centre + bound - s * q.max(axis=1)
    shift = jnp.clip(wanted, low, jnp.maximum(low, high))
    return (s[:, None] * motion + shift[:, None] * np.asarray(still)).reshape(y.shape)


def calmed(
    grid: Grid,
    still: Float[AnyArray, "joints variables"],
    y: Float[Array, " scaled"],
    share: Float[Array, ""] | float,
) -> Float[Array, " scaled"]:
    """The same motion made smaller, each joint's about its mean position.

    Args:
        grid: Rows of the limits.
        still: Scaled numbers of half of each joint's range.
        y: Scaled numbers of one trajectory.
        share: Of its size that is left.
    """
    motion = y.reshape(np.shape(still))
    mean = jnp.einsum("jrk,jk->jr", grid.R[:, : grid.positions], motion).mean(axis=1)
    return (share * motion + (1.0 - share) * mean[:, None] * np.asarray(still)).reshape(y.shape)


def random_motion(
    grid: Grid,
    still: Float[AnyArray, "joints variables"],
    draws: Float[Array, " scaled"],
    places: Float[Array, " joints"],
    reach: float = 0.95,
    size: float = 1.0,
) -> Float[Array, " scaled"]:
    """A motion from random numbers that fills its limits, anywhere in its ranges.

    Args:
        grid: Rows of the limits, with the bound that certifies them.
        still: Scaled numbers of half of each joint's range.
        draws: Its shape.
        places: Where in the range that is left each joint moves, from 0 to 1.
        reach: Share of the limits to use.
        size: Share of that, of the motion; its place is anywhere in what is left.
    """
    motion = draws.reshape(np.shape(still))
    rows = jnp.einsum("jrk,jk->jr", grid.R, motion)
    q, rest = rows[:, : grid.positions], rows[:, grid.positions :]
    peak = jnp.maximum(jnp.abs(rest).max(axis=1), 0.5 * (q.max(axis=1) - q.min(axis=1)))
    bound = reach * grid.bound
    s = size * bound / peak
    low = grid.c[:, 0] - bound - s * q.min(axis=1)
    high = grid.c[:, 0] + bound - s * q.max(axis=1)
    shift = low + (high - low) * places
    return (s[:, None] * motion + shift[:, None] * np.asarray(still)).reshape(draws.shape)


def _sizes(limits: Limits) -> Float[np.ndarray, "4 joints"]:
    """Half ranges, speeds, accelerations and jerks."""
    half = 0.5 * (np.asarray(limits.position_max) - np.asarray(limits.position_min))
    return np.array([half, limits.velocity, limits.acceleration, limits.jerk], np.float64)
