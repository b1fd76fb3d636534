"""What a trajectory is: a motion that is known for every time."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Hashable, require_float64
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError


class AbstractTrajectory(Hashable):
    """A motion of all joints as a function of time, with exact derivatives."""

    @property
    @abstractmethod
    def duration(self) -> Float[AnyArray, ""] | float:
        """From its start at time zero to its end [s]; of what repeats, one period."""

    @abstractmethod
    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many.

        Args:
            t: Times [s].
        """

    @property
    def joints(self) -> int:
        """Number of joints."""
        return jax.eval_shape(lambda: self.motion(0.0)).q.shape[-1]

    def jerk(self, t: Float[AnyArray, "*batch"] | float | int) -> Float[Array, "*batch joints"]:
        """The rate of the accelerations at one time or at many [rad/s³ or m/s³].

        Args:
            t: Times [s].
        """
        return _jerk(self, jnp.asarray(t, float))

    def sample_times(self, sample_time: float) -> Float[np.ndarray, " samples"]:
        """Times from the start to the end, both included, at most `sample_time` apart [s].

        Args:
            sample_time: Largest time between two samples [s].

        Raises:
            InputError: If `sample_time` is not positive.
        """
        if not 0 < sample_time < np.inf:
            raise InputError(f"`sample_time` must be positive [s], but is {sample_time:g}.")
        duration = float(self.duration)
        # A duration that rounding has left a little longer needs no further sample.
        steps = max(int(np.ceil(duration / sample_time * (1 - 1e-9))), 1)
        return np.linspace(0.0, duration, steps + 1)

    def sample(self, sample_time: float) -> tuple[Float[np.ndarray, " samples"], Motion]:
        """Times [s] and the motion at them, from the start to the end.

        Args:
            sample_time: Largest time between two samples [s].

        Raises:
            InputError: If `sample_time` is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("sampling a trajectory")
        times = self.sample_times(sample_time)
        motion = self.motion(times)
        return times, Motion(*(np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)))


def each_time(
    at: Callable[[Float[Array, ""]], Motion], t: Float[AnyArray, "*batch"] | float | int
) -> Motion:
    """Applies what gives the motion at one time to any shape of times.

    Args:
        at: The motion at a time: a method of the trajectory.
        t: Times [s].
    """
    times = jnp.asarray(t, float)
    flat = _each(at, times.reshape(-1))
    return jax.tree.map(lambda x: x.reshape(*times.shape, x.shape[-1]), flat)


# Compiled once for each kind of trajectory, since methods of modules are PyTrees.
@eqx.filter_jit
def _each(at: Callable[[Float[Array, ""]], Motion], times: Float[Array, " samples"]) -> Motion:
    return jax.vmap(at)(times)


@eqx.filter_jit
def _jerk(trajectory: AbstractTrajectory, times: Float[Array, "*batch"]) -> Array:
    return jax.jvp(lambda t: trajectory.motion(t).qdd, (times,), (jnp.ones_like(times),))[1]
