"""From an ordinary JAX function to a scalar program: run its jaxpr on arrays of scalars."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from jaxid.arrays import double_precision
from jaxid.errors import InputError
from jaxid.program import scalar
from jaxid.program.moves import (
    INDEXED_MOVES,
    MOVES,
    is_symbolic,
    move_by_index,
    on_numbers,
    scatter_add,
)
from jaxid.program.operation import COMPARISONS, FUNCTIONS, Operation
from jaxid.program.program import Program, assemble
from jaxid.program.scalar import Graph, Operand


class Free:
    """The mark of an entry that varies; see `FREE`."""

    __slots__ = ()

    def __repr__(self):
        return "FREE"


FREE = Free()
"""Marks the entries of an input that vary; the entries beside it stay constants.

`np.where(offset != 0, FREE, offset)` is an input whose zeros are known.
"""

_INNER_JAXPR = ("jaxpr", "call_jaxpr", "fun_jaxpr")
_INSTEAD = {
    "scan": "a program has no loops, so write the loop in Python",
    "while": "a program has no loops, so write a loop of known length in Python",
    "cond": "a program has no branches, so choose between values with `jnp.where`",
    "sort": "the order would depend on the values",
    "reduce_max": "use `jnp.maximum` of two entries at a time",
    "reduce_min": "use `jnp.minimum` of two entries at a time",
    "cumsum": "add the entries one after the other",
}


def _each(function: Callable, operands: int) -> np.ufunc:
    return np.frompyfunc(function, operands, 1)


def _operation(operation: Operation, operands: int) -> np.ufunc:
    return _each(lambda *x: scalar.apply(operation, *x), operands)


_add, _subtract, _multiply = (
    _each(f, 2) for f in (scalar.add, lambda x, y: scalar.add(x, scalar.negate(y)), scalar.multiply)
)
_maximum, _minimum = _operation(Operation.MAXIMUM, 2), _operation(Operation.MINIMUM, 2)
_negate, _select = _each(scalar.negate, 1), _each(scalar.select, 3)
_and, _or, _not = (
    _each(lambda *x, o=o: scalar.logic(o, *x), n)
    for o, n in ((Operation.AND, 2), (Operation.OR, 2), (Operation.NOT, 1))
)


def _reduce(function: np.ufunc, x: np.ndarray, axes: Sequence, initial: float) -> Any:
    for axis in sorted(axes, reverse=True):
        x = function.reduce(x, axis=axis, initial=initial)
    return x


def _dot_general(x: np.ndarray, y: np.ndarray, *, dimension_numbers, **_) -> np.ndarray:
    (contracted_x, contracted_y), (batch_x, batch_y) = dimension_numbers
    free_x = [k for k in range(x.ndim) if k not in (*contracted_x, *batch_x)]
    free_y = [k for k in range(y.ndim) if k not in (*contracted_y, *batch_y)]
    shared = [x.shape[k] for k in batch_x]
    rows, columns = (math.prod(a.shape[k] for k in free) for a, free in ((x, free_x), (y, free_y)))
    terms = math.prod(x.shape[k] for k in contracted_x)
    left = x.transpose((*batch_x, *free_x, *contracted_x)).reshape((*shared, rows, 1, terms))
    right = y.transpose((*batch_y, *free_y, *contracted_y)).reshape((*shared, 1, columns, terms))
    total = _add.reduce(_multiply(left, right), axis=-1, initial=0.0)
    return np.asarray(total, object).reshape(
        (*shared, *(x.shape[k] for k in free_x), *(y.shape[k] for k in free_y))
    )


def _select_n(which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if not is_symbolic(which):
        return np.choose(np.broadcast_to(which, cases[0].shape).astype(int), cases)
    return np.asarray(_select(which, cases[1], cases[0]), object)


def _select_truth(which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if not is_symbolic(which):
        return _select_n(which, *cases)
    return np.asarray(_or(_and(which, cases[1]), _and(_not(which), cases[0])), object)


_ARITHMETIC: dict[str, Callable] = {
    "add": _add,
    "add_any": _add,
    "sub": _subtract,
    "mul": _multiply,
    "neg": _negate,
    "square": lambda x: _multiply(x, x),
    "one_minus_square": lambda x: _multiply(_add(1.0, x), _subtract(1.0, x)),
    "polynomial": lambda x, *c, **_: functools.reduce(
        lambda total, next_c: _add(_multiply(total, x), next_c), reversed(c)
    ),
    "div": _each(scalar.divide, 2),
    "rsqrt": _each(lambda x: scalar.divide(1.0, scalar.apply(Operation.SQUARE_ROOT, x)), 1),
    "pow": _each(scalar.power, 2),
    "integer_pow": lambda x, *, y: _each(lambda e: scalar.integer_power(e, y), 1)(x),
    "logistic": _each(
        lambda x: scalar.divide(
            1.0, scalar.add(1.0, scalar.apply(Operation.EXPONENTIAL, scalar.negate(x)))
        ),
        1,
    ),
    "max": _maximum,
    "min": _minimum,
    "clamp": lambda low, x, high: _minimum(_maximum(low, x), high),
    "gt": _each(lambda x, y: scalar.apply(Operation.LESS, y, x), 2),
    "ge": _each(lambda x, y: scalar.apply(Operation.LESS_EQUAL, y, x), 2),
    "and": _and,
    "or": _or,
    "not": _not,
    "dot_general": _dot_general,
    "reduce_sum": lambda x, *, axes, **_: _reduce(_add, x, axes, 0.0),
    "reduce_prod": lambda x, *, axes, **_: _reduce(_multiply, x, axes, 1.0),
    "optimization_barrier": lambda *x: list(x),
    "tie": lambda _, x: x,
    **{o.value: _operation(o, 2) for o in COMPARISONS},
    **{
        o.value: _operation(o, 1)
        for o in (*FUNCTIONS, Operation.ABSOLUTE, Operation.SIGN)
        if o not in (Operation.POWER, Operation.ARC_TANGENT_2)
    },
    Operation.ARC_TANGENT_2.value: _operation(Operation.ARC_TANGENT_2, 2),
}
_WITH_PARAMETERS = ("integer_pow", "dot_general", "reduce_sum", "reduce_prod")


def _convert(x: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if not is_symbolic(x):
        return x.astype(dtype)
    if dtype.kind == "b":
        return np.asarray(_each(scalar.as_truth, 1)(x), object)
    truth = all(scalar.is_truth(e) for e in x.flat)
    if truth or np.issubdtype(dtype, np.floating):
        return np.asarray(_each(scalar.as_number, 1)(x), object)
    raise InputError(
        f"`trace` cannot translate a conversion to {dtype}: a program computes with real numbers."
    )


def _entries(x: np.ndarray) -> np.ndarray:
    """Numbers as Python's numbers, so that they mix with scalars."""
    if is_symbolic(x) or x.dtype == bool:
        return x.astype(object)
    return x.astype(np.float64).astype(object)


def _dtype(equation: JaxprEqn) -> np.dtype:
    """The type of what an equation gives, if that is one array."""
    return np.dtype(equation.outvars[0].aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]


def _translate(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """One equation on arrays of which at least one is symbolic."""
    name = equation.primitive.name
    if name in INDEXED_MOVES:
        return [move_by_index(equation, [_entries_of_floats(x) for x in operands])]
    if name in ("scatter-add", "scatter_add"):
        return [scatter_add(equation, operands)]
    if name == "select_n":
        truth = _dtype(equation).kind == "b"
        which, cases = operands[0], [_entries(x) for x in operands[1:]]
        return [(_select_truth if truth else _select_n)(which, *cases)]
    if name in ("div", "pow") and np.issubdtype(_dtype(equation), np.integer):
        raise InputError(f"`trace` cannot translate `{name}` of integers: use real numbers.")
    if name in _ARITHMETIC:
        parameters = equation.params if name in _WITH_PARAMETERS else {}
        result = _ARITHMETIC[name](*map(_entries, operands), **parameters)
        results = result if equation.primitive.multiple_results else [result]
        return [np.asarray(x, object) for x in results]
    reason = _INSTEAD.get(name, "it is not elementwise arithmetic, a sum, or a move of entries")
    raise InputError(f"`trace` cannot translate the JAX primitive `{name}`: {reason}.")


def _entries_of_floats(x: np.ndarray) -> np.ndarray:
    return x if np.issubdtype(x.dtype, np.integer) else _entries(x)


def _known(constant: object) -> np.ndarray:
    if isinstance(constant, Tracer):
        raise InputError(
            "The function given to `trace` closes over a value that JAX is tracing, which a "
            f"program cannot hold ({constant}): pass it as an input, or trace outside of `jit`."
        )
    return np.asarray(constant)


def _run(jaxpr: Jaxpr, constants: list, arguments: list[np.ndarray]) -> list[np.ndarray]:
    names = [*jaxpr.constvars, *jaxpr.invars]
    values = dict(zip(names, [*map(_known, constants), *arguments], strict=True))

    def read(name) -> np.ndarray:
        return np.asarray(name.val) if isinstance(name, Literal) else values[name]

    for equation in jaxpr.eqns:
        primitive = equation.primitive.name
        operands = [read(name) for name in equation.invars]
        inner = next((equation.params[k] for k in _INNER_JAXPR if k in equation.params), None)
        symbolic = any(is_symbolic(x) for x in operands)
        if inner is not None and primitive not in _INSTEAD:
            closed = isinstance(inner, ClosedJaxpr)
            results = _run(
                inner.jaxpr if closed else inner, inner.consts if closed else [], operands
            )
        elif primitive in MOVES:
            results = MOVES[primitive](*operands, **equation.params)
            results = results if equation.primitive.multiple_results else [results]
        elif primitive == "convert_element_type":
            results = [_convert(operands[0], np.dtype(equation.params["new_dtype"]))]
        elif symbolic:
            results = _translate(equation, operands)
        else:
            results = on_numbers(equation, *operands)
        dtype = object if symbolic else None
        values.update(
            (name, np.asarray(x, dtype)) for name, x in zip(equation.outvars, results, strict=True)
        )
    return [read(name) for name in jaxpr.outvars]


def _argument(graph: Graph, number: int, given: tuple[int, ...] | np.ndarray) -> np.ndarray:
    template = np.full(given, FREE, object) if isinstance(given, tuple) else np.asarray(given)
    entries = np.empty(template.shape, object)
    for position, index in enumerate(np.ndindex(template.shape)):
        value = template[index]
        free = value is FREE
        entries[index] = graph.node(Operation.INPUT, number, position) if free else float(value)
    return entries


def trace(function: Callable, *inputs: tuple[int, ...] | np.ndarray) -> Program:
    """Translates a function of a few arrays into a scalar program.

    The function is ordinary JAX: arithmetic, elementwise functions, `jnp.where` and comparisons,
    sums, matrix products, and whatever moves entries; also `jvp`, `jacfwd`, `vjp` and
    `linear_transpose` of such. Loops are Python loops, which the trace unrolls. Constants are
    folded and equal expressions are merged.

    The trace is in float64, whatever the precision of the process. Folding `0 x` to 0 hides a NaN
    in x: check inputs before they come to the program.

    Args:
        function: Takes one array per input and returns any PyTree of arrays.
        inputs: For each argument its shape, or an object array that mixes `FREE` entries
            with numbers; the numbers become constants of the program.

    Raises:
        InputError: If the function does what a scalar program cannot, such as a loop
            of JAX or a sort; or if it closes over a value that JAX is tracing.
    """
    graph = Graph()
    arguments = [_argument(graph, k, given) for k, given in enumerate(inputs)]
    result = applied(function, *arguments)
    leaves, structure = jax.tree.flatten(result)
    outputs: list[Operand] = [e for x in leaves for e in x.ravel()]
    shapes = tuple(x.shape for x in arguments)
    return assemble(shapes, outputs, tuple(x.shape for x in leaves), structure)


def applied(function: Callable, *arrays: np.ndarray) -> Any:
    """Runs a function, as `trace` takes it, on arrays of scalars of one graph.

    Args:
        function: Takes these arrays and returns any PyTree of arrays.
        arrays: Of scalars and numbers.

    Returns:
        What the function returns, with arrays of scalars and numbers in it.

    Raises:
        InputError: Like `trace`.
    """
    with double_precision():
        avals = [jax.ShapeDtypeStruct(x.shape, np.float64) for x in arrays]
        jaxpr, result = jax.make_jaxpr(function, return_shape=True)(*avals)
        found = _run(jaxpr.jaxpr, jaxpr.consts, list(arrays))
    leaves = [np.array([scalar.as_number(e) for e in _entries(x).ravel()], object) for x in found]
    shaped = [x.reshape(np.shape(y)) for x, y in zip(leaves, found, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(result), shaped)


def program_of_scalars(
    function: Callable[..., np.ndarray], *inputs: tuple[int, ...] | np.ndarray
) -> Program:
    """A program from a function of arrays of scalars, which computes with them itself.

    Args:
        function: Takes one array of scalars per input and returns one.
        inputs: As for `trace`.
    """
    graph = Graph()
    arguments = [_argument(graph, k, given) for k, given in enumerate(inputs)]
    result = function(*arguments)
    shapes = tuple(x.shape for x in arguments)
    return assemble(shapes, list(result.ravel()), (result.shape,), jax.tree.structure(0))
