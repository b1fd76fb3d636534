"""A scalar program as a fused XLA computation on batch-last arrays.

XLA's CPU backend fuses elementwise operations into the loops of their consumers, and
copies a shared operation into each of them. A program of a thousand operations with
hundreds of results would be computed many times over. A fence on a shared value stops
that.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import AnyArray, Array
from jaxid.errors import InputError

from .jax_sincos import sine_cosine
from .program import Program
from .scalar import Operation

ELEMENTWISE: dict[Operation, Callable] = {
    o: getattr(jnp, o.numpy.__name__) for o in Operation if o is not Operation.INPUT
}
HOLDS = jax.__version_info__ >= (0, 12)
"""Whether an optimization barrier stops XLA's CPU backend."""
CIRCULAR = (Operation.SINE, Operation.COSINE)
Entries = Sequence[Array | Sequence[Array]]
"""Entries of each input, in order: arrays of the batch's shape."""


def hidden_one(reference: Array) -> Array:
    """Return (sign bit of a number | 1), which is 1 for any number, NaN included.

    XLA does not copy divisions, since they are expensive, and x / 1 is exact, also for
    NaN and
    infinities: division by a one that XLA cannot recognise is a fence. From JAX 0.12 on
        an
    optimization barrier does the same at no cost. The number is known only at run time.
    """
    width = 8 * reference.dtype.itemsize
    bits = jax.lax.stop_gradient(reference).view(f"uint{width}")
    return (bits >> (width - 1) | 1).astype(reference.dtype)


def fenced(x: Array, one: Array | None) -> Array:
    """Return a value behind a fence (none if `one` is None): XLA does not compute it again."""
    if one is None:
        return x
    return jax.lax.optimization_barrier(x) if HOLDS else x / one


def fenced_nodes(program: Program) -> frozenset[int]:
    """Return positions of the nodes that a fence pays for.

    These are the nodes with (uses - 1) times the cost of computing them again > 6
    operations; between 0 and 30 the speed hardly depends on it.
    """
    free = (Operation.INPUT, Operation.NEGATE)
    costs, fenced = [], set()
    for k, node in enumerate(program.nodes):
        own = 20 if "function" in node.operation.traits else node.operation not in free
        cost = own + sum(costs[i] for i in node.uses)
        if "truth" not in node.operation.traits and cost * (program.uses[k] - 1) > 6:
            fenced.add(k)
            cost = 0
        costs.append(cost)
    return frozenset(fenced)


class Lowered(eqx.Module):
    """A program on JAX arrays whose batch axes stand last.

    Works under `jit`, `grad`, `jvp` and `vmap`, in the precision of the arrays. Call it
    inside `jax.jit`: otherwise each operation is dispatched by itself.
    """

    program: Program = eqx.field(static=True)
    fence: bool = eqx.field(static=True)  # whether fences stand behind shared values
    fenced: frozenset[int] = eqx.field(static=True)  # positions of these nodes

    def __call__(self, *arrays: AnyArray) -> list[Array | float]:
        """Compute the packed result, from arrays of the inputs' shapes and then any batch axes.

        For each entry of each output, in order, it is an array of the batch's shape or
        a constant.
        """
        return self.program.pack(self.distinct(*arrays))

    def distinct(self, *arrays: AnyArray) -> tuple[Array, ...]:
        """Compute the distinct results that vary, from the same arrays."""
        return self.run(self.entries(*arrays)[0], ELEMENTWISE)

    def entries(self, *arrays: AnyArray) -> tuple[list[Array], tuple[int, ...]]:
        """Return the inputs with their own axes merged and the whole batch behind; its shape."""
        dtype = jnp.result_type(*arrays, float) if arrays else jnp.result_type(float)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise InputError(
                f"A program computes with real numbers, but got arrays of {dtype}."
            )
        return self.program.align([jnp.asarray(x, dtype) for x in arrays], jnp)

    def dense(self, *arrays: AnyArray) -> Any:
        """Compute the outputs in the structure of the traced function, batch axes last.

        Constants cost memory and time here; prefer the packed result.
        """
        dtype, batch = jnp.result_type(*arrays, float), self.entries(*arrays)[1]
        full = [jnp.broadcast_to(jnp.asarray(x, dtype), batch) for x in self(*arrays)]
        return self.program.unpack(
            jnp.stack(full) if full else jnp.zeros((0, *batch), dtype)
        )

    def run(
        self, entries: Entries, operations: dict[Operation, Callable]
    ) -> tuple[Array, ...]:
        """Compute the distinct results that vary, with a function for each operation."""
        nodes = self.program.nodes
        # The last input: XLA folds what depends on constants, such as parameters often
        # are.
        firsts = [x[0] for x in reversed(entries) if len(x)]
        dtype = firsts[0].dtype if firsts else jnp.result_type(float)
        source = next((x for x in firsts if x.size), jnp.zeros((1,), dtype))
        anchor = hidden_one(source[(0,) * source.ndim]) if self.fence else None
        pairs = {}
        angles = {n.uses[0]: None for n in nodes if n.operation in CIRCULAR}
        angles = [k for k in angles if nodes[k].operation is Operation.INPUT]
        if angles:
            rows = [
                entries[number][entry]
                for number, entry in (nodes[k].place for k in angles)
            ]
            sines, cosines = _circular(jnp.stack(rows), anchor)
            pairs = {k: (sines[row], cosines[row]) for row, k in enumerate(angles)}
        values: list[Array] = []
        for position, node in enumerate(nodes):
            if node.operation is Operation.INPUT:
                number, entry = node.place
                values.append(entries[number][entry])
            elif node.operation in CIRCULAR:
                (angle,) = node.uses
                if angle not in pairs:
                    pairs[angle] = _circular(values[angle], anchor)
                values.append(pairs[angle][node.operation is Operation.COSINE])
            else:
                operands = [
                    values[x] if isinstance(x, int) else x for x in node.operands
                ]
                if node.operation is Operation.SELECT:
                    operands[1:] = [jnp.asarray(x, dtype) for x in operands[1:]]
                value = operations[node.operation](*operands)
                values.append(
                    fenced(value, anchor) if position in self.fenced else value
                )
        return tuple(values[k] for k in self.program.distinct[0])


def primitives(like: Array) -> dict[Operation, Callable]:
    """Return the operations with JAX's own primitives for the arithmetic.

    They skip the checks of types and shapes in array operators, so that a program is
    traced in a fraction of the time. JAX differentiates operators faster: do not
    differentiate these. All have the shape of one array.
    """

    @functools.cache
    def number(
        text: str,
    ) -> Array:  # plus and minus zero are equal, but not their texts
        return jax.lax.full_like(like, float(text))

    def whole(x: Any) -> Array:
        return number(repr(x)) if isinstance(x, float) else x

    def on_arrays(primitive: Callable) -> Callable:
        return lambda *operands: primitive(*map(whole, operands))

    return ELEMENTWISE | {
        Operation.ADD: on_arrays(jax.lax.add),
        Operation.SUBTRACT: on_arrays(jax.lax.sub),
        Operation.MULTIPLY: on_arrays(jax.lax.mul),
        Operation.DIVIDE: on_arrays(jax.lax.div),
        Operation.NEGATE: on_arrays(jax.lax.neg),
    }


@functools.lru_cache(maxsize=64)
def lower(program: Program, fence: bool = True) -> Lowered:
    """Prepare a program for JAX arrays, with fences behind shared values or without.

    On a GPU fences would break it into many kernels, and float64 divisions are slow.
    """
    return Lowered(program, fence, fenced_nodes(program) if fence else frozenset())


def on_any_platform(program: Program, evaluate: Callable, *arrays: AnyArray) -> Any:
    """Return `evaluate(lowered, *arrays)`, with fences where it runs on a CPU."""
    fenced, plain = (
        functools.partial(evaluate, lower(program, fence)) for fence in (True, False)
    )
    return jax.lax.platform_dependent(
        *map(jnp.asarray, arrays), cpu=fenced, default=plain
    )


@jax.custom_jvp
def _circular(x: Array, anchor: Array | None) -> tuple[Array, Array]:
    """Return sine and cosine behind fences; their derivatives are made from the fenced values."""
    sine, cosine = sine_cosine(x)
    return fenced(sine, anchor), fenced(cosine, anchor)


@_circular.defjvp
def _circular_jvp(primals, tangents):
    dx, _ = tangents
    sine, cosine = _circular(*primals)
    return (sine, cosine), (cosine * dx, -sine * dx)
