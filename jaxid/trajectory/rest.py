"""A Fourier series that starts and stops at rest: no jump in position, speed or acceleration."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.trajectory.basis import AbstractBasis, Envelope, FourierBasis
from jaxid.trajectory.fourier import FourierSeries
from jaxid.trajectory.trajectory import AbstractTrajectory, each_time


class RestToRest(AbstractTrajectory):
    r"""Whole periods of a Fourier series between standstill and standstill.

    The velocity $\sum_l a_{i,l}$ and the acceleration $\omega \sum_l l\, b_{i,l}$ at the start of a
    period must be zero, which Eq. 34 as printed does not ask for. Both are linear in the
    coefficients, so limits on such a motion are as linear as on any series: `rest_basis`. Before
    its start and after its end the robot stands still.

    Attributes:
        series: Whose periods begin and end at rest, as `RestToRest.of` makes it.
        periods: Number of periods between standstill and standstill.
    """

    series: FourierSeries
    periods: int = eqx.field(static=True, default=1)

    @classmethod
    def of(cls, series: FourierSeries, periods: int = 1) -> "RestToRest":
        """The nearest motion that starts and stops at rest.

        Args:
            series: Any series; the least change of its amplitudes makes it stand at its ends.
            periods: Number of periods.

        Raises:
            InputError: If there is no period, or the series has a single harmonic, which cannot
                stand at its ends.
        """
        if periods < 1:
            raise InputError(f"`periods` must be at least 1, but is {periods}.")
        _require_harmonics(series.harmonics)
        order = np.arange(1.0, series.harmonics + 1.0)
        a, b = jnp.asarray(series.a), jnp.asarray(series.b)
        a = a - jnp.mean(a, axis=1, keepdims=True)
        b = b - (b @ order / (order @ order))[:, None] * order[None, :]
        return cls(FourierSeries(series.offset, a, b, series.omega), periods)

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Time from standstill to standstill [s]."""
        return self.periods * self.series.period

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]: standstill before the start and after the end."""
        return each_time(self._at, t)

    def _at(self, time: Float[Array, ""]) -> Motion:
        inside = self.series.motion(jnp.clip(time, 0.0, self.duration))
        moves = (time > 0.0) & (time < self.duration)
        return Motion(inside.q, jnp.where(moves, inside.qd, 0.0), jnp.where(moves, inside.qdd, 0.0))


class RestToRestBasis(AbstractBasis):
    """Fourier series that start and stop at rest: numbers are the offset and what is left free.

    Attributes:
        harmonics: Number of harmonics.
        omega: Ground frequency [rad/s].
        duration: The period [s].
    """

    harmonics: int = eqx.field(static=True)
    omega: float = eqx.field(static=True)
    duration: float = eqx.field(static=True)

    def __init__(self, harmonics: int, omega: float):
        _require_harmonics(harmonics)
        series = FourierBasis(harmonics, omega)
        self.harmonics, self.omega, self.duration = harmonics, series.omega, series.duration

    @property
    def series(self) -> FourierBasis:
        """The series without the conditions at the ends."""
        return FourierBasis(self.harmonics, self.omega)

    def rows(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "4 samples variables"]:
        """Sines and cosines in the directions that stand still at the ends."""
        return self.series.rows(t) @ rest_basis(self.harmonics)

    def envelope(self, points: int) -> Envelope:
        """Samples of a period, as for any series."""
        rows, factor = self.series.envelope(points)
        return Envelope(tuple(x @ rest_basis(self.harmonics) for x in rows), factor)

    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> RestToRest:
        """One period of the series with these numbers."""
        return RestToRest(self.series.trajectory(x @ rest_basis(self.harmonics).T))


def rest_basis(harmonics: int) -> Float[np.ndarray, "coefficients free"]:
    """Directions in which the coefficients of a joint keep its standstill; orthonormal columns.

    A joint's coefficients (offset, a_1 ..., b_1 ...) are this matrix times free numbers, two fewer;
    the first of them is the offset.

    Args:
        harmonics: Number of harmonics.

    Raises:
        InputError: If there are fewer than two.
    """
    _require_harmonics(harmonics)
    order = np.arange(1.0, harmonics + 1.0)
    a, b = (np.linalg.svd(x[None, :])[2][1:].T for x in (np.ones(harmonics), order))
    return np.asarray(block_diag(np.ones((1, 1)), a, b))


def _require_harmonics(harmonics: int) -> None:
    if harmonics < 2:
        raise InputError(
            f"`harmonics` must be at least 2 for a motion between standstill and standstill, but "
            f"is {harmonics}."
        )
