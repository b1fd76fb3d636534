"""Spectra of the rows: what moves an estimate, and the residuals, line by line."""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.identification.estimators.estimate import Channel, Estimate
from jaxid.identification.factors import RowChunk
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.observations import Observations

MAX_ROWS = 2**15
"""Largest number of rows of a stretch; longer parts of a log are divided."""
MAX_SAMPLES = 2**20
"""Samples up to which every stretch is transformed; of longer logs some, evenly spread."""
MAX_LENGTHS = 4
"""Number of different lengths up to which each has its own lines; of more, similar ones share them,
so that memory does not grow with the number of gaps."""
BIN_EDGES = np.concatenate([np.arange(0.0, 1.0, 0.05), 1.15 ** np.arange(0, 80)])
"""Edges [Hz] of the bins in which spectra count as constant for correlations of parameters."""


class Stretch(NamedTuple):
    """Contiguous, equidistant rows of one recording, which are transformed at once.

    Attributes:
        recording: Index of the recording.
        rows: Half-open range of its rows.
        row_time: Time between two rows [s].
    """

    recording: int
    rows: tuple[int, int]
    row_time: float

    @property
    def length(self) -> int:
        """Number of rows."""
        return self.rows[1] - self.rows[0]


class Lines(NamedTuple):
    r"""Spectra of all stretches of one length, added up.

    Attributes:
        length: Rows of a stretch; shorter ones are padded with rows that do not count.
        row_time: Time between two rows [s].
        frequency: Frequencies of the lines [Hz].
        multiplicity: 2, or 1 for lines without a mirror image.
        gain: Gain (0 to 1) of the filters.
        energy: $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, channels, lines].
        bins: Bin of each line.
        leverage: Fraction (0 to 1) of each line explained by the fit [channels, lines].
        power: Periodogram of the disturbances [channels, lines].
        residual: Periodogram of the residuals [joints, lines], in [N² m²] or [N²].
        exposure: Number of stretches, weighted by the fraction of rows of each channel that count.
        stretches: Number of stretches.
    """

    length: int
    row_time: float
    frequency: np.ndarray
    multiplicity: np.ndarray
    gain: np.ndarray
    energy: np.ndarray
    bins: np.ndarray
    leverage: np.ndarray
    power: np.ndarray
    residual: np.ndarray
    exposure: np.ndarray
    stretches: int

    def add(self, other: "Lines") -> "Lines":
        """Return the sums with the spectra of stretches with the same lines."""
        names = ("energy", "leverage", "power", "residual", "exposure", "stretches")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return self._replace(**sums)


class RowSpectra(NamedTuple):
    """Spectra of the rows of an estimate.

    Attributes:
        lines: Spectra of every length of stretches.
        correlated: Energies of pairs of parameters, summed over the lines of each bin
            [bins, channels, base, base].
        complete: Whether all rows were transformed.
    """

    lines: list[Lines]
    correlated: np.ndarray
    complete: bool


def row_spectra(problem: RegressionProblem, estimate: Estimate) -> RowSpectra:
    """Transform every stretch of the rows in one pass.

    Args:
        problem: Rows of the estimate.
        estimate: Estimate, whose influence makes channels of the rows.
    """
    stretches, complete = _divide(problem)
    lengths = _padded_lengths(stretches)
    found: dict[tuple, Lines] = {}
    B, p = np.asarray(estimate.inverse), np.asarray(estimate.parameters)
    correlated = np.zeros((0, 0, *B.shape))
    for stretch, parts in _gather(problem, stretches, p):
        observations = problem.recordings[stretch.recording]
        pieces = [estimate.influence.channels(chunk, residuals) for chunk, residuals in parts]
        if not len(correlated):
            correlated = np.zeros((len(BIN_EDGES) + 1, len(pieces[0]), *B.shape))
        r = np.concatenate([np.where(chunk.mask, r, 0.0) for chunk, r in parts])
        n = lengths[stretch.length, stretch.row_time]
        lines = _transform(n, stretch.row_time, pieces, r, B, observations, correlated)
        key = (n, stretch.row_time, len(lines.frequency))
        found[key] = found[key].add(lines) if key in found else lines
    return RowSpectra(list(found.values()), correlated, complete)


def multiplicity(length: int) -> Float[np.ndarray, " lines"]:
    """Return how often a line counts: for itself, and for its mirror image."""
    m = np.full(length // 2 + 1, 2.0)
    m[0] = 1.0
    if length % 2 == 0:
        m[-1] = 1.0
    return m


def _transform(
    n: int,
    row_time: float,
    pieces: list[list[Channel]],
    residuals: np.ndarray,
    inverse: np.ndarray,
    observations: Observations,
    correlated: np.ndarray,
) -> Lines:
    """Return the lines of one stretch; add the energies of pairs to `correlated`."""
    frequency = np.fft.rfftfreq(n, row_time)
    gain = _gain(observations, frequency)
    # Lines with less gain carry no information.
    last = int(np.flatnonzero(gain > 1e-3)[-1]) + 1
    frequency, gain, m = frequency[:last], gain[:last], multiplicity(n)[:last]
    bins = np.searchsorted(BIN_EDGES, frequency, side="right")
    present, starts = np.unique(bins, return_index=True)
    size, channels = len(inverse), len(pieces[0])
    energy = np.empty((size, channels, last))
    leverage, power = np.empty((channels, last)), np.empty((channels, last))
    exposure = np.empty(channels)
    for c in range(channels):
        own, Z, theta, u, counted = _join([piece[c] for piece in pieces])
        Zf = np.fft.rfft(Z, n, axis=0)[:last]
        P = Zf @ inverse[:, own].T
        energy[:, c] = (np.abs(P) ** 2 * m[:, None]).T / n
        weighted = P * np.sqrt(m / n)[:, None]
        for k, (a, b) in zip(present, itertools.pairwise([*starts, last]), strict=True):
            both = np.concatenate([weighted[a:b].real, weighted[a:b].imag])
            correlated[k, c] += both.T @ both
        Tf = Zf if theta is Z else np.fft.rfft(theta, n, axis=0)[:last]
        leverage[c] = np.real(np.sum(P[:, own].conj() * Tf, axis=1)) / n
        power[c] = np.abs(np.fft.rfft(u, n)[:last]) ** 2 / n
        exposure[c] = counted / n
    residual = np.abs(np.fft.rfft(residuals, n, axis=0)[:last].T) ** 2 / n
    sums = energy, bins, leverage, power, residual, exposure
    return Lines(n, row_time, frequency, m, gain, *sums, 1)


def _join(pieces: list[Channel]) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray, int]:
    """Join the rows of one channel: columns, instruments, equations, disturbances, and count."""
    first = pieces[0]
    Z = np.concatenate([x.instruments for x in pieces])
    same = all(x.equations is x.instruments for x in pieces)
    theta = Z if same else np.concatenate([x.equations for x in pieces])
    u = np.concatenate([x.disturbance for x in pieces])
    return list(first.columns), Z, theta, u, sum(x.counted for x in pieces)


def _divide(problem: RegressionProblem) -> tuple[list[Stretch], bool]:
    """Divide recordings into stretches; return whether they hold all rows.

    Rows of different stretches count as independent: the relative error is about the correlation
    time of the noise over the length of a stretch.
    """
    stretches, samples = [], 0
    for number, o in enumerate(problem.recordings):
        most = max(4, min(MAX_ROWS, 4 * MAX_ROWS // o.decimation.factor))
        for a, b in o.row_segments:
            parts = np.array_split(np.arange(a, b), math.ceil((b - a) / most))
            stretches += [
                Stretch(number, (int(part[0]), int(part[-1]) + 1), o.row_time) for part in parts
            ]
        samples += o.samples
    if samples <= MAX_SAMPLES:
        return stretches, True
    count = max(1, len(stretches) * MAX_SAMPLES // samples)
    chosen = np.linspace(0, len(stretches) - 1, count).round().astype(int)
    return [stretches[k] for k in np.unique(chosen)], False


def _padded_lengths(stretches: list[Stretch]) -> dict[tuple[int, float], int]:
    """Return the padded length of stretches, by length and time between rows."""
    kinds = {(s.length, s.row_time) for s in stretches}
    if len(kinds) <= MAX_LENGTHS:
        return {kind: kind[0] for kind in kinds}
    padded = {}
    for row_time in {t for _, t in kinds}:
        lengths = sorted((n for n, t in kinds if t == row_time), reverse=True)
        top = lengths[0]
        for n in lengths:
            top = n if n * 1.5 < top else top
            padded[n, row_time] = top
    return padded


def _gain(observations: Observations, frequency: Float[np.ndarray, " lines"]) -> np.ndarray:
    """Return the gain of filter and decimation at some frequencies [Hz]."""
    dt = observations.sample_time
    gain = observations.filter.low_pass(dt).gain(frequency, dt)
    for k, factor in enumerate(observations.decimation.stages):
        gain = gain * observations.decimation.low_pass(k).gain(frequency, dt)
        dt *= factor
    return gain


def _gather(
    problem: RegressionProblem, stretches: list[Stretch], p: np.ndarray
) -> Iterator[tuple[Stretch, list[tuple[RowChunk, np.ndarray]]]]:
    """Yield each stretch with its chunks and residuals, in one pass over the rows."""
    remaining = iter(stretches)
    stretch = next(remaining, None)
    parts: list[tuple[RowChunk, np.ndarray]] = []
    spans = [(s.recording, *s.rows) for s in stretches]
    for chunk, residuals in problem.residuals(p, spans):
        begin, end = (chunk.recording, chunk.rows.start), (chunk.recording, chunk.rows.stop)
        while stretch is not None and begin < (stretch.recording, stretch.rows[1]):
            if end <= (stretch.recording, stretch.rows[0]):
                break
            low = max(chunk.rows.start, stretch.rows[0])
            high = min(chunk.rows.stop, stretch.rows[1])
            own = slice(low - chunk.rows.start, high - chunk.rows.start)
            parts.append((chunk.part(own), residuals[own]))
            if high < stretch.rows[1]:
                break
            yield stretch, parts
            stretch, parts = next(remaining, None), []
