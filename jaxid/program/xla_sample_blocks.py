"""A scalar program on rows of samples, by blocks that stay in the processor's cache.

If the results of a program are stacked where they are computed, XLA copies what each of
them needs into its own loop. Here the results of a block leave a branch as separate
arrays, and are put in place afterwards. An accelerator takes all samples at once.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from jaxid.arrays import Array, Float

from .gpu_kernel import in_kernel, suits_kernel
from .jax_transformation_rules import TRUE, differing_alike, with_derivatives_of
from .program import Program
from .xla import Results, fenced, hidden_one, lower
from .xla_loops import empty_rows, entry_rows, rows_of

BLOCK = 256
"""Samples of one evaluation."""
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


def _stored_results(program: Program, *arrays: Array) -> Results:
    """Return the results of `results_at_once`, each stored before it is used.

    Where results are stacked, a GPU would compute what they share for each of them.
    """
    return jax.lax.optimization_barrier(results_at_once(program, *arrays))


def _repeat(columns: Sequence, count: int):
    """Return all entries as arrays of the samples, also what these have in common."""
    entries = []
    for x in columns:
        entries.append([jnp.broadcast_to(row, count) for row in x])
    return entries


def _pack_block(program: Program, values: Array, *arrays: Array) -> tuple[Rows, Array]:
    """Return the packed result of a block of samples, and the rows of `entry_rows`."""
    if program.loops is None:
        return _pack(block_results, program, *arrays), values
    values = entry_rows(program, values, *arrays)
    entries = np.arange(len(program.outputs))
    return rows_of(program, values, entries).T, values


def _pack(results: Callable[..., Results], program: Program, *arrays: Array):
    """Return distinct results in the order of the packed result, with its constants."""
    columns = []
    for x in program.pack(results(program, *arrays)):
        column = jnp.asarray(x, arrays[-1].dtype)
        columns.append(jnp.broadcast_to(column, len(arrays[-1])))
    return jnp.stack(columns, axis=1)


def _in_blocks(program: Program, *arrays: Array):
    """Return the packed result of each sample, block by block."""
    count = len(arrays[-1])
    reference = arrays[-1][0, 0]
    values = empty_rows(program, min(count, BLOCK), reference)
    if count <= BLOCK:
        return _pack_block(program, values, *arrays)[0]

    def step(k, state):
        out, values = state
        # The last block begins earlier, so that it is as long as the others.
        start = jnp.minimum(k * BLOCK, count - BLOCK)
        parts = [_slice_samples(x, start, BLOCK) for x in arrays]
        block, values = _pack_block(program, values, *parts)
        out = jax.lax.dynamic_update_slice_in_dim(out, block, start, axis=0)
        return out, values

    # All of it is overwritten.
    shape = (count, len(program.outputs))
    initial_results = jnp.broadcast_to(reference, shape)
    blocks = math.ceil(count / BLOCK)
    return jax.lax.fori_loop(0, blocks, step, (initial_results, values))[0]


def _slice_samples(x: Array, start: Array, size: int):
    """Return some samples of an input, unless all samples have it in common."""
    return jax.lax.dynamic_slice_in_dim(x, start, size) if x.ndim == 2 else x


def on_rows(program: Program, *arrays: Array) -> Rows:
    """Return the packed result of each sample; not for differentiation.

    Inputs as in `block_results`; at least the last one has samples.
    """
    if not len(arrays[-1]):
        return jnp.zeros((0, len(program.outputs)), arrays[-1].dtype)

    @custom_vmap
    def run(*arrays):
        block_run = functools.partial(_in_blocks, program)
        vectorised_run = functools.partial(_pack, _stored_results, program)
        runs = {"cpu": block_run, "default": vectorised_run}
        if suits_kernel(program, arrays[-1].dtype):
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
    definition = functools.partial(_pack, results_at_once, program)
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
    program: Program, groups: tuple[tuple[int, ...], ...], *arrays: Array
) -> list[Array]:
    """Return sums over samples of products of results, which are not stored.

    A group holds positions in the packed result whose values are multiplied with each
    other.
    """
    count = len(arrays[0])
    dtype = arrays[0].dtype
    if count == 0:
        return [jnp.zeros((len(group), len(group)), dtype) for group in groups]

    def products(results, counts):
        values = program.pack(results)
        matrices = []
        for group in groups:
            columns = [counts * values[k] for k in group]
            matrix = jnp.stack(columns) if group else counts[:0, None]
            matrices.append(matrix @ matrix.T)
        return matrices

    def rows_of_block(program, *parts):
        values = empty_rows(program, len(parts[-1]), parts[-1][0, 0])
        return entry_rows(program, values, *parts)

    def products_of_rows(values, counts):
        matrices = []
        for group in groups:
            rows = rows_of(program, values, np.array(group, int))
            matrix = counts[None] * rows
            matrices.append(matrix @ matrix.T)
        return matrices

    def by_chunks(evaluate, products, size, *arrays):
        def step(k, sums):
            # The last chunk begins earlier; samples that were counted do not count
            # again.
            start = jnp.minimum(k * size, count - size)
            samples = start + jnp.arange(size)
            counts = (samples >= k * size).astype(dtype)
            parts = [_slice_samples(x, start, size) for x in arrays]
            results = evaluate(program, *parts)
            terms = products(results, counts)
            return jax.tree.map(jnp.add, sums, terms)

        initial_results = []
        for group in groups:
            zeros = jnp.zeros((len(group), len(group)), dtype)
            # `where`, see `differing_alike`.
            initial_results.append(jnp.where(TRUE, zeros, arrays[-1][0, 0]))
        chunks = math.ceil(count / size)
        return jax.lax.fori_loop(0, chunks, step, initial_results)

    on_cpu = (block_results, products)
    if program.loops is not None:
        on_cpu = (rows_of_block, products_of_rows)
    return jax.lax.platform_dependent(
        *differing_alike(arrays),
        cpu=functools.partial(by_chunks, *on_cpu, min(BLOCK, count)),
        default=functools.partial(
            by_chunks, results_at_once, products, min(2**16, count)
        ),
    )


def distinct_rows(program: Program, *arrays: Array) -> Array:
    """Return the distinct results of many samples from loops, block by block.

    Inputs are [samples, entries].
    """
    count = len(arrays[-1])
    size = min(BLOCK, count)
    numbers = program.distinct[1]
    _, first_entries = np.unique(numbers[numbers >= 0], return_index=True)
    entries = np.flatnonzero(numbers >= 0)[first_entries]

    def step(k, state):
        out, values = state
        start = jnp.minimum(k * size, count - size)
        parts = [_slice_samples(x, start, size) for x in arrays]
        values = entry_rows(program, values, *parts)
        rows = rows_of(program, values, entries)
        out = jax.lax.dynamic_update_slice_in_dim(out, rows, start, axis=1)
        return out, values

    arrays = differing_alike(arrays)
    reference = arrays[-1][0, 0]
    initial_results = jnp.broadcast_to(reference, (len(entries), count))
    values = empty_rows(program, size, reference)
    blocks = math.ceil(count / size)
    results, _ = jax.lax.fori_loop(0, blocks, step, (initial_results, values))
    return results
