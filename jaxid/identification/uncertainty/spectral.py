r"""The spectral sandwich: variances of estimates from rows whose errors are correlated in time.

An estimate is linear in the errors, $\hat p_i - p_i = \sum_{jt} P_{ijt} e_{jt}$, so its
variance is $\sum_{jf} K_{ijf} \phi_j(f)$ with $K = |FFT_t P|^2 / N$ and the spectrum
$\phi_j$ of the errors. The periodogram of the residuals is smoothed over a window of
lines and divided by $1 - h_{jf}$, with the leverage $h$ of each line: the fit has
explained that fraction of the errors.
"""

import dataclasses
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft, stats

from jaxid.arrays import AnyArray, Float, namespace, on_cores
from jaxid.measurement.observations import Observations

from ..estimators.estimate import Channel, Estimate
from ..factors import RowChunk, join_chunks
from ..problem import RegressionProblem, Span
from .blocks import BlockJackknife, jackknife
from .result import (
    AbstractUncertainty,
    ResidualSpectra,
    Uncertainty,
    rescale_covariance,
)

MAX_ROWS = 2**15
"""Largest number of rows of a stretch; longer parts of a log are divided."""
MAX_SAMPLES = 2**17
"""Samples up to which every stretch is transformed; of longer logs some, evenly spread, that are
shorter and hold three eighths as many samples together."""
MAX_LENGTHS = 4
"""Number of different lengths up to which each has its own lines; of more, similar ones share them,
so that memory does not grow with the number of gaps."""
BIN_EDGES = np.concatenate([np.arange(0.0, 1.0, 0.05), 1.15 ** np.arange(0, 80)])
"""Edges [Hz] of the bins in which spectra count as constant for correlations of parameters."""
BIN_COUNT = len(BIN_EDGES) + 1


class SpectralSandwich(AbstractUncertainty):
    """Spectral sandwich: right for errors that are correlated from row to row (default).

    Errors are assumed stationary and independent between joints, recordings, and parts
    of a log on both sides of a gap. Where the errors are larger in the part of a log
    that decides a parameter, the block jackknife gives more than chance allows: then
    its deviation counts. It needs one pass over the rows. Of logs of more than
    `MAX_SAMPLES` some evenly spread stretches are transformed: these give the ratio to
    the naive values. If only factors are known, the block jackknife is used instead.
    """

    def __call__(self, problem, estimate, naive):
        """Return the sandwich, wider where the jackknife contradicts it."""
        if not problem.recordings:
            errors, _ = BlockJackknife()(problem, estimate, naive)
            note = (
                "standard deviations come from the block jackknife: only factors "
                "were given."
            )
            return dataclasses.replace(errors, notes=errors.notes or (note,)), None
        spectra = row_spectra(problem, estimate)
        covariance, dof = sandwich(spectra)
        variances = np.diag(naive)
        undetermined = np.isinf(variances)
        if not spectra.complete:
            ratios = np.ones_like(variances)
            white = white_variances(spectra.lines)
            has_ratio = (white > 0) & ~undetermined
            ratios[has_ratio] = np.sqrt(variances[has_ratio] / white[has_ratio])
            deviations = np.sqrt(np.diag(covariance))
            covariance = rescale_covariance(covariance, ratios * deviations)
        covariance[undetermined, undetermined] = np.inf
        errors = Uncertainty(covariance, dof, naive, jackknife(estimate))
        return _widen_by_jackknife(errors, estimate), residual_spectra(spectra.lines)


def _widen_by_jackknife(errors: Uncertainty, estimate: Estimate) -> Uncertainty:
    """Take the jackknife's deviations where chance allows them once in ten thousand times."""
    if errors.jackknife is None:
        return errors
    # The fewer blocks decide a parameter, the more its jackknife scatters.
    shares = []
    for part in estimate.blocks.parts:
        R, _ = part.weighted(estimate.weights)
        shares.append(np.sum((R @ estimate.inverse) ** 2, axis=0))
    total = np.sum(shares, axis=0)
    deciding_blocks = total**2 / np.maximum(np.sum(np.square(shares), axis=0), 1e-300)
    limits = stats.f.ppf(0.9999, np.maximum(deciding_blocks, 1.0), errors.dof)

    deviations = errors.standard_deviations
    has_deviation = np.isfinite(deviations) & (deviations > 0)
    contradicts = has_deviation & (errors.jackknife**2 > limits * deviations**2)
    deviations = np.where(contradicts, errors.jackknife, deviations)
    covariance = rescale_covariance(errors.covariance, deviations)
    return dataclasses.replace(errors, covariance=covariance)


class ChannelSpectra(NamedTuple):
    """Spectra of one channel of a stretch."""

    # $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, lines]
    energy: np.ndarray
    leverage: np.ndarray  # fraction (0 to 1) of each line explained by the fit
    power: np.ndarray  # periodogram of the disturbances
    exposure: float  # fraction of the rows that count
    # products of the instruments, summed over the lines of each bin
    products: np.ndarray


class Lines:
    """Spectra of all stretches of one length, added up.

    A stretch is a contiguous, equidistant part of the rows, which is transformed at
    once.

    Attributes:
        length: Rows of a stretch; shorter ones are padded with rows that do not count.
        row_time: Time between two rows [s].
        frequency: Frequencies of the lines [Hz].
        multiplicity: Number of times that each line counts.
        gain: Gain (0 to 1) of filter and decimation at each line.
        bins: Bin of each line.
        energy: Sums of `ChannelSpectra.energy` [base, channels, lines].
        leverage: Sums of `ChannelSpectra.leverage` [channels, lines].
        power: Sums of `ChannelSpectra.power` [channels, lines].
        exposure: Sums of `ChannelSpectra.exposure` [channels].
        residual: Periodogram of the residuals [joints, lines], in [N² m²] or [N²].
        stretches: Number of stretches.
    """

    def __init__(
        self,
        length: int,
        row_time: float,
        frequency: np.ndarray,
        gain: np.ndarray,
        base_size: int,
        joints: int,
    ):
        count = len(frequency)
        self.length = length
        self.row_time = row_time
        self.frequency = frequency
        self.gain = gain
        self.multiplicity = multiplicity(length)[:count]
        self.bins = np.searchsorted(BIN_EDGES, frequency, side="right")
        self.energy = np.zeros((base_size, joints, count))
        self.leverage = np.zeros((joints, count))
        self.power = np.zeros((joints, count))
        self.residual = np.zeros((joints, count))
        self.exposure = np.zeros(joints)
        self.stretches = 0

    def transform(self, rows: np.ndarray) -> np.ndarray:
        """Return the Fourier transform of the rows of a stretch, on the last axis."""
        return np.asarray(fft.rfft(rows, self.length))[..., : len(self.frequency)]

    def add_residuals(self, residuals: np.ndarray) -> None:
        """Add the residuals of a stretch [rows, joints]."""
        self.residual += np.abs(self.transform(residuals.T)) ** 2 / self.length
        self.stretches += 1

    def add_channel(self, c: int, spectra: ChannelSpectra) -> None:
        """Add the spectra of one channel of a stretch."""
        self.energy[:, c] += spectra.energy
        self.leverage[c] += spectra.leverage
        self.power[c] += spectra.power
        self.exposure[c] += spectra.exposure

    def transform_channel(
        self, channel: Channel, inverse: np.ndarray
    ) -> ChannelSpectra:
        """Return the spectra of one channel of a stretch."""
        columns = list(channel.columns)
        instruments = self._transform_parts(channel.instruments)
        equations = instruments
        if channel.equations is not channel.instruments:
            equations = self._transform_parts(channel.equations)
        influences = inverse[:, columns] @ instruments
        explained = np.einsum("if,if->f", influences[columns], equations)

        products = np.zeros((BIN_COUNT, len(columns), len(columns)))
        edges = 2 * np.searchsorted(self.bins, np.arange(BIN_COUNT + 1))
        for k, (start, stop) in enumerate(itertools.pairwise(edges)):
            if start < stop:
                lines = instruments[:, start:stop]
                products[k] = lines @ lines.T
        return ChannelSpectra(
            energy=_add_parts(np.square(influences, out=influences)),
            leverage=_add_parts(explained) / self.multiplicity,
            power=np.abs(self.transform(channel.disturbance)) ** 2 / self.length,
            exposure=channel.counted / self.length,
            products=products,
        )

    def _transform_parts(self, rows: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of each line in turn, weighted by how often it counts."""
        scale = np.repeat(np.sqrt(self.multiplicity / self.length), 2)
        return scale * self.transform(rows.T).view(float)


def _add_parts(x: np.ndarray) -> np.ndarray:
    """Add what real and imaginary parts contribute to each line."""
    return x[..., ::2] + x[..., 1::2]


def multiplicity(length: int) -> Float[np.ndarray, " lines"]:
    """Return how often a line counts: for itself, and for its mirror image."""
    k = np.arange(length)
    return np.bincount(np.minimum(k, length - k)).astype(float)


class RowSpectra(NamedTuple):
    """Spectra of the rows of an estimate."""

    lines: list[Lines]  # of every length of stretches
    # columns of the inverse information of each channel [base, columns]
    inverses: list[np.ndarray]
    # products of each channel's instruments by bins [bins, columns, columns]
    products: list[np.ndarray]
    complete: bool  # whether all rows were transformed


class _StretchChannel(NamedTuple):
    """One channel of a stretch, to be transformed."""

    lines: Lines
    number: int
    channel: Channel


def row_spectra(problem: RegressionProblem, estimate: Estimate) -> RowSpectra:
    """Transform the stretches of the rows in one pass."""
    stretches, complete = _divide_into_stretches(problem)
    lengths = _shared_lengths(problem, stretches)
    all_lines: dict[tuple, Lines] = {}
    inverses: dict[int, np.ndarray] = {}
    products: dict[int, np.ndarray] = {}

    def channels() -> Iterator[_StretchChannel]:
        for rows in _rows_of_stretches(problem, stretches):
            recording = problem.recordings[rows.recording]
            row_time = recording.row_time
            length = lengths[len(rows.mask), row_time]
            frequency, gain = _visible_lines(recording, length)
            key = length, row_time, len(frequency)
            if key not in all_lines:
                sizes = problem.base.size, recording.joints
                all_lines[key] = Lines(length, row_time, frequency, gain, *sizes)
            lines = all_lines[key]
            residuals = rows.residuals(estimate.parameters)
            lines.add_residuals(np.where(rows.mask, residuals, 0.0))
            for c, channel in enumerate(estimate.influence(rows, residuals)):
                yield _StretchChannel(lines, c, channel)

    def transform(task: _StretchChannel) -> tuple[_StretchChannel, ChannelSpectra]:
        return task, task.lines.transform_channel(task.channel, estimate.inverse)

    # This thread makes the rows of the next stretch while others transform the channels
    # of one.
    other_cores = max(1, (os.cpu_count() or 1) - 1)
    joints = problem.robot.joints
    for task, spectra in on_cores(transform, channels(), other_cores, joints):
        c = task.number
        task.lines.add_channel(c, spectra)
        inverses[c] = estimate.inverse[:, list(task.channel.columns)]
        products[c] = products.get(c, 0.0) + spectra.products
    return RowSpectra(
        list(all_lines.values()),
        list(inverses.values()),
        list(products.values()),
        complete,
    )


def _divide_into_stretches(problem: RegressionProblem) -> tuple[list[Span], bool]:
    """Divide recordings into stretches; return whether they hold all rows.

    Rows of different stretches count as independent: the relative error is about the
    correlation time of the noise over the length of a stretch.
    """
    samples = sum(o.samples for o in problem.recordings)
    complete = samples <= MAX_SAMPLES
    max_rows = MAX_ROWS if complete else MAX_ROWS // 4
    stretches = []
    for number, recording in enumerate(problem.recordings):
        max_length = 4 * max_rows // recording.decimation.factor
        length = max(4, min(max_rows, max_length))
        for start, stop in recording.row_segments:
            # Equal lengths have fast transforms; all rows must be in a stretch.
            edges = [*range(start, stop, length), stop]
            if complete:
                parts = np.array_split(np.arange(start, stop), len(edges) - 1)
                edges = [*(int(part[0]) for part in parts), stop]
            stretches += [Span(number, a, b) for a, b in itertools.pairwise(edges)]
    if complete:
        return stretches, True
    count = max(1, len(stretches) * (3 * MAX_SAMPLES // 8) // samples)
    places = (np.arange(count) + 0.5) * len(stretches) / count
    return [stretches[k] for k in np.unique(places.astype(int))], False


def _shared_lengths(
    problem: RegressionProblem, stretches: Sequence[Span]
) -> dict[tuple[int, float], int]:
    """Return the length of the lines for every number of rows and time between them."""
    kinds = set()
    for stretch in stretches:
        row_time = problem.recordings[stretch.recording].row_time
        kinds.add((stretch.stop - stretch.start, row_time))
    if len(kinds) <= MAX_LENGTHS:
        return {(rows, row_time): rows for rows, row_time in kinds}
    lengths = {}
    longest: dict[float, int] = {}
    for rows, row_time in sorted(kinds, reverse=True):
        if rows * 1.5 < longest.get(row_time, math.inf):
            longest[row_time] = rows
        lengths[rows, row_time] = longest[row_time]
    return lengths


def _rows_of_stretches(
    problem: RegressionProblem, stretches: Sequence[Span]
) -> Iterator[RowChunk]:
    """Yield the rows of each stretch in one chunk."""
    parts = []
    for chunk in problem.chunks(stretches):
        for stretch in stretches:
            start = max(chunk.rows.start, stretch.start)
            stop = min(chunk.rows.stop, stretch.stop)
            if chunk.recording == stretch.recording and start < stop:
                parts.append(chunk.part(slice(start, stop)))
                if stop == stretch.stop:
                    yield join_chunks(parts)
                    parts = []


def _visible_lines(
    recording: Observations, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and gains of the lines that filter and decimation let pass."""
    frequency = fft.rfftfreq(length, recording.row_time)
    sample_time = recording.sample_time
    decimation = recording.decimation
    gain = recording.filter.low_pass(sample_time).gain(frequency, sample_time)
    for k, factor in enumerate(decimation.stages):
        gain = gain * decimation.low_pass(k).gain(frequency, sample_time)
        sample_time *= factor
    # Lines with less gain carry no information.
    count = int(np.flatnonzero(gain > 1e-3)[-1]) + 1
    return frequency[:count], gain[:count]


class SpectralWindows:
    """Windows of neighbouring lines, over which periodograms are smoothed.

    A window reaches 30 % of its frequency to either side, at least 0.25 Hz and four
    lines of the longest stretch [s]. The methods take NumPy and JAX arrays, with the
    lines as last axis in any order.
    """

    def __init__(self, frequency: Float[np.ndarray, " lines"], longest: float):
        self._order = np.argsort(frequency, kind="stable")
        places = np.argsort(self._order)
        ordered = frequency[self._order]
        half_widths = np.maximum(max(0.25, 4.0 / longest), 0.3 * ordered)
        margins = half_widths * (1 + 1e-9)
        first = np.searchsorted(ordered, ordered - margins, side="left")
        end = np.searchsorted(ordered, ordered + margins, side="right")
        self._lines = first[places], end[places]
        # Both ends of a window rise with its middle: the windows around a line are
        # neighbours.
        numbers = np.arange(len(ordered))
        first_window = np.searchsorted(end, numbers, side="right")
        end_window = np.searchsorted(first, numbers, side="right")
        self._windows = first_window[places], end_window[places]

    def sum_lines(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over the lines of its window."""
        return self._sum(x, *self._lines)

    def sum_windows(self, x: AnyArray) -> AnyArray:
        """Return for each line the sum over the windows that it is in."""
        return self._sum(x, *self._windows)

    def _sum(self, x: AnyArray, first: np.ndarray, end: np.ndarray) -> AnyArray:
        xp = namespace(x)
        sums = x[..., self._order].cumsum(axis=-1)
        sums = xp.concatenate([xp.zeros_like(sums[..., :1]), sums], axis=-1)
        return sums[..., end] - sums[..., first]


class SpectralTable:
    r"""The sandwich as a linear map of periodograms, $var_i = \sum_{jf} C_{ijf} I_{jf}$.

    Computed once for a design and applied to many draws; in NumPy, or in JAX where `xp`
    is `jax.numpy`. The other arguments are those of `Lines`, of all lengths of
    stretches together.
    """

    def __init__(
        self, xp, frequency, multiplicity, energy, leverage, exposure, longest
    ):
        self._xp = xp
        self._windows = SpectralWindows(frequency, longest)
        # A line and its mirror image are one random number.
        self._half = 0.5 * multiplicity[None]
        remaining_part = self._windows.sum_lines(self._half * (exposure - leverage))
        # A fit is assumed to leave at least 2 % of a window's power.
        min_part = 0.02 * self._windows.sum_lines(self._half * exposure)
        self._remaining_part = xp.maximum(remaining_part, xp.maximum(min_part, 1e-300))
        # Channel by channel: fewer numbers at once.
        self._maps = []
        for c in range(len(leverage)):
            smooth = energy[:, c] / self._remaining_part[c][None]
            self._maps.append(self._half * self._windows.sum_windows(smooth))
        # From a line's power to the scatter of its mean over the stretches.
        stretches = xp.maximum(exposure, 1.0)
        self._scatter = xp.sqrt(2.0 / (self._half * (1.0 + stretches)))

    @classmethod
    def of(cls, lines: Sequence[Lines]) -> "SpectralTable":
        """Return the table of the spectra of every length of stretches."""
        exposures = [x.exposure[:, None] + np.zeros_like(x.leverage) for x in lines]
        return cls(
            np,
            _join([x.frequency for x in lines]),
            _join([x.multiplicity for x in lines]),
            _join([x.energy for x in lines]),
            _join([x.leverage for x in lines]),
            _join(exposures),
            longest=max(x.length * x.row_time for x in lines),
        )

    def density(self, power: np.ndarray) -> np.ndarray:
        """Return the spectrum of the errors at each line, from the periodogram of residuals."""
        sums = self._windows.sum_lines(self._half * power)
        return np.asarray(sums / self._remaining_part)

    def __call__(self, power: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return variances and degrees of freedom for periodograms [draws, channels, lines]."""
        xp = self._xp
        variance: Any = 0.0
        squares: Any = 0.0
        for c, line_map in enumerate(self._maps):
            scatter = power[:, c] * self._scatter[c][None]
            variance = variance + power[:, c] @ line_map.T
            squares = squares + scatter**2 @ (line_map**2).T
        has_scatter = squares > 0
        dof = 4.0 * variance**2 / xp.where(has_scatter, squares, 1.0)
        return variance, xp.where(has_scatter, dof, xp.inf)


def _join(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return the arrays of all lengths of stretches side by side; one alone is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=-1)


def sandwich(spectra: RowSpectra) -> tuple[np.ndarray, np.ndarray]:
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
    for density, inverse, products in zip(
        table.density(power), spectra.inverses, spectra.products, strict=True
    ):
        means = np.bincount(bins, weights * density, BIN_COUNT) / bin_sizes
        information = np.einsum("k,kab->ab", means, products)
        covariance += inverse @ information @ inverse.T
    deviations = np.sqrt(np.maximum(variances, 0.0))
    return rescale_covariance(covariance, deviations), np.maximum(dof, 1.0)


def white_variances(lines: Sequence[Lines]) -> np.ndarray:
    """Return variances of the estimates for white errors, with one level for each joint."""
    rows = sum(x.length * x.exposure for x in lines)
    explained = sum(np.sum(x.multiplicity * x.leverage) for x in lines)
    power = sum(np.sum(x.multiplicity * x.power, axis=1) for x in lines)
    remaining_share = 1.0 - explained / max(np.sum(rows), 1.0)
    levels = power / np.maximum(rows * remaining_share, 1.0)
    return np.sum([np.einsum("icf,c->i", x.energy, levels) for x in lines], axis=0)


def residual_spectra(lines: Sequence[Lines]) -> ResidualSpectra:
    """Return spectra and whiteness of the residuals, from the stretches with the most rows."""
    longest = max(lines, key=lambda x: x.length * x.stretches)
    half = 0.5 * longest.multiplicity
    windows = SpectralWindows(longest.frequency, longest.length * longest.row_time)
    smooth = windows.sum_lines(half * longest.residual) / windows.sum_lines(half)
    mean_exposure = np.mean(longest.exposure)
    # One-sided: the mirror image of a line counts with it.
    scale = 2.0 * longest.row_time / np.maximum(mean_exposure, 1e-300)

    is_passed = (longest.gain > 0.5) & (longest.frequency > 0)
    if not is_passed.any():
        is_passed = longest.gain > 0
    leverage = longest.leverage / longest.exposure[:, None]
    remaining_part = np.clip(1.0 - leverage, 0.02, None)
    power = (longest.residual / remaining_part / longest.gain**2)[:, is_passed]
    total = power.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(power, axis=1) / np.where(total > 0, total, 1.0)
    count = power.shape[1]
    straight_line = np.arange(1, count + 1) / count
    low_frequencies = max(1, round(0.1 * count))
    figure_lines = np.unique(np.linspace(0, len(half) - 1, 400).round().astype(int))
    return ResidualSpectra(
        frequency=longest.frequency[figure_lines],
        density=scale * smooth[:, figure_lines],
        gain=longest.gain[figure_lines],
        departure=np.abs(cumulative - straight_line).max(axis=1),
        # Kolmogorov's quantile of 95 %.
        limit=float(1.358 / np.sqrt(count * mean_exposure)),
        low_frequency=cumulative[:, low_frequencies - 1],
        band=float(longest.frequency[is_passed][-1]),
    )


def sandwich_of_columns(
    xp, own, weights, inverse, p, columns, forces, exposure, row_time: float
):
    """Return variances and degrees of freedom of estimates `p` [draws, base], in NumPy or JAX.

    Columns [columns, rows] and forces [draws, rows] of each joint are zero where a row
    does not count; the columns belong to its `own` parameters; `exposure` is the
    fraction of rows that count.
    """
    length = columns[0].shape[-1]
    times = multiplicity(length)
    energy, leverage, power = [], [], []
    for indices, theta, Q, weight in zip(own, columns, forces, weights, strict=True):
        places = np.array(indices, int)
        equations = xp.fft.rfft(weight * theta)
        disturbance = xp.fft.rfft(weight * (Q - p[:, places] @ theta))
        real = inverse[:, places] @ equations.real
        imaginary = inverse[:, places] @ equations.imag
        explained = real[places] * equations.real + imaginary[places] * equations.imag
        energy.append(times[None] / length * (real**2 + imaginary**2))
        leverage.append(xp.sum(explained, axis=0) / length)
        power.append((disturbance.real**2 + disturbance.imag**2) / length)
    leverage = xp.stack(leverage)
    table = SpectralTable(
        xp,
        fft.rfftfreq(length, row_time),
        times,
        xp.stack(energy, axis=1),
        leverage,
        xp.broadcast_to(exposure[:, None], leverage.shape),
        length * row_time,
    )
    variance, dof = table(xp.stack(power, axis=1))
    return xp.asarray(variance), xp.maximum(dof, 1.0)
