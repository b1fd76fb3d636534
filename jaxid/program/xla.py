"""A scalar program as a fused XLA computation on batch-last arrays."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array
from jaxid.errors import InputError
from jaxid.program.fence import AbstractFence, default_fence, fenced_nodes
from jaxid.program.operation import Operation
from jaxid.program.program import Program
from jaxid.program.sincos import sine_cosine as polynomial_sine_cosine

ELEMENTWISE: dict[Operation, Callable] = {
    Operation.ADD: lambda x, y: x + y,
    Operation.SUBTRACT: lambda x, y: x - y,
    Operation.MULTIPLY: lambda x, y: x * y,
    Operation.DIVIDE: lambda x, y: x / y,
    Operation.NEGATE: lambda x: -x,
    Operation.POWER: lambda x, y: x**y,
    Operation.ARC_TANGENT_2: jnp.arctan2,
    Operation.MAXIMUM: jnp.maximum,
    Operation.MINIMUM: jnp.minimum,
    Operation.LESS: lambda x, y: x < y,
    Operation.LESS_EQUAL: lambda x, y: x <= y,
    Operation.EQUAL: lambda x, y: x == y,
    Operation.NOT_EQUAL: lambda x, y: x != y,
    Operation.AND: lambda x, y: x & y,
    Operation.OR: lambda x, y: x | y,
    Operation.NOT: lambda x: ~x,
    Operation.SELECT: jnp.where,
    Operation.ABSOLUTE: jnp.abs,
    Operation.SIGN: jnp.sign,
    Operation.TANGENT: jnp.tan,
    Operation.ARC_SINE: jnp.arcsin,
    Operation.ARC_COSINE: jnp.arccos,
    Operation.ARC_TANGENT: jnp.arctan,
    Operation.HYPERBOLIC_SINE: jnp.sinh,
    Operation.HYPERBOLIC_COSINE: jnp.cosh,
    Operation.HYPERBOLIC_TANGENT: jnp.tanh,
    Operation.SQUARE_ROOT: jnp.sqrt,
    Operation.CUBE_ROOT: jnp.cbrt,
    Operation.EXPONENTIAL: jnp.exp,
    Operation.LOGARITHM: jnp.log,
    Operation.EXPONENTIAL_MINUS_ONE: jnp.expm1,
    Operation.LOGARITHM_OF_ONE_PLUS: jnp.log1p,
}
CIRCULAR = (Operation.SINE, Operation.COSINE)
SineCosine = Callable[[Array], tuple[Array, Array]]


class Values(NamedTuple):
    """Everything that a program has computed.

    Attributes:
        nodes: For each node its array.
        pairs: Sines and cosines by their angles' positions.
        anchor: What the fences hold on to.
    """

    nodes: list[Array]
    pairs: dict[int, tuple[Array, Array]]
    anchor: Array


class Lowered(eqx.Module):
    """A program that runs on JAX arrays whose batch axes stand last.

    Works under `jit`, `grad`, `jvp` and `vmap`, in the precision of the arrays. Call it inside of
    `jax.jit`: without, each operation is dispatched by itself.
    """

    program: Program = eqx.field(static=True)
    fence: AbstractFence
    fenced: frozenset[int] = eqx.field(static=True)
    sine_cosine: SineCosine = eqx.field(static=True)

    def __call__(self, *arrays: AnyArray) -> list[Array | float]:
        """Computes the packed result.

        Args:
            arrays: For each input an array of the input's shape and any batch axes behind it.

        Returns:
            For each entry of each output, in order, an array of the batch's shape, or
            the constant that the entry always is.
        """
        values = self.run(self.entries(*arrays), ELEMENTWISE).nodes
        return [values[x] if isinstance(x, int) else x for x in self.program.outputs]

    def entries(self, *arrays: AnyArray) -> list[Array]:
        """The inputs with their own axes made one, and with the whole batch behind."""
        batch = self.program.batch_shape([np.shape(x) for x in arrays])
        dtype = jnp.result_type(*arrays, float) if arrays else jnp.result_type(float)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise InputError(f"A program computes with real numbers, but got arrays of {dtype}.")
        return [
            _entries(jnp.asarray(x, dtype), shape, batch)
            for x, shape in zip(arrays, self.program.input_shapes, strict=True)
        ]

    def dense(self, *arrays: AnyArray) -> Any:
        """Computes the outputs in the structure of the traced function, batch axes last.

        Writing out the constants costs memory and time; prefer the packed result.
        """
        packed = self(*arrays)
        batch = self.program.batch_shape([np.shape(x) for x in arrays])
        return unpack(self.program, packed, batch, jnp.result_type(*arrays, float))

    def run(self, entries: list[Array], operations: dict[Operation, Callable]) -> Values:
        """Computes all nodes.

        Args:
            entries: Of each input, its entries first.
            operations: How each kind of operation is done.
        """
        nodes = self.program.nodes
        dtype = entries[0].dtype if entries else jnp.result_type(float)
        source = next((x for x in entries if x.size), jnp.zeros((1,), dtype))
        fence = self.fence
        anchor = fence.anchor(source[(0,) * source.ndim])
        circular = _fenced(self.sine_cosine, fence)
        pairs = {}
        angles = _input_angles(self.program)
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
    """The operations with JAX's own primitives for the arithmetic.

    They skip what array operators do about types and shapes: a program is traced in a fraction of
    the time. Only where nothing is differentiated, since JAX differentiates operators faster.

    Args:
        like: Some array of the batch's shape.
    """
    numbers: dict[bytes, Array] = {}

    def whole(x: Any) -> Array:
        """A number as an array, made once."""
        if not isinstance(x, float):
            return x
        # Plus and minus zero are equal, but not the same.
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
    fence: AbstractFence | None = None,
    sine_cosine: SineCosine = polynomial_sine_cosine,
) -> Lowered:
    """Prepares a program for JAX arrays.

    Args:
        program: Made by `trace`.
        fence: How shared values are kept from being computed again; by default what was
            measured best for this backend and version of JAX.
        sine_cosine: Maps angles to their sines and cosines.
    """
    if fence is None:
        fence = default_fence(jax.default_backend(), jax.__version_info__)
    return Lowered(program, fence, fenced_nodes(program), sine_cosine)


def unpack(program: Program, packed: list, batch: tuple[int, ...], dtype: Any) -> Any:
    """A packed result as dense JAX arrays in the structure of the traced function, batch last."""
    full = [jnp.broadcast_to(jnp.asarray(x, dtype), batch) for x in packed]
    leaves, start = [], 0
    for shape in program.output_shapes:
        size = int(np.prod(shape, dtype=int))
        entries = full[start : start + size]
        stacked = jnp.stack(entries) if entries else jnp.zeros((0, *batch), dtype)
        leaves.append(stacked.reshape((*shape, *batch)))
        start += size
    return jax.tree.unflatten(program.structure, leaves)


def _entries(x: Array, shape: tuple[int, ...], batch: tuple[int, ...]) -> Array:
    """The input with its own axes made one, and with the whole batch behind."""
    own = x.shape[len(shape) :]
    size = int(np.prod(shape, dtype=int))
    missing = (1,) * (len(batch) - len(own))
    return jnp.broadcast_to(x.reshape(size, *missing, *own), (size, *batch))


def _input_angles(program: Program) -> list[int]:
    """Positions of the inputs of which a sine or a cosine is taken."""
    angles = {n.uses[0]: None for n in program.nodes if n.operation in CIRCULAR}
    return [k for k in angles if program.nodes[k].operation is Operation.INPUT]


def _fenced(sine_cosine: SineCosine, fence: AbstractFence) -> Callable:
    """Fences the pair, and makes its derivative from the fenced values."""

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
