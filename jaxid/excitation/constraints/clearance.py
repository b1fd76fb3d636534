"""No collisions: a least distance between the surfaces of what may not touch."""

import math

import equinox as eqx

from jaxid.arrays import Array, Float
from jaxid.dynamics.machine import on_samples
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.constraint import AbstractConstraint, Entry
from jaxid.robot.collision import CollisionModel
from jaxid.robot.robot import Robot

SIZE = 0.1
"""Length that a value of 1 stands for [m]."""


class _Axes(eqx.Module):
    """Robot and shapes, as what compiles programs needs them."""

    robot: Robot
    model: CollisionModel

    def axes(self, q) -> Float[Array, "capsules 2 3"]:
        """Ends of the capsules' axes at one pose."""
        return self.model.ends(self.robot, q)


class Clearance(AbstractConstraint):
    """Keeps every pair of shapes at least a distance apart.

    Values count in units of 0.1 m: two shapes that overlap by 0.17 m where 0.03 m are asked give 2.

    Attributes:
        model: Shapes and pairs.
        distance: Least distance between surfaces [m].
    """

    model: CollisionModel
    distance: float = 0.03

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """What each pair lacks of the distance."""
        placed = _Axes(robot, self.model)
        ends = on_samples(placed, placed.axes, motion.q)
        return (self.distance - self.model.clearances(ends)) / SIZE

    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """The pairs."""
        return tuple(
            Entry(f"the clearance of {name}", SIZE, "m", self.distance, least=True)
            for name in self.model.pair_names
        )

    def used(self, entry: Entry, value: float) -> float:
        """The least distance over the clearance that is left."""
        left = self.distance - value * SIZE
        return self.distance / left if left > 0 else math.inf
