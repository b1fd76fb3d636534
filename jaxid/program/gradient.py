"""The derivative of a scalar program, as another one (reverse mode)."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, namespace
from jaxid.errors import InputError

from .numpy_evaluation import evaluate
from .program import Program, assemble, record
from .scalar import (
    Graph,
    Operand,
    Operation,
    Scalar,
    add,
    apply,
    divide,
    multiply,
    negate,
    select,
)
from .xla_sample_blocks import packed_columns

_DERIVATIVES: dict[Operation, Callable[[Operand, Operand], Operand]] = {
    Operation.ABSOLUTE: lambda x, y: apply(Operation.SIGN, x),
    Operation.SIGN: lambda x, y: 0.0,
    Operation.SINE: lambda x, y: apply(Operation.COSINE, x),
    Operation.COSINE: lambda x, y: negate(apply(Operation.SINE, x)),
    Operation.TANGENT: lambda x, y: add(1.0, multiply(y, y)),
    Operation.ARC_SINE: lambda x, y: divide(1.0, _root_of_one_minus_square(x)),
    Operation.ARC_COSINE: lambda x, y: divide(-1.0, _root_of_one_minus_square(x)),
    Operation.ARC_TANGENT: lambda x, y: divide(1.0, add(1.0, multiply(x, x))),
    Operation.HYPERBOLIC_SINE: lambda x, y: apply(Operation.HYPERBOLIC_COSINE, x),
    Operation.HYPERBOLIC_COSINE: lambda x, y: apply(Operation.HYPERBOLIC_SINE, x),
    Operation.HYPERBOLIC_TANGENT: lambda x, y: add(1.0, negate(multiply(y, y))),
    Operation.SQUARE_ROOT: lambda x, y: divide(0.5, y),
    Operation.CUBE_ROOT: lambda x, y: divide(1.0, multiply(3.0, multiply(y, y))),
    Operation.EXPONENTIAL: lambda x, y: y,
    Operation.LOGARITHM: lambda x, y: divide(1.0, x),
    Operation.EXPONENTIAL_MINUS_ONE: lambda x, y: add(1.0, y),
    Operation.LOGARITHM_OF_ONE_PLUS: lambda x, y: divide(1.0, add(1.0, x)),
}
"""Derivatives of functions of one argument, by argument and result."""


def pull_back(program: Program, weights: AnyArray, *arrays: AnyArray) -> list[AnyArray]:
    """Return the derivative of a weighted sum of results by each input.

    Args:
        program: Program whose results are weighted.
        weights: Weights of the packed result, [results, *batch], in NumPy or JAX.
        arrays: Inputs of the program; batch axes follow those of each input.
    """
    derivative = gradient_program(program)
    if namespace(weights, *arrays) is np:
        return list(evaluate(derivative, *arrays, weights))
    jax_arrays = [jnp.asarray(x) for x in (*arrays, weights)]
    return list(derivative.unpack(packed_columns(derivative, *jax_arrays)))


@functools.lru_cache(maxsize=64)
def gradient_program(program: Program) -> Program:
    """Return the program of the derivative of a weighted sum of results by all inputs.

    Its last input holds the weights, one for each packed result.
    """
    graph = Graph()
    shapes = program.input_shapes
    # Inputs are loaded before the first operation, so that they come first.
    entries = range(len(program.outputs))
    weights = [graph.node(Operation.INPUT, len(shapes), entry) for entry in entries]
    scalars = record(program, graph)
    slopes = _slopes_of_nodes(program, scalars, weights)

    places = {}
    for k, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT:
            places[node.place] = k
    outputs = []
    for number, shape in enumerate(shapes):
        for entry in range(math.prod(shape)):
            # An input that affects no result has no node.
            k = places.get((number, entry))
            outputs.append(0.0 if k is None else slopes[k])
    structure = jax.tree.structure((0,) * len(shapes))
    return assemble((*shapes, (len(weights),)), outputs, shapes, structure)


def _slopes_of_nodes(program: Program, scalars: list[Scalar], weights: list[Scalar]):
    """Return the derivative of the weighted sum by each node (reverse mode)."""
    slopes: list[Operand] = [0.0] * len(scalars)
    for weight, x in zip(weights, program.outputs, strict=True):
        if isinstance(x, int):
            slopes[x] = add(slopes[x], weight)

    # Nodes read only nodes before them: backwards, a slope is complete when used.
    for k in reversed(range(len(scalars))):
        node = program.nodes[k]
        if node.operation is Operation.INPUT or slopes[k] == 0.0:
            continue
        references = node.operands
        operands = tuple(scalars[x] if isinstance(x, int) else x for x in references)
        shares = _slopes(node.operation, operands, scalars[k], slopes[k])
        for x, share in zip(references, shares, strict=True):
            if isinstance(x, int):
                slopes[x] = add(slopes[x], share)
    return slopes


def _slopes(operation: Operation, x: tuple[Operand, ...], y: Scalar, slope: Operand):
    """Return what the derivative by a result adds to those by its operands."""
    if operation in _DERIVATIVES:
        return (multiply(slope, _DERIVATIVES[operation](x[0], y)),)
    if "truth" in operation.traits:
        return (0.0,) * len(x)
    match operation:
        case Operation.ADD:
            return slope, slope
        case Operation.SUBTRACT:
            return slope, negate(slope)
        case Operation.NEGATE:
            return (negate(slope),)
        case Operation.MULTIPLY:
            return multiply(slope, x[1]), multiply(slope, x[0])
        case Operation.DIVIDE:
            share = divide(slope, x[1])
            return share, negate(multiply(share, y))
        case Operation.MAXIMUM | Operation.MINIMUM:
            is_equal = apply(Operation.EQUAL, x[0], y)
            return select(is_equal, slope, 0.0), select(is_equal, 0.0, slope)
        case Operation.SELECT:
            return 0.0, select(x[0], slope, 0.0), select(x[0], 0.0, slope)
        case Operation.POWER:
            base, exponent = x
            reduced_power = apply(Operation.POWER, base, add(exponent, -1.0))
            base_slope = multiply(slope, multiply(exponent, reduced_power))
            if not isinstance(exponent, Scalar):
                return base_slope, 0.0
            logarithm = apply(Operation.LOGARITHM, base)
            return base_slope, multiply(slope, multiply(y, logarithm))
        case Operation.ARC_TANGENT_2:
            share = divide(slope, add(multiply(x[0], x[0]), multiply(x[1], x[1])))
            return multiply(share, x[1]), negate(multiply(share, x[0]))
    raise InputError(f"the operation `{operation}` has no derivative.")


def _root_of_one_minus_square(x: Operand):
    """Return the cosine of the arc sine of x."""
    return apply(Operation.SQUARE_ROOT, add(1.0, negate(multiply(x, x))))
