"""The compiled pass over many samples: columns, filters and Gram matrices, chunk by chunk.

One loop evaluates the columns of a chunk, reduces them to rows, and adds up for each joint the Gram
matrix of its rows. Columns live only within an iteration. All in float64 on the CPU.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.dynamics.machine import program_of
from jaxid.identification.response import Stage
from jaxid.program import Program, default_fence, lower

CHUNK = 2048
"""Samples of an iteration: their columns stay in the cache."""
PIECE = 32768
"""Samples that are handed to the compiled loop at once."""
TILE = 16
"""Rows of a banded matrix product: more multiply more zeros, fewer use the processor less."""


class Shape(NamedTuple):
    """What the compiled loop depends on, beside the robot.

    Attributes:
        samples: Of an iteration.
        iterations: Most that one call can do.
        factors: Of the stages.
        lags: Lengths of the stages' responses.
        delays: Rows of each stage by which its results come late; the stage's memory.
    """

    samples: int
    iterations: int
    factors: tuple[int, ...]
    lags: tuple[int, ...]
    delays: tuple[int, ...]

    @classmethod
    def of(cls, chain: Sequence[Stage], chunk: int = CHUNK) -> "Shape":
        """For some stages of filters and decimation."""
        factors = tuple(stage.factor for stage in chain)
        lags = tuple(len(stage.response) for stage in chain)
        factor = math.prod(factors)
        rows = max(1, round(chunk / factor))
        delays = []
        for k, (n, f) in enumerate(zip(lags, factors, strict=True)):
            # Later stages must see whole rows of their own.
            whole = math.prod(factors[k + 1 :])
            delays.append(whole * -(-max(0, n - f) // (f * whole)))
        iterations = max(1, PIECE // (rows * factor))
        return cls(rows * factor, iterations, factors, lags, tuple(delays))

    @property
    def factor(self) -> int:
        """Samples for each row."""
        return math.prod(self.factors)

    @property
    def rows(self) -> int:
        """Rows of an iteration."""
        return self.samples // self.factor

    @property
    def delay(self) -> int:
        """Rows at the start of a call that stand for nothing yet."""
        rates = [math.prod(self.factors[k + 1 :]) for k in range(len(self.factors))]
        return sum(d // rate for d, rate in zip(self.delays, rates, strict=True))


Grams = list[np.ndarray]
"""For each joint the products of its columns and forces with each other."""


class Kernel:
    """The compiled loop for one robot."""

    def __init__(self, base: BaseParameters, chain: tuple[Stage, ...], chunk: int = CHUNK):
        n = (base.model.robot.joints,)
        columns = program_of(base, base.columns, n, n, n)
        tool = None
        if base.model.robot.tool is not None:
            tool = program_of(base.model, base.model.known_forces, n, n, n)
        self.shape = Shape.of(chain, chunk)
        self._matrices = [stage.matrix(TILE) for stage in chain]
        self._run = _compiled(columns, tool, tuple(acting_columns(base)), self.shape)

    def __call__(
        self,
        motion: Sequence[np.ndarray],
        forces: np.ndarray,
        weights: np.ndarray,
        mixing: Grams,
    ) -> Grams:
        """Adds up the Gram matrices of one piece.

        Args:
            motion: Angles, velocities, accelerations [samples, joints].
            forces: Measured [samples, joints].
            weights: Of the rows: nothing, or 1 where a row counts, [rows, joints]. The first rows
                are those that come late.
            mixing: For each joint what its columns and forces are multiplied with.
        """
        shape = self.shape
        iterations = -(-len(weights) // shape.rows)
        length = shape.iterations * shape.samples
        arrays = [_padded(x, length) for x in (*motion, forces)]
        weights = _padded(weights, shape.iterations * shape.rows)
        with on_cpu():
            found = self._run(
                *arrays, weights, mixing, self._matrices, np.asarray(iterations, np.int32)
            )
            return [np.asarray(x) for x in found]


def _padded(x: np.ndarray, length: int) -> np.ndarray:
    if len(x) >= length:
        return np.ascontiguousarray(x[:length])
    out = np.zeros((length, *x.shape[1:]), x.dtype)
    out[: len(x)] = x
    return out


@contextlib.contextmanager
def on_cpu():
    """Computes in float64 on the CPU, whatever the process does otherwise."""
    with double_precision(), jax.default_device(jax.devices("cpu")[0]):
        yield


@functools.lru_cache(maxsize=16)
def _compiled(
    program: Program, tool: Program | None, acting: tuple[tuple[int, ...], ...], shape: Shape
) -> Callable:
    """The loop; it is compiled when it is called first."""
    joints = len(acting)
    size = len(program.outputs) // joints
    fence = default_fence("cpu", jax.__version_info__)
    base_columns = lower(program, fence)
    tool_forces = None if tool is None else lower(tool, fence)
    # Joints share columns: every distinct one is filtered once.
    distinct: dict[tuple[bool, int | float], int] = {}
    first, chosen = [], []
    for j, own in enumerate(acting):
        for k in own:
            x = program.outputs[j * size + k]
            if distinct.setdefault((isinstance(x, int), x), len(distinct)) == len(first):
                first.append(j * size + k)
        outputs = [program.outputs[j * size + k] for k in own]
        chosen.append([distinct[isinstance(x, int), x] for x in outputs])
    chosen = [np.array([*own, len(first) + j]) for j, own in enumerate(chosen)]

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
        weights: AnyArray,
        mixing: list,
        matrices: list,
        count: AnyArray,
    ) -> list[Array]:
        def iteration(k: Array, state: tuple) -> tuple:
            carried, grams = state
            parts = [_part(x, k, shape.samples) for x in (q, qd, qdd, forces)]
            # What a branch returns is stored: no consumer computes it again.
            columns = jax.lax.cond(count > 0, evaluate, nothing, *parts)
            new = jnp.stack(columns)
            left = []
            for held, H, factor, lags in zip(
                carried, matrices, shape.factors, shape.lags, strict=True
            ):
                whole = jnp.concatenate([held, new], axis=1)
                left.append(whole[:, new.shape[1] :])
                new = _reduced(whole, H, new.shape[1] // factor, factor, lags)
            counted = _part(weights, k, shape.rows).astype(new.dtype)
            sums = []
            for j, own in enumerate(chosen):
                own_rows = new[own] if carried else jnp.stack([columns[i] for i in own])
                rows = mixing[j].T @ (own_rows * counted[j][None])
                sums.append(grams[j] + rows @ rows.T)
            return left, sums

        carried = [
            jnp.zeros((height, d * f)) for d, f in zip(shape.delays, shape.factors, strict=True)
        ]
        grams = [jnp.zeros((len(own), len(own))) for own in chosen]
        return jax.lax.fori_loop(0, count, iteration, (carried, grams))[1]

    return jax.jit(run)


def _part(x: AnyArray, k: Array, length: int) -> Array:
    """The samples of one iteration, last."""
    start = (k * length, jnp.zeros_like(k))
    return jax.lax.dynamic_slice(x, start, (length, x.shape[1])).T


def _reduced(x: Array, H: Array, rows: int, factor: int, lags: int) -> Array:
    """The banded matrix product, tile by tile."""
    tiles = []
    for start in range(0, rows, TILE):
        height = min(TILE, rows - start)
        window = (height - 1) * factor + lags
        low = start * factor
        tiles.append(x[:, low : low + window] @ H[:height, :window].T)
    return jnp.concatenate(tiles, axis=1)
