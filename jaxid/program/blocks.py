"""A scalar program on rows of samples, by blocks that stay in the processor's cache.

If the results of a program are stacked where they are computed, XLA copies what each of
them needs into its own loop. Here the results of a block leave a branch as separate
arrays, and are put in place afterwards. An accelerator takes all samples at once.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxid.arrays import Array, Float

from .program import Program
from .rules import ALWAYS, differing_alike
from .xla import fenced, hidden_one, lower, primitives

BLOCK = 256
"""Samples of one evaluation."""


def block_results(program: Program, *arrays: Array) -> tuple[Array, ...]:
    """Return the distinct results of a block of samples, each computed once.

    Inputs are [entries] if all samples have them in common, else [samples, entries].
    """
    block = next(len(x) for x in arrays if x.ndim == 2)

    def evaluate(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
        # Transposed once, behind a fence of its own.
        whole = jnp.concatenate([x.T for x in arrays if x.ndim == 2])
        rows = iter(fenced(whole, hidden_one(whole[0, 0])))
        inputs = [
            [next(rows) for _ in x.T]
            if x.ndim == 2
            else [jnp.broadcast_to(y, (block,)) for y in x]
            for x in arrays
        ]
        return lower(program, fence=True).run(inputs, primitives(whole[0]))

    # Results of a branch are stored: what uses them does not compute them again.
    first = arrays[-1][0, 0]
    nothing = tuple(jnp.broadcast_to(first, (block,)) for _ in program.distinct[0])
    return jax.lax.cond(hidden_one(first) > 0, evaluate, lambda _: nothing, arrays)


def results_at_once(program: Program, *arrays: Array) -> tuple[Array, ...]:
    """Return the distinct results of samples without fences, as an accelerator computes them."""
    count = next(len(x) for x in arrays if x.ndim == 2)
    inputs = [[jnp.broadcast_to(row, (count,)) for row in x.T] for x in arrays]
    like = jnp.zeros(count, arrays[-1].dtype)
    return lower(program, fence=False).run(inputs, primitives(like))


def _packed(
    results: Callable[..., tuple[Array, ...]], program: Program, *arrays: Array
) -> Float[Array, "samples out"]:
    """Return distinct results in the order of the packed result, with its constants."""
    packed = program.pack(results(program, *arrays))
    like = jnp.zeros(len(arrays[-1]), arrays[-1].dtype)
    full = [jax.lax.full_like(like, x) if isinstance(x, float) else x for x in packed]
    return jnp.stack(full, axis=1)


def _in_blocks(program: Program, *arrays: Array) -> Float[Array, "samples out"]:
    """Return the packed result of each sample, block by block."""
    count = len(arrays[-1])
    if count <= BLOCK:
        return _packed(block_results, program, *arrays)

    def step(k: Array, out: Array) -> Array:
        # The last block begins earlier, so that it is as long as the others.
        start = jnp.minimum(k * BLOCK, count - BLOCK)
        parts = [
            jax.lax.dynamic_slice_in_dim(x, start, BLOCK) if x.ndim == 2 else x
            for x in arrays
        ]
        part = _packed(block_results, program, *parts)
        return jax.lax.dynamic_update_slice_in_dim(out, part, start, axis=0)

    # All of it is overwritten.
    empty = jnp.broadcast_to(arrays[-1][0, 0], (count, len(program.outputs)))
    return jax.lax.fori_loop(0, -(-count // BLOCK), step, empty)


def on_rows(program: Program, *arrays: Array) -> Float[Array, "samples out"]:
    """Return the packed result of each sample; not for differentiation.

    Inputs as in `block_results`; at least the last one has samples.
    """
    if not len(arrays[-1]):
        return jnp.zeros((0, len(program.outputs)), arrays[-1].dtype)

    @custom_vmap
    def run(*arrays: Array) -> Array:
        in_blocks = functools.partial(_in_blocks, program)
        at_once = functools.partial(_packed, results_at_once, program)
        return jax.lax.platform_dependent(*arrays, cpu=in_blocks, default=at_once)

    @run.def_vmap
    def batch(size: int, batched: list[bool], *arrays: Array) -> tuple[Array, bool]:
        count = arrays[-1].shape[int(batched[-1])]
        own = [x.ndim - was == 1 for x, was in zip(arrays, batched, strict=True)]
        if count >= BLOCK and any(a and b for a, b in zip(own, batched, strict=True)):
            each = [x if was else None for x, was in zip(arrays, batched, strict=True)]
            whole = [None if was else x for x, was in zip(arrays, batched, strict=True)]

            def one(parts):
                return run(
                    *(w if x is None else x for x, w in zip(parts, whole, strict=True))
                )

            return jax.lax.map(one, each), True
        # All become samples, but for what is common to all.
        rows = []
        for x, was, common in zip(arrays, batched, own, strict=True):
            if common and not was:
                rows.append(x)
                continue
            x = x if was else x[None]
            x = x[:, None] if common else x
            rows.append(
                jnp.broadcast_to(x, (size, count, x.shape[-1])).reshape(-1, x.shape[-1])
            )
        return run(*rows).reshape(size, count, -1), True

    return run(*differing_alike(arrays))


def row_products(
    program: Program, groups: tuple[tuple[int, ...], ...], *arrays: Array
) -> list[Float[Array, "results results"]]:
    """Return the sums over samples of products of results; the results are never stored.

    A group holds positions in the packed result whose values are multiplied with each
    other.
    """
    count, dtype = len(arrays[0]), arrays[0].dtype
    if count == 0:
        return [jnp.zeros((len(group), len(group)), dtype) for group in groups]

    def products(rows: tuple[Array, ...], counted: Array) -> list[Array]:
        found, packed = [], program.pack(rows)
        for group in groups:
            values = [packed[k] for k in group]
            stacked = (
                jnp.stack([counted * x for x in values]) if group else counted[:0, None]
            )
            found.append(stacked @ stacked.T)
        return found

    def by_chunks(evaluate, size: int, *arrays: Array) -> list[Array]:
        def step(k: Array, sums: list[Array]) -> list[Array]:
            # The last chunk begins earlier; samples that were counted do not count
            # again.
            start = jnp.minimum(k * size, count - size)
            counted = (start + jnp.arange(size) >= k * size).astype(dtype)
            parts = [jax.lax.dynamic_slice_in_dim(x, start, size) for x in arrays]
            own = products(evaluate(program, *parts), counted)
            return [a + b for a, b in zip(sums, own, strict=True)]

        sizes = [(len(group), len(group)) for group in groups]
        # `where`, see `differing_alike`.
        empty = [
            jnp.where(ALWAYS, jnp.zeros(x, dtype), arrays[-1][0, 0]) for x in sizes
        ]
        return jax.lax.fori_loop(0, -(-count // size), step, empty)

    return jax.lax.platform_dependent(
        *differing_alike(arrays),
        cpu=functools.partial(by_chunks, block_results, min(BLOCK, count)),
        default=functools.partial(by_chunks, results_at_once, min(2**16, count)),
    )
