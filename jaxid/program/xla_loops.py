"""Loops over equal parts of a program, on rows of a block of samples."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array

from .equal_parts import Loop
from .program import Program
from .xla import hidden_one, lower


def empty_rows(program: Program, samples: int, reference: Array) -> Array:
    """Return memory for the rows of `entry_rows`; a program without loops has none."""
    count = 0 if program.loops is None else program.loops.loops[-1].stop
    return jnp.broadcast_to(reference, (count, samples))


def entry_rows(program: Program, values: Array, *arrays: Array) -> Array:
    """Return the rows of all values that the loops of a program compute.

    Args:
        program: Program with loops.
        values: Rows that are overwritten: to fill new ones costs time in each block.
        arrays: Inputs: [entries] if all samples have them in common, else [samples,
            entries].
    """
    samples = len(arrays[-1])
    reference = arrays[-1][0, 0]
    loops = program.loops
    inputs = []
    for x in (*arrays, jnp.asarray(loops.constants, reference.dtype)):
        matrix = x.T if x.ndim == 2 else x[:, None]
        inputs.append(jnp.broadcast_to(matrix, (len(matrix), samples)))
    rows = jnp.concatenate(inputs)
    values = jax.lax.dynamic_update_slice_in_dim(values, rows, 0, axis=0)
    for loop in loops.loops:
        turn = functools.partial(_turn, loop, hidden_one(reference))
        count = len(loop.choices)
        values = jax.lax.fori_loop(0, count, turn, values)
    return values


def _turn(loop: Loop, one: Array, turn: Array, values: Array):
    """Compute one turn of a loop, and write its results behind the others."""
    samples = values.shape[1]

    def skip(values, *_):
        return tuple(jnp.broadcast_to(values[0], samples) for _ in range(loop.size))

    def run(part: Program, values, sources, numbers):
        rows = []
        (count,) = part.input_shapes[1]
        for k in range(count):
            row = jax.lax.dynamic_index_in_dim(values, sources[k], keepdims=False)
            rows.append(row)
        results = lower(part).run([numbers, rows])
        # A shorter part writes its first result again, where the next turn writes.
        results = [*results, *results[:1] * (loop.size - len(results))]
        return tuple(jnp.broadcast_to(x, samples) for x in results)

    # Results of a branch are stored: what uses them does not compute them again.
    branches = [skip, *(functools.partial(run, part) for part in loop.programs)]
    is_always_true = one > 0
    choice = jnp.where(is_always_true, jnp.asarray(loop.choices)[turn] + 1, 0)
    sources = jnp.asarray(loop.sources)[turn]
    numbers = jnp.asarray(loop.numbers, values.dtype)[turn]
    results = jax.lax.switch(choice, branches, values, sources, numbers)
    start = loop.start + turn * loop.size
    block = jnp.stack(results)
    return jax.lax.dynamic_update_slice_in_dim(values, block, start, axis=0)


def rows_of(program: Program, values: Array, entries: np.ndarray) -> Array:
    """Return some entries of the packed result [entries, samples] from all rows."""
    rows = jnp.asarray(program.loops.results[entries])
    return values.at[rows].get(mode="promise_in_bounds")
