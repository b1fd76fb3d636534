r"""Spectra of the rows of an estimate: one pass transforms stretches of the recordings.

A stretch is a contiguous, equidistant part of the rows. Of each line the pass sums up
how much it moves the estimates ($K = |FFT_t P|^2 / N$, see `SpectralSandwich`), how
much of it the fit has explained, and the power of the residuals.
"""

import itertools
import math
import os
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import BaseMatrix, Matrices, Matrix, Vector, on_cores
from jaxid.measurement.observations import Observations

from ..estimators.estimate import Channel, Estimate
from ..factors import RowChunk, join_chunks
from ..problem import RegressionProblem, Span

MAX_ROWS = 2**15
"""Largest number of rows of a stretch; longer parts of a log are divided."""
MAX_SAMPLES = 2**17
"""Largest number of samples of which every stretch is transformed.

Of longer logs some stretches are, evenly spread, that are shorter and hold three
eighths as many samples together.
"""
MAX_LENGTHS = 4
"""Largest number of different lengths that each have their own lines.

Of more lengths similar ones share them, so that memory does not grow with the number
of gaps.
"""
BIN_EDGES = np.concatenate([np.arange(0.0, 1.0, 0.05), 1.15 ** np.arange(0, 80)])
"""Edges [Hz] of bins of constant spectra, for correlations of parameters."""
BIN_COUNT = len(BIN_EDGES) + 1


class ChannelSpectra(NamedTuple):
    """Spectra of one channel of a stretch."""

    # $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, lines]
    energy: Matrix
    leverage: Vector  # fraction (0 to 1) of each line explained by the fit
    power: Vector  # periodogram of the disturbances
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
        gain: Gain (0 to 1) of the filter at each line.
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
        frequency: Vector,
        gain: Vector,
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
        return np.asarray(scipy.fft.rfft(rows, self.length))[..., : len(self.frequency)]

    def add_residuals(self, residuals: Matrix) -> None:
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
        self, channel: Channel, inverse: BaseMatrix
    ) -> ChannelSpectra:
        """Return the spectra of one channel of a stretch."""
        columns = list(channel.columns)
        instruments = self._transform_parts(channel.instruments)
        equations = instruments
        if channel.equations is not channel.instruments:
            equations = self._transform_parts(channel.equations)
        influences = inverse[:, columns] @ instruments
        explained_power = np.einsum("if,if->f", influences[columns], equations)

        products = np.zeros((BIN_COUNT, len(columns), len(columns)))
        edges = 2 * np.searchsorted(self.bins, np.arange(BIN_COUNT + 1))
        for k, (start, stop) in enumerate(itertools.pairwise(edges)):
            if start < stop:
                lines = instruments[:, start:stop]
                products[k] = lines @ lines.T
        return ChannelSpectra(
            energy=_add_parts(np.square(influences, out=influences)),
            leverage=_add_parts(explained_power) / self.multiplicity,
            power=np.abs(self.transform(channel.disturbance)) ** 2 / self.length,
            exposure=channel.counted / self.length,
            products=products,
        )

    def _transform_parts(self, rows: Matrix) -> Matrix:
        """Return the real and imaginary parts of lines, weighted by their numbers."""
        scale = np.repeat(np.sqrt(self.multiplicity / self.length), 2)
        return scale * self.transform(rows.T).view(float)


def _add_parts(x: np.ndarray) -> np.ndarray:
    """Add what real and imaginary parts contribute to each line."""
    return x[..., ::2] + x[..., 1::2]


def multiplicity(length: int) -> Vector:
    """Return how often a line counts: for itself, and for its mirror image."""
    k = np.arange(length)
    return np.bincount(np.minimum(k, length - k)).astype(float)


class RowSpectra(NamedTuple):
    """Spectra of the rows of an estimate."""

    lines: list[Lines]  # of every length of stretches
    # columns of the inverse information of each channel [base, columns]
    inverses: Matrices
    # products of each channel's instruments by bins [bins, columns, columns]
    products: Matrices
    is_complete: bool  # whether all rows were transformed


class _StretchChannel(NamedTuple):
    """One channel of a stretch, to be transformed."""

    lines: Lines
    number: int
    channel: Channel


def row_spectra(problem: RegressionProblem, estimate: Estimate) -> RowSpectra:
    """Transform the stretches of the rows in one pass."""
    stretches, is_complete = divide_into_stretches(problem)
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

    def transform(task: _StretchChannel):
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
        is_complete,
    )


def divide_into_stretches(problem: RegressionProblem):
    """Divide recordings into stretches; return whether they hold all rows.

    Rows of different stretches count as independent: the relative error is about the
    correlation time of the noise over the length of a stretch.
    """
    samples = sum(o.samples for o in problem.recordings)
    is_complete = samples <= MAX_SAMPLES
    max_rows = MAX_ROWS if is_complete else MAX_ROWS // 4
    stretches = []
    for number, recording in enumerate(problem.recordings):
        max_length = 4 * max_rows // recording.decimation.step
        length = max(4, min(max_rows, max_length))
        for start, stop in recording.row_segments:
            # Equal lengths have fast transforms; all rows must be in a stretch.
            edges = [*range(start, stop, length), stop]
            if is_complete:
                rows = np.arange(start, stop)
                parts = np.array_split(rows, len(edges) - 1)
                edges = [*(int(part[0]) for part in parts), stop]
            for a, b in itertools.pairwise(edges):
                stretches.append(Span(number, a, b))
    if is_complete:
        return stretches, True
    transformed_samples = 3 * MAX_SAMPLES // 8
    count = max(1, len(stretches) * transformed_samples // samples)
    places = (np.arange(count) + 0.5) * len(stretches) / count
    numbers = np.unique(places.astype(int))
    return [stretches[k] for k in numbers], False


def _shared_lengths(problem: RegressionProblem, stretches: Sequence[Span]):
    """Return the length of the lines for every number of rows and time between them."""
    kinds = set()
    for stretch in stretches:
        row_time = problem.recordings[stretch.recording].row_time
        kinds.add((stretch.stop - stretch.start, row_time))
    if len(kinds) <= MAX_LENGTHS:
        return {(rows, row_time): rows for rows, row_time in kinds}
    lengths = {}
    longest_lengths: dict[float, int] = {}
    for rows, row_time in sorted(kinds, reverse=True):
        if rows * 1.5 < longest_lengths.get(row_time, math.inf):
            longest_lengths[row_time] = rows
        lengths[rows, row_time] = longest_lengths[row_time]
    return lengths


def spread_rows(problem: RegressionProblem) -> Iterator[RowChunk]:
    """Yield the rows of stretches in time: all rows, or an even selection of many."""
    stretches, _ = divide_into_stretches(problem)
    yield from _rows_of_stretches(problem, stretches)


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


def _visible_lines(recording: Observations, length: int):
    """Return frequencies [Hz] and gains of the lines that the filter passes."""
    frequency = scipy.fft.rfftfreq(length, recording.row_time)
    low_pass = recording.filter.low_pass(recording.sample_time)
    gain = low_pass.gain(frequency, recording.sample_time)
    # Lines with less gain carry no information.
    count = int(np.flatnonzero(gain > 1e-3)[-1]) + 1
    return frequency[:count], gain[:count]
