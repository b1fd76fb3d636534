r"""The spectral sandwich: variances of estimates from rows whose errors are correlated in time.

An estimate is linear in the errors, $\hat p_i - p_i = \sum_{jt} P_{ijt} e_{jt}$, so its variance
is $\sum_{jf} K_{ijf} \phi_j(f)$ with $K = |FFT_t P|^2 / N$ and the spectrum $\phi_j$ of the errors.
The periodogram of the residuals is smoothed over a window of lines and divided by $1 - h_{jf}$,
with the leverage $h$ of each line: the fit has explained that fraction of the errors.
"""

import dataclasses
from collections.abc import Sequence
from types import ModuleType

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.identification.uncertainty.jackknife import BlockJackknife, jackknife
from jaxid.identification.uncertainty.result import (
    AbstractUncertainty,
    ResidualSpectra,
    Uncertainty,
    mark_unknown,
)
from jaxid.identification.uncertainty.spectra import Lines, RowSpectra, multiplicity, row_spectra


class SpectralSandwich(AbstractUncertainty):
    """Spectral sandwich: right for errors that are correlated from row to row (default).

    Errors are assumed stationary and independent between joints, recordings, and parts of a log on
    both sides of a gap. It needs one pass over the rows. Of logs of more than a million samples
    some evenly spread stretches are transformed: these give the ratio to the naive values. Where
    only factors are known, the block jackknife takes its place.
    """

    def __call__(self, problem, estimate, naive):
        """Return the sandwich, with the jackknife as a cross-check."""
        if not problem.has_samples:
            found, _ = BlockJackknife()(problem, estimate, naive)
            note = (
                "standard deviations come from the block jackknife: only factors of the rows were "
                "given, and no spectrum of the residuals can be computed."
            )
            return dataclasses.replace(found, notes=found.notes or (note,)), None
        spectra = row_spectra(problem, estimate)
        covariance, dof, white = sandwich(spectra)
        if not spectra.complete:
            exact = np.diag(naive)
            known = (white > 0) & np.isfinite(exact)
            ratio = np.where(known, exact, 1.0) / np.where(known, white, 1.0)
            ratio = np.sqrt(np.where(known, ratio, 1.0))
            covariance = covariance * ratio * ratio[:, None]
        found = Uncertainty(mark_unknown(covariance, naive), dof, naive, jackknife(estimate))
        return found, residual_spectra(spectra.lines)


class Windows:
    """Sums over windows of lines, and their transposes, for NumPy and JAX arrays.

    A window reaches 30 % of its frequency to either side, at least 0.25 Hz and four lines.

    Args:
        frequency: Frequencies of the lines, in any order [Hz].
        longest: Duration of the longest stretch [s].
    """

    def __init__(self, frequency: Float[np.ndarray, " lines"], longest: float):
        self._order = np.argsort(frequency, kind="stable")
        self._place = np.argsort(self._order, kind="stable")
        f = frequency[self._order]
        half = np.maximum(max(0.25, 4.0 / longest), 0.3 * f)
        self._low = np.searchsorted(f, f - half * (1 + 1e-9), side="left")
        self._high = np.searchsorted(f, f + half * (1 + 1e-9), side="right")
        # Both ends of a window rise with its middle: the windows around a line are neighbours.
        places = np.arange(len(f))
        self._first = np.searchsorted(self._high, places, side="right")
        self._last = np.searchsorted(self._low, places, side="right")

    def sums(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over its window, along the last axis."""
        return self._between(x, self._low, self._high)

    def transposed_sums(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over the windows that contain it, along the last axis."""
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
    r"""Return the sandwich as a linear map of periodograms, $var_i = \sum_{jg} C_{ijg} I_{jg}$.

    Args:
        xp: NumPy or `jax.numpy`.
        windows: Windows over which spectra are smoothed.
        half: Half of each line's multiplicity.
        exposure: Number of stretches, weighted by the fraction of rows that count.
        leverage: Fraction of each line explained by the fit.
        energy: Influence of each line on each estimate.

    Returns:
        The map, and the power that the fit leaves in each window for errors of density one.
    """
    rest = windows.sums(half[None] * (exposure - leverage))
    # A fit is assumed to leave at least 2 % of a window's power.
    least = 0.02 * windows.sums(half[None] * exposure)
    rest = xp.maximum(rest, xp.maximum(least, 1e-300))
    return half[None, None] * windows.transposed_sums(energy / rest[None]), rest


class SpectralTable:
    r"""The sandwich as one linear map, computed once for a design and applied to many draws.

    Args:
        lines: Spectra of every length of stretches.

    Attributes:
        map: $C$ [base, channels x lines].
    """

    def __init__(self, lines: Sequence[Lines]):
        frequency = np.concatenate([x.frequency for x in lines])
        self._windows = Windows(frequency, max(x.length * x.row_time for x in lines))
        self._half = half = np.concatenate([0.5 * x.multiplicity for x in lines])
        leverage = np.concatenate([x.leverage for x in lines], axis=1)
        exposure = np.concatenate(
            [np.broadcast_to(x.exposure[:, None], x.leverage.shape) for x in lines], axis=1
        )
        energy = np.concatenate([x.energy for x in lines], axis=2)
        C, self._rest = variance_map(np, self._windows, half, exposure, leverage, energy)
        self.map = np.asarray(C).reshape(len(C), -1)
        self._scatter = np.broadcast_to(_scatter(np, half, exposure), C.shape[1:]).ravel()

    def density(self, power: np.ndarray) -> np.ndarray:
        """Return the spectrum of the errors at each line, from the periodogram of residuals."""
        return np.asarray(self._windows.sums(self._half * power) / self._rest)

    def __call__(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return variances and their degrees of freedom.

        Args:
            power: Periodograms of the residuals, [draws, channels, lines] or without draws.
        """
        flat = power.reshape(*power.shape[:-2], -1)
        variance = flat @ self.map.T
        squares = (flat * self._scatter) ** 2 @ (self.map**2).T
        return variance, np.asarray(_satterthwaite(np, variance, squares))


def _scatter(
    xp: ModuleType, half: Float[np.ndarray, " lines"], exposure: Float[AnyArray, "channels lines"]
) -> Float[AnyArray, "channels lines"]:
    """Return factors from a line's power to the scatter of its mean over the stretches."""
    return xp.sqrt(2.0 / (half[None] * (1.0 + xp.maximum(exposure, 1.0))))


def _satterthwaite(xp: ModuleType, variance: AnyArray, squares: AnyArray) -> AnyArray:
    """Return the degrees of freedom of variances that are sums of one chi-square per line."""
    positive = squares > 0
    return xp.where(positive, 4.0 * variance**2 / xp.where(positive, squares, 1.0), xp.inf)


def sandwich(spectra: RowSpectra) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the covariance of an estimate, degrees of freedom, and variances for white errors.

    Args:
        spectra: Spectra of the rows.
    """
    lines, count = spectra.lines, len(spectra.correlated)
    table = SpectralTable(lines)
    power = np.concatenate([x.power for x in lines], axis=1)
    variance, dof = table(power)
    bins = np.concatenate([x.bins for x in lines])
    weights = np.concatenate([x.multiplicity for x in lines])
    size = np.maximum(np.bincount(bins, weights, count), 1e-300)
    rough = np.zeros((len(variance), len(variance)))
    for c, density in enumerate(table.density(power)):
        mean = np.bincount(bins, weights * density, count) / size
        rough += np.einsum("k,kab->ab", mean, spectra.correlated[:, c])
    scale = np.sqrt(np.maximum(np.diag(rough), 1e-300))
    deviation = np.sqrt(np.maximum(variance, 0.0))
    covariance = rough / scale / scale[:, None] * deviation * deviation[:, None]
    covariance[np.diag_indices(len(variance))] = deviation**2
    return covariance, np.maximum(dof, 1.0), _white_variances(lines)


def _white_variances(lines: Sequence[Lines]) -> np.ndarray:
    """Return variances for errors that are independent from row to row, of each joint's size."""
    power = sum(np.sum(x.multiplicity * x.power, axis=1) for x in lines)
    rows = sum(x.length * x.exposure for x in lines)
    explained = sum(np.sum(x.multiplicity * x.leverage, axis=1) for x in lines)
    fraction = np.sum(explained) / max(np.sum(rows), 1.0)
    level = power / np.maximum(rows * (1.0 - fraction), 1.0)
    return np.sum([np.einsum("icf,c->i", x.energy, level) for x in lines], axis=0)


def residual_spectra(lines: Sequence[Lines]) -> ResidualSpectra:
    """Return spectra and whiteness of the residuals, from the stretches with the most rows.

    Args:
        lines: Spectra of every length of stretches.
    """
    most = max(lines, key=lambda x: x.length * x.stretches)
    rows = most.length * np.maximum(np.mean(most.exposure), 1e-300)
    half = 0.5 * most.multiplicity
    windows = Windows(most.frequency, most.length * most.row_time)
    smooth = windows.sums(half * most.residual) / windows.sums(half)
    # One-sided: the mirror image of a line counts with it.
    scale = 2.0 * most.row_time * most.length / rows
    passed = (most.gain > 0.5) & (most.frequency > 0)
    if not passed.any():
        passed = most.gain > 0
    rest = np.clip(1.0 - most.leverage / most.exposure[:, None], 0.02, None)
    power = (most.residual / rest / most.gain**2)[:, passed]
    total = power.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(power, axis=1) / np.where(total > 0, total, 1.0)
    count = int(passed.sum())
    straight = np.arange(1, count + 1) / count
    shown = np.unique(np.linspace(0, len(half) - 1, 400).round().astype(int))
    return ResidualSpectra(
        frequency=most.frequency[shown],
        density=scale * smooth[:, shown],
        gain=most.gain[shown],
        departure=np.abs(cumulative - straight).max(axis=1),
        # Kolmogorov's quantile of 95 %.
        limit=float(1.358 / np.sqrt(count * np.mean(most.exposure))),
        low_frequency=cumulative[:, max(0, round(0.1 * count) - 1)],
        band=float(most.frequency[passed][-1]),
    )


class LineSums(eqx.Module):
    """Spectra of the chunks of a data set, added up, for many draws of its forces; see `Lines`."""

    energy: Float[Array, "base joints lines"]
    leverage: Float[Array, "joints lines"]
    power: Float[Array, "draws joints lines"]
    exposure: Float[Array, " joints"]


def line_sums(
    own: tuple[tuple[int, ...], ...],
    weights: Float[Array, " joints"],
    inverse: Float[Array, "base base"],
    p: Float[Array, "draws base"],
    columns: list[Array],
    forces: list[Array],
    exposure: Float[Array, " joints"],
) -> LineSums:
    """Return the spectra of consecutive rows, in JAX.

    Args:
        own: Base parameters that can act on each joint.
        weights: Weights of the joints' rows.
        inverse: Inverse of the information.
        p: Estimates.
        columns: Columns of each joint [columns, rows], zero where a row does not count.
        forces: Forces of each joint [draws, rows], likewise.
        exposure: Fraction (0 to 1) of each joint's rows that count.
    """
    length = columns[0].shape[-1]
    m = multiplicity(length)[None]
    energy, leverage, power = [], [], []
    for k, A, Q, w in zip(own, columns, forces, weights, strict=True):
        mine = np.array(k, int)
        Z = jnp.fft.rfft(w * A)
        real, imaginary = inverse[:, mine] @ Z.real, inverse[:, mine] @ Z.imag
        r = jnp.fft.rfft(w * (Q - p[:, mine] @ A))
        energy.append(m / length * (real**2 + imaginary**2))
        both = real[mine] * Z.real + imaginary[mine] * Z.imag
        leverage.append(jnp.sum(both, axis=0) / length)
        power.append((r.real**2 + r.imag**2) / length)
    stacked = jnp.stack(energy, axis=1), jnp.stack(leverage), jnp.stack(power, axis=1)
    return LineSums(*stacked, exposure)


def variances(
    sums: LineSums, length: int, row_time: float
) -> tuple[Float[Array, "draws base"], Float[Array, "draws base"]]:
    """Return the variances of estimates and their degrees of freedom, in JAX.

    Args:
        sums: Spectra of all chunks.
        length: Rows of a chunk.
        row_time: Time between two rows [s].
    """
    windows = Windows(np.fft.rfftfreq(length, row_time), length * row_time)
    half = 0.5 * multiplicity(length)
    exposure = jnp.broadcast_to(sums.exposure[:, None], sums.leverage.shape)
    C, _ = variance_map(jnp, windows, half, exposure, sums.leverage, sums.energy)
    variance = jnp.einsum("djf,ijf->di", sums.power, C)
    scattered = sums.power * _scatter(jnp, half, exposure)[None]
    squares = jnp.einsum("djf,ijf->di", scattered**2, C**2)
    return variance, jnp.maximum(_satterthwaite(jnp, variance, squares), 1.0)
