"""The compiled pass over many samples: columns, filters and Gram matrices, chunk by chunk.

One loop evaluates the columns of a chunk, filters and decimates them to rows, and adds up the Gram
matrix of each joint's rows. Columns live only within an iteration. Filters and decimation are
matrix products with their impulse responses. All computation is in float64 on the CPU.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from scipy import signal

from jaxid.arrays import AnyArray, Array, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.measurement.decimation import AbstractDecimation
from jaxid.measurement.filters import AbstractFilter, LowPass
from jaxid.program import Program, default_fence, lower

PIECE = 32768
"""Samples that are passed to the compiled loop at once."""
TILE = 16
"""Rows of a banded matrix product: more multiply more zeros, fewer use the processor less."""

Grams = list[np.ndarray]
"""For each joint the products of its columns and forces with each other."""


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """Zero-phase filter followed by decimation.

    Attributes:
        response: Response of the filter to an impulse in its middle, of odd length.
        factor: Decimation factor.
    """

    response: Float[np.ndarray, " lags"]
    factor: int

    def matrix(self, rows: int) -> Float[np.ndarray, "rows samples"]:
        """Return the matrix that makes some rows of consecutive samples."""
        lags = len(self.response)
        H = np.zeros((rows, (rows - 1) * self.factor + lags))
        for i in range(rows):
            H[i, i * self.factor : i * self.factor + lags] = self.response
        return H


def filter_stages(
    filter: AbstractFilter, decimation: AbstractDecimation, sample_time: float
) -> tuple[Stage, ...]:
    """Return the stages of decimation, the first one with the filter in it.

    Stages that change nothing are left out.

    Args:
        filter: Filter of forces and columns.
        decimation: Decimation of forces and columns.
        sample_time: Time between two samples [s].
    """
    before, stages = impulse_response(filter.low_pass(sample_time)), []
    for k, factor in enumerate(decimation.stages):
        response = np.convolve(before, impulse_response(decimation.low_pass(k)))
        if factor > 1 or len(response) > 1:
            stages.append(Stage(response, factor))
        before = np.ones(1)
    return tuple(stages)


def impulse_response(low_pass: LowPass) -> Float[np.ndarray, " lags"]:
    """Return the response to an impulse in the middle, until it has decayed on both sides."""
    if not low_pass.sections:
        return np.ones(1)
    half = low_pass.memory()
    sos = np.array(low_pass.sections)
    impulse = np.zeros(2 * half + 1)
    impulse[0] = 1.0
    backward = signal.sosfilt(sos, impulse)[::-1]
    two_way = signal.sosfilt(sos, np.concatenate([backward, np.zeros(half)]))
    # The tail that the first pass cut off has decayed: the middle of the response is symmetric.
    right = two_way[2 * half :]
    return np.concatenate([right[:0:-1], right])


def reach_of(stages: Sequence[Stage]) -> int:
    """Return the number of samples before, and after, a row's instant on which it depends."""
    rates = [math.prod(s.factor for s in stages[:i]) for i in range(len(stages))]
    return sum(rate * (len(s.response) // 2) for rate, s in zip(rates, stages, strict=True))


class LoopShape(NamedTuple):
    """Sizes on which the compiled loop depends, beside the robot.

    Attributes:
        samples: Samples of an iteration.
        iterations: Largest number of iterations of one call.
        factors: Decimation factors of the stages.
        lags: Lengths of the stages' responses.
        delays: Rows of each stage by which its results come late.
    """

    samples: int
    iterations: int
    factors: tuple[int, ...]
    lags: tuple[int, ...]
    delays: tuple[int, ...]

    @property
    def rows(self) -> int:
        """Rows of an iteration."""
        return self.samples // math.prod(self.factors)

    @property
    def delay(self) -> int:
        """Rows at the start of a call that stand for nothing yet."""
        rates = [math.prod(self.factors[k + 1 :]) for k in range(len(self.factors))]
        return sum(d // rate for d, rate in zip(self.delays, rates, strict=True))


def loop_shape(stages: Sequence[Stage], chunk: int) -> LoopShape:
    """Return the sizes of the loop for some stages and about so many samples of an iteration."""
    factors = tuple(stage.factor for stage in stages)
    lags = tuple(len(stage.response) for stage in stages)
    factor = math.prod(factors)
    rows = max(1, round(chunk / factor))
    delays = []
    for k, (n, f) in enumerate(zip(lags, factors, strict=True)):
        # Later stages must get complete rows.
        later = math.prod(factors[k + 1 :])
        delays.append(later * -(-max(0, n - f) // (f * later)))
    iterations = max(1, PIECE // (rows * factor))
    return LoopShape(rows * factor, iterations, factors, lags, tuple(delays))


class CompiledLoop:
    """The compiled loop of one robot, on one or several devices.

    Args:
        base: The base parameters.
        stages: Filter and decimation.
        chunk: Samples of an iteration: their columns stay in the cache.
    """

    def __init__(self, base: BaseParameters, stages: tuple[Stage, ...], chunk: int):
        n = (base.model.robot.joints,)
        columns = program_of(base, base.columns, n, n, n)
        tool = None
        if base.model.robot.tool is not None:
            tool = program_of(base.model, base.model.known_forces, n, n, n)
        self.shape = loop_shape(stages, chunk)
        self.devices = tuple(jax.local_devices(backend="cpu"))
        self._matrices = [stage.matrix(TILE) for stage in stages]
        self._run = _compiled(columns, tool, tuple(base.acting_columns), self.shape)

    def prepare(self, samples: Sequence[AnyArray], mask: np.ndarray) -> list[np.ndarray]:
        """Return the arrays of one piece, filled up to the shape of the loop.

        Args:
            samples: Angles, velocities, accelerations and forces [samples, joints].
            mask: Rows that count; the first ones are those that come late [rows, joints].
        """
        shape = self.shape
        length, iterations = shape.iterations * shape.samples, -(-len(mask) // shape.rows)
        arrays = [_filled_up(np.asarray(x, np.float64), length) for x in samples]
        arrays.append(_filled_up(mask, shape.iterations * shape.rows))
        return [*arrays, np.asarray(iterations, np.int32)]

    def __call__(self, pieces: Sequence[list[np.ndarray]], mixing: Grams) -> list[Grams]:
        """Return the Gram matrices of some pieces, at most one for each device.

        Args:
            pieces: Arrays that `prepare` has made.
            mixing: For each joint the matrix by which its columns and forces are multiplied.
        """
        if len(self.devices) == 1:
            with on_cpu():
                return [self._to_numpy(self._run(*x, mixing, self._matrices)) for x in pieces]
        missing = len(self.devices) - len(pieces)
        pieces = [*pieces, *([np.zeros_like(x) for x in pieces[0]] for _ in range(missing))]
        run = _on_devices(self._run, Mesh(np.array(self.devices), ("pieces",)))
        with double_precision():
            arrays = [np.stack(x) for x in zip(*pieces, strict=True)]
            grams = self._to_numpy(run(*arrays, mixing, self._matrices))
        return [[x[k] for x in grams] for k in range(len(pieces) - missing)]

    @staticmethod
    def _to_numpy(arrays: Sequence[Array]) -> Grams:
        return [np.asarray(x) for x in arrays]


def _filled_up(x: np.ndarray, length: int) -> np.ndarray:
    if len(x) >= length:
        return np.ascontiguousarray(x[:length])
    out = np.zeros((length, *x.shape[1:]), x.dtype)
    out[: len(x)] = x
    return out


@contextlib.contextmanager
def on_cpu():
    """Compute in float64 on the CPU within a `with`, whatever the process does otherwise."""
    with double_precision(), jax.default_device(jax.devices("cpu")[0]):
        yield


@functools.lru_cache(maxsize=16)
def _compiled(
    program: Program, tool: Program | None, acting: tuple[tuple[int, ...], ...], shape: LoopShape
) -> Callable:
    """Return the loop, which is compiled when it is first called."""
    joints = len(acting)
    size = len(program.outputs) // joints
    fence = default_fence("cpu", jax.__version_info__)
    base_columns = lower(program, fence)
    tool_forces = None if tool is None else lower(tool, fence)
    # Joints share columns: every distinct one is filtered once.
    distinct: dict[tuple[bool, int | float], int] = {}
    first, places = [], []
    for j, own in enumerate(acting):
        for k in own:
            x = program.outputs[j * size + k]
            if distinct.setdefault((isinstance(x, int), x), len(distinct)) == len(first):
                first.append(j * size + k)
        outputs = [program.outputs[j * size + k] for k in own]
        places.append([distinct[isinstance(x, int), x] for x in outputs])
    places = [np.array([*own, len(first) + j]) for j, own in enumerate(places)]
    height = len(first) + joints

    def evaluate(q: Array, qd: Array, qdd: Array, forces: Array) -> list[Array]:
        packed = base_columns(q, qd, qdd)
        rows = [jnp.broadcast_to(jnp.asarray(packed[i], float), q.shape[1:]) for i in first]
        known = [0.0] * joints if tool_forces is None else tool_forces(q, qd, qdd)
        rows += [f - k for f, k in zip(forces, known, strict=True)]
        return rows

    def nothing(q: Array, qd: Array, qdd: Array, forces: Array) -> list[Array]:
        return [jnp.zeros(q.shape[1:])] * height

    def run(
        q: AnyArray,
        qd: AnyArray,
        qdd: AnyArray,
        forces: AnyArray,
        mask: AnyArray,
        count: AnyArray,
        mixing: list,
        matrices: list,
    ) -> list[Array]:
        def iteration(k: Array, state: tuple) -> tuple:
            carried, grams = state
            parts = [_part(x, k, shape.samples) for x in (q, qd, qdd, forces)]
            # Results of a branch are stored: no consumer computes them again.
            columns = jax.lax.cond(count > 0, evaluate, nothing, *parts)
            new = jnp.stack(columns)
            left = []
            stages = zip(carried, matrices, shape.factors, shape.lags, strict=True)
            for before, H, factor, lags in stages:
                joined = jnp.concatenate([before, new], axis=1)
                left.append(joined[:, new.shape[1] :])
                new = _decimate(joined, H, new.shape[1] // factor, factor, lags)
            counted = _part(mask, k, shape.rows).astype(new.dtype)
            sums = []
            for j, own in enumerate(places):
                own_rows = new[own] if carried else jnp.stack([columns[i] for i in own])
                rows = mixing[j].T @ (own_rows * counted[j][None])
                sums.append(grams[j] + rows @ rows.T)
            return left, sums

        carried = [
            jnp.zeros((height, d * f)) for d, f in zip(shape.delays, shape.factors, strict=True)
        ]
        grams = [jnp.zeros((len(own), len(own))) for own in places]
        return jax.lax.fori_loop(0, count, iteration, (carried, grams))[1]

    return jax.jit(run)


def _part(x: AnyArray, k: Array, length: int) -> Array:
    """Return the samples of one iteration, on the last axis."""
    start = (k * length, jnp.zeros_like(k))
    return jax.lax.dynamic_slice(x, start, (length, x.shape[1])).T


def _decimate(x: Array, H: Array, rows: int, factor: int, lags: int) -> Array:
    """Return the banded matrix product, tile by tile."""
    tiles = []
    for start in range(0, rows, TILE):
        height = min(TILE, rows - start)
        window = (height - 1) * factor + lags
        low = start * factor
        tiles.append(x[:, low : low + window] @ H[:height, :window].T)
    return jnp.concatenate(tiles, axis=1)


@functools.lru_cache(maxsize=16)
def _on_devices(run: Callable, mesh: Mesh) -> Callable:
    """Return the loop for one piece on each device, compiled once for all."""
    own, same = PartitionSpec(*mesh.axis_names), PartitionSpec()

    def device(*arrays) -> list[Array]:
        *piece, mixing, matrices = arrays
        return [x[None] for x in run(*(x[0] for x in piece), mixing, matrices)]

    return jax.jit(shard_map(device, mesh, (*(own,) * 6, same, same), own))


def shard_map(function: Callable, mesh: Mesh, arguments: tuple, results: PartitionSpec) -> Callable:
    """Return `jax.shard_map` of a function, without its check of what varies over the devices."""
    if hasattr(jax, "shard_map"):
        return jax.shard_map(
            function, mesh=mesh, in_specs=arguments, out_specs=results, check_vma=False
        )
    from jax.experimental.shard_map import shard_map as older

    return older(function, mesh=mesh, in_specs=arguments, out_specs=results, check_rep=False)
