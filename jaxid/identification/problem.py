"""The regression problem of identification: one pass over the rows makes all its factors."""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations, Progress
from jaxid.robot.robot import Robot

from .factors import Blocks, Columns, Factors, RowChunk, empty_factors, row_chunks
from .long_logs import stream_blocks, suits

Span = tuple[int, int, int]
"""Index of a recording, and the half-open range of some of its rows."""


class RegressionProblem:
    r"""Linear equations $\Theta p = Q$ of some recordings, and the factors of their rows (Eq. 26).

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
        recordings: Observations | Sequence[Observations] = (),
        progress: Progress | None = None,
        *,
        divisions: int = 10,
        blocks: Blocks | None = None,
        names: Sequence[str] | None = None,
    ):
        self.base, self.progress = base, progress
        alone = isinstance(recordings, Observations)
        given = (recordings,) if alone else tuple(recordings)
        law = base.model.memory
        self.recordings = tuple(with_memory(o, law) for o in given)
        own = (o.name for o in self.recordings)
        self.names = tuple(own if names is None else names)
        self._given = blocks
        self._edges = [block_edges(o, divisions) for o in self.recordings]
        self._cache: dict[int, list[RowChunk]] = {}

    @property
    def robot(self) -> Robot:
        """Robot of the base parameters."""
        return self.base.model.robot

    @functools.cached_property
    def blocks(self) -> Blocks:
        """The factors by contiguous blocks of time, made by the first pass over the rows."""
        if self._given is not None:
            return self._given
        self._require_samples()
        numbers = range(len(self.recordings))
        return Blocks(
            tuple(part for number in numbers for part in self._blocks_of(number))
        )

    def _blocks_of(self, number: int) -> Sequence[Factors]:
        """Return the factors of a recording's blocks; for a long one the loop is compiled."""
        recording, edges = self.recordings[number], self._edges[number]
        if recording.samples >= self.compiled_samples and suits(recording):
            report = functools.partial(self._report, number)
            return stream_blocks(self.base, recording, edges, report)
        folded = self.fold(RowChunk.equations, chunks=self._chunks(number))
        first = self._first_block(number)
        return folded.parts[first : first + len(edges) - 1]

    @functools.cached_property
    def factors(self) -> Factors:
        """The factors of all rows together."""
        return self.blocks.total

    def _require_samples(self) -> None:
        """Check that the rows themselves are known."""
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
        self._require_samples()
        return RegressionProblem(base, self.recordings, self.progress)

    def fold(
        self,
        equations: Callable[[RowChunk], Sequence[np.ndarray]],
        columns: Columns | None = None,
        chunks: Iterable[RowChunk] | None = None,
    ) -> Blocks:
        """Return the factors of transformed rows, by blocks of time.

        Args:
            equations: Function from a chunk to the rows `[columns, force]` of each
                joint.
            columns: Parameters to which these columns belong; by default those of the
                rows.
            chunks: Rows; by default all.

        Raises:
            InputError: If only factors are known.
        """
        columns = self.base.acting_columns if columns is None else columns
        empty = empty_factors(columns, self.base.size)
        parts = [empty] * self._first_block(len(self.recordings))
        for chunk in self.chunks() if chunks is None else chunks:
            parts[chunk.block] = parts[chunk.block].append(equations(chunk))
        return Blocks(tuple(parts))

    def chunks(self, spans: Sequence[Span] | None = None) -> Iterator[RowChunk]:
        """Yield the rows, recording by recording, in their order.

        Args:
            spans: Rows that are needed, in their order; others may come too. By default
                all.

        Raises:
            InputError: If only factors are known.
        """
        self._require_samples()
        for number in range(len(self.recordings)):
            wanted = (
                None if spans is None else [(a, b) for k, a, b in spans if k == number]
            )
            yield from self._chunks(number, wanted)

    def _chunks(self, number: int, wanted=None) -> Iterator[RowChunk]:
        """Yield the rows of one recording; keep them if they are all made and few."""
        if number in self._cache:
            yield from self._cache[number]
            return
        room = self.cached_numbers if wanted is None else -1
        kept, first = [], self._first_block(number)
        for whole in row_chunks(
            self.base, self.recordings[number], self.samples_per_chunk, wanted
        ):
            for chunk in whole._replace(recording=number, block=first).divide(
                self._edges[number]
            ):
                room -= sum(x.size for x in chunk.columns)
                kept = [*kept, chunk] if room >= 0 else []
                yield chunk
            self._report(number, whole.rows.stop / self.recordings[number].rows)
        if room >= 0:
            self._cache[number], self.cached_numbers = kept, room

    def _first_block(self, number: int) -> int:
        return sum(len(edges) - 1 for edges in self._edges[:number])

    def _report(self, number: int, done: float) -> None:
        """Report the completed fraction of a pass, from that of one recording."""
        if self.progress is not None:
            sizes = [o.samples for o in self.recordings]
            self.progress(
                min(1.0, (sum(sizes[:number]) + done * sizes[number]) / sum(sizes))
            )

    def residuals(
        self, p: np.ndarray, spans=None
    ) -> Iterator[tuple[RowChunk, np.ndarray]]:
        """Yield the rows with the residuals of some parameters [rows, joints]."""
        for chunk in self.chunks(spans):
            yield chunk, chunk.residuals(p)

    def reweighted(self, p: np.ndarray, weight: Callable, scale: np.ndarray) -> Blocks:
        """Return the factors of rows that have weights of their own, by the same blocks of time.

        Args:
            p: Base parameters, which give each row its residual.
            weight: Function from residuals, divided by their scale, to weights from 0
                to 1.
            scale: Size of each joint's residuals [joints], in [N m] or [N].
        """

        def equations(chunk: RowChunk) -> list[np.ndarray]:
            root = np.sqrt(weight(chunk.residuals(p) / scale))
            parts = zip(chunk.equations(), root.T, chunk.mask.T, strict=True)
            return [w[kept, None] * rows for rows, w, kept in parts]

        return self.fold(equations)


def block_edges(observations: Observations, blocks: int) -> list[int]:
    """Return the first row of each block of time, and the end of the last one.

    All blocks have equally many rows that count.
    """
    counted = np.flatnonzero(np.asarray(observations.mask).any(axis=1))
    edges = [int(part[0]) for part in np.array_split(counted, blocks) if len(part)]
    return [0, *edges[1:], observations.rows]


def cross_validation_folds(
    blocks: Blocks, count: int = 5
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return indices of all blocks but one contiguous part of time, and of that part; each once."""
    every = np.arange(len(blocks.parts))
    if len(every) < 2:
        raise InputError(
            "held-out errors need at least two blocks of rows: record longer."
        )
    parts = np.array_split(every, min(count, len(every)))
    return [(np.setdiff1d(every, part), part) for part in parts]
