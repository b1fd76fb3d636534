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
from .program import Program, Shape
from .scalar import Operation

ELEMENTWISE: dict[Operation, Callable] = {
    o: getattr(jnp, o.numpy.__name__) for o in Operation if o is not Operation.INPUT
}
BARRIER_HOLDS = jax.__version_info__ >= (0, 12)
"""Whether an optimization barrier stops XLA's CPU backend."""
MIN_SAVING = 6
"""Number of operations that a fence must save."""
FUNCTION_COST = 20
"""Cost of a function such as tanh, in additions."""
CIRCULAR = (Operation.SINE, Operation.COSINE)
Entries = Sequence[Array | Sequence[Array]]
"""Entries of each input, in order: arrays of the batch's shape."""


def hidden_one(reference: Array) -> Array:
    """Return (sign bit of a number | 1), which is 1 for any number, NaN included.

    XLA does not copy divisions, since they are expensive, and x / 1 is exact, also for
    NaN and infinities: division by a one that XLA cannot recognise is a fence. From JAX
    0.12 on an optimization barrier does the same at no cost. The number is known only
    at run time.
    """
    width = 8 * reference.dtype.itemsize
    bits = jax.lax.stop_gradient(reference).view(f"uint{width}")
    return (bits >> (width - 1) | 1).astype(reference.dtype)


def fenced(x: Array, one: Array | None) -> Array:
    """Return a value behind a fence, unless `one` is None."""
    if one is None:
        return x
    return jax.lax.optimization_barrier(x) if BARRIER_HOLDS else x / one


def fenced_nodes(program: Program) -> frozenset[int]:
    """Return positions of the nodes that a fence pays for.

    For these nodes the cost of computing them again, times (uses - 1), exceeds six
    operations; between 0 and 30 the speed hardly depends on this limit.
    """
    costs = []  # operations that compute each node again, from the fences before it
    nodes = set()
    for k, node in enumerate(program.nodes):
        cost = _cost(node.operation) + sum(costs[i] for i in node.uses)
        is_number = "truth" not in node.operation.traits
        if is_number and cost * (program.uses[k] - 1) > MIN_SAVING:
            nodes.add(k)
            cost = 0
        costs.append(cost)
    return frozenset(nodes)


def _cost(operation: Operation) -> int:
    """Return the cost of an operation, relative to that of an addition."""
    if operation in (Operation.INPUT, Operation.NEGATE):
        return 0
    return FUNCTION_COST if "function" in operation.traits else 1


class Lowered(eqx.Module):
    """A program on JAX arrays whose batch axes stand last.

    Works under `jit`, `grad`, `jvp` and `vmap`, in the precision of the arrays. Call it
    inside `jax.jit`: otherwise each operation is dispatched by itself.
    """

    program: Program = eqx.field(static=True)
    fence: bool = eqx.field(static=True)  # whether fences stand behind shared values
    fenced: frozenset[int] = eqx.field(static=True)  # positions of these nodes

    def __call__(self, *arrays: AnyArray) -> list[Array | float]:
        """Compute the packed result, from arrays with batch axes last.

        For each entry of each output, in order, it is an array of the batch's shape or
        a constant.
        """
        return self.program.pack(self.distinct(*arrays))

    def distinct(self, *arrays: AnyArray) -> tuple[Array, ...]:
        """Compute the distinct results that vary, from the same arrays."""
        return self.run(self.entries(*arrays)[0], ELEMENTWISE)

    def entries(self, *arrays: AnyArray) -> tuple[list[Array], Shape]:
        """Return the inputs as [entries, *batch], and the batch's shape."""
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
        dtype = jnp.result_type(*arrays, float)
        _, batch = self.entries(*arrays)
        rows = [jnp.broadcast_to(jnp.asarray(x, dtype), batch) for x in self(*arrays)]
        results = jnp.stack(rows) if rows else jnp.zeros((0, *batch), dtype)
        return self.program.unpack(results)

    def run(
        self, entries: Entries, operations: dict[Operation, Callable]
    ) -> tuple[Array, ...]:
        """Compute the results that vary, with a function for each operation."""
        nodes = self.program.nodes
        # The last input: XLA folds what depends on constants, such as parameters often
        # are.
        firsts = [x[0] for x in reversed(entries) if len(x)]
        dtype = firsts[0].dtype if firsts else jnp.result_type(float)
        source = next((x for x in firsts if x.size), jnp.zeros((1,), dtype))
        one = hidden_one(source[(0,) * source.ndim]) if self.fence else None

        # Together they are vectorised; angles that are computed follow one by one.
        pairs = self._sines_and_cosines(entries, one)
        values: list[Array] = []
        for position, node in enumerate(nodes):
            if node.operation is Operation.INPUT:
                number, entry = node.place
                values.append(entries[number][entry])
                continue
            if node.operation in CIRCULAR:
                (angle,) = node.uses
                if angle not in pairs:
                    pairs[angle] = _circular(values[angle], one)
                sine, cosine = pairs[angle]
                values.append(sine if node.operation is Operation.SINE else cosine)
                continue
            operands = [values[x] if isinstance(x, int) else x for x in node.operands]
            if node.operation is Operation.SELECT:
                # Both choices may be constants, which have no precision of their own.
                operands[1:] = [jnp.asarray(x, dtype) for x in operands[1:]]
            value = operations[node.operation](*operands)
            is_fenced = position in self.fenced
            values.append(fenced(value, one) if is_fenced else value)
        return tuple(values[k] for k in self.program.distinct[0])

    def _sines_and_cosines(
        self, entries: Entries, one: Array | None
    ) -> dict[int, tuple[Array, Array]]:
        """Compute sine and cosine of all inputs that are angles in one call."""
        nodes = self.program.nodes
        angles = []
        for node in nodes:
            if node.operation not in CIRCULAR or node.uses[0] in angles:
                continue
            if nodes[node.uses[0]].operation is Operation.INPUT:
                angles.append(node.uses[0])
        if not angles:
            return {}
        places = [nodes[angle].place for angle in angles]
        inputs = jnp.stack([entries[number][entry] for number, entry in places])
        sines, cosines = _circular(inputs, one)
        return {angle: (sines[k], cosines[k]) for k, angle in enumerate(angles)}


def primitives(like: Array) -> dict[Operation, Callable]:
    """Return the operations with JAX's own primitives for the arithmetic.

    They skip the checks of types and shapes in array operators, so that a program is
    traced in a fraction of the time. JAX differentiates operators faster: do not
    differentiate these. All have the shape of one array.
    """

    # By text: plus and minus zero are equal, but not their texts.
    @functools.cache
    def constant(text: str) -> Array:
        return jax.lax.full_like(like, float(text))

    def on_arrays(primitive: Callable) -> Callable:
        def apply(*operands: Array | float) -> Array:
            arrays = [
                constant(repr(x)) if isinstance(x, float) else x for x in operands
            ]
            return primitive(*arrays)

        return apply

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
    return jax.lax.platform_dependent(
        *map(jnp.asarray, arrays),
        cpu=functools.partial(evaluate, lower(program, fence=True)),
        default=functools.partial(evaluate, lower(program, fence=False)),
    )


@jax.custom_jvp
def _circular(x: Array, one: Array | None) -> tuple[Array, Array]:
    """Return sine and cosine behind fences, also for their derivatives."""
    sine, cosine = sine_cosine(x)
    return fenced(sine, one), fenced(cosine, one)


@_circular.defjvp
def _circular_jvp(primals, tangents):
    dx, _ = tangents
    sine, cosine = _circular(*primals)
    return (sine, cosine), (cosine * dx, -sine * dx)
