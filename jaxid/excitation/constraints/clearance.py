"""Distances that shapes keep while the robot moves."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.sample_methods import on_samples
from jaxid.robot.collision import CollisionModel

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
    def distances(self) -> np.ndarray:
        """Least distance of each pair [m]."""
        return np.minimum(self.distance, 0.5 * np.array(self.model.room))

    def __call__(self, robot, motion):
        """Return the missing distance of each pair."""
        ends = eqx.Partial(self.model.ends, robot)
        gaps = self.model.clearances(on_samples(ends, ends.__call__, motion.q))
        return (jnp.broadcast_to(self.distances, gaps.shape) - gaps) / SIZE

    def entries(self, robot):
        """Return the pairs."""
        pairs = zip(self.model.pair_names, self.distances.tolist(), strict=True)
        return tuple(
            Finding(f"the clearance of {name}", SIZE, "m", distance, True)
            for name, distance in pairs
        )
