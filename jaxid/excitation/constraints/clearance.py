"""Distances that shapes keep while the robot moves."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Vector
from jaxid.program.sample_methods import evaluate_samples
from jaxid.robot.collision import CollisionModel
from jaxid.robot.robot import Robot

from .constraint import (
    AbstractConstraint,
    Finding,
    in_blocks,
    pull_back_samples,
)

SIZE = 0.1
"""Missing distance that counts as one [m]."""


class Clearance(AbstractConstraint):
    """Least distance between the surfaces of shapes that must not collide.

    Values count in units of 0.1 m: two shapes that overlap by 0.17 m where 0.03 m are
    required give 2.

    Attributes:
        model: Shapes and pairs.
        distance: Least distance between surfaces, of all pairs or of each [m]; half of
            the largest one of two bodies that are nearer in every pose.
    """

    model: CollisionModel
    distance: float | Vector = 0.03

    @property
    def distances(self) -> Vector:
        """Least distance of each pair [m]."""
        return np.minimum(self.distance, 0.5 * np.array(self.model.room))

    def __call__(self, robot, motion):
        """Return the missing distance of each pair."""
        ends = self._ends(robot, motion.q)
        if not isinstance(ends, np.ndarray):
            gaps = self.model.clearances(ends)
            return (jnp.broadcast_to(self.distances, gaps.shape) - gaps) / SIZE

        def gaps_of_pairs(ends):
            return (self.model.gaps(ends),)

        *batch, capsules, _, _ = ends.shape
        samples = ends.reshape(-1, capsules, 2, 3)
        (pair_gaps,) = in_blocks(gaps_of_pairs, samples)
        gaps = self.model.least_of_groups(pair_gaps)
        return (self.distances - gaps.reshape(*batch, -1)) / SIZE

    def _ends(self, robot: Robot, q: AnyArray):
        """Return the ends of all capsules' axes."""
        ends = eqx.Partial(self.model.ends, robot)
        return evaluate_samples(ends, ends.__call__, q)

    def linearisation(self, robot):
        """Return a function of missing distances and their derivatives.

        Only the distances between given ends are compiled, once for equal shapes.
        """
        ends = eqx.Partial(self.model.ends, robot)

        def linearise(motion, entries):
            arrays = (self._ends(robot, motion.q), entries)
            gaps, end_slopes = in_blocks(self.model.linearised_clearances, *arrays)
            weights = -end_slopes / SIZE
            motion_slopes = pull_back_samples(ends, ends.__call__, weights, motion.q)
            return (self.distances[entries] - gaps) / SIZE, motion_slopes

        return linearise

    def entries(self, robot):
        """Return a finding for each pair of shapes, still without a value."""
        pairs = zip(self.model.pair_names, self.distances.tolist(), strict=True)
        return tuple(
            Finding(
                name=f"the clearance of {name}",
                size=SIZE,
                unit="m",
                limit=distance,
                is_lower_limit=True,
            )
            for name, distance in pairs
        )
