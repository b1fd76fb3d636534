"""The rows of some recordings, as often as an estimator wants to see them."""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.errors import InputError
from jaxid.identification.factors import (
    Blocks,
    Factors,
    block_edges,
    empty,
    factorise,
    reduced_rows,
)
from jaxid.identification.streaming import Progress
from jaxid.measurement.observations import Observations
from jaxid.robot.robot import Robot

HELD = 2**26
"""Numbers (half a gigabyte) up to which reduced columns are kept for the next pass."""

Span = tuple[int, int, int]
"""A recording's number, and the half-open range of some of its rows."""


class RowChunk(NamedTuple):
    """Consecutive rows of one block of time, reduced: filtered, decimated, without a known tool.

    Attributes:
        recording: Number of the recording.
        block: Number of the block of time, of all recordings.
        rows: Which of its rows.
        acting: For each joint the base parameters that can act on it.
        columns: For each joint its columns [rows, columns that act on the joint].
        forces: Measured [rows, joints], in [N m] or [N].
        counted: Which rows count for which joint.
    """

    recording: int
    block: int
    rows: slice
    acting: list[tuple[int, ...]]
    columns: list[np.ndarray]
    forces: np.ndarray
    counted: np.ndarray

    def part(self, own: slice) -> "RowChunk":
        """Some of the rows, counted from the chunk's first."""
        start = self.rows.start
        return self._replace(
            rows=slice(start + own.start, start + own.stop),
            columns=[x[own] for x in self.columns],
            forces=self.forces[own],
            counted=self.counted[own],
        )


class Rows:
    """The rows of some recordings: their factors, and passes over the rows themselves.

    Most estimators need only `blocks` or `factors`: one triangle for each joint. Who needs rows or
    residuals goes through `chunks`, for observations in memory and for logs that are larger alike;
    reduced columns are kept between passes while they are few.

    Args:
        base: The base parameters whose columns they are.
        blocks: The factors by contiguous blocks of time.
        recordings: What the factors were made of; none where only the factors are known.
        progress: Is told now and then which share of a pass over a long log is done, of 1.
    """

    def __init__(
        self,
        base: BaseParameters,
        blocks: Blocks,
        recordings: Sequence[Observations] = (),
        progress: Progress | None = None,
    ):
        self.base, self.blocks = base, blocks
        self.recordings, self.progress = tuple(recordings), progress
        self._held: list[RowChunk] | None = None

    @classmethod
    def of(
        cls,
        base: BaseParameters,
        recordings: Sequence[Observations],
        progress: Progress | None = None,
    ) -> "Rows":
        """Goes through recordings for the first time, and keeps their factors (Eq. 26)."""
        blocks = factorise(base, recordings, progress=progress)
        return cls(base, blocks, recordings, progress)

    @property
    def robot(self) -> Robot:
        """Whose rows they are."""
        return self.base.model.robot

    @functools.cached_property
    def factors(self) -> Factors:
        """The factors of all rows together."""
        return self.blocks.total

    @property
    def seen(self) -> bool:
        """Whether the rows themselves are known, and not their factors only."""
        return bool(self.recordings)

    def require_seen(self, what: str) -> None:
        """Refuses to go on with factors only.

        Args:
            what: The task that needs rows, as it reads in a sentence.

        Raises:
            InputError: If only factors are known.
        """
        if not self.seen:
            raise InputError(
                f"{what} needs the rows themselves, but only their factors are known: use "
                "`identify` with the recordings."
            )

    def with_base(self, base: BaseParameters) -> "Rows":
        """The same recordings with the columns of other base parameters, factorised again.

        For estimators that look for constants of the model's terms.

        Raises:
            InputError: If only factors are known.
        """
        self.require_seen("another model")
        return Rows.of(base, self.recordings, self.progress)

    def chunks(self, spans: Sequence[Span] | None = None) -> Iterator[RowChunk]:
        """Goes through the rows, recording by recording, in their order.

        Args:
            spans: What has to be among the rows; everything if None.

        Raises:
            InputError: If only factors are known.
        """
        self.require_seen("a pass over the rows")
        if self._held is not None:
            yield from self._held
            return
        kept: list[RowChunk] | None = [] if spans is None else None
        size, done, blocks = 0, 0, 0
        whole = sum(o.rows for o in self.recordings)
        acting = acting_columns(self.base)
        for number, recording in enumerate(self.recordings):
            mask, edges = np.asarray(recording.mask), block_edges(recording)
            wanted = None if spans is None else [(a, b) for k, a, b in spans if k == number]
            passing = reduced_rows(self.base, recording, wanted=wanted)
            for rows, columns, forces in passing:
                for block, (low, high) in enumerate(itertools.pairwise(edges), blocks):
                    a, b = max(low, rows.start), min(high, rows.stop)
                    if a >= b:
                        continue
                    own = slice(a - rows.start, b - rows.start)
                    parts = [x[own] for x in columns]
                    chunk = RowChunk(
                        number, block, slice(a, b), acting, parts, forces[own], mask[a:b]
                    )
                    size += sum(x.size for x in parts)
                    if kept is not None:
                        kept = [*kept, chunk] if size <= HELD else None
                    yield chunk
                done += len(forces)
                if self.progress is not None:
                    self.progress(done / whole)
            blocks += len(edges) - 1
        self._held = kept

    def residuals(
        self, p: np.ndarray, spans: Sequence[Span] | None = None
    ) -> Iterator[tuple[RowChunk, np.ndarray]]:
        """Goes through rows with what parameters leave of the forces [rows, joints]."""
        for chunk in self.chunks(spans):
            pairs = zip(chunk.columns, chunk.acting, strict=True)
            felt = [theta @ p[list(own)] for theta, own in pairs]
            yield chunk, chunk.forces - np.stack(felt, axis=1)

    def reweighted(
        self, p: np.ndarray, share: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> Blocks:
        """The factors by the same blocks of time, with every row multiplied by its own root weight.

        Args:
            p: Base parameters, which give each row its residual.
            share: From residuals and counted rows [rows, joints] to the rows' weights, of 1.
        """
        parts = [empty(self.base) for _ in self.blocks.parts]
        for chunk, residuals in self.residuals(p):
            root = np.sqrt(share(residuals, chunk.counted))
            joints = []
            for j, before in enumerate(parts[chunk.block].joints):
                kept = chunk.counted[:, j]
                whole = np.column_stack([chunk.columns[j], chunk.forces[:, j]])[kept]
                joints.append(before.joined(root[kept, j, None] * whole))
            parts[chunk.block] = Factors(tuple(joints), self.base.size)
        return Blocks(tuple(parts))
