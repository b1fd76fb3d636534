"""A scalar program as a fused XLA computation on batch-last arrays.

XLA's CPU backend fuses elementwise operations into the loops of their consumers, and
copies a shared operation into each of them. A program of a thousand operations with
hundreds of results would be computed many times over. A fence on a shared value stops
that.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import AnyArray, Array

from .jax_sincos import sine_cosine
from .program import Node, Program, Shape
from .scalar import Operation

ELEMENTWISE: dict[Operation, Callable] = {
    o: getattr(jnp, o.numpy.__name__) for o in Operation if o is not Operation.INPUT
}
MIN_SAVING = 6
"""Number of operations that a fence must save."""
FUNCTION_COST = 20
"""Cost of a function such as tanh, in additions."""
SHORT_COMPILATION = {"xla_cpu_use_fusion_emitters": False}
"""Option by which XLA writes the kernels of a CPU without its fusion emitters.

With jax 0.10 the columns of a Panda compile in 2.8 instead of 6.5 CPU seconds and in 45
instead of 340 MB. They run as fast, but programs with few results run up to a quarter
slower.
"""
MIN_RESULTS_RATIO = 0.25
"""Results over operations from which a program is compiled with this option."""
CIRCULAR_FUNCTIONS = (Operation.SINE, Operation.COSINE)
Entries = Sequence[Sequence[Array] | Array]
"""Entries of each input, in order: arrays of the batch's shape."""
Values = Sequence[Array] | Mapping[int, Array]
"""Values of nodes by position."""
Results = tuple[Array, ...]
"""Distinct results that vary, in order: arrays of the batch's shape."""


def hidden_one(reference: Array) -> Array:
    """Return (sign bit of a number | 1), which is 1 for any number, NaN included.

    XLA does not copy divisions, since they are expensive, and x / 1 is exact, also for
    NaN and infinities: division by a one that XLA cannot recognise is a fence. The
    number is known only at run time.
    """
    width = 8 * reference.dtype.itemsize
    bits = jax.lax.stop_gradient(reference).view(f"uint{width}")
    sign = bits >> (width - 1)
    return (sign | 1).astype(reference.dtype)


def fenced(x: Array, one: Array | None) -> Array:
    """Return a value behind a fence, unless `one` is None."""
    return x if one is None else x / one


@functools.lru_cache(maxsize=64)
def fenced_nodes(program: Program) -> frozenset[int]:
    """Return positions of the nodes that a fence pays for.

    For these nodes the cost of computing them again, times (uses - 1), exceeds six
    operations; between 0 and 30 the speed hardly depends on this limit.
    """
    costs = []  # operations that compute each node again, from the fences before it
    positions = set()
    for k, node in enumerate(program.nodes):
        cost = _cost(node.operation) + sum(costs[i] for i in node.uses)
        saving = cost * (program.uses[k] - 1)
        is_number = "truth" not in node.operation.traits
        if is_number and saving > MIN_SAVING:
            positions.add(k)
            cost = 0
        costs.append(cost)
    return frozenset(positions)


def _cost(operation: Operation):
    """Return the cost of an operation, relative to that of an addition."""
    if operation in (Operation.INPUT, Operation.NEGATE):
        return 0
    return FUNCTION_COST if "function" in operation.traits else 1


class Lowered(eqx.Module):
    """A program on JAX arrays whose batch axes stand last.

    Works under `jit`, `grad`, `jvp` and `vmap`, in the precision of the arrays. Call it
    inside `jax.jit`: otherwise each operation is executed by itself.
    """

    program: Program = eqx.field(static=True)
    fence: bool = eqx.field(static=True)  # whether fences stand behind shared values

    def __call__(self, *arrays: AnyArray) -> list[Array | float]:
        """Compute the packed result, from arrays with batch axes last.

        For each entry of each output, in order, it is an array of the batch's shape or
        a constant.
        """
        return self.program.pack(self.distinct(*arrays))

    def distinct(self, *arrays: AnyArray) -> Results:
        """Compute the distinct results that vary, from the same arrays."""
        return self.run(self.entries(*arrays)[0])

    def entries(self, *arrays: AnyArray) -> tuple[list[Array], Shape]:
        """Return the inputs as [entries, *batch], and the batch's shape."""
        dtype = jnp.result_type(*arrays, float)
        return self.program.align([jnp.asarray(x, dtype) for x in arrays], jnp)

    def dense(self, *arrays: AnyArray) -> Any:
        """Compute the outputs in the structure of the traced function, batch axes last.

        Constants cost memory and time here; prefer the packed result.
        """
        dtype = jnp.result_type(*arrays, float)
        entries, batch = self.entries(*arrays)
        distinct_values = self.run(entries)
        values = self.program.pack(distinct_values)
        rows = [jnp.broadcast_to(jnp.asarray(x, dtype), batch) for x in values]
        results = jnp.stack(rows) if rows else jnp.zeros((0, *batch), dtype)
        return self.program.unpack(results)

    def run(self, entries: Entries) -> Results:
        """Compute the distinct results that vary, from the entries of the inputs."""
        reference = _reference(entries)
        one = None
        fences = frozenset()
        if self.fence:
            one = hidden_one(reference)
            fences = fenced_nodes(self.program)
        # Together they are vectorised; angles that are computed follow one by one.
        circular_pairs = self._sines_and_cosines(entries, one)
        values: list[Array] = []
        for position, node in enumerate(self.program.nodes):
            if node.operation is Operation.INPUT:
                number, entry = node.place
                value = entries[number][entry]
            elif node.operation in CIRCULAR_FUNCTIONS:
                (angle,) = node.uses
                if angle not in circular_pairs:
                    circular_pairs[angle] = _circular(values[angle], one)
                value = circular_pairs[angle][CIRCULAR_FUNCTIONS.index(node.operation)]
            else:
                value = apply_node(node, values, reference.dtype)
                if position in fences:
                    value = fenced(value, one)
            values.append(value)
        return tuple(values[k] for k in self.program.distinct[0])

    def _sines_and_cosines(self, entries: Entries, one: Array | None):
        """Compute sine and cosine of all inputs that are angles in one call."""
        nodes = self.program.nodes
        operands = [x.uses[0] for x in nodes if x.operation in CIRCULAR_FUNCTIONS]
        angles = []
        inputs = []
        for k in dict.fromkeys(operands):
            if nodes[k].operation is Operation.INPUT:
                number, entry = nodes[k].place
                angles.append(k)
                inputs.append(entries[number][entry])
        if not angles:
            return {}
        sines, cosines = _circular(jnp.stack(inputs), one)
        pairs = zip(sines, cosines, strict=True)
        return dict(zip(angles, pairs, strict=True))


def _reference(entries: Entries):
    """Return a number that is not known before run time."""
    # The last input: XLA folds what depends on constants, such as parameters often are.
    rows = [x[0] for x in reversed(entries) if len(x)]
    for row in rows:
        if row.size:
            return row[(0,) * row.ndim]
    return jnp.zeros((), rows[0].dtype if rows else float)


def apply_node(node: Node, values: Values, dtype: Any) -> Array:
    """Compute a node from the values of those before it."""
    operands = [values[x] if isinstance(x, int) else x for x in node.operands]
    if node.operation is Operation.SELECT:
        # Both choices may be constants, which have no precision of their own.
        operands[1:] = [jnp.asarray(x, dtype) for x in operands[1:]]
    return ELEMENTWISE[node.operation](*operands)


def lower(program: Program, fence: bool = True) -> Lowered:
    """Prepare a program for JAX arrays, with fences behind shared values or without.

    On a GPU fences would break it into many kernels, and float64 divisions are slow.
    """
    return Lowered(program, fence)


def kernel_options(program: Program) -> dict[str, Any] | None:
    """Return options for compiling a program as a whole, which `jax.jit` takes."""
    has_many_results = len(program.outputs) > MIN_RESULTS_RATIO * program.counts.total
    return SHORT_COMPILATION if has_many_results and _knows_option() else None


@functools.cache
def _knows_option() -> bool:
    """Return whether this version of XLA knows the option."""
    try:
        jax.jit(jnp.negative, compiler_options=SHORT_COMPILATION).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def on_any_platform(program: Program, evaluate: Callable, *arrays: AnyArray) -> Any:
    """Return `evaluate(lowered, *arrays)`, with fences where it runs on a CPU."""
    return jax.lax.platform_dependent(
        *map(jnp.asarray, arrays),
        cpu=functools.partial(evaluate, lower(program, fence=True)),
        default=functools.partial(evaluate, lower(program, fence=False)),
    )


@jax.custom_jvp
def _circular(x: Array, one: Array | None):
    """Return sine and cosine behind fences, also for their derivatives."""
    sine, cosine = sine_cosine(x)
    return fenced(sine, one), fenced(cosine, one)


@_circular.defjvp
def _circular_jvp(primals, tangents):
    dx, _ = tangents
    sine, cosine = _circular(*primals)
    return (sine, cosine), (cosine * dx, -sine * dx)
