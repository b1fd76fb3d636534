"""Reverse-mode derivative of a lowered program, node by node.

JAX finds the same derivative, but processes each operation many times: where the compiled result
comes from a cache, that takes longer than everything else.
"""

import functools
import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import AnyArray, Array
from jaxid.program.operations import Operation
from jaxid.program.program import Node, Program, Reference
from jaxid.program.xla import CIRCULAR, ELEMENTWISE, Lowered, Values, primitives

Groups = tuple[tuple[int, ...], ...]


class Reversible(eqx.Module):
    """A lowered program for `grad` and `vjp`, with the same numbers and faster to trace.

    It has no forward mode: use the lowered program itself for `jvp`, `jacfwd` and `hessian`.

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
