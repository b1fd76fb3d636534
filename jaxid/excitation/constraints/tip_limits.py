"""Limits of the end-effector: speed, acceleration, and a box."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, as_array
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.sample_methods import on_samples
from jaxid.errors import InputError
from jaxid.robot.forward_kinematics import tip_placement
from jaxid.robot.robot import Robot

from .constraint import AbstractConstraint, Finding

SMOOTHING = 1e-6
"""Value of a rate over its limit at standstill, where it is made smooth."""


def tip_motion(robot: Robot, motion: Motion) -> tuple[Float[AnyArray, "*batch 3"], ...]:
    """Return position, velocity and acceleration of the end-effector's origin [m, s].

    They are those in the frame of the ground, without gravity.

    Args:
        robot: Robot that moves.
        motion: Joint motion with any leading axes.
    """

    def place(q):
        return tip_placement(robot, q)[1]

    def speed(q, qd):
        return jax.jvp(place, (q,), (qd,))[1]

    def tip(q, qd, qdd):
        velocity, acceleration = jax.jvp(speed, (q, qd), (qd, qdd))
        return jnp.stack([place(q), velocity, acceleration])

    states = on_samples(robot, tip, motion.q, motion.qd, motion.qdd)
    return tuple(states[..., order, :] for order in range(3))


class Side(NamedTuple):
    """A side of the box that is not open."""

    axis: int  # axis to which it is perpendicular
    sign: float  # 1 where coordinates must not be larger, -1 where not smaller
    end: float  # its coordinate times the sign [m]
    size: float  # half of the box's edge; 1 where the opposite side is open [m]


def _corner(x: Any) -> np.ndarray:
    return np.asarray(as_array("workspace", x), np.float64)


class TipLimits(AbstractConstraint):
    """Limits of the end-effector: speed, acceleration, and a box parallel to the axes.

    Values of the box count in half of its edges, or in metres where the opposite side
    is open.

    Attributes:
        speed: Largest speed; infinity for none [m/s].
        acceleration: Largest acceleration; infinity for none [m/s²].
        low: Smallest coordinates of the origin; minus infinity where the box is open
            [m].
        high: Largest coordinates; infinity where the box is open [m].

    Raises:
        InputError: If a limit is not positive, or `low` and `high` are no corners of a
            box.
    """

    speed: float = math.inf
    acceleration: float = math.inf
    low: Float[AnyArray, "3"] = eqx.field(converter=_corner, default=(-math.inf,) * 3)
    high: Float[AnyArray, "3"] = eqx.field(converter=_corner, default=(math.inf,) * 3)

    def __check_init__(self):
        if not (self.speed > 0 and self.acceleration > 0):
            raise InputError(
                "`speed` [m/s] and `acceleration` [m/s²] must be positive, but are "
                f"{self.speed:g} and {self.acceleration:g}."
            )
        are_points = self.low.shape == self.high.shape == (3,)
        if not are_points or not (self.low < self.high).all():
            raise InputError(
                "`low` and `high` must hold three numbers each, and `low` the smaller "
                f"ones, but are {self.low} and {self.high} [m]."
            )

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess over each limit."""
        position, velocity, acceleration = tip_motion(robot, motion)
        values = []
        for vector, limit in (
            (velocity, self.speed),
            (acceleration, self.acceleration),
        ):
            if math.isfinite(limit):
                square = jnp.sum((vector / limit) ** 2, axis=-1)
                values.append(jnp.sqrt(square + SMOOTHING**2) - 1.0)
        for side in self._sides:
            coordinate = side.sign * position[..., side.axis]
            values.append((coordinate - side.end) / side.size)
        return jnp.stack(values, axis=-1)

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the quantities that have a limit."""
        entries = []
        for name, limit, unit in (
            ("speed", self.speed, "m/s"),
            ("acceleration", self.acceleration, "m/s²"),
        ):
            if math.isfinite(limit):
                quantity = f"the {name} of the end-effector"
                entries.append(Finding(quantity, limit, unit, limit))
        for axis, sign, end, size in self._sides:
            quantity = f"{'xyz'[axis]} of the end-effector"
            entry = Finding(quantity, size, "m", sign * end, sign < 0)
            if not np.isfinite(self.low[axis] + self.high[axis]):
                note = "the other side is open"
                entry = entry._replace(note=note, usage=lambda value: math.nan)
            entries.append(entry)
        return tuple(entries)

    @property
    def _sides(self) -> list[Side]:
        """Sides of the box that are not open."""
        half_edges = 0.5 * (self.high - self.low)
        sizes = np.where(np.isfinite(half_edges), half_edges, 1.0)
        sides = []
        for axis, size in enumerate(sizes.tolist()):
            for sign, corner in ((1.0, self.high), (-1.0, self.low)):
                if np.isfinite(corner[axis]):
                    end = sign * float(corner[axis])
                    sides.append(Side(axis, sign, end, size))
        return sides
