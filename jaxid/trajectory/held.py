"""A motion that waits at its end, so that it lasts a whole number of a controller's cycles."""

import math

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.trajectory import AbstractTrajectory

ROUNDING = 1e-6
"""Share of a cycle by which a duration may miss a whole number of them."""


class Held(AbstractTrajectory):
    """A motion that ends at rest, and then its last pose until a cycle is over.

    Attributes:
        inner: The motion.
        sample_time: Of a cycle [s].
    """

    inner: AbstractTrajectory
    sample_time: float = eqx.field(static=True)

    @property
    def duration(self) -> float:
        """The first whole number of cycles in which the motion has ended [s]."""
        return cycles(float(self.inner.duration), self.sample_time) * self.sample_time

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion, and its last pose after its end."""
        return self.inner.motion(jnp.minimum(jnp.asarray(t, float), self.inner.duration))


def cycles(duration: float, sample_time: float) -> int:
    """Cycles after which a motion has ended.

    Args:
        duration: Of the motion [s].
        sample_time: Of a cycle [s].
    """
    return max(math.ceil(duration / sample_time - ROUNDING), 1)
