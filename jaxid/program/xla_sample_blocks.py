"""A scalar program on rows of samples, by blocks that stay in the processor's cache.

If the results of a program are stacked where they are computed, XLA copies what each of
them needs into its own loop. Here the results of a block leave a branch as separate
arrays, and are put in place afterwards. An accelerator takes all samples at once.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from jaxid.arrays import Array, Float, Indices

from .gpu_kernel import in_kernel, suits_kernel
from .jax_transformation_rules import TRUE, differing_alike, with_derivatives_of
from .program import Program
from .xla import Results, fenced, hidden_one, lower
from .xla_loops import empty_rows, entry_rows, rows_of

BLOCK = 256
"""Samples of one evaluation."""
BLOCK_OF_PRODUCTS = 512
"""Samples of one evaluation whose results are multiplied with each other.

Longer rows make products faster: 12 % on a Panda and on Go2, with 256 more samples.
"""
BLOCK_ON_GPU = 2**16
"""The same on another device than a CPU: its memory for results is limited by this."""
Rows = Float[Array, "samples out"]
"""Packed result of each sample."""


def block_results(program: Program, *arrays: Array) -> Results:
    """Return the distinct results of a block of samples, each computed once.

    Inputs are [entries] if all samples have them in common, else [samples, entries].
    """
    count = len(arrays[-1])
    reference = arrays[-1][0, 0]

    def evaluate(arrays):
        # All samples are transposed together, behind a fence of their own.
        transposed_arrays = [x.T for x in arrays if x.ndim == 2]
        matrix = jnp.concatenate(transposed_arrays)
        one = hidden_one(matrix[0, 0])
        rows = iter(fenced(matrix, one))
        columns: list[Any] = list(arrays)
        for k, x in enumerate(arrays):
            if x.ndim == 2:
                entries = x.shape[1]
                columns[k] = list(itertools.islice(rows, entries))
        lowered_program = lower(program, fence=True)
        return lowered_program.run(_repeat(columns, count))

    def skip(_):
        return tuple(jnp.broadcast_to(reference, count) for _ in program.distinct[0])

    # Results of a branch are stored: what uses them does not compute them again.
    is_always_true = hidden_one(reference) > 0
    return jax.lax.cond(is_always_true, evaluate, skip, arrays)


def results_at_once(program: Program, *arrays: Array) -> Results:
    """Return the distinct results of samples, without fences."""
    columns = [x.T for x in arrays]
    entries = _repeat(columns, len(arrays[-1]))
    return lower(program, fence=False).run(entries)


def _repeat(columns: Sequence, count: int):
    """Return all entries as arrays of the samples, also what these have in common."""
    entries = []
    for x in columns:
        entries.append([jnp.broadcast_to(row, count) for row in x])
    return entries


class BlockResults(NamedTuple):
    """Results of a block of samples.

    Attributes:
        program: Program.
        values: Distinct results, or the rows that the loops of a program compute.
        row: Any entry of all samples.
    """

    program: Program
    values: Results | Array
    row: Array

    def entries(self, positions: Sequence[int], axis: int = 0) -> Array:
        """Return some entries of the packed result, along this axis."""
        if not isinstance(self.values, tuple):
            rows = rows_of(self.program, self.values, np.array(positions, int))
            return rows if axis == 0 else rows.T
        values = self.program.pack(self.values)
        columns = []
        for k in positions:
            column = jnp.asarray(values[k], self.row.dtype)
            columns.append(jnp.broadcast_to(column, self.row.shape))
        return jnp.stack(columns, axis) if columns else self.row[:0, None]

    def packed(self) -> Rows:
        """Return the packed result of each sample."""
        return self.entries(range(len(self.program.outputs)), axis=1)


def _evaluate_block(
    program: Program, memory: Array, *arrays: Array
) -> tuple[BlockResults, Array]:
    """Return the results of a block, and memory that loops overwrite next time."""
    row = arrays[-1][:, 0]
    if program.loops is None:
        return BlockResults(program, block_results(program, *arrays), row), memory
    rows = entry_rows(program, memory, *arrays)
    return BlockResults(program, rows, row), rows


def _evaluate_at_once(
    program: Program, memory: Array, *arrays: Array
) -> tuple[BlockResults, Array]:
    """Return the results of many samples, without fences."""
    results = results_at_once(program, *arrays)
    return BlockResults(program, results, arrays[-1][:, 0]), memory


def _over_blocks(
    program: Program,
    size: int,
    step: Callable[[Any, BlockResults, Array, Array], Any],
    state: Any,
    *arrays: Array,
    evaluate: Callable[..., tuple[BlockResults, Array]] = _evaluate_block,
) -> Any:
    """Return the state after a step for each block of samples.

    A step takes the state, the results, the first sample of the block, and the first
    one that no block before has held.
    """
    count = len(arrays[-1])
    size = min(size, count)

    def on_block(k, state_and_memory):
        state, memory = state_and_memory
        # The last block begins earlier, so that it is as long as the others.
        start = jnp.minimum(k * size, count - size)
        parts = []
        for x in arrays:
            is_common = x.ndim == 1
            part = x if is_common else jax.lax.dynamic_slice_in_dim(x, start, size)
            parts.append(part)
        results, memory = evaluate(program, memory, *parts)
        return step(state, results, start, k * size), memory

    memory = empty_rows(program, size, arrays[-1][0, 0])
    blocks = math.ceil(count / size)
    return jax.lax.fori_loop(0, blocks, on_block, (state, memory))[0]


def _in_blocks(program: Program, *arrays: Array) -> Rows:
    """Return the packed result of each sample, block by block."""

    def step(rows, results, start, _):
        return jax.lax.dynamic_update_slice_in_dim(rows, results.packed(), start, 0)

    # All of it is overwritten.
    shape = (len(arrays[-1]), len(program.outputs))
    rows = jnp.broadcast_to(arrays[-1][0, 0], shape)
    return _over_blocks(program, BLOCK, step, rows, *arrays)


def _at_once(program: Program, *arrays: Array) -> Rows:
    """Return the packed result of each sample, without fences."""
    results, _ = _evaluate_at_once(program, arrays[-1], *arrays)
    return results.packed()


def _stored_at_once(program: Program, *arrays: Array) -> Rows:
    """Return the packed result, of distinct results that are stored before.

    Where results are stacked, a GPU would compute what they share for each of them.
    """
    results, _ = _evaluate_at_once(program, arrays[-1], *arrays)
    values = jax.lax.optimization_barrier(results.values)
    return results._replace(values=values).packed()


def on_rows(program: Program, *arrays: Array) -> Rows:
    """Return the packed result of each sample; not for differentiation.

    Inputs as in `block_results`; at least the last one has samples.
    """
    if not len(arrays[-1]):
        return jnp.zeros((0, len(program.outputs)), arrays[-1].dtype)

    @custom_vmap
    def run(*arrays):
        block_run = functools.partial(_in_blocks, program)
        vectorised_run = functools.partial(_stored_at_once, program)
        runs = {"cpu": block_run, "default": vectorised_run}
        if suits_kernel(program, *arrays):
            runs["cuda"] = functools.partial(in_kernel, program)
        return jax.lax.platform_dependent(*arrays, **runs)

    @run.def_vmap
    def batch(size, is_batched, *arrays):
        inputs = list(zip(arrays, is_batched, strict=True))
        count = arrays[-1].shape[int(is_batched[-1])]
        # Parameters are vectors, with the axis of the batch matrices.
        has_own_parameters = any(x.ndim == 2 and has_batch for x, has_batch in inputs)
        if has_own_parameters and count >= BLOCK:
            # Blocks have parameters in common: no block may hold several elements.
            return _one_after_the_other(run, inputs), True

        # All become samples, but for what is common to all.
        rows = []
        for x, has_batch in inputs:
            is_common = x.ndim - has_batch == 1
            if is_common and not has_batch:
                rows.append(x)
                continue
            x = x if has_batch else x[None]
            x = x[:, None] if is_common else x
            entries = x.shape[-1]
            repeated_rows = jnp.broadcast_to(x, (size, count, entries))
            rows.append(repeated_rows.reshape(-1, entries))
        return run(*rows).reshape(size, count, -1), True

    return run(*differing_alike(arrays))


def packed_columns(program: Program, *arrays: Array) -> Array:
    """Return the packed result [out, *batch] of arrays whose batch axes stand last."""
    batch = arrays[0].shape[1:]
    definition = functools.partial(_at_once, program)
    run = with_derivatives_of(definition, functools.partial(on_rows, program))
    rows = [x.reshape(len(x), -1).T for x in arrays]
    return run(*rows).T.reshape(-1, *batch)


def _one_after_the_other(run: Callable, inputs: list[tuple[Array, bool]]):
    """Call a function for each element of a batch, with inputs that have one or not."""
    elements = [x for x, has_batch in inputs if has_batch]

    def on_element(parts):
        remaining_parts = iter(parts)
        return run(
            *(next(remaining_parts) if has_batch else x for x, has_batch in inputs)
        )

    return jax.lax.map(on_element, elements)


def row_products(
    program: Program, groups: tuple[Indices, ...], *arrays: Array
) -> list[Array]:
    """Return sums over samples of products of results, which are not stored.

    A group holds positions in the packed result whose values are multiplied with each
    other.
    """
    count = len(arrays[0])
    dtype = arrays[0].dtype
    if count == 0:
        return [jnp.zeros((len(group), len(group)), dtype) for group in groups]

    def step(sums, results, start, first):
        # Samples that were counted before do not count again.
        samples = start + jnp.arange(len(results.row))
        counts = (samples >= first).astype(dtype)
        totals = []
        for group, total in zip(groups, sums, strict=True):
            rows = counts[None] * results.entries(group)
            totals.append(total + rows @ rows.T)
        return totals

    def by_blocks(size, evaluate, *arrays):
        sums = []
        for group in groups:
            zeros = jnp.zeros((len(group), len(group)), dtype)
            # `where`, see `differing_alike`.
            sums.append(jnp.where(TRUE, zeros, arrays[-1][0, 0]))
        return _over_blocks(program, size, step, sums, *arrays, evaluate=evaluate)

    return jax.lax.platform_dependent(
        *differing_alike(arrays),
        cpu=functools.partial(by_blocks, BLOCK_OF_PRODUCTS, _evaluate_block),
        default=functools.partial(by_blocks, BLOCK_ON_GPU, _evaluate_at_once),
    )


def distinct_rows(program: Program, *arrays: Array) -> Array:
    """Return the distinct results of many samples from loops, block by block.

    Inputs are [samples, entries].
    """
    _, numbers = program.distinct
    _, first_entries = np.unique(numbers[numbers >= 0], return_index=True)
    entries = np.flatnonzero(numbers >= 0)[first_entries]

    def step(rows, results, start, _):
        block = results.entries(entries)
        return jax.lax.dynamic_update_slice_in_dim(rows, block, start, axis=1)

    arrays = differing_alike(arrays)
    shape = (len(entries), len(arrays[-1]))
    rows = jnp.broadcast_to(arrays[-1][0, 0], shape)
    return _over_blocks(program, BLOCK, step, rows, *arrays)
