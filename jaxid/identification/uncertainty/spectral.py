r"""The spectral sandwich: variances of estimates from rows with correlated errors.

An estimate is linear in the errors, $\hat p_i - p_i = \sum_{jt} P_{ijt} e_{jt}$, so its
variance is $\sum_{jf} K_{ijf} \phi_j(f)$ with $K = |FFT_t P|^2 / N$ and the spectrum
$\phi_j$ of the errors. The periodogram of the residuals is smoothed over a window of
lines and divided by $1 - h_{jf}$, with the leverage $h$ of each line: the fit has
explained that fraction of the errors.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from jaxid.arrays import (
    AnyArray,
    BaseMatrix,
    BaseVector,
    Matrix,
    Vector,
    namespace,
)

from ..estimators.estimate import Estimate
from .blocks import BlockJackknife, jackknife
from .result import (
    AbstractUncertainty,
    ResidualSpectra,
    Uncertainty,
    rescale_covariance,
)
from .slow_rows import with_friction_near_rest
from .spectra_of_rows import BIN_COUNT, Lines, RowSpectra, multiplicity, row_spectra


class SpectralSandwich(AbstractUncertainty):
    """Spectral sandwich: right for errors correlated from row to row (default).

    Errors are assumed stationary and independent between joints, recordings, and parts
    of a log on both sides of a gap. Where the errors are larger in the part of a log
    that decides a parameter, the block jackknife gives more than chance allows: then
    its deviation counts. Intervals include what slow rows change beyond noise, as where
    joints stick. It needs two passes over the rows. Of logs of more than
    131,072 samples some evenly spread stretches are transformed: these give the ratio
    to the naive values. If only factors are known, the block jackknife is used instead.
    """

    def __call__(self, problem, estimate, naive):
        """Return the sandwich, wider where jackknife or slow rows contradict it."""
        if not problem.recordings:
            errors, _ = BlockJackknife()(problem, estimate, naive)
            note = (
                "standard deviations come from the block jackknife: "
                "only factors were given."
            )
            return dataclasses.replace(errors, notes=errors.notes or (note,)), None
        spectra = row_spectra(problem, estimate)
        covariance, dof = sandwich(spectra)
        variances = np.diag(naive)
        is_undetermined = np.isinf(variances)
        if not spectra.is_complete:
            white_noise_variances = white_variances(spectra.lines)
            has_ratio = (white_noise_variances > 0) & ~is_undetermined
            ratios = np.ones_like(variances)
            np.divide(variances, white_noise_variances, out=ratios, where=has_ratio)
            deviations = np.sqrt(ratios) * np.sqrt(np.diag(covariance))
            covariance = rescale_covariance(covariance, deviations)
        covariance[is_undetermined, is_undetermined] = np.inf
        errors = Uncertainty(covariance, dof, naive, jackknife(estimate))
        errors = _widen_by_jackknife(errors, estimate)
        errors = with_friction_near_rest(errors, problem, estimate)
        return errors, residual_spectra(spectra.lines)


def _widen_by_jackknife(errors: Uncertainty, estimate: Estimate) -> Uncertainty:
    """Take the jackknife's deviations where chance allows them once in 10,000 times."""
    if errors.jackknife is None:
        return errors
    shares = []
    for part in estimate.blocks.parts:
        R, _ = part.weighted(estimate.weights)
        shares.append(np.sum((R @ estimate.inverse) ** 2, axis=0))
    # The fewer blocks decide a parameter, the more its jackknife scatters.
    total = np.sum(shares, axis=0)
    squares = np.sum(np.square(shares), axis=0)
    deciding_blocks = total**2 / np.maximum(squares, 1e-300)
    max_ratios = scipy.stats.f.ppf(0.9999, np.maximum(deciding_blocks, 1.0), errors.dof)

    deviations = errors.standard_deviations
    has_deviation = np.isfinite(deviations) & (deviations > 0)
    is_exceeded = errors.jackknife**2 > max_ratios * deviations**2
    deviations = np.where(has_deviation & is_exceeded, errors.jackknife, deviations)
    covariance = rescale_covariance(errors.covariance, deviations)
    return dataclasses.replace(errors, covariance=covariance)


class SpectralWindows:
    """Windows of neighbouring lines, over which periodograms are smoothed.

    A window reaches 30 % of its frequency to either side, at least 0.25 Hz and four
    lines of the longest stretch (`max_duration` [s]). The methods take NumPy and JAX
    arrays, with the lines as last axis in any order.
    """

    def __init__(self, frequency: Vector, max_duration: float):
        self._order = np.argsort(frequency, kind="stable")
        places = np.argsort(self._order)
        ordered_frequency = frequency[self._order]
        min_half_width = max(0.25, 4.0 / max_duration)
        half_widths = np.maximum(min_half_width, 0.3 * ordered_frequency)
        # Lines at the edge of a window belong to it in spite of rounding.
        half_widths = half_widths * (1 + 1e-9)
        lower_edges = ordered_frequency - half_widths
        upper_edges = ordered_frequency + half_widths
        first_line = np.searchsorted(ordered_frequency, lower_edges, side="left")
        end_line = np.searchsorted(ordered_frequency, upper_edges, side="right")
        self._lines = first_line[places], end_line[places]
        # Both ends of a window rise with its middle: the windows around a line are
        # neighbours.
        numbers = np.arange(len(ordered_frequency))
        first_window = np.searchsorted(end_line, numbers, side="right")
        end_window = np.searchsorted(first_line, numbers, side="right")
        self._windows = first_window[places], end_window[places]

    def sum_lines(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over the lines of its window."""
        return self._sum(x, *self._lines)

    def sum_windows(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over the windows that it is in."""
        return self._sum(x, *self._windows)

    def _sum(self, x: AnyArray, starts: np.ndarray, ends: np.ndarray) -> AnyArray:
        xp = namespace(x)
        sums = x[..., self._order].cumsum(axis=-1)
        sums = xp.concatenate([xp.zeros_like(sums[..., :1]), sums], axis=-1)
        return sums[..., ends] - sums[..., starts]


class SpectralTable:
    r"""The sandwich as a map of periodograms: $var_i = \sum_{jf} C_{ijf} I_{jf}$.

    Computed once for a design and applied to many draws; in NumPy, or in JAX where `xp`
    is `jax.numpy`. The other arguments are those of `Lines`, of all lengths of
    stretches together.
    """

    def __init__(
        self, xp, frequency, multiplicity, energy, leverage, exposure, max_duration
    ):
        self._xp = xp
        self._windows = SpectralWindows(frequency, max_duration)
        # A line and its mirror image are one random number.
        self._half = 0.5 * multiplicity[None]
        window_rows = self._windows.sum_lines(self._half * exposure)
        unexplained_part = self._half * (exposure - leverage)
        residual_rows = self._windows.sum_lines(unexplained_part)
        # A fit is assumed to leave at least 2 % of a window's power.
        min_rows = xp.maximum(0.02 * window_rows, 1e-300)
        self._residual_rows = xp.maximum(residual_rows, min_rows)
        # Channel by channel: fewer numbers at once.
        self._maps = []
        for c in range(len(leverage)):
            energy_of_row = energy[:, c] / self._residual_rows[c][None]
            smooth_power = self._windows.sum_windows(energy_of_row)
            self._maps.append(self._half * smooth_power)
        # From a line's power to the scatter of its mean over the stretches.
        stretches = xp.maximum(exposure, 1.0)
        self._scatter = xp.sqrt(2.0 / (self._half * (1.0 + stretches)))

    @classmethod
    def of(cls, lines: Sequence[Lines]) -> "SpectralTable":
        """Return the table of the spectra of every length of stretches."""
        # All lines of a channel have one exposure; the table wants one for each line.
        exposures = [x.exposure[:, None] + np.zeros_like(x.leverage) for x in lines]
        return cls(
            np,
            _join([x.frequency for x in lines]),
            _join([x.multiplicity for x in lines]),
            _join([x.energy for x in lines]),
            _join([x.leverage for x in lines]),
            _join(exposures),
            max_duration=max(x.length * x.row_time for x in lines),
        )

    def density(self, power: Matrix) -> Matrix:
        """Return the errors' spectrum at each line, from residual periodograms."""
        sums = self._windows.sum_lines(self._half * power)
        return np.asarray(sums / self._residual_rows)

    def __call__(self, power: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return variances and degrees of freedom.

        Periodograms are [draws, channels, lines].
        """
        xp = self._xp
        variance: Any = 0.0
        squares: Any = 0.0
        for c, line_map in enumerate(self._maps):
            channel_power = power[:, c]
            variance = variance + channel_power @ line_map.T
            scatter = channel_power * self._scatter[c][None]
            squares = squares + scatter**2 @ (line_map**2).T
        has_scatter = squares > 0
        dof = 4.0 * variance**2 / xp.where(has_scatter, squares, 1.0)
        return variance, xp.where(has_scatter, dof, xp.inf)


def _join(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays of all stretch lengths side by side; a single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=-1)


def sandwich(spectra: RowSpectra) -> tuple[BaseMatrix, BaseVector]:
    """Return the covariance of an estimate, and degrees of freedom of each variance.

    Variances are summed line by line. For correlations between parameters the spectrum
    of the errors counts as constant within each bin.
    """
    lines = spectra.lines
    table = SpectralTable.of(lines)
    power = _join([x.power for x in lines])
    (variances,), (dof,) = table(power[None])

    bins = _join([x.bins for x in lines])
    weights = _join([x.multiplicity for x in lines])
    bin_sizes = np.maximum(np.bincount(bins, weights, BIN_COUNT), 1e-300)
    covariance = np.zeros((len(variances), len(variances)))
    densities = table.density(power)
    channels = zip(densities, spectra.inverses, spectra.products, strict=True)
    for density, inverse, products in channels:
        sums = np.bincount(bins, weights * density, BIN_COUNT)
        means = sums / bin_sizes
        information = np.einsum("k,kab->ab", means, products)
        covariance += inverse @ information @ inverse.T
    deviations = np.sqrt(np.maximum(variances, 0.0))
    return rescale_covariance(covariance, deviations), np.maximum(dof, 1.0)


def white_variances(lines: Sequence[Lines]) -> BaseVector:
    """Return variances of estimates for white errors, with one level for each joint."""
    rows = sum(x.length * x.exposure for x in lines)
    explained_power = sum(np.sum(x.multiplicity * x.leverage) for x in lines)
    power = sum(np.sum(x.multiplicity * x.power, axis=1) for x in lines)
    remaining_share = 1.0 - explained_power / max(np.sum(rows), 1.0)
    levels = power / np.maximum(rows * remaining_share, 1.0)
    variances = [np.einsum("icf,c->i", x.energy, levels) for x in lines]
    return np.sum(variances, axis=0)


def residual_spectra(lines: Sequence[Lines]) -> ResidualSpectra:
    """Return spectra and whiteness of residuals, from stretches with the most rows."""
    longest_lines = max(lines, key=lambda x: x.length * x.stretches)
    half_multiplicity = 0.5 * longest_lines.multiplicity
    windows = SpectralWindows(
        longest_lines.frequency, longest_lines.length * longest_lines.row_time
    )
    residual_sums = windows.sum_lines(half_multiplicity * longest_lines.residual)
    smooth_power = residual_sums / windows.sum_lines(half_multiplicity)
    mean_exposure = np.mean(longest_lines.exposure)
    # One-sided: the mirror image of a line counts with it.
    scale = 2.0 * longest_lines.row_time / np.maximum(mean_exposure, 1e-300)

    is_passed = (longest_lines.gain > 0.5) & (longest_lines.frequency > 0)
    if not is_passed.any():
        is_passed = longest_lines.gain > 0
    # A joint whose force is not measured has no rows.
    exposure = np.maximum(longest_lines.exposure, 1e-300)
    leverage = longest_lines.leverage / exposure[:, None]
    remaining_part = np.clip(1.0 - leverage, 0.02, None)
    whitened_power = longest_lines.residual / remaining_part / longest_lines.gain**2
    power = whitened_power[:, is_passed]
    total_power = power.sum(axis=1, keepdims=True)
    finite_total = np.where(total_power > 0, total_power, 1.0)
    cumulative_power = np.cumsum(power, axis=1) / finite_total
    count = power.shape[1]
    straight_line = np.arange(1, count + 1) / count
    low_frequencies = max(1, round(0.1 * count))
    figure_places = np.linspace(0, len(half_multiplicity) - 1, 400).round()
    figure_lines = np.unique(figure_places.astype(int))
    return ResidualSpectra(
        frequency=longest_lines.frequency[figure_lines],
        density=scale * smooth_power[:, figure_lines],
        gain=longest_lines.gain[figure_lines],
        departure=np.abs(cumulative_power - straight_line).max(axis=1),
        # Kolmogorov's quantile of 95 %.
        limit=float(1.358 / np.sqrt(count * mean_exposure)),
        low_frequency=cumulative_power[:, low_frequencies - 1],
        band=float(longest_lines.frequency[is_passed][-1]),
    )


def sandwich_of_columns(
    xp,
    joint_parameters,
    weights,
    inverse,
    p,
    columns,
    forces,
    exposure,
    row_time: float,
):
    """Return variances and degrees of freedom of estimates `p` [draws, base].

    Arrays are those of NumPy or JAX.

    Columns [columns, rows] and forces [draws, rows] of each joint are zero where a row
    does not count; the columns belong to `joint_parameters`; `exposure` is the
    fraction of rows that count.
    """
    length = columns[0].shape[-1]
    times = multiplicity(length)
    energy = []
    leverage = []
    power = []
    for indices, theta, Q, weight in zip(
        joint_parameters, columns, forces, weights, strict=True
    ):
        acting_parameters = np.array(indices, int)
        column_lines = xp.fft.rfft(weight * theta)
        residuals = Q - p[:, acting_parameters] @ theta
        residual_lines = xp.fft.rfft(weight * residuals)
        # Changes of the estimates by the cosine and by the sine of each line.
        by_cosine = inverse[:, acting_parameters] @ column_lines.real
        by_sine = inverse[:, acting_parameters] @ column_lines.imag
        energy.append(times[None] / length * (by_cosine**2 + by_sine**2))
        # What the fitted parameters explain of each line's own disturbance.
        explained_power = (
            by_cosine[acting_parameters] * column_lines.real
            + by_sine[acting_parameters] * column_lines.imag
        )
        leverage.append(xp.sum(explained_power, axis=0) / length)
        residual_squares = residual_lines.real**2 + residual_lines.imag**2
        power.append(residual_squares / length)
    leverage = xp.stack(leverage)
    table = SpectralTable(
        xp,
        scipy.fft.rfftfreq(length, row_time),
        times,
        xp.stack(energy, axis=1),
        leverage,
        xp.broadcast_to(exposure[:, None], leverage.shape),
        length * row_time,
    )
    variance, dof = table(xp.stack(power, axis=1))
    return xp.asarray(variance), xp.maximum(dof, 1.0)
