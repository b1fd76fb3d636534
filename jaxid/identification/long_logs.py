"""Factors of long logs: one compiled loop over the samples, on all cores.

The loop evaluates the columns of a chunk, filters them to rows by matrix
products with the impulse response, and adds up the Gram matrix of each joint's rows;
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

from jaxid.arrays import (
    AnyArray,
    Array,
    Indices,
    Matrix,
    Vector,
    double_precision,
    on_cores,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.measurement.filters import LowPass
from jaxid.measurement.observations import Observations, Progress
from jaxid.program import Program, kernel_options, lower
from jaxid.program.sample_methods import program_of

from .factors import Factors, JointFactor, divide_rows, row_chunks, without_tool

CHUNK = 2048
"""Samples of an iteration of the loop."""
PIECE = 32768
"""Samples that are passed to the loop at once."""
TILE = 16
"""Rows of a banded product: more multiply zeros, fewer use the processor less."""
FIRST_PIECES = 8
"""Pieces of the log from which the first triangles are made."""
MAX_SIZE_RATIO = 1e4
"""Ratio of sizes of directions up to which products of rows lose no digits."""
MAX_COST = 256
"""Products for each row and column of a filter up to which a matrix product pays."""

Grams = list[np.ndarray]
"""For each joint the products of its columns and forces with each other."""
BlockGrams = tuple[int, Grams]
"""Index of a block of time, and products of rows in it."""


def suits(observations: Observations) -> bool:
    """Return whether the filter of a log is short enough to compile for."""
    # A filter is a matrix product of so many products for each row and column.
    lags = len(filter_response(observations))
    return lags <= MAX_COST * observations.decimation.step


def filter_response(observations: Observations) -> Vector:
    """Return the response of the filter of forces and columns to an impulse."""
    return impulse_response(observations.filter.low_pass(observations.sample_time))


def impulse_response(low_pass: LowPass) -> Vector:
    """Return the response to an impulse in the middle, decayed on both sides."""
    half = low_pass.memory()
    impulse = np.zeros(6 * half + 1)
    impulse[3 * half] = 1.0
    return low_pass(impulse)[2 * half : 4 * half + 1]


class LoopShape(NamedTuple):
    """Sizes of the loop."""

    step: int  # samples for each row
    lags: int  # length of the filter's response; 1 without a filter
    rows: int  # rows of an iteration

    @property
    def samples(self) -> int:
        """Samples of an iteration."""
        return self.rows * self.step

    @property
    def iterations(self) -> int:
        """Largest number of iterations of a call."""
        return max(1, PIECE // self.samples)

    @property
    def delay(self) -> int:
        """Rows at the start of a call that hold no data yet."""
        return math.ceil(max(0, self.lags - self.step) / self.step)

    @property
    def reach(self) -> int:
        """Samples before, and after, a row's instant on which it depends."""
        return self.lags // 2


class Piece(NamedTuple):
    """Consecutive rows that the loop adds up in one call."""

    block: int  # index of their block of time
    rows: slice
    samples: slice  # samples on which they depend


def stream_blocks(
    base: BaseParameters,
    observations: Observations,
    edges: Sequence[int],
    progress: Progress | None = None,
) -> list[Factors]:
    """Return the factors of blocks of time by the compiled loop, for any length of log.

    All cores share the log. Products are added up in the order of the pieces, so that
    the number of cores changes no digit. `edges` are the first row of each block, and
    the end of the last one.
    """
    mask = np.asarray(observations.mask)
    triangles = _Stream(base, observations, edges).triangles(progress)
    blocks = []
    for R, (start, stop) in zip(triangles, itertools.pairwise(edges), strict=True):
        counts = mask[start:stop].sum(axis=0).tolist()
        joints = map(JointFactor, base.acting_columns, R, counts)
        blocks.append(Factors(tuple(joints), base.size))
    return blocks


class _Pass(NamedTuple):
    """Result of one pass over a log."""

    triangles: list[Grams]  # R factor for each block and joint
    total: Grams  # products of all rows
    is_accurate: bool  # whether the first look has shown the size of every direction


class _Stream:
    """A log and its compiled loop; see `stream_blocks`."""

    def __init__(
        self, base: BaseParameters, observations: Observations, edges: Sequence[int]
    ):
        response = filter_response(observations)
        step = observations.decimation.step
        self._stride = 1
        if len(response) == 1:
            # Without a filter the samples between the rows are not needed.
            self._stride = step
            step = 1
        self._base = base
        self._observations = observations
        self._edges = list(edges)
        self._mask = np.asarray(observations.mask)
        self._shape = LoopShape(step, len(response), max(1, round(CHUNK / step)))
        self._matrix = _banded_matrix(response, step)
        program = program_of(base, base.columns, *base.model.input_shapes)
        self._loop = _compile_loop(program, tuple(base.acting_columns), self._shape)
        self._pieces: list[Piece] = []
        for segment in range(len(observations.segments)):
            self._pieces += self._divide(segment)
        self._end_rows = list(self._rows_of_ends())

    def _divide(self, segment: int) -> Iterator[Piece]:
        """Yield the pieces of the rows of a segment that do not depend on its ends."""
        recording = self._observations
        reach = self._shape.reach
        start, stop = recording.segments[segment]
        first_row, end_row = recording.row_segments[segment]
        step = recording.decimation.step
        edge = recording.filter.edge(recording.sample_time)
        # A row must be so far from the ends of what the filter has left.
        distance = max(reach - edge, 0)
        first_inner_row = first_row + math.ceil(distance / step)
        samples = stop - start - 2 * edge - distance
        end_inner_row = min(first_row + math.ceil(samples / step), end_row)
        call_rows = self._shape.iterations * self._shape.rows
        max_rows = call_rows - self._shape.delay
        # The first sample on which row zero of the segment depends.
        origin = start + edge - reach
        for block, rows in divide_rows(
            self._edges, slice(first_inner_row, end_inner_row)
        ):
            for row in range(rows.start, rows.stop, max_rows):
                next_row = min(row + max_rows, rows.stop)
                begin = origin + (row - first_row) * step
                end = min(begin + self._samples_of(next_row - row), stop)
                samples_of_rows = slice(begin, end, self._stride)
                yield Piece(block, slice(row, next_row), samples_of_rows)

    def _samples_of(self, rows: int) -> int:
        """Return the number of samples of the iterations that make so many rows."""
        iterations = math.ceil((rows + self._shape.delay) / self._shape.rows)
        return iterations * self._shape.samples * self._stride

    def _rows_of_ends(self) -> Iterator[BlockGrams]:
        """Yield block and equations of rows that no piece covers, reduced in NumPy."""
        is_end = np.ones(len(self._mask), bool)
        for piece in self._pieces:
            is_end[piece.rows] = False
        # Starts and stops of the runs of such rows alternate.
        padded_mask = np.pad(is_end, 1)
        changes = np.flatnonzero(np.diff(padded_mask))
        ranges = [(int(a), int(b)) for a, b in changes.reshape(-1, 2)]
        samples = max(4096, 2 * self._shape.reach)
        for chunk in row_chunks(self._base, self._observations, samples, ranges):
            mask = chunk.mask & is_end[chunk.rows, None]
            ends = chunk._replace(mask=mask)
            for part in ends.divide(self._edges):
                yield part.block, part.equations()

    def triangles(self, progress: Progress | None) -> list[Grams]:
        """Return an R factor of columns and forces for each block and joint."""
        result = self._pass(self._first_grams(), progress)
        if not result.is_accurate:
            # The pass has shown directions that the first look has missed.
            result = self._pass(result.total, progress)
        return result.triangles

    def _first_grams(self) -> Grams:
        """Return the Gram matrices of a few parts of the log."""
        step = max(1, len(self._pieces) // FIRST_PIECES)
        pieces = []
        for block, rows, samples in self._pieces[step // 2 :: step]:
            # As many rows of a piece as an iteration has.
            stop = min(rows.stop, rows.start + self._shape.rows)
            rows = slice(rows.start, stop)
            count = self._samples_of(stop - rows.start)
            end = min(samples.stop, samples.start + count)
            samples = slice(samples.start, end, self._stride)
            pieces.append(Piece(block, rows, samples))
        mixing = [np.eye(len(columns) + 1) for columns in self._base.acting_columns]
        grams = [matrices for _, matrices in self._grams(pieces, mixing)]
        return _sum_by_joint(grams)

    def _pass(self, first_grams: Grams, progress: Progress | None) -> _Pass:
        """Reduce all rows, given about what the products of all rows are."""
        triangles = [_regular_triangle(G) for G in first_grams]
        mixing = [np.linalg.inv(R) for R in triangles]
        blocks = [[np.zeros_like(R) for R in triangles] for _ in self._edges[1:]]
        for block, grams in self._grams(self._pieces, mixing, progress):
            for total, G in zip(blocks[block], grams, strict=True):
                total += G
        block_triangles = []
        for block in blocks:
            pairs = zip(block, triangles, strict=True)
            block_triangles.append([_root(G) @ R for G, R in pairs])
        totals = _sum_by_joint(blocks)
        joints = zip(totals, first_grams, mixing, strict=True)
        return _Pass(
            triangles=block_triangles,
            total=[R.T @ G @ R for R, G in zip(triangles, totals, strict=True)],
            is_accurate=all(_shows_every_direction(*joint) for joint in joints),
        )

    def _grams(
        self, pieces: list[Piece], mixing: Grams, progress: Progress | None = None
    ) -> Iterator[BlockGrams]:
        """Yield block and Gram matrices of some pieces, and of the ends."""
        # One core adds up a piece; the next ones are read meanwhile.
        arrays = map(self._fill, pieces)
        results = on_cores(lambda x: self._call(x, mixing), arrays)
        for k, grams in enumerate(results):
            yield pieces[k].block, grams
            if progress is not None:
                progress((k + 1) / len(pieces))
        for block, equations in self._end_rows:
            pairs = zip(equations, mixing, strict=True)
            mixed_rows = [rows @ mix for rows, mix in pairs]
            yield block, [rows.T @ rows for rows in mixed_rows]

    def _fill(self, piece: Piece) -> Grams:
        """Read the arrays of one piece, filled up to the shape of the loop."""
        shape = self._shape
        motion, forces = self._observations.read(piece.samples)
        forces = without_tool(self._base, motion, forces)
        arguments = np.hstack(self._base.model.arguments(motion))
        # The first rows come late, and do not count.
        mask = np.pad(self._mask[piece.rows], ((shape.delay, 0), (0, 0)))
        samples = shape.iterations * shape.samples
        rows = shape.iterations * shape.rows
        iterations = math.ceil(len(mask) / shape.rows)
        return [
            _fill_up(np.asarray(arguments, np.float64), samples),
            _fill_up(np.asarray(forces, np.float64), samples),
            _fill_up(mask, rows),
            np.asarray(iterations, np.int32),
        ]

    def _call(self, arrays: Grams, mixing: Grams) -> Grams:
        """Return the Gram matrices of a piece."""
        cpu = jax.local_devices(backend="cpu")[0]
        with double_precision(), jax.default_device(cpu):
            return [np.asarray(G) for G in self._loop(*arrays, mixing, self._matrix)]


def _banded_matrix(response: Vector, step: int) -> Matrix:
    """Return the matrix that makes the rows of a tile of consecutive samples."""
    rows = []
    for k in range(TILE):
        margins = k * step, (TILE - 1 - k) * step
        rows.append(np.pad(response, margins))
    return np.stack(rows)


def _sum_by_joint(grams: list[Grams]) -> Grams:
    return [np.sum(matrices, axis=0) for matrices in zip(*grams, strict=True)]


def _fill_up(x: Matrix, length: int) -> Matrix:
    """Return an array of so many rows, filled up with zeros."""
    rows = np.zeros((length, x.shape[1]), x.dtype)
    rows[: len(x)] = x[:length]
    return rows


def _shows_every_direction(total: Matrix, first_grams: Matrix, mixing: Matrix) -> bool:
    """Return whether the first look has shown the size of each direction it saw."""
    values, directions = np.linalg.eigh(mixing.T @ first_grams @ mixing)
    visible_directions = directions[:, values > 0.5]
    if not visible_directions.shape[1]:
        return not total.any()
    visible_total = visible_directions.T @ total @ visible_directions
    sizes = np.linalg.eigvalsh(visible_total)
    typical_size = np.median(sizes)
    max_size = MAX_SIZE_RATIO * typical_size
    min_size = typical_size / MAX_SIZE_RATIO
    return bool(np.linalg.norm(total) <= max_size and sizes[0] > min_size)


def _regular_triangle(G: Matrix) -> Matrix:
    """Return a triangle whose square is about G, and which is never singular."""
    norms = np.sqrt(np.diag(G))
    substitute = max(norms.max(initial=0.0), 1.0)
    scale = np.where(norms > 0, norms, substitute)
    scaled_gram = G / np.outer(scale, scale)
    regular_gram = scaled_gram + 1e-13 * np.eye(len(G))
    return np.linalg.cholesky(regular_gram).T * scale


def _root(G: Matrix) -> Matrix:
    """Return an upper triangle whose square is G; zero columns stay zero.

    G may be singular.
    """
    root = np.zeros_like(G)
    columns = np.flatnonzero(np.diag(G) > 0)
    places = np.ix_(columns, columns)
    values, directions = np.linalg.eigh(G[places])
    rows = np.sqrt(np.maximum(values, 0.0))[:, None] * directions.T
    root[places] = np.linalg.qr(rows, mode="r")
    return root


class _DistinctColumns(NamedTuple):
    """Columns that the loop filters; joints share them.

    Parallel axes have equal columns: a quarter of them on a UR10, where filtering all
    would take one and a half times as long.
    """

    outputs: list[int]  # outputs of the program, every distinct expression once
    # rows of each joint's columns and force among the filtered ones
    places: Grams

    @classmethod
    def of(cls, program: Program, acting: tuple[Indices, ...]) -> "_DistinctColumns":
        """Return the distinct columns that act on joints."""
        size = len(program.outputs) // len(acting)
        rows: dict[str, int] = {}
        outputs = []
        joint_rows = []
        for j, columns in enumerate(acting):
            joint_rows.append([])
            for output in (j * size + k for k in columns):
                name = repr(program.outputs[output])
                if name not in rows:
                    rows[name] = len(rows)
                    outputs.append(output)
                joint_rows[j].append(rows[name])
        # The forces of the joints follow the columns.
        places = [np.array([*x, len(rows) + j]) for j, x in enumerate(joint_rows)]
        return cls(outputs, places)


@functools.lru_cache(maxsize=16)
def _compile_loop(
    program: Program, acting: tuple[Indices, ...], shape: LoopShape
) -> Callable:
    """Return the loop, which is compiled when it is first called."""
    joints = len(acting)
    distinct_columns = _DistinctColumns.of(program, acting)
    base_columns = lower(program, fence=True)
    height = len(distinct_columns.outputs) + joints
    zeros = [jnp.zeros(shape.samples)] * height

    def evaluate(motion: Array, forces: Array):
        outputs = base_columns(*jnp.split(motion, len(motion) // joints))
        columns = []
        for output in distinct_columns.outputs:
            column = jnp.asarray(outputs[output], float)
            columns.append(jnp.broadcast_to(column, motion.shape[1:]))
        return columns + list(forces)

    def run(motion, forces, mask, count, mixing, matrix):
        def iteration(k: Array, state: tuple) -> tuple:
            tail, grams = state
            motion_part = _iteration_part(motion, k, shape.samples)
            forces_part = _iteration_part(forces, k, shape.samples)
            # Results of a branch are stored: no consumer computes them again.
            columns = jax.lax.cond(
                count > 0, evaluate, lambda *_: zeros, motion_part, forces_part
            )
            rows = jnp.stack(columns)
            if shape.lags > 1:
                samples = jnp.concatenate([tail, rows], axis=1)
                tail = samples[:, shape.samples :]
                rows = _filtered_rows(samples, matrix, shape)
            weights = _iteration_part(mask, k, shape.rows).astype(rows.dtype)
            sums = []
            for gram, mix, places, weight in zip(
                grams, mixing, distinct_columns.places, weights, strict=True
            ):
                joint_rows = rows[places]
                if shape.lags == 1:
                    # Without a filter the columns are taken before they are stored.
                    joint_rows = jnp.stack([columns[i] for i in places])
                mixed_rows = mix.T @ (joint_rows * weight[None])
                sums.append(gram + mixed_rows @ mixed_rows.T)
            return tail, sums

        tail = jnp.zeros((height, shape.delay * shape.step))
        grams = [jnp.zeros((len(x), len(x))) for x in distinct_columns.places]
        return jax.lax.fori_loop(0, count, iteration, (tail, grams))[1]

    return jax.jit(run, compiler_options=kernel_options(program))


def _iteration_part(x: AnyArray, k: Array, length: int) -> Array:
    """Return the samples of one iteration, on the last axis."""
    start = (k * length, jnp.zeros_like(k))
    return jax.lax.dynamic_slice(x, start, (length, x.shape[1])).T


def _filtered_rows(samples: Array, matrix: Array, shape: LoopShape) -> Array:
    """Return the rows of an iteration by a banded matrix product, tile by tile."""
    tiles = []
    for row in range(0, shape.rows, TILE):
        height = min(TILE, shape.rows - row)
        width = (height - 1) * shape.step + shape.lags
        start = row * shape.step
        window = samples[:, start : start + width]
        tiles.append(window @ matrix[:height, :width].T)
    return jnp.concatenate(tiles, axis=1)
