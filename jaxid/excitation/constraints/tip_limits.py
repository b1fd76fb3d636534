"""Limits of the end-effector: speed, acceleration, and a box."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Vector3, as_array
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.program.sample_methods import on_samples
from jaxid.robot.forward_kinematics import tip_placement
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import Vectors

from .clearance import SIZE
from .constraint import AbstractConstraint, Finding

SMOOTHING = 1e-6
"""Value of a rate over its limit at standstill, where it is made smooth."""


def tip_motion(robot: Robot, motion: Motion) -> tuple[Vectors, ...]:
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
    coordinate: float  # its coordinate along the axis [m]


def _corner(x: Any):
    return np.asarray(as_array("workspace", x), np.float64)


class TipLimits(AbstractConstraint):
    """Limits of the end-effector: speed, acceleration, and a box parallel to the axes.

    Excess over a side of the box counts in units of 0.1 m.

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
    low: Vector3 = eqx.field(converter=_corner, default=(-math.inf,) * 3)
    high: Vector3 = eqx.field(converter=_corner, default=(math.inf,) * 3)

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

    def __call__(self, robot, motion):
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
            excess = side.sign * (position[..., side.axis] - side.coordinate)
            values.append(excess / SIZE)
        return jnp.stack(values, axis=-1)

    def entries(self, robot):
        """Return the quantities that have a limit."""
        entries = []
        for name, limit, unit in (
            ("speed", self.speed, "m/s"),
            ("acceleration", self.acceleration, "m/s²"),
        ):
            if math.isfinite(limit):
                quantity = f"the {name} of the end-effector"
                entries.append(Finding(quantity, limit, unit, limit))
        for axis, sign, coordinate in self._sides:
            name = f"{'xyz'[axis]} of the end-effector"
            is_lower_limit = sign < 0
            entries.append(
                Finding(name, SIZE, "m", coordinate, is_lower_limit, has_use=False)
            )
        return tuple(entries)

    @property
    def _sides(self):
        """Sides of the box that are not open."""
        sides = [Side(axis, 1.0, end) for axis, end in enumerate(self.high.tolist())]
        sides += [Side(axis, -1.0, end) for axis, end in enumerate(self.low.tolist())]
        return [side for side in sides if math.isfinite(side.coordinate)]
