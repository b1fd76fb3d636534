"""Rules that JAX follows in place of its own: for derivatives, `vmap`, and many devices."""

import functools
import string
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.sharding import NamedSharding, PartitionSpec

from jaxid.arrays import Array

ALWAYS = np.array(True)
"""Condition of a `where` whose result only differs along as many axes as its other branch."""


def differing_alike(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return arrays that all differ along the axes of `shard_map` along which one of them does.

    The results of branches and loops must not depend on which input differs.
    """
    firsts = (x[(0,) * x.ndim] for x in arrays if x.size)
    like = functools.reduce(lambda a, b: jnp.where(ALWAYS, a, b), firsts)
    return tuple(jnp.where(ALWAYS, x, like) for x in arrays)


def with_derivatives_of(plain: Callable, run: Callable) -> Callable:
    """Return a function of arrays whose derivatives are those of another definition of it.

    Only along inputs that move the other definition is differentiated.
    """
    found = jax.custom_jvp(run)

    def derivative(primals: tuple, tangents: tuple) -> tuple:
        moving = [k for k, x in enumerate(tangents) if not isinstance(x, SymbolicZero)]

        def of_moving(*given: Array) -> Any:
            arrays = list(primals)
            for k, x in zip(moving, given, strict=True):
                arrays[k] = x
            return plain(*arrays)

        return jax.jvp(
            of_moving,
            tuple(primals[k] for k in moving),
            tuple(tangents[k] for k in moving),
        )

    found.defjvp(derivative, symbolic_zeros=True)
    return found


def divided(function: Callable) -> Callable:
    """Return a function of arrays with one leading axis, which devices divide among themselves.

    Each device computes what belongs to its part of the axis, and nothing moves between
    them: the results have the same axis.
    """

    @custom_vmap
    def run(*arrays: Array) -> Any:
        if jax.sharding.get_abstract_mesh().manual_axes:
            # `shard_map` has divided the arrays already.
            return function(*arrays)
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*arrays)
        constants = program.consts

        # JAX divides functions without constants only: they become arguments.
        def whole(*given: Array) -> Any:
            known, arrays = given[: len(constants)], given[len(constants) :]
            out = jaxpr_as_fun(ClosedJaxpr(program.jaxpr, known))(*arrays)
            return jax.tree.unflatten(jax.tree.structure(shapes), out)

        return _divisible(function, whole, len(constants))(*constants, *arrays)

    @run.def_vmap
    def batch(size: int, batched: list[bool], *arrays: Array) -> tuple[Any, Any]:
        out = jax.vmap(function, [0 if x else None for x in batched])(*arrays)
        return out, jax.tree.map(lambda _: True, out)

    return with_derivatives_of(function, lambda *arrays: run(*differing_alike(arrays)))


def _divisible(function: Callable, whole: Callable, constants: int) -> Callable:
    """Return a function whose arguments behind some constants have one leading axis."""
    divisible = custom_partitioning(whole)

    def partition(mesh: Any, arguments: Any, results: Any) -> tuple:
        specs = [x.sharding.spec[:1] for x in arguments[constants:]]
        leading = next((x for x in specs if any(x)), ())
        own, same = (NamedSharding(mesh, PartitionSpec(*x)) for x in (leading, ()))
        given = [same if k < constants else own for k in range(len(arguments))]

        def part(*given: Array) -> Any:
            return function(*given[constants:])

        return mesh, part, jax.tree.map(lambda _: own, results), tuple(given)

    def rule(_: Any, arguments: Any, results: Any) -> str:
        names = iter(
            f"{a}{b}" for a in string.ascii_lowercase for b in string.ascii_lowercase
        )

        def axes(x: Any, divided: bool) -> str:
            own = [next(names) for _ in x.shape]
            return " ".join(["lead", *own[1:]] if divided else own)

        given = ", ".join(axes(x, k >= constants) for k, x in enumerate(arguments))
        return f"{given} -> {', '.join(axes(x, True) for x in results)}"

    divisible.def_partition(partition=partition, sharding_rule=rule)
    return divisible
