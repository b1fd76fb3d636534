"""Families of trajectories: each joint's motion is a basis times the joint's coefficients."""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, namespace
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.trajectory import AbstractTrajectory, as_scalar

Envelope = tuple[tuple[Float[np.ndarray, "rows variables"], ...], float]
"""Rows for each order of derivative, and a factor of at least 1; see `AbstractBasis.envelope`."""


class AbstractBasis(eqx.Module):
    """A family of trajectories: functions of time that are the same for all joints.

    The coefficients of a trajectory are a matrix x [joints, variables]. Limits of position,
    velocity, acceleration and jerk are linear in them.

    Attributes:
        duration: Time from the start of the motion to its end; the period of a periodic one [s].
    """

    if TYPE_CHECKING:

        @property
        def duration(self) -> Any:
            """Duration [s]: a field or a property of each basis."""
    else:
        duration: eqx.AbstractVar[float]

    @abstractmethod
    def rows(self, t: Float[AnyArray, " samples"]) -> Float[AnyArray, "4 samples variables"]:
        """Return position, velocity, acceleration and jerk of every function.

        Args:
            t: Times [s]; NumPy arrays give NumPy arrays.
        """

    @abstractmethod
    def envelope(self, points: int) -> Envelope:
        """Return rows whose largest value bounds the motion at all times, and their factor.

        For coefficients x of a joint, |f(t) - c| <= factor * max |rows[k] @ x - c| at every time t,
        where f is the derivative of order k (from 0 to 3) of the joint's motion and c any constant.

        Args:
            points: Approximate number of rows for each order; more rows give tighter bounds.
        """

    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> "LinearTrajectory":
        """Return the trajectory with these coefficients.

        Args:
            x: Coefficients, one row for each joint.
        """
        return LinearTrajectory(self, x)

    @property
    def variables(self) -> int:
        """Number of coefficients of each joint."""
        return self.rows(np.zeros(1)).shape[2]

    def times(self, samples: int) -> Float[np.ndarray, " samples"]:
        """Return equidistant times at which a run is measured, without their end [s].

        Args:
            samples: Number of times.
        """
        return np.arange(samples) * (float(self.duration) / samples)

    def instants(self, points: int) -> Float[np.ndarray, " points"]:
        """Return equidistant times over the whole motion, for limits that hold throughout [s].

        Args:
            points: Number of times.
        """
        return self.times(points)

    def retimings(
        self, shifts: int = 40, tolerance: float = 1e-9
    ) -> Float[np.ndarray, "retimings variables variables"]:
        """Return maps to the coefficients of the same motion begun later or run backwards.

        Only maps that stay in the family are returned: a periodic motion may begin at any time, a
        motion between standstills may run backwards. The first map changes nothing. All of them
        keep the limits of the joint.

        Args:
            shifts: Number of equidistant times at which the motion may begin.
            tolerance: Largest relative deviation from the shifted motion.
        """
        part = -(-4 * self.variables // shifts)
        step = float(self.duration) / (shifts * part)
        rows = np.asarray(self.rows((np.arange(shifts * part) + 0.5) * step)[0])
        inverse, size = np.linalg.pinv(rows), np.abs(rows).max()
        moved = [np.roll(r, k * part, axis=0) for r in (rows, rows[::-1]) for k in range(shifts)]
        maps = [(inverse @ wanted, wanted) for wanted in moved]
        return np.array(
            [T for T, wanted in maps if np.abs(rows @ T - wanted).max() <= tolerance * size]
        )


class LinearTrajectory(AbstractTrajectory):
    """A trajectory of a basis.

    Attributes:
        basis: The functions of time.
        coefficients: Coefficients of the functions, one row for each joint.
    """

    basis: AbstractBasis
    coefficients: Float[AnyArray, "joints variables"]

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.coefficients.shape[0]

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Duration of the basis [s]."""
        return self.basis.duration

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """Return the motion at one time or at many [s]."""
        return _motion(self.basis, self.coefficients, jnp.asarray(t, float))


@eqx.filter_jit
def _motion(basis: AbstractBasis, x: AnyArray, t: Array) -> Motion:
    rows = jnp.asarray(basis.rows(t.reshape(-1)))
    return Motion(*((part @ x.T).reshape(*t.shape, -1) for part in rows[:3]))


def stand_outside(
    rows: Callable[[AnyArray], AnyArray], t: Float[AnyArray, " samples"], duration: AnyArray | float
) -> Float[AnyArray, "4 samples variables"]:
    """Return rows of a motion that stands still before its start and after its end.

    Args:
        rows: Rows from the start at zero to the end.
        t: Times [s].
        duration: Time of the end [s].
    """
    xp = namespace(t, as_scalar(duration))
    # Written with `where`, because the derivative of `clip` at its ends is one half.
    inner = rows(xp.where(t < 0.0, 0.0, xp.where(t > duration, duration, t)))
    inside = ((t >= 0.0) & (t <= duration))[None, :, None]
    position = np.array([True, False, False, False])[:, None, None]
    return xp.where(position | inside, inner, 0.0)
