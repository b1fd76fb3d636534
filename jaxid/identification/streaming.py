"""Factors of long logs: Gram matrices of preconditioned columns, by a compiled loop.

A Gram matrix of the columns themselves would lose twice the digits of their condition number. So a
few parts of the log give a first triangle for each joint, and the pass adds up the products of
columns times the inverse of this triangle: these are almost orthonormal, so that no digits are
lost. The triangle of all rows follows from both.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.compiled import CompiledLoop, Grams, Stage, filter_stages, reach_of
from jaxid.identification.factors import (
    Factors,
    JointFactor,
    RowChunk,
    divide_rows,
    reduce_chunk,
)
from jaxid.measurement.observations import Observations, Progress

LONG = 100_000
"""Samples from which compiling pays."""


class Piece(NamedTuple):
    """Consecutive rows of one block that the compiled loop adds up in one call.

    Attributes:
        block: Index of the block of time.
        rows: Half-open range of rows.
        samples: Samples that are needed.
    """

    block: int
    rows: tuple[int, int]
    samples: slice


def suits(observations: Observations) -> bool:
    """Return whether a log is long enough to compile for, and its filters are short enough."""
    if observations.samples < LONG:
        return False
    stages = _stages(observations)
    # A filter is a matrix product of so many products for each row and column.
    cost = sum(len(stage.response) / stage.factor for stage in stages)
    return cost <= 256 and max((len(s.response) for s in stages), default=1) <= 16384


def _stages(observations: Observations) -> tuple[Stage, ...]:
    return filter_stages(observations.filter, observations.decimation, observations.sample_time)


def stream_blocks(
    base: BaseParameters,
    observations: Observations,
    edges: Sequence[int],
    progress: Progress | None = None,
    chunk: int = 2048,
) -> list[Factors]:
    """Return the factors of blocks of time by the compiled loop, for logs of any length.

    All CPU devices of this process share the log. Products are added up in the order of the pieces:
    the number of devices changes no digit but those that a compiler may change.

    Args:
        base: The base parameters.
        observations: Observations of a recording.
        edges: First row of each block, and the end of the last one.
        progress: Callback, called with the completed fraction (0 to 1).
        chunk: Samples of an iteration of the loop.
    """
    mask, indices = np.asarray(observations.mask), base.acting_columns
    stream = _Stream(base, observations, edges, progress, chunk)
    blocks = []
    for R, (first, last) in zip(stream.triangles(), itertools.pairwise(edges), strict=True):
        joints = zip(indices, R, mask[first:last].sum(axis=0), strict=True)
        blocks.append(Factors(tuple(JointFactor(c, r, int(n)) for c, r, n in joints), base.size))
    return blocks


class _Stream:
    """Pass of one log through the compiled loop; see `stream_blocks`."""

    def __init__(
        self,
        base: BaseParameters,
        observations: Observations,
        edges: Sequence[int],
        progress: Progress | None,
        chunk: int,
    ):
        self._progress = progress
        stages = _stages(observations)
        self._stride = 1
        if all(len(stage.response) == 1 for stage in stages):
            # Without filters the samples between the rows are not needed.
            self._stride, stages = math.prod(stage.factor for stage in stages), ()
        self._observations, self._edges = observations, list(edges)
        self._widths = [len(columns) + 1 for columns in base.acting_columns]
        self._loop = CompiledLoop(base, stages, chunk)
        self._mask = np.asarray(observations.mask)
        reach = reach_of(stages)
        segments = range(len(observations.segments))
        self._pieces = [p for k in segments for p in self._divide(k, reach)]
        self._ends = list(self._reduce_ends(base, reach)) if reach else []

    def _divide(self, segment: int, reach: int) -> Iterator[Piece]:
        """Yield the pieces of the rows of a segment that do not depend on its ends."""
        o, shape = self._observations, self._loop.shape
        (a, b), r0 = o.segments[segment], o.row_segments[segment][0]
        first = a + o.filter.edge(o.sample_time)
        most = shape.iterations * shape.rows - shape.delay
        for block, rows in divide_rows(self._edges, slice(*self._inner(segment, reach))):
            for r in range(rows.start, rows.stop, most):
                end = min(r + most, rows.stop)
                begin = first + (r - r0) * o.decimation.factor - reach
                length = self._samples_of(end - r)
                samples = slice(begin, min(begin + length, b), self._stride)
                yield Piece(block, (r, end), samples)

    def _inner(self, segment: int, reach: int) -> tuple[int, int]:
        """Return the range of rows of a segment that do not depend on its ends."""
        o = self._observations
        (a, b), (r0, r1) = o.segments[segment], o.row_segments[segment]
        if not reach:
            return r0, r1
        factor, edge = o.decimation.factor, o.filter.edge(o.sample_time)
        away = max(reach - edge, o.decimation.memory(), 0)
        low = r0 + -(-away // factor)
        high = r0 + (b - a - 2 * edge - 1 - away) // factor + 1
        return (low, min(high, r1)) if low < high else (r1, r1)

    def _samples_of(self, rows: int) -> int:
        shape = self._loop.shape
        return -(-(rows + shape.delay) // shape.rows) * shape.samples * self._stride

    def _reduce_ends(self, base: BaseParameters, reach: int) -> Iterator[RowChunk]:
        """Yield the rows that no piece covers, reduced in NumPy."""
        covered = np.zeros(len(self._mask), bool)
        for piece in self._pieces:
            covered[slice(*piece.rows)] = True
        indices = base.acting_columns
        for chunk in self._observations.chunks(max(4096, 2 * reach)):
            start, stop = chunk.rows
            outer = np.flatnonzero(~covered[start:stop])
            if not len(outer):
                continue
            columns, forces = reduce_chunk(
                base, *self._observations.read(slice(*chunk.samples)), chunk
            )
            for run in np.split(outer, np.flatnonzero(np.diff(outer) > 1) + 1):
                a, b = int(run[0]), int(run[-1]) + 1
                for block, rows in divide_rows(self._edges, slice(start + a, start + b)):
                    own = slice(rows.start - start, rows.stop - start)
                    copies = [theta[own].copy() for theta in columns]
                    mask = self._mask[rows]
                    yield RowChunk(0, block, rows, indices, copies, forces[own].copy(), mask)

    def triangles(self) -> list[list[np.ndarray]]:
        """Return an R factor of columns and forces for each block and joint."""
        first = self._first_grams()
        R, blocks, similar = self._pass(first)
        if not similar:
            # The first look has missed what the pass has seen: now it is known.
            total = [np.sum(parts, axis=0) for parts in zip(*blocks, strict=True)]
            R, blocks, _ = self._pass([r.T @ G @ r for r, G in zip(R, total, strict=True)])
        return [[_root(G) @ r for G, r in zip(grams, R, strict=True)] for grams in blocks]

    def _first_grams(self, parts: int = 8) -> Grams:
        """Return the Gram matrices of a few parts of the log."""
        plain = [np.eye(width) for width in self._widths]
        step = max(1, len(self._pieces) // parts)
        pieces = [self._first_rows(piece) for piece in self._pieces[step // 2 :: step]]
        total = [np.zeros((width, width)) for width in self._widths]
        for _, grams in self._run(pieces, plain):
            _add(total, grams)
        self._add_ends([total] * (len(self._edges) - 1), plain)
        return total

    def _first_rows(self, piece: Piece) -> Piece:
        """Return the first rows of a piece, as many as an iteration has."""
        (a, b), samples = piece.rows, piece.samples
        b = min(b, a + self._loop.shape.rows)
        stop = min(samples.stop, samples.start + self._samples_of(b - a))
        return Piece(piece.block, (a, b), slice(samples.start, stop, samples.step))

    def _pass(self, first: Grams) -> tuple[Grams, list[Grams], bool]:
        """Return the first triangles, Gram matrices of every block, and whether they agree."""
        R = [_triangle(G) for G in first]
        mixing = [np.linalg.inv(r) for r in R]
        blocks = [[np.zeros((w, w)) for w in self._widths] for _ in self._edges[1:]]
        for done, (piece, grams) in enumerate(self._run(self._pieces, mixing), 1):
            _add(blocks[piece.block], grams)
            if self._progress is not None:
                self._progress(done / len(self._pieces))
        self._add_ends(blocks, mixing)
        total = [np.sum(parts, axis=0) for parts in zip(*blocks, strict=True)]
        return R, blocks, all(_similar(*x) for x in zip(total, first, mixing, strict=True))

    def _run(self, pieces: Sequence[Piece], mixing: Grams) -> Iterator[tuple[Piece, Grams]]:
        """Call the loop for some pieces, and read the next ones meanwhile."""
        size = len(self._loop.devices)
        groups = [pieces[k : k + size] for k in range(0, len(pieces), size)]
        with ThreadPoolExecutor(1) as reader:
            coming = [reader.submit(self._prepare, group) for group in groups[:1]]
            for group, following in itertools.zip_longest(groups, groups[1:]):
                prepared = coming.pop().result()
                if following is not None:
                    coming.append(reader.submit(self._prepare, following))
                yield from zip(group, self._loop(prepared, mixing), strict=True)

    def _prepare(self, pieces: Sequence[Piece]) -> list[list[np.ndarray]]:
        prepared, delay = [], self._loop.shape.delay
        for piece in pieces:
            motion, forces = self._observations.read(piece.samples)
            mask = np.concatenate(
                [np.zeros((delay, self._mask.shape[1]), bool), self._mask[slice(*piece.rows)]]
            )
            prepared.append(self._loop.prepare((motion.q, motion.qd, motion.qdd, forces), mask))
        return prepared

    def _add_ends(self, blocks: list[Grams], mixing: Grams) -> None:
        for end in self._ends:
            for j, equations in enumerate(end.equations()):
                rows = equations @ mixing[j]
                blocks[end.block][j] += rows.T @ rows


def _add(total: Grams, grams: Grams) -> None:
    for into, G in zip(total, grams, strict=True):
        into += G


def _triangle(G: np.ndarray) -> np.ndarray:
    """Return an upper triangle R, never singular, with R'R about G."""
    norms = np.sqrt(np.diag(G))
    scale = np.where(norms > 0, norms, max(norms.max(initial=0.0), 1.0))
    regular = G / scale / scale[:, None] + 1e-13 * np.eye(len(G))
    return np.linalg.cholesky(regular).T * scale


def _similar(total: np.ndarray, first: np.ndarray, mixing: np.ndarray, ratio: float = 1e4) -> bool:
    """Return whether the first look has shown the size of every direction that it has shown."""
    values, directions = np.linalg.eigh(mixing.T @ first @ mixing)
    shown = directions[:, values > 0.5]
    if not shown.shape[1]:
        return not total.any()
    sizes = np.linalg.eigvalsh(shown.T @ total @ shown)
    return float(np.linalg.norm(total)) <= ratio * float(np.median(sizes)) and bool(
        sizes[0] * ratio > np.median(sizes)
    )


def _root(G: np.ndarray) -> np.ndarray:
    """Return an upper triangle whose square is G, which may be singular; zero columns stay zero."""
    root = np.zeros_like(G)
    live = np.flatnonzero(np.diag(G) > 0)
    own = np.ix_(live, live)
    try:
        root[own] = np.linalg.cholesky(G[own]).T
    except np.linalg.LinAlgError:
        values, directions = np.linalg.eigh(G[own])
        rows = np.sqrt(np.maximum(values, 0.0))[:, None] * directions.T
        root[own] = np.linalg.qr(rows, mode="r")
    return root
