"""A scalar program as one kernel on a GPU (Pallas, compiled by Triton).

Each thread computes one sample, from its row of the inputs to its row of the results:
nothing else goes through memory. Where JAX cannot compile such a kernel, XLA computes
the program.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Float

from .jax_transformation_rules import divisible
from .program import Program
from .scalar import Operation
from .xla import apply_node

BLOCK = 128
"""Samples of one instance of the kernel, one for each thread of four warps."""
MAX_OUTPUTS = 16
"""Results of a sample up to which a kernel is faster than XLA.

Threads write their rows side by side, so that each store of a result touches many lines
of memory. Measured on an H200: 7 results take 0.4 to 0.7 of XLA's time, 49 take 1.1.
"""
MAX_NODES = 2000
"""Length of a program up to which kernels were measured (1,604)."""
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


def suits_kernel(program: Program, dtype: Any) -> bool:
    """Return whether a kernel is the fastest form of a program on this GPU."""
    is_short = len(program.nodes) <= MAX_NODES
    has_few_outputs = len(program.outputs) <= MAX_OUTPUTS
    has_functions = dtype in (np.float32, np.float64)
    return is_short and has_few_outputs and has_functions and has_triton()


def in_kernel(
    program: Program, *arrays: Array, interpret: bool = False
) -> Float[Array, "samples out"]:
    """Return the packed result of each sample, computed by one kernel.

    Inputs are [entries] if all samples have them in common, else [samples, entries]; at
    least the last one has samples. Devices divide the samples among themselves.

    Args:
        program: Program with few results.
        arrays: Inputs of the program.
        interpret: Whether XLA executes the kernel step by step, on any device.
    """
    # Devices divide the inputs behind those that all samples have in common.
    order = sorted(range(len(arrays)), key=lambda k: arrays[k].ndim)
    sorted_arrays = [arrays[k] for k in order]
    common_count = sum(x.ndim == 1 for x in arrays)

    def on_device(*sorted_arrays):
        inputs = list(arrays)
        for k, x in zip(order, sorted_arrays, strict=True):
            inputs[k] = x
        return _call_kernel(program, inputs, interpret)

    if jax.sharding.get_abstract_mesh().manual_axes:
        # `shard_map` has divided the arrays already.
        return on_device(*sorted_arrays)
    return divisible(on_device, on_device, common_count)(*sorted_arrays)


def _call_kernel(program: Program, inputs: list[Array], interpret: bool):
    """Compute the samples of one device."""
    # It takes a while to import, and only GPUs need it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    samples = inputs[-1]
    count = len(samples)
    dtype = samples.dtype
    positions_by_use = _positions_by_use(program)

    def kernel(*references):
        *columns, results = references
        start = BLOCK * jnp.asarray(pallas.program_id(0), int)
        positions = start + jnp.arange(BLOCK)
        # Threads beyond the last sample compute it again.
        rows = jnp.minimum(positions, count - 1)
        values: dict[int, Array] = {}
        for position in positions_by_use:
            node = program.nodes[position]
            if node.operation is Operation.INPUT:
                number, entry = node.place
                column = columns[number]
                is_common = column.ndim == 1
                value = column[entry] if is_common else column[rows, entry]
            else:
                value = apply_node(node, values, dtype)
            values[position] = value
        for k, x in enumerate(program.outputs):
            value = jnp.asarray(values[x] if isinstance(x, int) else x, dtype)
            results[rows, k] = jnp.broadcast_to(value, BLOCK)

    def result_like(x):
        return jnp.broadcast_to(x[:, :1], (count, len(program.outputs)))

    call = pallas.pallas_call(
        kernel,
        # Of the samples, so that it differs along the same axes of `shard_map`.
        out_shape=jax.eval_shape(result_like, samples),
        grid=(math.ceil(count / BLOCK),),
        compiler_params=triton.CompilerParams(num_warps=4),
        interpret=interpret,
    )
    return call(*inputs)


def _positions_by_use(program: Program):
    """Return positions of all nodes, those of inputs where they are first read.

    If all inputs were loaded at the start, a thread's registers would not hold them.
    """
    positions: dict[int, None] = {}
    for position, node in enumerate(program.nodes):
        if node.operation is not Operation.INPUT:
            positions.update(dict.fromkeys((*node.uses, position)))
    # Inputs that no node reads are results.
    positions.update(dict.fromkeys(range(len(program.nodes))))
    return tuple(positions)
