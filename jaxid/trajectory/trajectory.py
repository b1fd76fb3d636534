"""Trajectories: motions of all joints as functions of time, and their bases.

In a family each joint's motion is a basis of functions times the joint's coefficients.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Float,
    Hashable,
    Vector,
    namespace,
    require_float64,
)
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

SHIFTS = 40
"""Times of a period at which a periodic motion may begin."""
RETIMING_TOLERANCE = 1e-9
"""Relative error up to which a retimed motion is one of the family."""

Time = Float[AnyArray, ""] | float
"""One time [s]."""
Times = Float[AnyArray, " samples"]
"""Times of samples [s]."""
Rows = Float[AnyArray, "4 samples variables"]
"""Position, velocity, acceleration and jerk of each function of a basis."""
Coefficients = Float[AnyArray, "joints variables"]
"""Coefficients of a trajectory, one row for each joint."""
States = tuple[Float[AnyArray, "samples joints"], ...]
"""Positions, velocities and accelerations."""


def as_scalar(value: Any) -> Any:
    """Return a number as an array: compiled functions are the same for all values."""
    return value if isinstance(value, jax.Array) else np.array(value, np.float64)


class AbstractTrajectory(Hashable):
    """A motion of all joints as a function of time, with exact derivatives."""

    @property
    @abstractmethod
    def duration(self) -> Time:
        """Time from the start to the end, or period of a periodic motion [s]."""

    @abstractmethod
    def states(self, t: Times) -> States:
        """Return positions, velocities and accelerations at times [s], under `jit`."""

    def motion(self, t: AnyArray | float | int) -> Motion:
        """Return the motion at one time or at many [s]."""
        return _motion(self, jnp.asarray(t, float))

    def measured_times(self, samples: int) -> Times:
        """Return equidistant times at which a run is measured [s]."""
        return np.arange(samples) * (float(self.duration) / samples)

    def columns(self, t: AnyArray) -> dict[str, AnyArray]:
        """Return what a table says beside the motion, by name, at times [s]."""
        return {}

    def feed_forward(self, t: AnyArray) -> AnyArray | None:
        """Return forces that a controller may add, at times [s]; None if unknown."""
        return None

    @property
    def joints(self) -> int:
        """Number of joints."""
        return jax.eval_shape(lambda: self.motion(0.0)).q.shape[-1]

    def sample(self, sample_time: float) -> tuple[Vector, Motion]:
        """Return times from the start to the end [s], and the motion at them.

        Args:
            sample_time: Largest time between two samples [s].

        Raises:
            InputError: If `sample_time` is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("sampling a trajectory")
        if not 0 < sample_time < np.inf:
            raise InputError(
                f"`sample_time` must be positive [s], but is {sample_time:g}."
            )
        duration = float(self.duration)
        # Rounding may make a duration slightly longer: that needs no further sample.
        steps = max(math.ceil(duration / sample_time * (1 - 1e-9)), 1)
        times = np.linspace(0.0, duration, steps + 1)
        return times, jax.tree.map(np.asarray, self.motion(times))


@eqx.filter_jit
def _motion(trajectory: AbstractTrajectory, t: Array):
    states = trajectory.states(t.reshape(-1))
    return Motion(*(x.reshape(*t.shape, -1) for x in states))


class PaddedToCycle(AbstractTrajectory):
    """A motion that is padded with its final pose to a whole number of cycles.

    Attributes:
        inner: The motion.
        sample_time: Cycle of the controller [s].
    """

    inner: AbstractTrajectory
    sample_time: float = eqx.field(static=True)

    @property
    def duration(self) -> float:
        """First whole number of cycles in which the motion has ended [s]."""
        cycles = count_cycles(float(self.inner.duration), self.sample_time)
        return cycles * self.sample_time

    def states(self, t):
        """Return the motion, and its final pose after its end."""
        return self.inner.states(jnp.minimum(t, self.inner.duration))

    def columns(self, t):
        """Return the columns of the motion."""
        return self.inner.columns(t)

    def feed_forward(self, t):
        """Return the forces of the motion."""
        return self.inner.feed_forward(t)


def count_cycles(duration: float, sample_time: float) -> int:
    """Return the number of a controller's cycles in which a motion ends."""
    # A motion may end a millionth of a cycle later, for rounding.
    return max(math.ceil(duration / sample_time - 1e-6), 1)


Envelope = tuple[tuple[Float[np.ndarray, "rows variables"], ...], float]
"""Rows for each order of derivative, and a factor; see `AbstractBasis`."""


class AbstractBasis(eqx.Module):
    """A family of trajectories: functions of time that are the same for all joints.

    The coefficients of a trajectory are a matrix x [joints, variables]. Limits of
    position, velocity, acceleration and jerk are linear in them.

    Attributes:
        duration: Time from the start of the motion to its end; the period of a periodic
            one [s].
    """

    if TYPE_CHECKING:

        @property
        def duration(self) -> Any:
            """Duration [s]: a field or a property of each basis."""
    else:
        duration: eqx.AbstractVar[float]

    @abstractmethod
    def rows(self, t: Times) -> Rows:
        """Return every function and its three derivatives at times [s].

        Times in NumPy give rows in NumPy.
        """

    @abstractmethod
    def envelope(self, points: int) -> Envelope:
        """Return rows whose largest value bounds the motion, and their factor.

        For coefficients x of a joint, |f(t) - c| <= factor * max |rows[k] @ x - c| at
        every time t, where f is the derivative of order k (from 0 to 3) of the joint's
        motion and c any constant.

        Args:
            points: Approximate number of rows for each order; more rows give tighter
                bounds.
        """

    def trajectory(self, x: Coefficients) -> "LinearTrajectory":
        """Return the trajectory with these coefficients, one row for each joint."""
        return LinearTrajectory(self, x)

    @property
    def variables(self) -> int:
        """Number of coefficients of each joint."""
        return self.rows(np.zeros(1)).shape[2]

    def times(self, samples: int) -> Times:
        """Return equidistant times at which a run is measured [s]."""
        return np.arange(samples) * (float(self.duration) / samples)

    def instants(self, points: int) -> Times:
        """Return equidistant times over the whole motion, for constraints [s]."""
        return self.times(points)

    def retimings(self) -> np.ndarray:
        """Return maps to coefficients of the same motion, begun later or reversed.

        Only maps that stay in the family are returned: a periodic motion may begin at
        any of 40 times, a motion between standstills may run backwards. The first map
        changes nothing. All of them keep the limits of the joint.
        """
        # So many equidistant times determine the coefficients, and shifts hit them.
        samples_per_shift = math.ceil(4 * self.variables / SHIFTS)
        samples = SHIFTS * samples_per_shift
        step = float(self.duration) / samples
        times = (np.arange(samples) + 0.5) * step
        positions, *_ = self.rows(times)
        rows = np.asarray(positions)
        inverse = np.linalg.pinv(rows)
        tolerance = RETIMING_TOLERANCE * np.abs(rows).max()

        maps = []
        for direction in (rows, rows[::-1]):
            for shift in range(SHIFTS):
                retimed_rows = np.roll(direction, shift * samples_per_shift, axis=0)
                retiming = inverse @ retimed_rows
                errors = rows @ retiming - retimed_rows
                if np.abs(errors).max() <= tolerance:
                    maps.append(retiming)
        return np.array(maps)


class LinearTrajectory(AbstractTrajectory):
    """A trajectory of a basis.

    Attributes:
        basis: The functions of time.
        coefficients: Coefficients of the functions, one row for each joint.
    """

    basis: AbstractBasis
    coefficients: Coefficients

    @property
    def duration(self) -> Time:
        """Duration of the basis [s]."""
        return self.basis.duration

    def measured_times(self, samples):
        """Return the times at which motions of the basis are measured [s]."""
        return self.basis.times(samples)

    def states(self, t):
        """Return the rows of the basis times the coefficients."""
        rows = jnp.asarray(self.basis.rows(t))
        return tuple(part @ self.coefficients.T for part in rows[:3])


def stand_outside(
    rows: Callable[[AnyArray], AnyArray],
    t: Times,
    duration: AnyArray | float,
) -> Rows:
    """Return rows of a motion that stands still outside of its duration [s]."""
    xp = namespace(t, as_scalar(duration))
    # Written with `where`, because the derivative of `clip` at its ends is one half.
    is_before = t < 0.0
    is_after = t > duration
    times = xp.where(is_after, duration, t)
    times = xp.where(is_before, 0.0, times)
    is_moving = ~(is_before | is_after)[None, :, None]
    is_position = np.array([True, False, False, False])[:, None, None]
    return xp.where(is_position | is_moving, rows(times), 0.0)
