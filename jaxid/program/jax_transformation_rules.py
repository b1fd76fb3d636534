"""Rules for JAX: derivatives, `vmap`, and many devices."""

import functools
import itertools
import string
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.sharding import NamedSharding, PartitionSpec

from jaxid.arrays import Array

TRUE = np.array(True)
"""Condition of a `where` whose other branch only adds axes of `shard_map`."""


def differing_alike(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return arrays that all differ along the same axes of `shard_map`.

    The results of branches and loops must not depend on which input differs.
    """
    first_entries = (x[(0,) * x.ndim] for x in arrays if x.size)
    joined_entry = functools.reduce(lambda a, b: jnp.where(TRUE, a, b), first_entries)
    return tuple(jnp.where(TRUE, x, joined_entry) for x in arrays)


def with_derivatives_of(definition: Callable, run: Callable) -> Callable:
    """Return a function of arrays with the derivatives of another definition.

    The other definition is differentiated only by inputs that have a tangent.
    """
    function = jax.custom_jvp(run)

    def derivative(primals, tangents):
        has_tangent = [not isinstance(x, SymbolicZero) for x in tangents]
        variables = [k for k, tangent in enumerate(has_tangent) if tangent]

        def of_variables(*values):
            arrays = list(primals)
            for k, value in zip(variables, values, strict=True):
                arrays[k] = value
            return definition(*arrays)

        points = tuple(primals[k] for k in variables)
        directions = tuple(tangents[k] for k in variables)
        return jax.jvp(of_variables, points, directions)

    function.defjvp(derivative, symbolic_zeros=True)
    return function


def divided(function: Callable) -> Callable:
    """Return a function of arrays whose leading axis devices divide.

    Each device computes what belongs to its part of the axis, and nothing moves between
    them: the results have the same axis.
    """

    @custom_vmap
    def run(*arrays):
        if jax.sharding.get_abstract_mesh().manual_axes:
            # `shard_map` has divided the arrays already.
            return function(*arrays)
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*arrays)
        count = len(program.consts)

        # JAX divides functions without constants only: they become arguments.
        def without_constants(*arguments):
            jaxpr = ClosedJaxpr(program.jaxpr, arguments[:count])
            evaluate = jaxpr_as_fun(jaxpr)
            results = evaluate(*arguments[count:])
            structure = jax.tree.structure(shapes)
            return jax.tree.unflatten(structure, results)

        def on_part(*arguments):
            return function(*arguments[count:])

        divisible_function = divisible(on_part, without_constants, count)
        return divisible_function(*program.consts, *arrays)

    @run.def_vmap
    def batch(size, is_batched, *arrays):
        axes = [0 if x else None for x in is_batched]
        results = jax.vmap(function, axes)(*arrays)
        return results, jax.tree.map(lambda _: True, results)

    return with_derivatives_of(function, lambda *arrays: run(*differing_alike(arrays)))


def divisible(on_part: Callable, on_all: Callable, constants: int) -> Callable:
    """Return a function whose arguments behind some constants have one leading axis.

    Args:
        on_part: Function of constants and arrays, for the part of one device.
        on_all: The same for all devices.
        constants: Number of constants.
    """
    divisible_function = custom_partitioning(on_all)

    def partition(mesh, arguments, results):
        # The leading axis of the first array that is divided.
        arrays = arguments[constants:]
        specs = [x.sharding.spec[:1] for x in arrays]
        leading_axis = next(filter(any, specs), ())
        divided_sharding = NamedSharding(mesh, PartitionSpec(*leading_axis))
        common_sharding = NamedSharding(mesh, PartitionSpec())
        shardings = (common_sharding,) * constants + (divided_sharding,) * len(arrays)

        result_shardings = jax.tree.map(lambda _: divided_sharding, results)
        return mesh, on_part, result_shardings, shardings

    def rule(_, arguments, results):
        """Name the axes: all arrays share the leading one, and no others."""
        letters = itertools.product(string.ascii_lowercase, repeat=2)
        names = map("".join, letters)

        def axes(x, is_array):
            words = list(itertools.islice(names, len(x.shape)))
            if is_array:
                words[:1] = ["lead"]
            return " ".join(words)

        inputs = [axes(x, k >= constants) for k, x in enumerate(arguments)]
        outputs = [axes(x, is_array=True) for x in results]
        input_list = ", ".join(inputs)
        output_list = ", ".join(outputs)
        return f"{input_list} -> {output_list}"

    divisible_function.def_partition(partition=partition, sharding_rule=rule)
    return divisible_function
