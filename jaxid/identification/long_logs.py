"""Factors of long logs: one compiled loop over the samples, on all cores of the processor.

The loop evaluates the columns of a chunk, filters and decimates them to rows by matrix
products with the impulse responses, and adds up the Gram matrix of each joint's rows;
columns live only within an iteration, in float64. A Gram matrix of the columns
themselves would lose twice the digits of their condition number. So a few parts of the
log give a first triangle for each joint, and the pass adds up the products of columns
times the inverse of this triangle: these are almost orthonormal, so that no digits are
lost. The triangle of all rows follows from both.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision, on_cores
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.measurement.filters import AbstractLowPass
from jaxid.measurement.observations import Observations, Progress
from jaxid.program import Program, lower

from .factors import Factors, JointFactor, divide_rows, row_chunks, without_tool

CHUNK = 2048
"""Samples of an iteration of the loop."""
PIECE = 32768
"""Samples that are passed to the loop at once."""
TILE = 16
"""Rows of a banded matrix product: more multiply more zeros, fewer use the processor less."""

Grams = list[np.ndarray]
"""For each joint the products of its columns and forces with each other."""
Stage = tuple[np.ndarray, int]
"""Zero-phase filter, as its response of odd length to an impulse, and a decimation factor."""


def suits(observations: Observations) -> bool:
    """Return whether the filters of a log are short enough to compile for."""
    sizes = [(len(response), factor) for response, factor in _stages(observations)]
    # A filter is a matrix product of so many products for each row and column.
    cost = sum(lags / factor for lags, factor in sizes)
    return cost <= 256 and max((lags for lags, _ in sizes), default=1) <= 16384


def _stages(observations: Observations) -> tuple[Stage, ...]:
    """Return the stages of decimation that change something, the first one with the filter."""
    filter, decimation = observations.filter, observations.decimation
    before, stages = impulse_response(filter.low_pass(observations.sample_time)), []
    for k, factor in enumerate(decimation.stages):
        response = np.convolve(before, impulse_response(decimation.low_pass(k)))
        if factor > 1 or len(response) > 1:
            stages.append((response, factor))
        before = np.ones(1)
    return tuple(stages)


def impulse_response(low_pass: AbstractLowPass) -> Float[np.ndarray, " lags"]:
    """Return the response to an impulse in the middle, until it has decayed on both sides."""
    half = low_pass.memory()
    return low_pass(np.eye(1, 6 * half + 1, 3 * half)[0])[2 * half : 4 * half + 1]


class LoopShape(NamedTuple):
    """Sizes of the loop and of its stages."""

    samples: int  # samples of an iteration
    rows: int  # rows of an iteration
    iterations: int  # largest number of iterations of a call
    factors: tuple[int, ...]  # decimation factor of each stage
    lags: tuple[int, ...]  # length of the response of each stage
    delays: tuple[int, ...]  # rows by which the results of each stage come late
    delay: int  # rows at the start of a call that stand for nothing yet
    reach: int  # samples before, and after, a row's instant on which it depends

    @classmethod
    def of(cls, stages: Sequence[Stage], chunk: int) -> "LoopShape":
        """Return the sizes for some stages and about so many samples of an iteration."""
        factors = tuple(factor for _, factor in stages)
        lags = tuple(len(response) for response, _ in stages)
        later = whole = math.prod(factors)
        delays, delay, reach = [], 0, 0
        for n, factor in zip(lags, factors, strict=True):
            reach += whole // later * (n // 2)
            later //= factor
            # Later stages must get complete rows.
            rows = -(-max(0, n - factor) // (factor * later))
            delays.append(later * rows)
            delay += rows
        rows = max(1, round(chunk / whole))
        samples = rows * whole
        sizes = samples, rows, max(1, PIECE // samples)
        return cls(*sizes, factors, lags, tuple(delays), delay, reach)


Piece = tuple[int, tuple[int, int], slice]
"""Consecutive rows that the loop adds up in one call: their block, range, and samples."""


def stream_blocks(
    base: BaseParameters,
    observations: Observations,
    edges: Sequence[int],
    progress: Progress | None = None,
) -> list[Factors]:
    """Return the factors of blocks of time by the compiled loop, for logs of any length.

    All cores share the log. Products are added up in the order of the pieces, so that
    the number of cores changes no digit. `edges` are the first row of each block, and
    the end of the last one.
    """
    mask, indices = np.asarray(observations.mask), base.acting_columns
    stream = _Stream(base, observations, edges, progress)
    blocks = []
    for R, (first, last) in zip(
        stream.triangles(), itertools.pairwise(edges), strict=True
    ):
        joints = zip(indices, R, mask[first:last].sum(axis=0).tolist(), strict=True)
        blocks.append(
            Factors(tuple(JointFactor(*joint) for joint in joints), base.size)
        )
    return blocks


class _Stream:
    """Pass of one log through the compiled loop; see `stream_blocks`."""

    def __init__(
        self, base: BaseParameters, observations: Observations, edges, progress
    ):
        stages, self._stride = _stages(observations), 1
        if all(len(response) == 1 for response, _ in stages):
            # Without filters the samples between the rows are not needed.
            self._stride, stages = math.prod(factor for _, factor in stages), ()
        self._base, self._observations = base, observations
        self._edges, self._progress = list(edges), progress
        self._widths = [len(columns) + 1 for columns in base.acting_columns]
        self._mask = np.asarray(observations.mask)
        self._shape = LoopShape.of(stages, CHUNK)
        # Each makes the rows of a tile of consecutive samples.
        self._matrices = [
            np.stack([np.pad(h, (k * f, (TILE - 1 - k) * f)) for k in range(TILE)])
            for h, f in stages
        ]
        columns = program_of(base, base.columns, *base.model.input_shapes)
        self._loop = _compiled(columns, tuple(base.acting_columns), self._shape)
        segments = range(len(observations.segments))
        self._pieces = [piece for k in segments for piece in self._divide(k)]
        self._ends = list(self._reduce_ends())

    def _divide(self, segment: int) -> Iterator[Piece]:
        """Yield the pieces of the rows of a segment that do not depend on its ends."""
        o, shape, reach = self._observations, self._shape, self._shape.reach
        (a, b), (r0, r1) = o.segments[segment], o.row_segments[segment]
        factor, edge = o.decimation.factor, o.filter.edge(o.sample_time)
        away = max(reach - edge, o.decimation.memory(), 0)
        low = r0 + -(-away // factor)
        high = min(r0 + (b - a - 2 * edge - 1 - away) // factor + 1, r1)
        most = shape.iterations * shape.rows - shape.delay
        for block, rows in divide_rows(self._edges, slice(low, high)):
            for r in range(rows.start, rows.stop, most):
                end = min(r + most, rows.stop)
                begin = a + edge + (r - r0) * factor - reach
                samples = slice(
                    begin, min(begin + self._samples_of(end - r), b), self._stride
                )
                yield block, (r, end), samples

    def _samples_of(self, rows: int) -> int:
        shape = self._shape
        return -(-(rows + shape.delay) // shape.rows) * shape.samples * self._stride

    def _reduce_ends(self) -> Iterator[tuple[int, list[np.ndarray]]]:
        """Yield block and equations of the rows that no piece covers, reduced in NumPy."""
        outer = np.ones(len(self._mask), bool)
        for _, rows, _ in self._pieces:
            outer[slice(*rows)] = False
        changes = np.flatnonzero(np.diff(np.r_[False, outer, False])).tolist()
        runs = list(zip(changes[::2], changes[1::2], strict=True))
        samples = max(4096, 2 * self._shape.reach)
        for chunk in row_chunks(self._base, self._observations, samples, runs):
            mask = chunk.mask & outer[chunk.rows, None]
            for part in chunk._replace(mask=mask).divide(self._edges):
                yield part.block, part.equations()

    def triangles(self) -> list[list[np.ndarray]]:
        """Return an R factor of columns and forces for each block and joint."""
        first, R, blocks = self._first_grams(), [], []
        for _ in range(2):
            R = []
            for G in first:
                norms = np.sqrt(np.diag(G))
                scale = np.where(norms > 0, norms, max(norms.max(initial=0.0), 1.0))
                # A triangle that is never singular.
                regular = G / scale / scale[:, None] + 1e-13 * np.eye(len(G))
                R.append(np.linalg.cholesky(regular).T * scale)
            mixing = [np.linalg.inv(r) for r in R]
            blocks = [[np.zeros((w, w)) for w in self._widths] for _ in self._edges[1:]]
            self._add(blocks, self._pieces, mixing, self._progress)
            total = [np.sum(parts, axis=0) for parts in zip(*blocks, strict=True)]
            if all(_similar(*x) for x in zip(total, first, mixing, strict=True)):
                break
            # The first look has missed what the pass has seen: now it is known.
            first = [r.T @ G @ r for r, G in zip(R, total, strict=True)]
        return [
            [_root(G) @ r for G, r in zip(grams, R, strict=True)] for grams in blocks
        ]

    def _first_grams(self, parts: int = 8) -> Grams:
        """Return the Gram matrices of a few parts of the log."""
        step, pieces = max(1, len(self._pieces) // parts), []
        for block, (a, b), samples in self._pieces[step // 2 :: step]:
            # As many rows of a piece as an iteration has.
            b = min(b, a + self._shape.rows)
            stop = min(samples.stop, samples.start + self._samples_of(b - a))
            pieces.append((block, (a, b), slice(samples.start, stop, samples.step)))
        total = [np.zeros((width, width)) for width in self._widths]
        self._add(
            [total] * (len(self._edges) - 1), pieces, [np.eye(w) for w in self._widths]
        )
        return total

    def _add(
        self, blocks: list[Grams], pieces: list[Piece], mixing: Grams, progress=None
    ) -> None:
        """Add the Gram matrices of some pieces, and of the ends, to those of their blocks."""
        # One core adds up a piece; the next ones are read meanwhile.
        found = on_cores(lambda x: self._call(x, mixing), map(self._fill, pieces))
        for done, ((block, _, _), grams) in enumerate(
            zip(pieces, found, strict=True), 1
        ):
            for total, G in zip(blocks[block], grams, strict=True):
                total += G
            if progress is not None:
                progress(done / len(pieces))
        for block, equations in self._ends:
            for total, rows, mix in zip(blocks[block], equations, mixing, strict=True):
                mixed = rows @ mix
                total += mixed.T @ mixed

    def _fill(self, piece: Piece) -> list[np.ndarray]:
        """Read the arrays of one piece, filled up to the shape of the loop."""
        (motion, forces), shape = self._observations.read(piece[2]), self._shape
        # The first rows come late, and do not count.
        mask = np.pad(self._mask[slice(*piece[1])], ((shape.delay, 0), (0, 0)))
        length = shape.iterations * shape.samples
        together = np.hstack(
            [np.asarray(x) for x in self._base.model.arguments(motion)]
        )
        arrays = [
            _filled_up(np.asarray(x, np.float64), length)
            for x in (together, without_tool(self._base, motion, forces))
        ]
        arrays.append(_filled_up(mask, shape.iterations * shape.rows))
        return [*arrays, np.asarray(-(-len(mask) // shape.rows), np.int32)]

    def _call(self, arrays: list[np.ndarray], mixing: Grams) -> Grams:
        """Return the Gram matrices of a piece."""
        with (
            double_precision(),
            jax.default_device(jax.local_devices(backend="cpu")[0]),
        ):
            return [np.asarray(G) for G in self._loop(*arrays, mixing, self._matrices)]


def _filled_up(x: np.ndarray, length: int) -> np.ndarray:
    missing = max(0, length - len(x))
    return (
        np.pad(x, ((0, missing), (0, 0)))
        if missing
        else np.ascontiguousarray(x[:length])
    )


def _similar(
    total: np.ndarray, first: np.ndarray, mixing: np.ndarray, ratio: float = 1e4
) -> bool:
    """Return whether the first look has shown the size of every direction that it has shown."""
    values, directions = np.linalg.eigh(mixing.T @ first @ mixing)
    shown = directions[:, values > 0.5]
    if not shown.shape[1]:
        return not total.any()
    sizes = np.linalg.eigvalsh(shown.T @ total @ shown)
    middle = np.median(sizes)
    return bool(np.linalg.norm(total) <= ratio * middle and sizes[0] * ratio > middle)


def _root(G: np.ndarray) -> np.ndarray:
    """Return an upper triangle whose square is G, which may be singular; zero columns stay zero."""
    root = np.zeros_like(G)
    live = np.flatnonzero(np.diag(G) > 0)
    own = np.ix_(live, live)
    values, directions = np.linalg.eigh(G[own])
    rows = np.sqrt(np.maximum(values, 0.0))[:, None] * directions.T
    root[own] = np.linalg.qr(rows, mode="r")
    return root


@functools.lru_cache(maxsize=16)
def _compiled(
    program: Program, acting: tuple[tuple[int, ...], ...], shape: LoopShape
) -> Callable:
    """Return the loop, which is compiled when it is first called."""
    joints = len(acting)
    size = len(program.outputs) // joints
    base_columns = lower(program, fence=True)

    def entry(j: int, k: int) -> str:
        return repr(program.outputs[j * size + k])

    # Joints share columns: every distinct one is filtered once.
    distinct = {entry(j, k): j * size + k for j, own in enumerate(acting) for k in own}
    first, rows = (
        list(distinct.values()),
        {key: row for row, key in enumerate(distinct)},
    )
    places = [
        np.array([*(rows[entry(j, k)] for k in own), len(first) + j])
        for j, own in enumerate(acting)
    ]
    height = len(first) + joints

    def evaluate(motion: Array, forces: Array) -> list[Array]:
        packed = base_columns(*jnp.split(motion, len(motion) // joints))
        columns = [
            jnp.broadcast_to(jnp.asarray(packed[i], float), motion.shape[1:])
            for i in first
        ]
        return columns + list(forces)

    def run(motion, forces, mask, count, mixing, matrices) -> list[Array]:
        def iteration(k: Array, state: tuple) -> tuple:
            carried, grams = state
            parts = [_part(x, k, shape.samples) for x in (motion, forces)]
            # Results of a branch are stored: no consumer computes them again.
            columns = jax.lax.cond(count > 0, evaluate, lambda *_: nothing, *parts)
            new = jnp.stack(columns)
            left = []
            stages = zip(carried, matrices, shape.factors, shape.lags, strict=True)
            for before, H, factor, lags in stages:
                joined = jnp.concatenate([before, new], axis=1)
                left.append(joined[:, new.shape[1] :])
                tiles, rows = [], new.shape[1] // factor
                # A banded matrix product, tile by tile.
                for low in range(0, rows, TILE):
                    height = min(TILE, rows - low)
                    window = (height - 1) * factor + lags
                    part = joined[:, low * factor : low * factor + window]
                    tiles.append(part @ H[:height, :window].T)
                new = jnp.concatenate(tiles, axis=1)
            counted = _part(mask, k, shape.rows).astype(new.dtype)
            sums = []
            for j, own in enumerate(places):
                own_rows = new[own] if carried else jnp.stack([columns[i] for i in own])
                rows = mixing[j].T @ (own_rows * counted[j][None])
                sums.append(grams[j] + rows @ rows.T)
            return left, sums

        nothing = [jnp.zeros(shape.samples)] * height
        sizes = zip(shape.delays, shape.factors, strict=True)
        carried = [jnp.zeros((height, delay * factor)) for delay, factor in sizes]
        grams = [jnp.zeros((len(own), len(own))) for own in places]
        return jax.lax.fori_loop(0, count, iteration, (carried, grams))[1]

    return jax.jit(run)


def _part(x: AnyArray, k: Array, length: int) -> Array:
    """Return the samples of one iteration, on the last axis."""
    start = (k * length, jnp.zeros_like(k))
    return jax.lax.dynamic_slice(x, start, (length, x.shape[1])).T
