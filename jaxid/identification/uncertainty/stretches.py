"""Stretches: contiguous rows, equally far apart in time, that are transformed at once."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.identification.factors import RowChunk
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.observations import Observations

LONGEST_ROWS = 2**15
LONGEST_SAMPLES = 2**17
"""Rows and samples of a stretch: what is longer is divided."""
SEEN = 2**20
"""Samples up to which every stretch is looked at; of longer logs some, evenly spread."""
KINDS, RATIO = 4, 1.5
"""Different lengths up to which each has lines of its own; of more, those within this ratio share
them, so that memory does not grow with the number of gaps."""
FAINT = 1e-3
"""Gain of the filters below which a line says nothing."""


class Stretch(NamedTuple):
    """Rows of one recording without a gap.

    Attributes:
        recording: Number of the recording.
        rows: Half-open range.
        row_time: Between two rows [s].
    """

    recording: int
    rows: tuple[int, int]
    row_time: float

    @property
    def length(self) -> int:
        """Number of rows."""
        return self.rows[1] - self.rows[0]


def stretches(rows: RegressionProblem) -> tuple[list[Stretch], bool]:
    """Divides recordings into stretches.

    Rows of different stretches count as independent: the error is of the size of the noise's memory
    over a stretch's length.

    Returns:
        The stretches, and whether they hold all rows.
    """
    found, samples = [], 0
    for number, recording in enumerate(rows.recordings):
        o = recording
        most = max(4, min(LONGEST_ROWS, LONGEST_SAMPLES // o.decimation.factor))
        for a, b in o.row_segments:
            parts = np.array_split(np.arange(a, b), math.ceil((b - a) / most))
            found += [
                Stretch(number, (int(part[0]), int(part[-1]) + 1), o.row_time) for part in parts
            ]
        samples += o.samples
    if samples <= SEEN:
        return found, True
    chosen = np.linspace(0, len(found) - 1, max(1, len(found) * SEEN // samples))
    return [found[k] for k in np.unique(chosen.round().astype(int))], False


def filled(wanted: list[Stretch]) -> dict[tuple[int, float], int]:
    """Lengths to which stretches are filled up, by length and time between rows."""
    kinds = {(s.length, s.row_time) for s in wanted}
    if len(kinds) <= KINDS:
        return {kind: kind[0] for kind in kinds}
    found = {}
    for row_time in {t for _, t in kinds}:
        lengths = sorted((n for n, t in kinds if t == row_time), reverse=True)
        top = lengths[0]
        for n in lengths:
            if n * RATIO < top:
                top = n
            found[n, row_time] = top
    return found


def passes(observations: Observations, frequency: Float[np.ndarray, " lines"]) -> np.ndarray:
    """Gain of filter and decimation at some frequencies [Hz]."""
    dt = observations.sample_time
    gain = observations.filter.low_pass(dt).gain(frequency, dt)
    for k, factor in enumerate(observations.decimation.stages):
        gain = gain * observations.decimation.low_pass(k).gain(frequency, dt)
        dt *= factor
    return gain


def gathered(
    rows: RegressionProblem, wanted: list[Stretch], p: np.ndarray
) -> Iterator[tuple[Stretch, list[tuple[RowChunk, np.ndarray]]]]:
    """Goes through rows once and hands out the chunks, with residuals, of each stretch."""
    coming = iter(wanted)
    stretch = next(coming, None)
    held: list[tuple[RowChunk, np.ndarray]] = []
    spans = [(s.recording, *s.rows) for s in wanted]
    for chunk, residuals in rows.residuals(p, spans):
        while stretch is not None and _begins(chunk) < (stretch.recording, stretch.rows[1]):
            if _ends(chunk) <= (stretch.recording, stretch.rows[0]):
                break
            low = max(chunk.rows.start, stretch.rows[0])
            high = min(chunk.rows.stop, stretch.rows[1])
            own = slice(low - chunk.rows.start, high - chunk.rows.start)
            held.append((chunk.part(own), residuals[own]))
            if high < stretch.rows[1]:
                break
            yield stretch, held
            stretch, held = next(coming, None), []


def _begins(chunk: RowChunk) -> tuple[int, int]:
    return chunk.recording, chunk.rows.start


def _ends(chunk: RowChunk) -> tuple[int, int]:
    return chunk.recording, chunk.rows.stop
