"""Limits of the end-effector: its speed, its acceleration, and the box that it must not leave."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Numbers
from jaxid.dynamics.machine import on_samples
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints.constraint import AbstractConstraint, Entry
from jaxid.robot.kinematics import tip_placement
from jaxid.robot.robot import Robot

STILL = 1e-6
"""Share of a limit by which a length is rounded up, so that it is smooth at zero."""
OPEN = "the other side is open"
"""What is said of a box's side that has none opposite."""


class TipMotion(NamedTuple):
    """Where the end-effector is and how it moves, in the frame of the ground.

    Attributes:
        position: Of its origin [m].
        velocity: Of its origin [m/s].
        acceleration: Of its origin, without gravity [m/s²].
    """

    position: Float[Array, "*batch 3"]
    velocity: Float[Array, "*batch 3"]
    acceleration: Float[Array, "*batch 3"]


class _Tip(eqx.Module):
    """The robot, as what compiles programs needs it."""

    robot: Robot

    def states(self, q, qd, qdd) -> Float[Array, "3 3"]:
        """Position, velocity and acceleration of one sample."""

        def place(angles):
            return tip_placement(self.robot, angles)[1]

        def speed(angles, rates):
            return jax.jvp(place, (angles,), (rates,))[1]

        velocity, acceleration = jax.jvp(speed, (q, qd), (qd, qdd))
        return jnp.stack([place(q), velocity, acceleration])


def tip_motion(robot: Robot, motion: Motion) -> TipMotion:
    """The motion of the end-effector's origin, in the frame of the ground.

    Args:
        robot: Whose end-effector it is.
        motion: Joint motion with any leading axes.
    """
    tip = _Tip(robot)
    states = on_samples(tip, tip.states, motion.q, motion.qd, motion.qdd)
    return TipMotion(states[..., 0, :], states[..., 1, :], states[..., 2, :])


class TipSpeed(AbstractConstraint):
    """Keeps the speed of the end-effector below a limit.

    Attributes:
        limit: Largest speed [m/s].
    """

    limit: float

    def __check_init__(self):
        _require_positive("TipSpeed", self.limit, "m/s")

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Relative excess of the speed."""
        return _length(tip_motion(robot, motion).velocity / self.limit)[..., None] - 1.0

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """One value."""
        return (Entry("the speed of the end-effector", self.limit, "m/s", self.limit),)


class TipAcceleration(AbstractConstraint):
    """Keeps the acceleration of the end-effector below a limit.

    Attributes:
        limit: Largest acceleration [m/s²].
    """

    limit: float

    def __check_init__(self):
        _require_positive("TipAcceleration", self.limit, "m/s²")

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Relative excess of the acceleration."""
        return _length(tip_motion(robot, motion).acceleration / self.limit)[..., None] - 1.0

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """One value."""
        return (Entry("the acceleration of the end-effector", self.limit, "m/s²", self.limit),)


class Workspace(AbstractConstraint):
    """Keeps the end-effector's origin in a box whose edges are parallel to the ground's axes.

    Values count in half edges of the box; a side at infinity is open, and then the other one counts
    in metres.

    Attributes:
        low: Smallest coordinates [m].
        high: Largest coordinates [m].
    """

    low: Float[AnyArray, "3"]
    high: Float[AnyArray, "3"]

    @classmethod
    def of(cls, low: Numbers, high: Numbers) -> "Workspace":
        """Builds a box and checks it.

        Args:
            low: Smallest coordinates [m]; minus infinity where it is open.
            high: Largest coordinates [m]; infinity where it is open.

        Raises:
            InputError: If these are no corners of a box, or no side has an end.
        """
        corners = np.array(low, np.float64), np.array(high, np.float64)
        if any(x.shape != (3,) or np.isnan(x).any() for x in corners):
            raise InputError("`low` and `high` of a workspace must hold three numbers each [m].")
        if (corners[0] >= corners[1]).any():
            raise InputError(f"`low` {low} of a workspace must be below `high` {high} [m].")
        if not np.isfinite(corners).any():
            raise InputError("a workspace must have an end on some side, but is all of space.")
        return cls(*corners)

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Excess over each side that has an end."""
        p = tip_motion(robot, motion).position
        sides, ends, sizes = self._sides()
        along = jnp.stack([p[..., axis] * sign for axis, sign in sides], axis=-1)
        return (along - jnp.broadcast_to(ends, along.shape)) / jnp.broadcast_to(sizes, along.shape)

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """The sides that have an end."""
        sides, ends, sizes = self._sides()
        return tuple(
            Entry(
                f"{'xyz'[axis]} of the end-effector",
                float(size),
                "m",
                float(sign * end),
                least=sign < 0,
                note="" if np.isfinite(self.low[axis] + self.high[axis]) else OPEN,
            )
            for (axis, sign), end, size in zip(sides, ends, sizes, strict=True)
        )

    def used(self, entry: Entry, value: float) -> float:
        """The distance from the box's middle over half of its edge; nothing where it is open."""
        return math.nan if entry.note else 1.0 + value

    def _sides(self) -> tuple[list[tuple[int, float]], np.ndarray, np.ndarray]:
        low, high = np.asarray(self.low), np.asarray(self.high)
        half = np.where(np.isfinite(high - low), 0.5 * (high - low), 1.0)
        found = [
            ((axis, sign), end, half[axis])
            for axis in range(3)
            for sign, end in ((1.0, high[axis]), (-1.0, -low[axis]))
            if np.isfinite(end)
        ]
        sides, ends, sizes = zip(*found, strict=True)
        return list(sides), np.array(ends), np.array(sizes)


def _length(vector: Array) -> Array:
    """Length of vectors, smooth at zero and there at most `STILL` too large."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + STILL**2)


def _require_positive(what: str, limit: float, unit: str) -> None:
    if not 0 < limit < np.inf:
        raise InputError(f"`limit` of `{what}` must be positive [{unit}], but is {limit:g}.")
