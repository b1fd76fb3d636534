"""A scalar program as kernels on a GPU (Pallas, compiled by Triton).

Each thread computes one sample, from its row of the inputs to its row of the results:
nothing else goes through memory. Many results would be written side by side too slowly:
one kernel stores each distinct result of all threads together, and a second one puts
them in place. Where JAX cannot compile such kernels, XLA computes the program.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Float, Indices

from .jax_transformation_rules import divisible
from .program import Program, Shape
from .scalar import Operation
from .xla import apply_node

BLOCK = 128
"""Samples of one instance of the kernel, one for each thread of four warps."""
MAX_OUTPUTS = 16
"""Results of a sample up to which a kernel is faster than XLA.

Threads write their rows side by side, so that each store of a result touches many lines
of memory. Measured on an H200: 7 results take 0.4 to 0.7 of XLA's time, 49 take 1.1.
More results are stored by one kernel and put in place by another one.
"""
RESULTS_OF_KERNEL = 48
"""Distinct results that one kernel computes.

Triton compiles a kernel in a time that grows with its stores and with the square of its
operations: the 274 distinct results of a Panda's regressor take 29 CPU s in one kernel,
9 in six. Threads of the six keep their numbers in registers, one of the one does not.
"""
TILE = 64
"""Samples, and results, that an instance of the second kernel puts in place."""
MAX_NODES = 2000
"""Length of a program up to which kernels were measured (1,604)."""
MAX_ENTRIES = 2**31 - 1
"""Entries of an array up to which kernels find them: places are numbers of 32 bits."""
MIN_CAPABILITY = 8.0
"""First compute capability of NVIDIA GPUs for which XLA compiles by Triton."""


@functools.cache
def has_triton() -> bool:
    """Return whether Triton compiles kernels for the GPUs of this process."""
    try:
        devices = jax.devices("cuda")
        from jax.experimental.pallas import triton
    except (ImportError, RuntimeError):
        return False  # there is no such GPU, or JAX no longer has this compiler
    is_supported = hasattr(triton, "CompilerParams")  # since JAX 0.7
    capabilities = [float(device.compute_capability) for device in devices]
    return is_supported and min(capabilities) >= MIN_CAPABILITY


def suits_kernel(program: Program, *arrays: Array) -> bool:
    """Return whether kernels are the fastest form of a program on this GPU."""
    is_short = len(program.nodes) <= MAX_NODES
    is_constant = not program.distinct[0]
    row_sizes = [len(program.outputs), *(x.shape[-1] for x in arrays)]
    is_addressable = len(arrays[-1]) * max(row_sizes) <= MAX_ENTRIES
    has_functions = arrays[-1].dtype in (np.float32, np.float64)
    can_run = is_addressable and has_functions and has_triton()
    return is_short and not is_constant and can_run


def in_kernel(
    program: Program, *arrays: Array, interpret: bool = False
) -> Float[Array, "samples out"]:
    """Return the packed result of each sample, computed by one or two kernels.

    Inputs are [entries] if all samples have them in common, else [samples, entries]; at
    least the last one has samples. Devices divide the samples among themselves.

    Args:
        program: Program that `suits_kernel`.
        arrays: Inputs of the program.
        interpret: Whether XLA executes the kernels step by step, on any device.
    """
    # Devices divide the inputs behind those that all samples have in common.
    order = sorted(range(len(arrays)), key=lambda k: arrays[k].ndim)
    sorted_arrays = [arrays[k] for k in order]
    common_count = sum(x.ndim == 1 for x in arrays)
    # Functions that devices divide have no constants: these are arguments too.
    is_placed = len(program.outputs) > MAX_OUTPUTS
    tables = _tables(program, arrays[-1].dtype) if is_placed else ()

    def on_device(*arguments):
        tables_on_device = arguments[: len(tables)]
        inputs = list(arrays)
        for k, x in zip(order, arguments[len(tables) :], strict=True):
            inputs[k] = x
        if not is_placed:
            return _results(program, inputs, interpret)
        rows = _distinct_rows(program, inputs, interpret)
        return _placed(rows, *tables_on_device, interpret=interpret)

    if jax.sharding.get_abstract_mesh().manual_axes:
        # `shard_map` has divided the arrays already.
        return on_device(*tables, *sorted_arrays)
    run = divisible(on_device, on_device, len(tables) + common_count)
    return run(*tables, *sorted_arrays)


def _tables(program: Program, dtype: Any) -> tuple[Array, Array]:
    """Return the number of each packed result, or -1, and its constant, or 0."""
    _, numbers = program.distinct
    constants = [0.0 if isinstance(x, int) else x for x in program.outputs]
    return jnp.asarray(numbers, np.int32), jnp.asarray(constants, dtype)


def _results(program: Program, inputs: list[Array], interpret: bool) -> Array:
    """Compute the packed results of the samples of one device."""

    def write(results, values, samples):
        for k, x in enumerate(program.outputs):
            value = jnp.asarray(values[x] if isinstance(x, int) else x, results.dtype)
            results[samples, k] = jnp.broadcast_to(value, BLOCK)

    nodes, _ = program.distinct
    shape = (len(inputs[-1]), len(program.outputs))
    return _call_kernel(program, nodes, inputs, write, shape, interpret)


def _distinct_rows(program: Program, inputs: list[Array], interpret: bool) -> Array:
    """Compute the distinct results [results, samples] of the samples of one device."""
    nodes, _ = program.distinct
    rows = _rows_of_group(program, inputs, 0, None, interpret)
    for first in range(RESULTS_OF_KERNEL, len(nodes), RESULTS_OF_KERNEL):
        rows = _rows_of_group(program, inputs, first, rows, interpret)
    return rows


def _rows_of_group(
    program: Program,
    inputs: list[Array],
    first: int,
    rows: Array | None,
    interpret: bool,
) -> Array:
    """Compute some distinct results, from this one on, into the rows of all."""
    nodes, _ = program.distinct
    group = nodes[first : first + RESULTS_OF_KERNEL]

    def write(results, values, samples):
        for k, node in enumerate(group):
            results[first + k, samples] = jnp.broadcast_to(values[node], BLOCK)

    shape = (len(nodes), len(inputs[-1]))
    return _call_kernel(program, group, inputs, write, shape, interpret, rows)


def _call_kernel(
    program: Program,
    nodes: Sequence[int],
    inputs: list[Array],
    write: Callable[[Any, Mapping[int, Array], Array], None],
    shape: Shape,
    interpret: bool,
    results: Array | None = None,
) -> Array:
    """Compute some nodes, which `write` puts into results of this shape.

    Results that are given are overwritten where `write` stores, and kept elsewhere.
    """
    # It takes a while to import, and only GPUs need it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    count = len(inputs[-1])
    positions_by_use = _positions_by_use(program, nodes)

    def kernel(*references):
        columns, results = references[: len(inputs)], references[-1]
        samples = _members(pallas.program_id(0), BLOCK, count)
        values: dict[int, Array] = {}
        for position in positions_by_use:
            node = program.nodes[position]
            if node.operation is Operation.INPUT:
                number, entry = node.place
                column = columns[number]
                is_common = column.ndim == 1
                value = column[entry] if is_common else column[samples, entry]
            else:
                value = apply_node(node, values, results.dtype)
            values[position] = value
        write(results, values, samples)

    arguments = inputs if results is None else [*inputs, results]
    call = pallas.pallas_call(
        kernel,
        out_shape=_alike(inputs[-1], shape),
        grid=(math.ceil(count / BLOCK),),
        input_output_aliases={} if results is None else {len(inputs): 0},
        compiler_params=triton.CompilerParams(num_warps=4),
        interpret=interpret,
    )
    return call(*arguments)


def _placed(rows: Array, numbers: Array, constants: Array, *, interpret: bool) -> Array:
    """Return the packed results of samples from their distinct results."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    samples = rows.shape[1]
    entries = len(numbers)

    def kernel(rows, numbers, constants, results):
        sample = _members(pallas.program_id(0), TILE, samples)[:, None]
        entry = _members(pallas.program_id(1), TILE, entries)
        number = numbers[entry][None]
        constant = constants[entry][None]
        values = rows[jnp.maximum(number, 0), sample]
        placed_values = jnp.where(number >= 0, values, constant)
        results[sample, entry[None]] = placed_values

    call = pallas.pallas_call(
        kernel,
        out_shape=_alike(rows, (samples, entries)),
        grid=(math.ceil(samples / TILE), math.ceil(entries / TILE)),
        compiler_params=triton.CompilerParams(num_warps=4),
        interpret=interpret,
    )
    return call(rows, numbers, constants)


def _members(block: Array, size: int, count: int) -> Array:
    """Return the numbers of the members of a block, side by side.

    The last block begins earlier, so that it is full: some members are computed twice.
    Triton sees that the numbers are consecutive, and loads what they stand for at once.
    """
    start = jnp.minimum(size * block, max(count - size, 0))
    members = start + jnp.arange(size, dtype=np.int32)
    return members if count >= size else jnp.minimum(members, count - 1)


def _alike(x: Array, shape: Shape) -> jax.ShapeDtypeStruct:
    """Return a shape whose array differs along the same axes of `shard_map` as x."""
    return jax.eval_shape(lambda x: jnp.broadcast_to(x[0, 0], shape), x)


def _positions_by_use(program: Program, nodes: Sequence[int]) -> Indices:
    """Return positions of these nodes and of what they need, inputs where first read.

    If all inputs were loaded at the start, a thread's registers would not hold them.
    """
    needed = set(nodes)
    for position in reversed(range(len(program.nodes))):
        if position in needed:
            needed.update(program.nodes[position].uses)
    positions: dict[int, None] = {}
    for position in sorted(needed):
        node = program.nodes[position]
        if node.operation is not Operation.INPUT:
            positions.update(dict.fromkeys((*node.uses, position)))
    # Inputs that no node reads are results.
    positions.update(dict.fromkeys(nodes))
    return tuple(positions)
