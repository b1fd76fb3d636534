"""A scalar program as a fused XLA computation on batch-last arrays.

XLA's CPU backend fuses elementwise operations into the loops of their consumers, and copies a
shared operation into each of them. A program of a thousand operations with hundreds of results
would be computed many times over. A fence on a shared value stops that.
"""

import enum
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array
from jaxid.errors import InputError
from jaxid.program.program import Node, Program, Reference
from jaxid.program.scalar import Operation
from jaxid.program.sincos import sine_cosine as polynomial_sine_cosine

ELEMENTWISE: dict[Operation, Callable] = {
    o: getattr(jnp, o.numpy.__name__) for o in Operation if o is not Operation.INPUT
}
CIRCULAR = (Operation.SINE, Operation.COSINE)
SineCosine = Callable[[Array], tuple[Array, Array]]
Groups = tuple[tuple[int, ...], ...]


class Fence(enum.Enum):
    """A way to make XLA compute a shared value only once.

    XLA does not copy divisions, since they are expensive, and x / 1 is exact, also for NaN and
    infinities: `DIVISION` divides by a one that XLA cannot recognise. The derivative has the same
    fence. `BARRIER` is an optimization barrier, which newer versions of XLA respect on a CPU. With
    `NONE` XLA decides.
    """

    NONE = "none"
    BARRIER = "barrier"
    DIVISION = "division"

    def __call__(self, x: Array, one: Array) -> Array:
        """Return x, which XLA now computes once.

        Args:
            x: Value.
            one: The number that `hidden_one` makes.
        """
        if self is Fence.DIVISION:
            return x / one
        return jax.lax.optimization_barrier(x) if self is Fence.BARRIER else x


def hidden_one(reference: Array) -> Array:
    """Return (sign bit of a number | 1), which is 1 for any number, NaN included.

    Args:
        reference: Number known only at run time, in the precision of the program.
    """
    wide = reference.dtype == jnp.float64
    bits = jax.lax.bitcast_convert_type(
        jax.lax.stop_gradient(reference), jnp.uint64 if wide else jnp.uint32
    )
    sign = jax.lax.shift_right_logical(bits, jnp.full_like(bits, 63 if wide else 31))
    return (sign | jnp.ones_like(bits)).astype(reference.dtype)


def default_fence(backend: str, version: tuple[int, ...]) -> Fence:
    """Choose a fence that was measured to work (`benchmarks/fences.py`, JAX 0.10.2 and 0.12.0).

    In 0.10 only the division works on a CPU; in 0.12 both do, equally fast, and the barrier adds
    no arithmetic. On a GPU a fence would break the program into many kernels, and float64 divisions
    are slow, so that none is placed; nothing was measured there.

    Args:
        backend: Name of JAX's platform as `jax.default_backend()` gives it.
        version: Version of JAX as `jax.__version_info__` gives it.
    """
    if backend != "cpu":
        return Fence.NONE
    return Fence.BARRIER if version >= (0, 12) else Fence.DIVISION


def fenced_nodes(program: Program, threshold: int = 6) -> frozenset[int]:
    """Return positions of the nodes that a fence pays for.

    These are the nodes with (uses - 1) times the cost of computing them again > threshold.

    Args:
        program: Program to place fences in.
        threshold: Threshold [operations]; between 0 and 30 the speed hardly depends on it.
    """
    free = (Operation.INPUT, Operation.NEGATE)
    costs, fenced = [], set()
    for k, node in enumerate(program.nodes):
        own = 20 if "function" in node.operation.traits else node.operation not in free
        cost = own + sum(costs[i] for i in node.uses)
        if cost * (program.uses[k] - 1) > threshold:
            fenced.add(k)
            cost = 0
        costs.append(cost)
    return frozenset(fenced)


class Values(NamedTuple):
    """Values of a program.

    Attributes:
        nodes: Array of each node.
        pairs: Sines and cosines by the positions of their angles.
        anchor: The one that the fences divide by.
    """

    nodes: list[Array]
    pairs: dict[int, tuple[Array, Array]]
    anchor: Array


class Lowered(eqx.Module):
    """A program on JAX arrays whose batch axes stand last.

    Works under `jit`, `grad`, `jvp` and `vmap`, in the precision of the arrays. Call it inside
    `jax.jit`: otherwise each operation is dispatched by itself.

    Attributes:
        program: Program made by `trace`.
        fence: Fence of shared values.
        fenced: Positions of the nodes that have a fence.
        sine_cosine: Function from angles to their sines and cosines.
    """

    program: Program = eqx.field(static=True)
    fence: Fence = eqx.field(static=True)
    fenced: frozenset[int] = eqx.field(static=True)
    sine_cosine: SineCosine = eqx.field(static=True)

    def __call__(self, *arrays: AnyArray) -> list[Array | float]:
        """Compute the packed result.

        Args:
            arrays: Arrays with the shapes of the inputs, each followed by any batch axes.

        Returns:
            For each entry of each output, in order, an array of the batch's shape, or a constant.
        """
        values = self.run(self.entries(*arrays), ELEMENTWISE).nodes
        return [values[x] if isinstance(x, int) else x for x in self.program.outputs]

    def entries(self, *arrays: AnyArray) -> list[Array]:
        """Return the inputs with their own axes merged into one, followed by the whole batch."""
        batch = self.program.batch_shape([np.shape(x) for x in arrays])
        dtype = jnp.result_type(*arrays, float) if arrays else jnp.result_type(float)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise InputError(f"A program computes with real numbers, but got arrays of {dtype}.")
        return [
            _entries(jnp.asarray(x, dtype), shape, batch)
            for x, shape in zip(arrays, self.program.input_shapes, strict=True)
        ]

    def dense(self, *arrays: AnyArray) -> Any:
        """Compute the outputs in the structure of the traced function, batch axes last.

        Constants cost memory and time here; prefer the packed result.
        """
        program, dtype = self.program, jnp.result_type(*arrays, float)
        batch = program.batch_shape([np.shape(x) for x in arrays])
        full = [jnp.broadcast_to(jnp.asarray(x, dtype), batch) for x in self(*arrays)]
        leaves = []
        for entries, shape in zip(program.split(full), program.output_shapes, strict=True):
            stacked = jnp.stack(entries) if entries else jnp.zeros((0, *batch), dtype)
            leaves.append(stacked.reshape((*shape, *batch)))
        return jax.tree.unflatten(program.structure, leaves)

    def run(self, entries: list[Array], operations: dict[Operation, Callable]) -> Values:
        """Compute all nodes.

        Args:
            entries: Arrays of the inputs, entries first.
            operations: Function for each kind of operation.
        """
        nodes = self.program.nodes
        dtype = entries[0].dtype if entries else jnp.result_type(float)
        source = next((x for x in entries if x.size), jnp.zeros((1,), dtype))
        fence = self.fence
        anchor = hidden_one(source[(0,) * source.ndim])
        circular = _fenced(self.sine_cosine, fence)
        pairs = {}
        angles = {n.uses[0]: None for n in nodes if n.operation in CIRCULAR}
        angles = [k for k in angles if nodes[k].operation is Operation.INPUT]
        if angles:
            rows = [entries[number][entry] for number, entry in (nodes[k].place for k in angles)]
            sines, cosines = circular(jnp.stack(rows), anchor)
            pairs = {k: (sines[row], cosines[row]) for row, k in enumerate(angles)}
        values: list[Array] = []
        for position, node in enumerate(nodes):
            if node.operation is Operation.INPUT:
                number, entry = node.place
                values.append(entries[number][entry])
            elif node.operation in CIRCULAR:
                (angle,) = node.uses
                if angle not in pairs:
                    pairs[angle] = circular(values[angle], anchor)
                values.append(pairs[angle][node.operation is Operation.COSINE])
            else:
                operands = [values[x] if isinstance(x, int) else x for x in node.operands]
                if node.operation is Operation.SELECT:
                    operands[1:] = [jnp.asarray(x, dtype) for x in operands[1:]]
                value = operations[node.operation](*operands)
                values.append(fence(value, anchor) if position in self.fenced else value)
        return Values(values, pairs, anchor)


def primitives(like: Array) -> dict[Operation, Callable]:
    """Return the operations with JAX's own primitives for the arithmetic.

    They skip the checks of types and shapes in array operators, so that a program is traced in a
    fraction of the time. JAX differentiates operators faster: do not differentiate these.

    Args:
        like: Array of the batch's shape.
    """
    numbers: dict[bytes, Array] = {}

    def whole(x: Any) -> Array:
        """Return a number as an array, made once."""
        if not isinstance(x, float):
            return x
        # Plus and minus zero are equal, but not identical.
        bits = np.float64(x).tobytes()
        if bits not in numbers:
            numbers[bits] = jax.lax.full_like(like, x)
        return numbers[bits]

    def on_arrays(primitive: Callable) -> Callable:
        return lambda *operands: primitive(*map(whole, operands))

    return ELEMENTWISE | {
        Operation.ADD: on_arrays(jax.lax.add),
        Operation.SUBTRACT: on_arrays(jax.lax.sub),
        Operation.MULTIPLY: on_arrays(jax.lax.mul),
        Operation.DIVIDE: on_arrays(jax.lax.div),
        Operation.NEGATE: on_arrays(jax.lax.neg),
    }


def lower(
    program: Program,
    fence: Fence | None = None,
    sine_cosine: SineCosine = polynomial_sine_cosine,
) -> Lowered:
    """Prepare a program for JAX arrays.

    Args:
        program: Program made by `trace`.
        fence: Fence of shared values; by default the fastest one for this backend and version of
            JAX.
        sine_cosine: Function from angles to their sines and cosines.
    """
    if fence is None:
        fence = default_fence(jax.default_backend(), jax.__version_info__)
    return Lowered(program, fence, fenced_nodes(program), sine_cosine)


def _entries(x: Array, shape: tuple[int, ...], batch: tuple[int, ...]) -> Array:
    own = x.shape[len(shape) :]
    size = math.prod(shape)
    missing = (1,) * (len(batch) - len(own))
    return jnp.broadcast_to(x.reshape(size, *missing, *own), (size, *batch))


def _fenced(sine_cosine: SineCosine, fence: Fence) -> Callable:
    """Fence the pair, and make its derivative from the fenced values."""

    @jax.custom_jvp
    def circular(x: Array, anchor: Array) -> tuple[Array, Array]:
        sine, cosine = sine_cosine(x)
        return fence(sine, anchor), fence(cosine, anchor)

    @circular.defjvp
    def _jvp(primals, tangents):
        dx, _ = tangents
        sine, cosine = circular(*primals)
        return (sine, cosine), (cosine * dx, -sine * dx)

    return circular


class Reversible(eqx.Module):
    """A lowered program for `grad` and `vjp`, with the same numbers and faster to trace.

    JAX finds the same derivative, but processes each operation many times: where the compiled
    result comes from a cache, that takes longer than everything else. It has no forward
    mode: use the lowered program itself for `jvp`, `jacfwd` and `hessian`.

    Attributes:
        lowered: Program on JAX arrays.
    """

    lowered: Lowered

    @property
    def program(self) -> Program:
        """Program that is computed."""
        return self.lowered.program

    def stacked(self, groups: Groups, *arrays: AnyArray) -> list[Array]:
        """Compute entries of the packed result, stacked: faster to trace than one by one.

        Args:
            groups: Positions in the packed result; each group becomes one array.
            arrays: Arrays with the shapes of the inputs, each followed by any batch axes.

        Returns:
            For each group an array with its entries along the last axis but one.
        """
        stacked: Any = _stacked(self.lowered, groups, self.lowered.entries(*arrays))
        return stacked


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _stacked(lowered: Lowered, groups: Groups, entries: list[Array]) -> list[Array]:
    return _stacked_forward(lowered, groups, entries)[0]


def _stacked_forward(
    lowered: Lowered, groups: Groups, entries: list[Array]
) -> tuple[list[Array], tuple[Values, Array]]:
    first = next(x[0] for x in entries if len(x))
    values = lowered.run(entries, primitives(first))
    axis = max(first.ndim - 1, 0)
    arrays = []
    for group in groups:
        own = [lowered.program.outputs[k] for k in group]
        rows = [values.nodes[x] if isinstance(x, int) else jax.lax.full_like(first, x) for x in own]
        rows = [jax.lax.expand_dims(x, (axis,)) for x in rows]
        empty = jnp.zeros((*first.shape[:axis], 0, *first.shape[axis:]), first.dtype)
        arrays.append(jax.lax.concatenate(rows, axis) if rows else empty)
    return arrays, (values, first)


def _stacked_backward(
    lowered: Lowered, groups: Groups, residuals: tuple[Values, Array], given: list[Array]
) -> tuple[list[Array]]:
    values, first = residuals
    axis = max(first.ndim - 1, 0)
    each = []
    for group, stack in zip(groups, given, strict=True):
        for row, k in enumerate(group):
            x = lowered.program.outputs[k]
            if isinstance(x, int):
                each.append((x, jax.lax.index_in_dim(stack, row, axis, keepdims=False)))
    return (_pull(lowered, values, each, first),)


_stacked.defvjp(_stacked_forward, _stacked_backward)


def _pull(
    lowered: Lowered, values: Values, given: Iterable[tuple[int, Array]], like: Array
) -> list[Array]:
    """Return cotangents of the inputs from those of some nodes.

    Args:
        lowered: Program on JAX arrays.
        values: Values of the program.
        given: Positions of nodes with their cotangents.
        like: Array of the batch's shape.
    """
    nodes = lowered.program.nodes
    sums: list[Array | None] = [None] * len(nodes)
    table = primitives(like)
    multiply, negate = table[Operation.MULTIPLY], table[Operation.NEGATE]

    def value(x: Reference) -> Array | float:
        return values.nodes[x] if isinstance(x, int) else x

    def accumulate(x: Reference, c: Array) -> None:
        if isinstance(x, int):
            old = sums[x]
            sums[x] = c if old is None else jax.lax.add(old, c)

    for k, c in given:
        accumulate(k, c)
    for position in reversed(range(len(nodes))):
        node, c = nodes[position], sums[position]
        if c is None or node.operation is Operation.INPUT:
            continue
        operands = node.operands
        if node.operation in CIRCULAR:
            (angle,) = node.uses
            sine, cosine = values.pairs[angle]
            is_sine = node.operation is Operation.SINE
            accumulate(angle, multiply(c, cosine) if is_sine else negate(multiply(c, sine)))
            continue
        if position in lowered.fenced:
            c = lowered.fence(c, values.anchor)
        if node.operation is Operation.ADD:
            accumulate(operands[0], c)
            accumulate(operands[1], c)
        elif node.operation is Operation.SUBTRACT:
            accumulate(operands[0], c)
            if isinstance(operands[1], int):
                accumulate(operands[1], negate(c))
        elif node.operation is Operation.NEGATE:
            accumulate(operands[0], negate(c))
        elif node.operation is Operation.MULTIPLY:
            for own, other in (operands, operands[::-1]):
                if isinstance(own, int):
                    accumulate(own, multiply(c, value(other)))
        else:
            for own, cotangent in _operand_cotangents(node, [value(x) for x in operands], c):
                accumulate(own, cotangent)
    return _input_cotangents(lowered.program, jax.lax.full_like(like, 0), sums)


def _operand_cotangents(node: Node, operands: list[Any], c: Array) -> list[tuple[int, Array]]:
    """Return the cotangents of an operation's operands by JAX's own rule."""
    places = [
        k
        for k, x in enumerate(operands)
        if isinstance(node.operands[k], int) and jnp.issubdtype(x.dtype, jnp.floating)
    ]

    def apply(*differentiated: Array) -> Array:
        full = list(operands)
        for k, x in zip(places, differentiated, strict=True):
            full[k] = x
        return ELEMENTWISE[node.operation](*full)

    _, pull = jax.vjp(apply, *(operands[k] for k in places))
    return [(int(node.operands[k]), x) for k, x in zip(places, pull(c), strict=True)]


def _input_cotangents(program: Program, zero: Array, sums: list[Array | None]) -> list[Array]:
    """Return cotangents of the inputs, entries first."""
    rows = [[zero] * math.prod(shape) for shape in program.input_shapes]
    for node, c in zip(program.nodes, sums, strict=True):
        if node.operation is Operation.INPUT and c is not None:
            number, entry = node.place
            rows[number][entry] = c
    return [jnp.stack(own) if own else jnp.zeros((0, *zero.shape), zero.dtype) for own in rows]
