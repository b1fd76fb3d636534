"""Trajectories: motions of all joints as functions of time, with exact derivatives."""

import itertools
import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Hashable, is_traced, namespace, require_float64
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError


def as_scalar(value: Any) -> Any:
    """Return one number as an array, so that compiled functions do not depend on its value."""
    return value if isinstance(value, jax.Array) else np.array(value, np.float64)


class AbstractTrajectory(Hashable):
    """A motion of all joints as a function of time, with exact derivatives."""

    @property
    @abstractmethod
    def duration(self) -> Float[AnyArray, ""] | float:
        """Time from the start at zero to the end [s]; one period of a periodic motion."""

    @abstractmethod
    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """Return the motion at one time or at many.

        Args:
            t: Times [s].
        """

    @property
    def joints(self) -> int:
        """Number of joints."""
        return jax.eval_shape(lambda: self.motion(0.0)).q.shape[-1]

    def jerk(self, t: Float[AnyArray, "*batch"] | float | int) -> Float[Array, "*batch joints"]:
        """Return the rate of change of the accelerations [rad/s³ or m/s³].

        Args:
            t: Times [s].
        """
        return _jerk(self, jnp.asarray(t, float))

    def sample_times(self, sample_time: float) -> Float[np.ndarray, " samples"]:
        """Return times from the start to the end, both included, at most `sample_time` apart [s].

        Args:
            sample_time: Largest time between two samples [s].

        Raises:
            InputError: If `sample_time` is not positive.
        """
        if not 0 < sample_time < np.inf:
            raise InputError(f"`sample_time` must be positive [s], but is {sample_time:g}.")
        duration = float(self.duration)
        # Rounding may make a duration slightly longer: that needs no further sample.
        steps = max(math.ceil(duration / sample_time * (1 - 1e-9)), 1)
        return np.linspace(0.0, duration, steps + 1)

    def sample(self, sample_time: float) -> tuple[Float[np.ndarray, " samples"], Motion]:
        """Return times [s] from the start to the end and the motion at them.

        Args:
            sample_time: Largest time between two samples [s].

        Raises:
            InputError: If `sample_time` is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("sampling a trajectory")
        times = self.sample_times(sample_time)
        return times, jax.tree.map(np.asarray, self.motion(times))


@eqx.filter_jit
def _jerk(trajectory: AbstractTrajectory, times: Float[Array, "*batch"]) -> Array:
    return jax.jvp(lambda t: trajectory.motion(t).qdd, (times,), (jnp.ones_like(times),))[1]


class PiecewisePolynomial(AbstractTrajectory):
    """Polynomials of time that follow one another; standstill before the start and after the end.

    Attributes:
        times: Start of each polynomial, and the end of the last one [s].
        coefficients: Coefficients of the powers of the time since a polynomial's start, highest
            power first.
    """

    times: Float[AnyArray, " knots"]
    coefficients: Float[AnyArray, "powers pieces joints"]

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Time of the end [s]."""
        return self.times[-1]

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """Return the motion at one time or at many [s]."""
        return _polynomial_motion(self.times, self.coefficients, jnp.asarray(t, float))


@eqx.filter_jit
def _polynomial_motion(times: AnyArray, coefficients: AnyArray, t: Array) -> Motion:
    derivatives = evaluate_polynomials(times, coefficients, t.reshape(-1))[:3]
    return Motion(*(x.reshape(*t.shape, -1) for x in derivatives))


def evaluate_polynomials(
    times: Float[AnyArray, " knots"],
    coefficients: Float[AnyArray, "powers pieces columns"],
    t: Float[AnyArray, " samples"],
) -> Float[AnyArray, "4 samples columns"]:
    """Return piecewise polynomials and their first three derivatives, constant outside their times.

    Args:
        times: Start of each piece, and the end of the last one [s].
        coefficients: Coefficients of the powers of the time since a piece's start, highest first.
        t: Times [s].
    """
    xp = namespace(times, coefficients, t)
    times, coefficients, t = (xp.asarray(x) for x in (times, coefficients, t))
    # Written with `where`, because the derivative of `clip` at its ends is one half.
    clipped = xp.where(t < times[0], times[0], xp.where(t > times[-1], times[-1], t))
    piece = xp.clip(xp.searchsorted(times, clipped, side="right") - 1, 0, len(times) - 2)
    x = (clipped - times[piece])[:, None]
    c = coefficients[:, piece]
    value, first, second, third = c[0], *(xp.zeros_like(c[0]) for _ in range(3))
    for coefficient in c[1:]:
        third = third * x + 3 * second
        second = second * x + 2 * first
        first = first * x + value
        value = value * x + coefficient
    inside = ((t >= times[0]) & (t <= times[-1]))[:, None]
    return xp.stack([value, *(xp.where(inside, d, 0.0) for d in (first, second, third))])


class Segments(AbstractTrajectory):
    """Trajectories that follow one another without a pause.

    Before the start the motion is that of the first member, after the end that of the last one.

    Attributes:
        members: Trajectories in the order in which they are run.
        largest_jump: Largest jump of coordinates, velocities or accelerations where two members
            meet, in the joint's unit and its rates [rad or m, per s, per s²].

    Raises:
        InputError: If there is no member, or one does not start as the one before it ends.
    """

    members: tuple[AbstractTrajectory, ...] = eqx.field(converter=tuple)
    largest_jump: float = eqx.field(static=True, default=1e-6)

    def __check_init__(self):
        if not self.members:
            raise InputError("`members` must hold at least one trajectory, but is empty.")
        if is_traced(self.members):
            return
        for k, (before, after) in enumerate(itertools.pairwise(self.members), 1):
            end, start = before.motion(before.duration), after.motion(0.0)
            if end.joints != start.joints:
                raise InputError(
                    f"`members` {k} and {k + 1} must move the same joints, but have "
                    f"{end.joints} and {start.joints}."
                )
            self._refuse_jumps(k, end, start)

    def _refuse_jumps(self, k: int, end: Motion, start: Motion) -> None:
        for name, x, y in (
            ("coordinate", end.q, start.q),
            ("velocity", end.qd, start.qd),
            ("acceleration", end.qdd, start.qdd),
        ):
            jump = np.abs(np.asarray(y) - np.asarray(x))
            if jump.max() > self.largest_jump:
                raise InputError(
                    f"the {name} of joint {int(jump.argmax()) + 1} jumps by {jump.max():.3g} "
                    f"between `members` {k} and {k + 1}: start the second as the first ends, put "
                    "a spline between them, or raise `largest_jump`."
                )

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Total time of all members [s]."""
        return sum(member.duration for member in self.members)

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """Return the motion at one time or at many [s]."""
        return _segment_motion(self.members, jnp.asarray(t, float))


@eqx.filter_jit
def _segment_motion(members: tuple[AbstractTrajectory, ...], t: Array) -> Motion:
    begin, motion = 0.0, members[0].motion(t)
    for before, member in itertools.pairwise(members):
        begin = begin + before.duration
        later = (t >= begin)[..., None]
        motion = jax.tree.map(
            lambda x, y, later=later: jnp.where(later, y, x), motion, member.motion(t - begin)
        )
    return motion


class PaddedToCycle(AbstractTrajectory):
    """A motion that ends at rest, padded with its final pose to a whole number of cycles.

    Attributes:
        inner: The motion.
        sample_time: Cycle of the controller [s].
    """

    inner: AbstractTrajectory
    sample_time: float = eqx.field(static=True)

    @property
    def duration(self) -> float:
        """First whole number of cycles in which the motion has ended [s]."""
        return count_cycles(float(self.inner.duration), self.sample_time) * self.sample_time

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """Return the motion, and its final pose after its end."""
        return self.inner.motion(jnp.minimum(jnp.asarray(t, float), self.inner.duration))


def count_cycles(duration: float, sample_time: float, tolerance: float = 1e-6) -> int:
    """Return the number of a controller's cycles after which a motion has ended.

    Args:
        duration: Duration of the motion [s].
        sample_time: Cycle of the controller [s].
        tolerance: Fraction of a cycle that a motion may end later, for rounding.
    """
    return max(math.ceil(duration / sample_time - tolerance), 1)
