"""Translation of a JAX function into a scalar program: its jaxpr runs on arrays of scalars.

Primitives that only move entries of an array are written out for NumPy if they are
common; the others (gather, scatter, dynamic slices) move the *positions* of the entries
with JAX itself, and the entries follow.
"""

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

from . import scalar
from .program import Program, assemble
from .scalar import Graph, Operation

FREE = object()
"""Mark of the entries of an input that vary; numbers beside it become constants.

`np.where(offset != 0, FREE, offset)` is an input whose zeros are known.
"""

_UNSUPPORTED = {
    "scan": "a program has no loops, so write the loop in Python",
    "while": "a program has no loops, so write a loop of known length in Python",
    "cond": "a program has no branches, so choose between values with `jnp.where`",
    "sort": "the order would depend on the values",
    "reduce_max": "use `jnp.maximum` of two entries at a time",
    "reduce_min": "use `jnp.minimum` of two entries at a time",
    "cumsum": "add the entries one after the other",
}


def _is_symbolic(x: np.ndarray) -> bool:
    """Return whether an array holds scalars of a trace."""
    return x.dtype == object


def _broadcast(x: np.ndarray, *_, shape, broadcast_dimensions, **__) -> np.ndarray:
    placed = [1] * len(shape)
    for source, target in enumerate(broadcast_dimensions):
        placed[target] = x.shape[source]
    return np.broadcast_to(x.reshape(placed), shape)


def _slice(x: np.ndarray, *, start_indices, limit_indices, strides) -> np.ndarray:
    steps = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, steps))]


def _pad(x: np.ndarray, filler: np.ndarray, *, padding_config) -> np.ndarray:
    for axis, (low, high, interior) in enumerate(padding_config):
        x = np.moveaxis(x, axis, 0)
        spread = max(len(x) + (len(x) - 1) * interior, 0)
        padded = np.full(
            (max(low, 0) + spread + max(high, 0), *x.shape[1:]), filler, x.dtype
        )
        padded[max(low, 0) : max(low, 0) + spread : interior + 1] = x
        x = np.moveaxis(padded[max(-low, 0) : len(padded) - max(-high, 0)], 0, axis)
    return x


_MOVEMENTS: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *x, dimension: np.concatenate(x, axis=dimension),
    "copy": lambda x, **_: x,
    "copy_p": lambda x, **_: x,
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, dimensions),
    "pad": _pad,
    "reshape": lambda x, *_, new_sizes, **__: x.reshape(new_sizes),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "split": lambda x, *, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "stack": lambda *x, axis: np.stack(x, axis=axis),
    "tile": lambda x, *, reps: np.tile(x, reps),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "unstack": lambda x, *, axis: list(np.moveaxis(x, axis, 0)),
}

_IN_NUMPY: dict[str, Callable] = {
    "add": np.add,
    "div": np.divide,
    "eq": np.equal,
    "mul": np.multiply,
    "neg": np.negative,
    "select_n": lambda which, *cases: np.where(which, cases[-1], cases[0]),
    "sub": np.subtract,
    "tanh": np.tanh,
}
"""Primitives that known numbers go through in NumPy: JAX would compile each shape."""

_INDEXED = {
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
    "scatter_add": (0, 2),
}
"""Positions of the operands that hold entries; the others hold indices."""


def _on_numbers(equation: JaxprEqn, *operands: np.ndarray) -> list[np.ndarray]:
    """Run one equation on known numbers, in NumPy where it suffices, also inside another trace."""
    primitive, params = equation.primitive.name, equation.params
    # Division of whole numbers differs.
    exact = primitive != "div" or operands[0].dtype == np.float64
    if primitive in _IN_NUMPY and exact and len(operands) <= 3:
        with np.errstate(all="ignore"):
            result = _IN_NUMPY[primitive](*operands)
            return [
                np.asarray(result, getattr(equation.outvars[0].aval, "dtype", None))
            ]
    if primitive == "iota":
        shape, axis = params["shape"], params["dimension"]
        return [np.indices(shape, params["dtype"])[axis]]
    with jax.ensure_compile_time_eval():
        # A NumPy array would take the precision of the process; a JAX array keeps its
        # own.
        arrays = [jax.numpy.asarray(x, x.dtype) for x in operands]
        results = equation.primitive.bind(*arrays, **params)
        results = results if equation.primitive.multiple_results else [results]
        return [np.asarray(x) for x in results]


def _move_by_index(
    equation: JaxprEqn, carriers: tuple[int, ...], operands: list[np.ndarray]
) -> np.ndarray:
    """Move entries to the places that the indices among the operands give."""
    entries, labels, start = [], list(operands), 0
    for k in carriers:
        entries.append(_entries(operands[k]).ravel())
        positions = np.arange(start, start + operands[k].size, dtype=np.float64)
        labels[k] = positions.reshape(operands[k].shape)
        start += operands[k].size
    (moved,) = _on_numbers(equation, *labels)
    if not ((moved >= 0) & (moved < start)).all():
        raise InputError(
            f"`trace` met an index outside of its array in `{equation.primitive}`: "
            "correct it."
        )
    return np.concatenate(entries)[moved.astype(int)]


def _scatter_add(equation: JaxprEqn, operands: list[np.ndarray]) -> np.ndarray:
    """Add entries at known places, as the transpose of a gather does."""
    target, indices, updates = operands
    total = target.astype(object).copy()
    for k, update in enumerate(updates.astype(object).ravel()):
        one = np.zeros(updates.size)
        one[k] = 1
        zeros = np.zeros(target.shape)
        (places,) = _on_numbers(equation, zeros, indices, one.reshape(updates.shape))
        for place in np.argwhere(places):
            total[tuple(place)] = _add(total[tuple(place)], update)
    return total


def _each(function: Callable, operands: int) -> np.ufunc:
    return np.frompyfunc(function, operands, 1)


def _operation(operation: Operation) -> np.ufunc:
    return _each(lambda *x: scalar.apply(operation, *x), operation.numpy.nin)


_add, _subtract, _multiply = (
    _each(f, 2)
    for f in (scalar.add, lambda x, y: scalar.add(x, scalar.negate(y)), scalar.multiply)
)
_maximum, _minimum = _operation(Operation.MAXIMUM), _operation(Operation.MINIMUM)
_select = _each(scalar.select, 3)


def _reduce(function: np.ufunc, x: np.ndarray, axes: Sequence, initial: float) -> Any:
    for axis in sorted(axes, reverse=True):
        x = function.reduce(x, axis=axis, initial=initial)
    return x


def _dot_general(x: np.ndarray, y: np.ndarray, *, dimension_numbers, **_) -> np.ndarray:
    (contracted_x, contracted_y), (batch_x, batch_y) = dimension_numbers
    free_x = [k for k in range(x.ndim) if k not in (*contracted_x, *batch_x)]
    free_y = [k for k in range(y.ndim) if k not in (*contracted_y, *batch_y)]
    shared = [x.shape[k] for k in batch_x]
    rows, columns = (
        math.prod(a.shape[k] for k in free) for a, free in ((x, free_x), (y, free_y))
    )
    terms = math.prod(x.shape[k] for k in contracted_x)
    left = x.transpose((*batch_x, *free_x, *contracted_x)).reshape(
        (*shared, rows, 1, terms)
    )
    right = y.transpose((*batch_y, *free_y, *contracted_y)).reshape(
        (*shared, 1, columns, terms)
    )
    total = _add.reduce(_multiply(left, right), axis=-1, initial=0.0)
    return np.asarray(total, object).reshape(
        (*shared, *(x.shape[k] for k in free_x), *(y.shape[k] for k in free_y))
    )


def _select_n(which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if not _is_symbolic(which):
        return np.choose(np.broadcast_to(which, cases[0].shape).astype(int), cases)
    return np.asarray(_select(which, cases[1], cases[0]), object)


_ELEMENTARY = [
    o
    for o in Operation
    if "function" in o.traits
    or o in (Operation.LESS, Operation.LESS_EQUAL, Operation.EQUAL, Operation.NOT_EQUAL)
    or o in (Operation.ABSOLUTE, Operation.SIGN)
]
_ARITHMETIC: dict[str, Callable] = {
    **{o.value: _operation(o) for o in _ELEMENTARY},
    **{
        o.value: _each(functools.partial(scalar.logic, o), o.numpy.nin)
        for o in (Operation.AND, Operation.OR, Operation.NOT)
    },
    "add": _add,
    "add_any": _add,
    "sub": _subtract,
    "mul": _multiply,
    "neg": _each(scalar.negate, 1),
    "square": lambda x: _multiply(x, x),
    "one_minus_square": lambda x: _multiply(_add(1.0, x), _subtract(1.0, x)),
    "polynomial": lambda x, *c, **_: functools.reduce(
        lambda total, next_c: _add(_multiply(total, x), next_c), reversed(c)
    ),
    "div": _each(scalar.divide, 2),
    "rsqrt": _each(
        lambda x: scalar.divide(1.0, scalar.apply(Operation.SQUARE_ROOT, x)), 1
    ),
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
    "dot_general": _dot_general,
    "reduce_sum": lambda x, *, axes, **_: _reduce(_add, x, axes, 0.0),
    "reduce_prod": lambda x, *, axes, **_: _reduce(_multiply, x, axes, 1.0),
    "optimization_barrier": lambda *x: list(x),
    "tie": lambda _, x: x,
}


def _convert(x: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if not _is_symbolic(x):
        return x.astype(dtype)
    if dtype.kind == "b":
        return np.asarray(_each(scalar.as_truth, 1)(x), object)
    truth = all(scalar.is_truth(e) for e in x.flat)
    if truth or np.issubdtype(dtype, np.floating):
        return np.asarray(_each(scalar.as_number, 1)(x), object)
    raise InputError(
        f"`trace` cannot translate a conversion to {dtype}: a program computes with "
        "real numbers."
    )


def _entries(x: np.ndarray) -> np.ndarray:
    """Return an array of scalars, or of Python's own numbers, which mix with them."""
    if _is_symbolic(x) or x.dtype == bool:
        return x.astype(object)
    return x.astype(np.float64).astype(object)


def _translate(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Run one equation on arrays of which at least one is symbolic."""
    name = equation.primitive.name
    if name in _INDEXED:
        carriers = _INDEXED[name]
        if any(_is_symbolic(x) for k, x in enumerate(operands) if k not in carriers):
            raise InputError(
                f"`trace` cannot translate `{name}` with a variable index: use "
                "constant integers."
            )
        if "add" in name:
            return [_scatter_add(equation, operands)]
        return [_move_by_index(equation, carriers, operands)]
    if name == "select_n":
        return [_select_n(operands[0], *map(_entries, operands[1:]))]
    aval: Any = equation.outvars[0].aval
    if name in ("div", "pow") and np.issubdtype(aval.dtype, np.integer):
        raise InputError(
            f"`trace` cannot translate `{name}` of integers: use real numbers."
        )
    if name in _ARITHMETIC:
        with_parameters = name in (
            "integer_pow",
            "dot_general",
            "reduce_sum",
            "reduce_prod",
        )
        parameters = equation.params if with_parameters else {}
        result = _ARITHMETIC[name](*map(_entries, operands), **parameters)
        results = result if equation.primitive.multiple_results else [result]
        return [np.asarray(x, object) for x in results]
    reason = _UNSUPPORTED.get(
        name, "it is not elementwise arithmetic, a sum, or a move of entries"
    )
    raise InputError(f"`trace` cannot translate the JAX primitive `{name}`: {reason}.")


def _known(constant: object) -> np.ndarray:
    if isinstance(constant, Tracer):
        raise InputError(
            "`trace`: the function closes over a value that JAX is tracing: pass it "
            "as an input."
        )
    return np.asarray(constant)


def _run(
    jaxpr: Jaxpr, constants: list, arguments: list[np.ndarray]
) -> list[np.ndarray]:
    names = [*jaxpr.constvars, *jaxpr.invars]
    values = dict(zip(names, [*map(_known, constants), *arguments], strict=True))

    def read(name) -> np.ndarray:
        return np.asarray(name.val) if isinstance(name, Literal) else values[name]

    for equation in jaxpr.eqns:
        primitive = equation.primitive.name
        operands = [read(name) for name in equation.invars]
        keys = ("jaxpr", "call_jaxpr", "fun_jaxpr")
        inner = next((equation.params[k] for k in keys if k in equation.params), None)
        symbolic = any(_is_symbolic(x) for x in operands)
        if inner is not None and primitive not in _UNSUPPORTED:
            closed = isinstance(inner, ClosedJaxpr)
            results = _run(
                inner.jaxpr if closed else inner,
                inner.consts if closed else [],
                operands,
            )
        elif primitive in _MOVEMENTS:
            results = _MOVEMENTS[primitive](*operands, **equation.params)
            results = results if equation.primitive.multiple_results else [results]
        elif primitive == "convert_element_type":
            results = [_convert(operands[0], np.dtype(equation.params["new_dtype"]))]
        elif symbolic:
            results = _translate(equation, operands)
        else:
            results = _on_numbers(equation, *operands)
        dtype = object if symbolic else None
        values.update(
            (name, np.asarray(x, dtype))
            for name, x in zip(equation.outvars, results, strict=True)
        )
    return [read(name) for name in jaxpr.outvars]


def trace(function: Callable, *inputs: tuple[int, ...] | np.ndarray) -> Program:
    """Translate a function of a few arrays into a scalar program.

    The function is ordinary JAX: arithmetic, elementwise functions, `jnp.where` and
    comparisons, sums, matrix products, and movements of entries; also `jvp`, `jacfwd`,
    `vjp` and `linear_transpose` of these. Loops are Python loops, which the trace
    unrolls. Constants are folded and equal expressions are merged.

    The trace is in float64, whatever the precision of the process. Folding `0 x` to 0
    hides a NaN in x: check inputs beforehand.

    Args:
        function: Function of one array for each input; returns any PyTree of arrays.
        inputs: Shape of each argument, or an object array that mixes `FREE` entries
            with numbers; the numbers become constants of the program.
    """
    graph = Graph()
    arguments = []
    for number, given in enumerate(inputs):
        template = (
            np.full(given, FREE, object)
            if isinstance(given, tuple)
            else np.asarray(given)
        )
        entries = np.empty(template.shape, object)
        for position, value in enumerate(template.ravel()):
            free = (
                graph.node(Operation.INPUT, number, position)
                if value is FREE
                else float(value)
            )
            entries.flat[position] = free
        arguments.append(entries)
    with double_precision():
        avals = [jax.ShapeDtypeStruct(x.shape, np.float64) for x in arguments]
        jaxpr, result = jax.make_jaxpr(function, return_shape=True)(*avals)
        leaves = _run(jaxpr.jaxpr, jaxpr.consts, arguments)
    outputs = [scalar.as_number(e) for x in leaves for e in _entries(x).ravel()]
    shapes = tuple(x.shape for x in arguments)
    structure = jax.tree.structure(result)
    return assemble(shapes, outputs, tuple(np.shape(x) for x in leaves), structure)
