r"""The spectral sandwich: variances of estimates from rows whose errors are correlated in time.

An estimate is linear in the errors, $\hat p_i - p_i = \sum_{jt} P_{ijt} e_{jt}$, so its variance
is $\sum_{jf} K_{ijf} \phi_j(f)$ with $K = |FFT_t P|^2 / N$ and the spectrum $\phi_j$ of the errors.
The periodogram of the residuals is smoothed over a window of lines and divided by what the fit has
left of it, $1 - h_{jf}$ with the leverage $h$ of each line.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.uncertainty.spectra import Lines, Seen

NARROWEST, RELATIVE = 0.25, 0.3
"""Half of a window's width: at least the first [Hz], and this share of its frequency."""
FEWEST = 4
"""Lines to either side that a window holds at least, of short recordings."""
LEAST_LEFT = 0.02
"""Smallest share of a window's power that a fit is taken to leave."""


class Variances(NamedTuple):
    """What the spectral sandwich finds.

    Attributes:
        covariance: Of the estimates [base, base].
        freedom: Degrees of freedom of each variance (Satterthwaite).
        white: Variances from the same lines if the errors were independent from row to row.
    """

    covariance: np.ndarray
    freedom: np.ndarray
    white: np.ndarray


class Windows:
    """Sums over windows of lines, and their transposes, of several kinds of stretches together.

    They take and give arrays of NumPy or of JAX.

    Args:
        frequency: Of the lines, in any order [Hz].
        longest: Duration of the longest stretch [s].
    """

    def __init__(self, frequency: Float[np.ndarray, " lines"], longest: float):
        self._order = np.argsort(frequency, kind="stable")
        self._place = np.argsort(self._order, kind="stable")
        f = frequency[self._order]
        half = np.maximum(np.maximum(NARROWEST, FEWEST / longest), RELATIVE * f)
        self._low = np.searchsorted(f, f - half * (1 + 1e-9), side="left")
        self._high = np.searchsorted(f, f + half * (1 + 1e-9), side="right")
        # Both ends of a window rise with its middle: the windows that hold a line are neighbours.
        places = np.arange(len(f))
        self._first = np.searchsorted(self._high, places, side="right")
        self._last = np.searchsorted(self._low, places, side="right")

    @classmethod
    def of(cls, lines: Sequence[Lines]) -> "Windows":
        """For every kind of stretch."""
        frequency = np.concatenate([x.frequency for x in lines])
        return cls(frequency, max(x.length * x.row_time for x in lines))

    def sums(self, x: AnyArray) -> AnyArray:
        """For each line the sum over its window, along the last axis."""
        return self._between(x, self._low, self._high)

    def transposed(self, x: AnyArray) -> AnyArray:
        """For each line the sum over the windows that hold it, along the last axis."""
        return self._between(x, self._first, self._last)

    def _between(self, x: AnyArray, low: np.ndarray, high: np.ndarray) -> AnyArray:
        sums = x[..., self._order].cumsum(axis=-1)
        flat = (1,) * (x.ndim - 1)
        before = sums[..., np.maximum(low - 1, 0)] * (low > 0).astype(float).reshape(*flat, -1)
        after = sums[..., np.maximum(high - 1, 0)] * (high > 0).astype(float).reshape(*flat, -1)
        return (after - before)[..., self._place]


def variance_map(
    xp: ModuleType,
    windows: Windows,
    half: Float[np.ndarray, " lines"],
    exposure: Float[AnyArray, "channels lines"],
    leverage: Float[AnyArray, "channels lines"],
    energy: Float[AnyArray, "base channels lines"],
) -> tuple[Float[AnyArray, "base channels lines"], Float[AnyArray, "channels lines"]]:
    r"""The sandwich as a linear map of periodograms, $var_i = \sum_{jg} C_{ijg} I_{jg}$.

    Args:
        xp: NumPy, or JAX's.
        windows: Over which spectra are smoothed.
        half: Half of each line's multiplicity.
        exposure: Number of stretches, as many as rows count.
        leverage: What of each line the fit has taken.
        energy: How each line moves each estimate.

    Returns:
        The map, and what the fit has left of each window.
    """
    left = windows.sums(half[None] * (exposure - leverage))
    least = LEAST_LEFT * windows.sums(half[None] * exposure)
    left = xp.maximum(left, xp.maximum(least, 1e-300))
    return half[None, None] * windows.transposed(energy / left[None]), left


class SpectralTable:
    r"""The sandwich as one linear map, made once for a design and used for many draws.

    Attributes:
        map: $C$ [base, channels x lines].
    """

    def __init__(self, lines: Sequence[Lines]):
        self._lines = lines
        self._windows = Windows.of(lines)
        half = np.concatenate([0.5 * x.multiplicity for x in lines])
        leverage = np.concatenate([x.leverage for x in lines], axis=1)
        there = np.concatenate(
            [np.broadcast_to(x.exposure[:, None], x.leverage.shape) for x in lines], axis=1
        )
        energy = np.concatenate([x.energy for x in lines], axis=2)
        C, self._left = variance_map(np, self._windows, half, there, leverage, energy)
        self.map = np.asarray(C).reshape(len(C), -1)
        self._scatter = np.broadcast_to(scatter(np, half, there), C.shape[1:]).ravel()

    def density(self, power: np.ndarray) -> np.ndarray:
        """The errors' spectrum at each line, from the residuals' periodogram."""
        half = np.concatenate([0.5 * x.multiplicity for x in self._lines])
        return np.asarray(self._windows.sums(half * power) / self._left)

    def __call__(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variances and their degrees of freedom.

        Args:
            power: Periodograms of the residuals, [draws, channels, lines] or without draws.
        """
        flat = power.reshape(*power.shape[:-2], -1)
        variance = flat @ self.map.T
        squares = (flat * self._scatter) ** 2 @ (self.map**2).T
        return variance, np.asarray(satterthwaite(np, variance, squares))


def scatter(
    xp: ModuleType, half: Float[np.ndarray, " lines"], exposure: Float[AnyArray, "channels lines"]
) -> Float[AnyArray, "channels lines"]:
    """By how much to multiply a line's power to get the scatter of its mean.

    A line's power is that of as many draws as there are stretches: its square overstates.
    """
    return xp.sqrt(2.0 / (half[None] * (1.0 + xp.maximum(exposure, 1.0))))


def satterthwaite(xp: ModuleType, variance: AnyArray, squares: AnyArray) -> AnyArray:
    """Degrees of freedom of variances that are sums of chi-squares, one for each line."""
    there = squares > 0
    return xp.where(there, 4.0 * variance**2 / xp.where(there, squares, 1.0), xp.inf)


def sandwich(seen: Seen) -> Variances:
    """The covariance of an estimate from what a pass over the rows has seen."""
    lines = seen.lines
    table = SpectralTable(lines)
    power = np.concatenate([x.power for x in lines], axis=1)
    variance, freedom = table(power)
    density = table.density(power)
    bins = np.concatenate([x.bins for x in lines])
    weights = np.concatenate([x.multiplicity for x in lines])
    count = np.maximum(np.bincount(bins, weights, len(seen.correlated)), 1e-300)
    rough = np.zeros((len(variance), len(variance)))
    for c, own in enumerate(density):
        mean = np.bincount(bins, weights * own, len(seen.correlated)) / count
        rough += np.einsum("k,kab->ab", mean, seen.correlated[:, c])
    size = np.sqrt(np.maximum(np.diag(rough), 1e-300))
    deviation = np.sqrt(np.maximum(variance, 0.0))
    covariance = rough / size / size[:, None] * deviation * deviation[:, None]
    covariance[np.diag_indices(len(variance))] = deviation**2
    return Variances(covariance, np.maximum(freedom, 1.0), _white(lines))


def _white(lines: Sequence[Lines]) -> np.ndarray:
    """Variances for errors that are independent from row to row, and of a joint's own size."""
    power = sum(np.sum(x.multiplicity * x.power, axis=1) for x in lines)
    rows = sum(x.length * x.exposure for x in lines)
    taken = sum(np.sum(x.multiplicity * x.leverage, axis=1) for x in lines)
    share = np.sum(taken) / max(np.sum(rows), 1.0)
    level = power / np.maximum(rows * (1.0 - share), 1.0)
    return np.sum([np.einsum("icf,c->i", x.energy, level) for x in lines], axis=0)
