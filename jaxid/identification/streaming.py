"""Long logs: Gram matrices of prepared columns, by compiled chunks, as accurate as a QR.

A Gram matrix of the columns themselves would lose twice the digits that their condition number
takes. So a first glance at a few parts of the log gives a triangle for each joint, and the pass
adds up the products of columns times its inverse: almost orthonormal, so that nothing is lost. The
triangle of all rows follows from both.
"""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.identification.kernel import CHUNK, Grams, Kernel
from jaxid.identification.reduction import reduced
from jaxid.identification.response import Stage, centre, stages
from jaxid.measurement.observations import Observations
from jaxid.measurement.observations import Progress as Progress

LONG = 100_000
"""Samples from which compiling pays."""
COSTLY = 256
"""Products for each row and column up to which filters are matrices."""
LARGEST = 16384
"""Lags of a response that the loop carries along."""
GLANCES = 8
"""Parts of the log of which the first triangle is made."""
REGULAR = 1e-13
"""Share of a column's square by which a triangle is kept from being singular."""
ALIKE = 1e4
"""Ratio of squares that the first triangle may be wrong by."""


class Ends(NamedTuple):
    """Rows near a segment's ends, where filters see the end: reduced in NumPy."""

    rows: slice
    columns: list[np.ndarray]
    forces: np.ndarray


class Piece(NamedTuple):
    """Consecutive rows of one block that the compiled loop does in one call."""

    block: int
    rows: tuple[int, int]
    samples: slice


def suits(observations: Observations) -> bool:
    """Whether a log is long enough to compile for, and its filters are short enough."""
    if observations.samples < LONG:
        return False
    chain = _chain(observations)
    cost = sum(len(stage.response) / stage.factor for stage in chain)
    return cost <= COSTLY and max((len(s.response) for s in chain), default=1) <= LARGEST


def _chain(observations: Observations) -> tuple[Stage, ...]:
    return stages(observations.filter, observations.decimation, observations.sample_time)


class Stream:
    """A log on its way through the compiled loop.

    Args:
        base: The base parameters.
        observations: A long log.
        edges: Rows at which blocks of time begin, and the last one ends.
        chunk: Samples of an iteration.
        progress: Is told now and then which share of the log is done, of 1.
    """

    def __init__(
        self,
        base: BaseParameters,
        observations: Observations,
        edges: Sequence[int],
        chunk: int = CHUNK,
        progress: Progress | None = None,
    ):
        self._read = observations.read
        self._progress = progress
        chain = _chain(observations)
        self._stride = 1
        if all(len(stage.response) == 1 for stage in chain):
            # Without filters the samples between the rows are not needed.
            self._stride, chain = math.prod(stage.factor for stage in chain), ()
        self._observations, self._edges = observations, list(edges)
        self._widths = [len(columns) + 1 for columns in acting_columns(base)]
        self._kernel = Kernel(base, chain, chunk)
        self._mask = np.asarray(observations.mask)
        self._pieces, self._ends = [], []
        reach = centre(chain)
        for number in range(len(observations.segments)):
            low, high = self._inner(number, reach)
            self._pieces += self._divided(number, low, high, reach)
        inner = [range(*piece.rows) for piece in self._pieces]
        covered = np.zeros(len(self._mask), bool)
        for rows in inner:
            covered[rows.start : rows.stop] = True
        for chunk_of_rows in observations.chunks(max(4096, 2 * reach)) if reach else ():
            outer = ~covered[slice(*chunk_of_rows.rows)]
            if outer.any():
                motion, measured = self._read(slice(*chunk_of_rows.samples))
                columns, forces = reduced(base, motion, measured, chunk_of_rows)
                self._append(slice(*chunk_of_rows.rows), outer, columns, forces)

    def _append(
        self, rows: slice, outer: np.ndarray, columns: list[np.ndarray], forces: np.ndarray
    ) -> None:
        """Keeps the rows that no piece covers, which stand together at an end."""
        first, last = (int(i) for i in np.flatnonzero(outer)[[0, -1]])
        if not outer[first : last + 1].all():
            # Both ends of a short segment in one chunk: two parts.
            middle = first + int(np.argmin(outer[first:]))
            parts = [(first, middle), (middle + int(np.argmax(outer[middle:])), last + 1)]
        else:
            parts = [(first, last + 1)]
        for a, b in parts:
            self._ends.append(
                Ends(
                    slice(rows.start + a, rows.start + b),
                    [theta[a:b].copy() for theta in columns],
                    forces[a:b].copy(),
                )
            )

    def _inner(self, segment: int, reach: int) -> tuple[int, int]:
        """Rows of a segment that see nothing of its ends."""
        o = self._observations
        (a, b), (r0, r1) = o.segments[segment], o.row_segments[segment]
        if not reach:
            return r0, r1
        factor, edge = o.decimation.factor, o.filter.edge(o.sample_time)
        away = max(reach - edge, o.decimation.memory(), 0)
        low = r0 + -(-away // factor)
        high = r0 + (b - a - 2 * edge - 1 - away) // factor + 1
        return (low, min(high, r1)) if low < high else (r1, r1)

    def _divided(self, segment: int, low: int, high: int, reach: int) -> Iterator[Piece]:
        o, shape = self._observations, self._kernel.shape
        (a, b), r0 = o.segments[segment], o.row_segments[segment][0]
        first = a + o.filter.edge(o.sample_time)
        most = shape.iterations * shape.rows - shape.delay
        for block, (start, stop) in enumerate(zip(self._edges, self._edges[1:], strict=False)):
            start, stop = max(start, low), min(stop, high)
            for r in range(start, stop, most):
                end = min(r + most, stop)
                begin = first + (r - r0) * o.decimation.factor - reach
                iterations = -(-(end - r + shape.delay) // shape.rows)
                length = iterations * shape.samples * self._stride
                samples = slice(begin, min(begin + length, b), self._stride)
                yield Piece(block, (r, end), samples)

    def _runs(
        self, pieces: Sequence[Piece], mixing: Grams, most: int | None = None
    ) -> Iterator[tuple[Piece, Grams]]:
        """Calls the loop for some pieces, and reads the next one meanwhile.

        With `most`, only so many rows of each piece are read.
        """
        if most is not None:
            pieces = [self._first(piece, most) for piece in pieces]
        with ThreadPoolExecutor(1) as reader:
            coming = [reader.submit(self._read, p.samples) for p in pieces[:1]]
            for piece, following in zip(pieces, [*pieces[1:], None], strict=True):
                motion, forces = coming.pop().result()
                if following is not None:
                    coming.append(reader.submit(self._read, following.samples))
                delay, (a, b) = self._kernel.shape.delay, piece.rows
                weights = np.zeros((delay + b - a, self._mask.shape[1]), bool)
                weights[delay:] = self._mask[a:b]
                parts = [_float(x) for x in (motion.q, motion.qd, motion.qdd)]
                yield piece, self._kernel(parts, _float(forces), weights, mixing)

    def _first(self, piece: Piece, most: int) -> Piece:
        """The first rows of a piece."""
        (a, b), samples, shape = piece.rows, piece.samples, self._kernel.shape
        b = min(b, a + most)
        iterations = -(-(b - a + shape.delay) // shape.rows)
        stop = min(samples.stop, samples.start + iterations * shape.samples * self._stride)
        return Piece(piece.block, (a, b), slice(samples.start, stop, samples.step))

    def _glance(self) -> Grams:
        """Gram matrices of a few parts of the log as they are."""
        plain = [np.eye(width) for width in self._widths]
        step = max(1, len(self._pieces) // GLANCES)
        rows = self._kernel.shape.rows
        total = [np.zeros((width, width)) for width in self._widths]
        for _, grams in self._runs(self._pieces[step // 2 :: step], plain, rows):
            _add(total, grams)
        self._add_ends([total] * (len(self._edges) - 1), plain)
        return total

    def _grams(self, mixing: Grams) -> list[Grams]:
        """Gram matrices of every block."""
        blocks = [[np.zeros((w, w)) for w in self._widths] for _ in self._edges[1:]]
        for done, (piece, grams) in enumerate(self._runs(self._pieces, mixing), 1):
            _add(blocks[piece.block], grams)
            if self._progress is not None:
                self._progress(done / len(self._pieces))
        self._add_ends(blocks, mixing)
        return blocks

    def _add_ends(self, blocks: list[Grams], mixing: Grams) -> None:
        for end in self._ends:
            for k, (low, high) in enumerate(zip(self._edges, self._edges[1:], strict=False)):
                a, b = max(low, end.rows.start), min(high, end.rows.stop)
                if a >= b:
                    continue
                part = slice(a - end.rows.start, b - end.rows.start)
                for j, theta in enumerate(end.columns):
                    kept = self._mask[a:b, j]
                    rows = np.column_stack([theta[part], end.forces[part, j]])[kept] @ mixing[j]
                    blocks[k][j] += rows.T @ rows

    def triangles(self) -> list[list[np.ndarray]]:
        """For each block and joint an R factor of its columns and forces."""
        glance = self._glance()
        R, blocks, alike = self._pass(glance)
        if not alike:
            # The glance has missed what the pass has seen: now it is known.
            total = [np.sum(parts, axis=0) for parts in zip(*blocks, strict=True)]
            R, blocks, _ = self._pass([r.T @ G @ r for r, G in zip(R, total, strict=True)])
        return [[_root(G) @ r for G, r in zip(grams, R, strict=True)] for grams in blocks]

    def _pass(self, glance: Grams) -> tuple[Grams, list[Grams], bool]:
        """The triangles of a glance, Gram matrices of every block, and whether they are alike."""
        R = [_triangle(G) for G in glance]
        mixing = [np.linalg.inv(r) for r in R]
        blocks = self._grams(mixing)
        total = [np.sum(parts, axis=0) for parts in zip(*blocks, strict=True)]
        return R, blocks, all(_alike(*x) for x in zip(total, glance, mixing, strict=True))


def _float(x: AnyArray) -> np.ndarray:
    return np.asarray(x, np.float64)


def _add(total: Grams, grams: Grams) -> None:
    for into, G in zip(total, grams, strict=True):
        into += G


def _triangle(G: np.ndarray) -> np.ndarray:
    """An upper triangle R, never singular, with R'R about G."""
    norms = np.sqrt(np.diag(G))
    scale = np.where(norms > 0, norms, max(norms.max(initial=0.0), 1.0))
    regular = G / scale / scale[:, None] + REGULAR * np.eye(len(G))
    return np.linalg.cholesky(regular).T * scale


def _alike(total: np.ndarray, glance: np.ndarray, mixing: np.ndarray) -> bool:
    """Whether a glance has shown the size of every direction that it has shown at all."""
    values, directions = np.linalg.eigh(mixing.T @ glance @ mixing)
    shown = directions[:, values > 0.5]
    if not shown.shape[1]:
        return not total.any()
    found = np.linalg.eigvalsh(shown.T @ total @ shown)
    return float(np.linalg.norm(total)) <= ALIKE * float(np.median(found)) and bool(
        found[0] * ALIKE > np.median(found)
    )


def _root(G: np.ndarray) -> np.ndarray:
    """An upper triangle whose square is G, which may be singular; columns of zeros stay zeros."""
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
