"""Distances that shapes keep while the robot moves."""

import functools
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Float
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.sample_methods import on_samples
from jaxid.robot.collision import CollisionModel
from jaxid.robot.robot import Robot

from .constraint import AbstractConstraint, Finding

SIZE = 0.1
"""Missing distance that counts as one [m]."""


class Clearance(AbstractConstraint):
    """Least distance between the surfaces of shapes that must not collide.

    Values count in units of 0.1 m: two shapes that overlap by 0.17 m where 0.03 m are
    required give 2.

    Attributes:
        model: Shapes and pairs.
        distance: Least distance between surfaces [m]; half of the largest one of two
            bodies that are nearer in every pose.
    """

    model: CollisionModel
    distance: float = 0.03

    @property
    def distances(self) -> Float[np.ndarray, " pairs"]:
        """Least distance of each pair [m]."""
        return np.minimum(self.distance, 0.5 * np.array(self.model.room))

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the missing distance of each pair."""
        ends = eqx.Partial(self.model.ends, robot)
        gaps = self.model.clearances(on_samples(ends, ends.__call__, motion.q))
        return (jnp.broadcast_to(self.distances, gaps.shape) - gaps) / SIZE

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the pairs."""

        def entry(name: str, distance: float) -> Finding:
            usage = functools.partial(used_fraction, distance)
            quantity = f"the clearance of {name}"
            return Finding(quantity, SIZE, "m", distance, True, usage=usage)

        return tuple(map(entry, self.model.pair_names, self.distances.tolist()))


def used_fraction(distance: float, value: float) -> float:
    """Return the required distance over the present one; infinite at contact."""
    gap = distance - SIZE * value
    return distance / gap if gap > 0 else math.inf
