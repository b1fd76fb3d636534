"""The regression problem of identification: one pass over rows makes all factors."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import BaseVector, Joints, Matrices, Matrix
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations, ObservedLogs, Progress
from jaxid.robot.robot import Robot

from .factors import Blocks, Factors, Ranges, RowChunk, empty_factors, row_chunks
from .long_logs import stream_blocks, suits


class Span(NamedTuple):
    """Half-open range of some rows of a recording."""

    recording: int  # index of the recording
    start: int
    stop: int


class RegressionProblem:
    r"""Linear equations $\Theta p = Q$ of recordings, and their factors (Eq. 26).

    Most estimators need only `blocks` or `factors`: one triangle for each joint.
    Estimators that need the rows themselves, or residuals, iterate over `chunks`, in
    memory or from files alike. Columns are kept between passes as long as they are few
    (`cached_numbers`).

    Args:
        base: Base parameters, which are the unknowns.
        recordings: Observations of one recording or several; none where only factors
            are known.
        progress: Callback, called with the completed fraction (0 to 1) of a pass over
            long logs.
        divisions: Number of blocks of time into which the rows of each recording are
            divided.
        blocks: Factors by blocks of time, if they were made before.
        names: Names of the recordings; by default their own.
    """

    samples_per_chunk = 65536
    """Samples whose columns are evaluated at once."""
    cached_numbers = 2**26
    """Numbers (half a gigabyte) up to which columns are kept for the next pass."""
    compiled_samples = 100_000
    """Samples from which it pays to compile the pass over a recording."""

    def __init__(
        self,
        base: BaseParameters,
        recordings: ObservedLogs = (),
        progress: Progress | None = None,
        *,
        divisions: int = 10,
        blocks: Blocks | None = None,
        names: Sequence[str] | None = None,
    ):
        if isinstance(recordings, Observations):
            recordings = (recordings,)
        law = base.model.memory
        self.base = base
        self.progress = progress
        self.recordings = tuple(with_memory(o, law) for o in recordings)
        names = [o.name for o in self.recordings] if names is None else names
        self.names = tuple(names)
        self._initial_blocks = blocks
        self._edges = [block_edges(o, divisions) for o in self.recordings]
        self._cached_chunks: dict[int, list[RowChunk]] = {}

    @property
    def robot(self) -> Robot:
        """Robot of the base parameters."""
        return self.base.model.robot

    @functools.cached_property
    def blocks(self) -> Blocks:
        """Factors by contiguous blocks of time, made by the first pass over rows."""
        if self._initial_blocks is not None:
            return self._initial_blocks
        self.require_rows()
        parts = []
        for number, recording in enumerate(self.recordings):
            # Compiling the pass pays for long recordings with short filters.
            if recording.samples >= self.compiled_samples and suits(recording):
                report = functools.partial(self._report, number)
                edges = self._edges[number]
                parts += stream_blocks(self.base, recording, edges, report)
            else:
                parts += self._reduce(number, RowChunk.equations)
        return Blocks(tuple(parts))

    @functools.cached_property
    def factors(self) -> Factors:
        """The factors of all rows together."""
        return self.blocks.total

    def require_rows(self) -> None:
        """Check that the rows themselves are known, not only their factors."""
        if not self.recordings:
            raise InputError(
                "this estimate needs the rows themselves: `identify` the recordings."
            )

    def with_base(self, base: BaseParameters) -> "RegressionProblem":
        """Return the problem of the same recordings with other base parameters.

        For estimators that search for constants of the model's terms.

        Raises:
            InputError: If only factors are known.
        """
        self.require_rows()
        return RegressionProblem(base, self.recordings, self.progress)

    def _reduce(self, number: int, equations: Callable):
        """Return the factors of one recording's blocks of time."""
        empty_part = empty_factors(self.base.acting_columns, self.base.size)
        parts = [empty_part] * (len(self._edges[number]) - 1)
        first_block = self._first_block(number)
        for chunk in self.recording_chunks(number):
            block = chunk.block - first_block
            parts[block] = parts[block].append(equations(chunk))
        return parts

    def _first_block(self, number: int) -> int:
        return sum(len(edges) - 1 for edges in self._edges[:number])

    def chunks(self, spans: Sequence[Span] | None = None) -> Iterator[RowChunk]:
        """Yield the rows, recording by recording, in their order.

        Args:
            spans: Rows that are needed, in their order; others may come too. By default
                all.

        Raises:
            InputError: If only factors are known.
        """
        self.require_rows()
        for number in range(len(self.recordings)):
            ranges = None
            if spans is not None:
                ranges = [(x.start, x.stop) for x in spans if x.recording == number]
            yield from self.recording_chunks(number, ranges)

    def recording_chunks(
        self, number: int, ranges: Ranges = None
    ) -> Iterator[RowChunk]:
        """Yield the rows of one recording; keep them if they are all made and few."""
        if number in self._cached_chunks:
            yield from self._cached_chunks[number]
            return
        recording = self.recordings[number]
        numbers = recording.rows * sum(map(len, self.base.acting_columns))
        is_kept = ranges is None and numbers <= self.cached_numbers
        first_block = self._first_block(number)
        chunks = []
        for rows in row_chunks(self.base, recording, self.samples_per_chunk, ranges):
            rows = rows._replace(recording=number, block=first_block)
            for chunk in rows.divide(self._edges[number]):
                if is_kept:
                    chunks.append(chunk)
                yield chunk
            self._report(number, rows.rows.stop / recording.rows)
        if is_kept:
            self._cached_chunks[number] = chunks
            self.cached_numbers -= numbers

    def _report(self, number: int, share: float) -> None:
        """Report the completed fraction of a pass, from that of one recording."""
        if self.progress is not None:
            sizes = [o.samples for o in self.recordings]
            samples = sum(sizes[:number]) + share * sizes[number]
            self.progress(min(1.0, samples / sum(sizes)))

    def residuals(self, p: BaseVector) -> Iterator[tuple[RowChunk, Matrix]]:
        """Yield the rows with the residuals of some parameters [rows, joints]."""
        for chunk in self.chunks():
            yield chunk, chunk.residuals(p)

    def reweighted(self, p: BaseVector, weight: Callable, scale: Joints) -> Blocks:
        """Return the factors of rows with their own weights, by blocks of time.

        Args:
            p: Base parameters, which give each row its residual.
            weight: Function from residuals, divided by their scale, to weights from 0
                to 1.
            scale: Size of each joint's residuals [joints], in [N m] or [N].

        Raises:
            InputError: If only factors are known.
        """
        self.require_rows()

        def equations(chunk: RowChunk) -> Matrices:
            row_weights = np.sqrt(weight(chunk.residuals(p) / scale))
            joints = zip(chunk.equations(), row_weights.T, chunk.mask.T, strict=True)
            return [roots[mask, None] * rows for rows, roots, mask in joints]

        parts = []
        for number in range(len(self.recordings)):
            parts += self._reduce(number, equations)
        return Blocks(tuple(parts))


def block_edges(observations: Observations, blocks: int) -> list[int]:
    """Return the first row of each block of time, and the end of the last one.

    All blocks have equally many rows that count.
    """
    rows = np.flatnonzero(observations.mask.any(axis=1))
    parts = [part for part in np.array_split(rows, blocks) if len(part)]
    return [0, *(int(part[0]) for part in parts[1:]), observations.rows]


def cross_validation_folds(
    blocks: Blocks, count: int = 5
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return indices of all blocks but a contiguous part, and of it, for each part."""
    numbers = np.arange(len(blocks.parts))
    if len(numbers) < 2:
        raise InputError(
            "held-out errors need at least two blocks of rows: record longer."
        )
    parts = np.array_split(numbers, min(count, len(numbers)))
    return [(np.setdiff1d(numbers, part), part) for part in parts]
