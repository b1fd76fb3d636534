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
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft, stats

from jaxid.arrays import AnyArray, Float, on_cores
from jaxid.measurement.observations import Observations

from ..estimators.estimate import Channel, Estimate
from ..factors import RowChunk
from ..problem import RegressionProblem, Span
from .blocks import BlockJackknife, jackknife
from .result import AbstractUncertainty, ResidualSpectra, Uncertainty

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


class SpectralSandwich(AbstractUncertainty):
    """Spectral sandwich: right for errors that are correlated from row to row (default).

    Errors are assumed stationary and independent between joints, recordings, and parts
    of a log on both sides of a gap. Where the errors are larger in the part of a log
    that decides a parameter, the block jackknife gives more than chance allows: then
    its deviation counts. It needs one pass over the rows. Of logs of more than
    `MAX_SAMPLES` some evenly spread stretches are transformed: these give the ratio to
    the naive values. Where only factors are known, the block jackknife takes the place
    of all.
    """

    def __call__(self, problem, estimate, naive):
        """Return the sandwich, wider where the jackknife contradicts it."""
        if not problem.recordings:
            found, _ = BlockJackknife()(problem, estimate, naive)
            note = (
                "standard deviations come from the block jackknife: only factors "
                "were given."
            )
            return dataclasses.replace(found, notes=found.notes or (note,)), None
        lines, pairs, complete = row_spectra(problem, estimate)
        covariance, dof, white = sandwich(lines, pairs)
        exact = np.diag(naive)
        if not complete:
            known = (white > 0) & np.isfinite(exact)
            ratio = np.sqrt(
                np.divide(exact, white, out=np.ones_like(white), where=known)
            )
            covariance = covariance * ratio * ratio[:, None]
        unknown = np.isinf(exact)
        covariance[unknown, unknown] = np.inf
        found = Uncertainty(covariance, dof, naive, jackknife(estimate))
        return _widened(found, estimate), residual_spectra(lines)


def _widened(found: Uncertainty, estimate: Estimate) -> Uncertainty:
    """Take the jackknife's deviations where chance allows them once in ten thousand times."""
    if found.jackknife is None:
        return found
    # The fewer blocks decide a parameter, the more its jackknife scatters.
    parts = [part.weighted(estimate.weights)[0] for part in estimate.blocks.parts]
    shares = np.array([np.sum((R @ estimate.inverse) ** 2, axis=0) for R in parts])
    deciding = shares.sum(axis=0) ** 2 / np.maximum((shares**2).sum(axis=0), 1e-300)
    size, dof = found.standard_deviations, np.asarray(found.dof)
    known = np.isfinite(size) & (size > 0)
    ratio = np.divide(found.jackknife, size, out=np.ones_like(size), where=known)
    wider = ratio**2 > stats.f.ppf(0.9999, np.maximum(deciding, 1.0), dof)
    scale = np.where(wider, ratio, 1.0)
    covariance = np.asarray(found.covariance) * scale * scale[:, None]
    return dataclasses.replace(found, covariance=covariance)


class Lines(NamedTuple):
    r"""Spectra of all stretches of one length, added up.

    A stretch is a contiguous, equidistant part of the rows, which is transformed at
    once.
    """

    length: (
        int  # rows of a stretch; shorter ones are padded with rows that do not count
    )
    row_time: float
    frequency: np.ndarray
    multiplicity: np.ndarray
    gain: np.ndarray
    bins: np.ndarray
    energy: (
        np.ndarray
    )  # $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, channels, lines]
    leverage: (
        np.ndarray
    )  # fraction (0 to 1) of each line explained by the fit [channels, lines]
    power: np.ndarray  # periodogram of the disturbances [channels, lines]
    residual: (
        np.ndarray
    )  # periodogram of the residuals [joints, lines], in [N² m²] or [N²]
    exposure: (
        np.ndarray
    )  # stretches, weighted by the fraction of each channel's rows that count
    stretches: np.ndarray  # number of stretches, as an array without axes

    @classmethod
    def empty(
        cls, length: int, observations: Observations, sizes: tuple[int, int]
    ) -> "Lines":
        """Return the lines of no stretch yet, for some sizes (base parameters, channels)."""
        row_time, (base, channels) = observations.row_time, sizes
        frequency = fft.rfftfreq(length, row_time)
        dt, decimation = observations.sample_time, observations.decimation
        gain = observations.filter.low_pass(dt).gain(frequency, dt)
        for k, factor in enumerate(decimation.stages):
            gain = gain * decimation.low_pass(k).gain(frequency, dt)
            dt *= factor
        # Lines with less gain carry no information.
        count = int(np.flatnonzero(gain > 1e-3)[-1]) + 1
        frequency = frequency[:count]
        bins = np.searchsorted(BIN_EDGES, frequency, side="right")
        known = frequency, multiplicity(length)[:count], gain[:count], bins
        joints = observations.mask.shape[1]
        shapes = (
            (base, channels, count),
            (channels, count),
            (channels, count),
            (joints, count),
        )
        sums = map(np.zeros, (*shapes, channels, ()))
        return cls(length, row_time, *known, *sums)

    def transform(self, rows: np.ndarray) -> np.ndarray:
        """Return the Fourier transform of the rows of a stretch, on the last axis."""
        return np.asarray(fft.rfft(rows, self.length))[..., : len(self.frequency)]


def row_spectra(problem: RegressionProblem, estimate: Estimate):
    """Transform every stretch of the rows in one pass.

    Returns:
        Spectra of every length of stretches; for each channel its columns of $B$ and
        the products of its instruments, summed over the lines of each bin [bins,
        columns, columns]; whether all rows were transformed.
    """
    stretches, complete = _divide(problem)
    kinds = {(b - a, problem.recordings[number].row_time) for number, a, b in stretches}
    lengths, longest = {}, {}
    for n, row_time in sorted(kinds, reverse=True):
        if len(kinds) <= MAX_LENGTHS or n * 1.5 < longest.get(row_time, math.inf):
            longest[row_time] = n
        lengths[n, row_time] = longest[row_time]
    found: dict[tuple, Lines] = {}
    pairs: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    B, p = np.asarray(estimate.inverse), np.asarray(estimate.parameters)

    def pieces_of_stretches() -> Iterator[tuple[Span, RowChunk, np.ndarray]]:
        for chunk, residuals in problem.residuals(p, stretches):
            start, stop = chunk.rows.start, chunk.rows.stop
            for number, a, b in stretches:
                own = slice(max(start, a) - start, min(stop, b) - start)
                if number == chunk.recording and own.start < own.stop:
                    yield (number, a, b), chunk.part(own), residuals[own]

    def channels() -> Iterator[tuple[Lines, int, Sequence[Channel]]]:
        for (number, a, b), group in itertools.groupby(
            pieces_of_stretches(), lambda x: x[0]
        ):
            o, parts = problem.recordings[number], [(chunk, r) for _, chunk, r in group]
            pieces = [
                estimate.influence(chunk, residuals) for chunk, residuals in parts
            ]
            new = Lines.empty(
                lengths[b - a, o.row_time], o, (len(B), parts[0][1].shape[1])
            )
            lines = found.setdefault((new.length, o.row_time, len(new.frequency)), new)
            r = np.concatenate([np.where(chunk.mask, r, 0.0) for chunk, r in parts])
            lines.residual[...] += np.abs(lines.transform(r.T)) ** 2 / lines.length
            lines.stretches[...] += 1
            del parts
            for c, own in enumerate(zip(*pieces, strict=True)):
                yield lines, c, own

    # This thread makes the rows of the next stretch while others transform the channels
    # of one.
    others = max(1, (os.cpu_count() or 1) - 1)
    transformed = on_cores(
        lambda x: (*x[:2], _channel(x[0], B, x[2])),
        channels(),
        others,
        problem.robot.joints,
    )
    for lines, c, (own, energy, leverage, power, exposure, products) in transformed:
        lines.energy[:, c] += energy
        lines.leverage[c] += leverage
        lines.power[c] += power
        lines.exposure[c] += exposure
        pairs[c] = B[:, own], products + (pairs[c][1] if c in pairs else 0.0)
    return list(found.values()), list(pairs.values()), complete


def multiplicity(length: int) -> Float[np.ndarray, " lines"]:
    """Return how often a line counts: for itself, and for its mirror image."""
    k = np.arange(length)
    return np.bincount(np.minimum(k, length - k)).astype(float)


def _channel(lines: Lines, inverse: np.ndarray, parts: Sequence[Channel]) -> tuple:
    """Return columns, the sums of `Lines`, and products by bins, of one channel of a stretch."""
    n, m = lines.length, lines.multiplicity
    own, scale = list(parts[0].columns), np.repeat(np.sqrt(m / n), 2)

    def transform(rows: list[np.ndarray]) -> np.ndarray:
        """Return real and imaginary parts of each line, weighted by how often it counts."""
        return scale * lines.transform(np.concatenate(rows).T).view(float)

    Z = theta = transform([x.instruments for x in parts])
    if any(x.equations is not x.instruments for x in parts):
        theta = transform([x.equations for x in parts])
    P = inverse[:, own] @ Z
    leverage = np.einsum("if,if->f", P[own], theta)
    leverage = (leverage[::2] + leverage[1::2]) / m
    np.square(P, out=P)
    energy = P[:, ::2] + P[:, 1::2]
    products = np.zeros((len(BIN_EDGES) + 1, len(own), len(own)))
    present, starts = np.unique(lines.bins, return_index=True)
    for k, (a, b) in zip(present, itertools.pairwise([*starts, len(m)]), strict=True):
        both = Z[:, 2 * a : 2 * b]
        products[k] = both @ both.T
    power = (
        np.abs(lines.transform(np.concatenate([x.disturbance for x in parts]))) ** 2 / n
    )
    return own, energy, leverage, power, sum(x.counted for x in parts) / n, products


def _divide(problem: RegressionProblem) -> tuple[list[Span], bool]:
    """Divide recordings into stretches; return whether they hold all rows.

    Rows of different stretches count as independent: the relative error is about the
    correlation time of the noise over the length of a stretch.
    """
    samples = sum(o.samples for o in problem.recordings)
    complete = samples <= MAX_SAMPLES
    rows, stretches = MAX_ROWS if complete else MAX_ROWS // 4, []
    for number, o in enumerate(problem.recordings):
        most = max(4, min(rows, 4 * rows // o.decimation.factor))
        for a, b in o.row_segments:
            if complete:
                parts = np.array_split(np.arange(a, b), math.ceil((b - a) / most))
                stretches += [
                    (number, int(part[0]), int(part[-1]) + 1) for part in parts
                ]
            else:
                # Equal lengths have fast transforms.
                stretches += [(number, k, min(k + most, b)) for k in range(a, b, most)]
    if complete:
        return stretches, True
    count = max(1, len(stretches) * (3 * MAX_SAMPLES // 8) // samples)
    chosen = (np.arange(count) + 0.5) * len(stretches) / count
    return [stretches[k] for k in np.unique(chosen.astype(int))], False


def window_sums(frequency: Float[np.ndarray, " lines"], longest: float):
    """Return functions that sum arrays over windows of lines, and over the windows with a line.

    A window reaches 30 % of its frequency to either side, at least 0.25 Hz and four
    lines of the longest stretch [s]. The functions take NumPy and JAX arrays, with the
    lines as last axis.
    """
    order = np.argsort(frequency, kind="stable")
    place = np.argsort(order, kind="stable")
    f = frequency[order]
    half = np.maximum(max(0.25, 4.0 / longest), 0.3 * f)
    low = np.searchsorted(f, f - half * (1 + 1e-9), side="left")
    high = np.searchsorted(f, f + half * (1 + 1e-9), side="right")
    # Both ends of a window rise with its middle: the windows around a line are
    # neighbours.
    first = np.searchsorted(high, np.arange(len(f)), side="right")
    last = np.searchsorted(low, np.arange(len(f)), side="right")

    def between(low: np.ndarray, high: np.ndarray) -> Callable[[AnyArray], AnyArray]:
        def total(x: AnyArray) -> AnyArray:
            sums = x[..., order].cumsum(axis=-1)
            flat = (*(1,) * (x.ndim - 1), -1)
            before = sums[..., np.maximum(low - 1, 0)] * (low > 0).astype(
                float
            ).reshape(flat)
            after = sums[..., np.maximum(high - 1, 0)] * (high > 0).astype(
                float
            ).reshape(flat)
            return (after - before)[..., place]

        return total

    return between(low, high), between(first, last)


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
        self._sums, transposed_sums = window_sums(frequency, longest)
        self._half = half = 0.5 * multiplicity[None]
        # A fit is assumed to leave at least 2 % of a window's power.
        rest = self._sums(half * (exposure - leverage))
        least = 0.02 * self._sums(half * exposure)
        self._rest = xp.maximum(rest, xp.maximum(least, 1e-300))
        # Channel by channel: fewer numbers at once.
        pairs = [(energy[:, c], self._rest[c]) for c in range(len(self._rest))]
        self._maps = [half * transposed_sums(x / rest[None]) for x, rest in pairs]
        # From a line's power to the scatter of its mean over the stretches.
        self._scatter = xp.sqrt(2.0 / (half * (1.0 + xp.maximum(exposure, 1.0))))

    @classmethod
    def of(cls, lines: Sequence[Lines]) -> "SpectralTable":
        """Return the table of the spectra of every length of stretches."""
        names = "frequency", "multiplicity", "energy", "leverage"
        arrays = [[getattr(x, name) for x in lines] for name in names]
        arrays.append([x.exposure[:, None] + 0 * x.leverage for x in lines])
        longest = max(x.length * x.row_time for x in lines)
        joined = (np.concatenate(x, -1) if len(x) > 1 else x[0] for x in arrays)
        return cls(np, *joined, longest=longest)

    def density(self, power: np.ndarray) -> np.ndarray:
        """Return the spectrum of the errors at each line, from the periodogram of residuals."""
        return np.asarray(self._sums(self._half * power) / self._rest)

    def __call__(self, power: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return variances and degrees of freedom for periodograms [draws, channels, lines]."""
        xp, terms = self._xp, list(enumerate(self._maps))
        variance: Any = sum(power[:, c] @ C.T for c, C in terms)
        squares: Any = sum(
            (power[:, c] * self._scatter[c][None]) ** 2 @ (C**2).T for c, C in terms
        )
        positive = squares > 0
        dof = xp.where(
            positive, 4.0 * variance**2 / xp.where(positive, squares, 1.0), xp.inf
        )
        return variance, dof


def sandwich(lines: Sequence[Lines], pairs: Sequence[tuple[np.ndarray, np.ndarray]]):
    """Return the covariance of an estimate, degrees of freedom, and variances for white errors."""
    count, table = len(BIN_EDGES) + 1, SpectralTable.of(lines)
    power = np.concatenate([x.power for x in lines], axis=1)
    (variance,), (dof,) = table(power[None])
    bins = np.concatenate([x.bins for x in lines])
    weights = np.concatenate([x.multiplicity for x in lines])
    size = np.maximum(np.bincount(bins, weights, count), 1e-300)
    rough = np.zeros((len(variance), len(variance)))
    for density, (B, products) in zip(table.density(power), pairs, strict=True):
        mean = np.bincount(bins, weights * density, count) / size
        rough += B @ np.einsum("k,kab->ab", mean, products) @ B.T
    scale = np.sqrt(np.maximum(np.diag(rough), 1e-300))
    deviation = np.sqrt(np.maximum(variance, 0.0))
    covariance = rough / scale / scale[:, None] * deviation * deviation[:, None]
    covariance[np.diag_indices(len(variance))] = deviation**2
    # White errors have one level for each joint.
    rows = sum(x.length * x.exposure for x in lines)
    explained = sum(np.sum(x.multiplicity * x.leverage, axis=1) for x in lines)
    level = sum(np.sum(x.multiplicity * x.power, axis=1) for x in lines)
    free = 1.0 - np.sum(explained) / max(np.sum(rows), 1.0)
    level = level / np.maximum(rows * free, 1.0)
    white = np.sum([np.einsum("icf,c->i", x.energy, level) for x in lines], axis=0)
    return covariance, np.maximum(dof, 1.0), white


def residual_spectra(lines: Sequence[Lines]) -> ResidualSpectra:
    """Return spectra and whiteness of the residuals, from the stretches with the most rows."""
    most = max(lines, key=lambda x: x.length * x.stretches)
    rows = most.length * np.maximum(np.mean(most.exposure), 1e-300)
    half = 0.5 * most.multiplicity
    sums, _ = window_sums(most.frequency, most.length * most.row_time)
    smooth = sums(half * most.residual) / sums(half)
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


def sandwich_of_columns(
    xp, own, weights, inverse, p, columns, forces, exposure, row_time: float
):
    """Return variances and degrees of freedom of estimates `p` [draws, base], in NumPy or JAX.

    Columns [columns, rows] and forces [draws, rows] of each joint are zero where a row
    does not count; the columns belong to its own parameters; `exposure` is the fraction
    of rows that count.
    """
    length = columns[0].shape[-1]
    frequency, m = fft.rfftfreq(length, row_time), multiplicity(length)
    energy, leverage, power = [], [], []
    for k, A, Q, w in zip(own, columns, forces, weights, strict=True):
        mine = np.array(k, int)
        Z = xp.fft.rfft(w * A)
        real, imaginary = inverse[:, mine] @ Z.real, inverse[:, mine] @ Z.imag
        r = xp.fft.rfft(w * (Q - p[:, mine] @ A))
        energy.append(m[None] / length * (real**2 + imaginary**2))
        both = real[mine] * Z.real + imaginary[mine] * Z.imag
        leverage.append(xp.sum(both, axis=0) / length)
        power.append((r.real**2 + r.imag**2) / length)
    leverage = xp.stack(leverage)
    exposures = xp.broadcast_to(exposure[:, None], leverage.shape)
    sums = xp.stack(energy, axis=1), leverage, exposures
    table = SpectralTable(xp, frequency, m, *sums, length * row_time)
    variance, dof = table(xp.stack(power, axis=1))
    return xp.asarray(variance), xp.maximum(dof, 1.0)
