"""Translation of a JAX function into a scalar program.

The jaxpr of the function runs on arrays whose entries are scalars of a graph.
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
from .program import Program, Shape, assemble
from .scalar import Graph, Operation

Arrays = list[np.ndarray]
"""Operands or results of an equation, in order."""
FREE = object()
"""Mark of the entries of an input that vary; numbers beside it become constants.

`np.where(offset != 0, FREE, offset)` is an input whose zeros are known.
"""

_REASONS_FOR_REFUSAL = {
    "while": "a program has no loops, so write a loop of known length in Python",
    "cond": "a program has no branches, so choose between values with `jnp.where`",
    "sort": "the order would depend on the values",
    "reduce_max": "use `jnp.maximum` of two entries at a time",
    "reduce_min": "use `jnp.minimum` of two entries at a time",
    "cumsum": "add the entries one after the other",
}


def _is_symbolic(x: np.ndarray):
    """Return whether an array holds scalars of a trace."""
    return x.dtype == object


def _broadcast(x: np.ndarray, *_, shape, broadcast_dimensions, **__):
    """Put the axes of an array at some positions, and repeat it along the others."""
    own_shape = [1] * len(shape)
    for source, target in enumerate(broadcast_dimensions):
        own_shape[target] = x.shape[source]
    return np.broadcast_to(x.reshape(own_shape), shape)


def _slice(x: np.ndarray, *, start_indices, limit_indices, strides):
    """Cut a part out of an array."""
    steps = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, steps))]


def _pad(x: np.ndarray, filler: np.ndarray, *, padding_config):
    """Pad each axis before, behind and between its entries; negative padding cuts."""
    for axis, (front_padding, rear_padding, gaps) in enumerate(padding_config):
        x = np.moveaxis(x, axis, 0)
        entries = len(x)
        gaps_between = (entries - 1) * gaps
        start = max(front_padding, 0)
        stop = start + max(entries + gaps_between, 0)
        size = stop + max(rear_padding, 0)
        result = np.full((size, *x.shape[1:]), filler, x.dtype)
        result[start : stop : gaps + 1] = x
        # Negative padding cuts entries off.
        begin = max(-front_padding, 0)
        end = size - max(-rear_padding, 0)
        remaining_entries = result[begin:end]
        x = np.moveaxis(remaining_entries, 0, axis)
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

_NUMPY_FUNCTIONS: dict[str, Callable] = {
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

_CARRIER_POSITIONS = {
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
    "scatter_add": (0, 2),
}
"""Positions of the operands that hold entries; the others hold indices."""


def _on_numbers(equation: JaxprEqn, *operands: np.ndarray):
    """Evaluate one equation for numbers, in NumPy if it has the same primitive."""
    name = equation.primitive.name
    parameters = equation.params
    if name == "iota":
        indices = np.indices(parameters["shape"], parameters["dtype"])
        return [indices[parameters["dimension"]]]
    # NumPy divides whole numbers in another way than JAX.
    is_exact = name != "div" or operands[0].dtype == np.float64
    if name in _NUMPY_FUNCTIONS and is_exact and len(operands) <= 3:
        dtype = getattr(equation.outvars[0].aval, "dtype", None)
        with np.errstate(all="ignore"):
            result = _NUMPY_FUNCTIONS[name](*operands)
        return [np.asarray(result, dtype)]
    with jax.ensure_compile_time_eval():
        # A JAX array keeps its precision; a NumPy array takes that of the process.
        arrays = [jax.numpy.asarray(x, x.dtype) for x in operands]
        results = equation.primitive.bind(*arrays, **parameters)
        return [np.asarray(x) for x in _as_list(equation, results)]


def _as_list(equation: JaxprEqn, results: Any):
    """Return the results of an equation as a list."""
    return list(results) if equation.primitive.multiple_results else [results]


def _move_by_index(equation: JaxprEqn, carriers: tuple[int, ...], operands: Arrays):
    """Move entries to the places that the indices among the operands give."""
    entries = []
    labels = list(operands)
    start = 0
    for k in carriers:
        x = operands[k]
        stop = start + x.size
        numbers = np.arange(start, stop, dtype=float)
        entries.append(_entries(x).ravel())
        labels[k] = numbers.reshape(x.shape)
        start = stop
    # JAX moves the labels; the entries follow them.
    (positions,) = _on_numbers(equation, *labels)
    is_inside = (positions >= 0) & (positions < start)
    if not is_inside.all():
        raise InputError(
            "`trace` met an index outside of its array "
            f"in `{equation.primitive}`: correct it."
        )
    return np.concatenate(entries)[positions.astype(int)]


def _scatter_add(equation: JaxprEqn, operands: Arrays):
    """Add entries at constant places, as the transpose of a gather does."""
    target, indices, updates = operands
    total = target.astype(object).copy()
    zeros = np.zeros(target.shape)
    for k, update in enumerate(updates.astype(object).ravel()):
        # Where JAX adds a one, the update is added.
        mark = np.zeros(updates.shape)
        mark.flat[k] = 1
        (marks,) = _on_numbers(equation, zeros, indices, mark)
        for place in map(tuple, np.argwhere(marks)):
            total[place] = _add(total[place], update)
    return total


def _each(function: Callable, operands: int) -> np.ufunc:
    """Return a function of scalars as one of arrays of them."""
    return np.frompyfunc(function, operands, 1)


def _operation(operation: Operation) -> np.ufunc:
    """Return an operation on arrays of scalars."""
    return _each(lambda *x: scalar.apply(operation, *x), operation.numpy.nin)


_add = _each(scalar.add, 2)
_subtract = _each(lambda x, y: scalar.add(x, scalar.negate(y)), 2)
_multiply = _each(scalar.multiply, 2)
_divide = _each(scalar.divide, 2)
_negate = _each(scalar.negate, 1)
_maximum = _operation(Operation.MAXIMUM)
_minimum = _operation(Operation.MINIMUM)
_select = _each(scalar.select, 3)
_square_root = _operation(Operation.SQUARE_ROOT)
_exponential = _operation(Operation.EXPONENTIAL)


def _reduce(function: np.ufunc, x: np.ndarray, axes: Sequence, initial: float):
    """Combine the entries along some axes."""
    for axis in sorted(axes, reverse=True):
        x = function.reduce(x, axis=axis, initial=initial)
    return x


def _dot_general(x: np.ndarray, y: np.ndarray, *, dimension_numbers, **_):
    """Multiply arrays, and add the products along their contracted axes."""
    contracted_axes, batch_axes = dimension_numbers
    x, rows = _as_matrices(x, contracted_axes[0], batch_axes[0])
    y, columns = _as_matrices(y, contracted_axes[1], batch_axes[1])
    x_rows = x[..., :, None, :]
    y_columns = y[..., None, :, :]
    products = _multiply(x_rows, y_columns)
    sums = _add.reduce(products, axis=-1, initial=0.0)
    shape = (*x.shape[:-2], *rows, *columns)
    return np.asarray(sums, object).reshape(shape)


def _as_matrices(x: np.ndarray, contracted: Sequence[int], batch: Sequence[int]):
    """Return an array as [*batch, others, contracted], and its other axes."""
    # Axes in the order of `dot_general`'s result.
    other_axes = [k for k in range(x.ndim) if k not in (*contracted, *batch)]
    shape = tuple(x.shape[k] for k in other_axes)
    sorted_array = x.transpose((*batch, *other_axes, *contracted))
    terms = math.prod(x.shape[k] for k in contracted)
    batch_shape = sorted_array.shape[: len(batch)]
    return sorted_array.reshape(*batch_shape, math.prod(shape), terms), shape


def _polynomial(x: np.ndarray, *coefficients: np.ndarray, **_):
    """Evaluate a polynomial whose constant comes first, by Horner's scheme."""
    total, *remaining_coefficients = reversed(coefficients)
    for coefficient in remaining_coefficients:
        total = _add(_multiply(total, x), coefficient)
    return total


def _logistic(x: np.ndarray):
    """Return 1 / (1 + exp(-x))."""
    return _divide(1.0, _add(1.0, _exponential(_negate(x))))


def _integer_power(x: np.ndarray, *, y: int):
    """Return a whole power of each entry; of an array without axes, a scalar."""
    return _each(lambda entry: scalar.integer_power(entry, y), 1)(x)


def _select_n(which: np.ndarray, *cases: np.ndarray):
    """Choose between arrays, entry by entry."""
    if not _is_symbolic(which):
        numbers = np.broadcast_to(which, cases[0].shape).astype(int)
        return np.choose(numbers, cases)
    return np.asarray(_select(which, cases[1], cases[0]), object)


_COMPARISONS = (
    Operation.LESS,
    Operation.LESS_EQUAL,
    Operation.EQUAL,
    Operation.NOT_EQUAL,
)
_ELEMENTARY_OPERATIONS = [
    *(operation for operation in Operation if "function" in operation.traits),
    *_COMPARISONS,
    Operation.ABSOLUTE,
    Operation.SIGN,
]
_LOGIC = (Operation.AND, Operation.OR, Operation.NOT)
_ARITHMETIC: dict[str, Callable] = {
    **{o.value: _operation(o) for o in _ELEMENTARY_OPERATIONS},
    **{o.value: _each(functools.partial(scalar.logic, o), o.numpy.nin) for o in _LOGIC},
    "add": _add,
    "add_any": _add,
    "sub": _subtract,
    "mul": _multiply,
    "neg": _negate,
    "square": lambda x: _multiply(x, x),
    "one_minus_square": lambda x: _multiply(_add(1.0, x), _subtract(1.0, x)),
    "polynomial": _polynomial,
    "div": _divide,
    "rsqrt": lambda x: _divide(1.0, _square_root(x)),
    "pow": _each(scalar.power, 2),
    "integer_pow": _integer_power,
    "logistic": _logistic,
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
_PRIMITIVES_WITH_PARAMETERS = (
    "integer_pow",
    "dot_general",
    "reduce_sum",
    "reduce_prod",
)
"""Primitives whose parameters decide about the result."""


def _convert(x: np.ndarray, dtype: np.dtype):
    """Convert an array to another type."""
    if not _is_symbolic(x):
        return x.astype(dtype)
    if dtype.kind == "b":
        to_truth_values = _each(scalar.as_truth, 1)
        return np.asarray(to_truth_values(x), object)
    holds_truth_values = all(scalar.is_truth(entry) for entry in x.flat)
    if holds_truth_values or np.issubdtype(dtype, np.floating):
        to_numbers = _each(scalar.as_number, 1)
        return np.asarray(to_numbers(x), object)
    raise InputError(
        f"`trace` cannot translate a conversion to {dtype}: "
        "a program computes with real numbers."
    )


def _entries(x: np.ndarray):
    """Return an array of scalars, or of Python's own numbers, which mix with them."""
    if _is_symbolic(x) or x.dtype == bool:
        return x.astype(object)
    return x.astype(np.float64).astype(object)


def _translate(equation: JaxprEqn, operands: Arrays):
    """Run one equation on arrays of which at least one is symbolic."""
    name = equation.primitive.name
    if name in _CARRIER_POSITIONS:
        carriers = _CARRIER_POSITIONS[name]
        indices = [x for k, x in enumerate(operands) if k not in carriers]
        if any(map(_is_symbolic, indices)):
            raise InputError(
                f"`trace` cannot translate `{name}` "
                "with a variable index: use constant integers."
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
        parameters = equation.params if name in _PRIMITIVES_WITH_PARAMETERS else {}
        results = _ARITHMETIC[name](*map(_entries, operands), **parameters)
        return [np.asarray(x, object) for x in _as_list(equation, results)]
    reason = _REASONS_FOR_REFUSAL.get(
        name, "it is not elementwise arithmetic, a sum, or a move of entries"
    )
    raise InputError(f"`trace` cannot translate the JAX primitive `{name}`: {reason}.")


def _as_constant(constant: object):
    """Return a constant of a traced function in NumPy."""
    if isinstance(constant, Tracer):
        raise InputError(
            "`trace`: the function closes over a value "
            "that JAX is tracing: pass it as an input."
        )
    return np.asarray(constant)


def _run(
    graph: Graph, label: str, jaxpr: Jaxpr, constants: list, arguments: Arrays
) -> Arrays:
    """Run a jaxpr on arrays of scalars or numbers, one equation after the other.

    New scalars get the label, or the `jax.named_scope` of their equation.
    """
    values: dict[Any, np.ndarray] = {}
    for name, constant in zip(jaxpr.constvars, constants, strict=True):
        values[name] = _as_constant(constant)
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(name):
        return np.asarray(name.val) if isinstance(name, Literal) else values[name]

    for equation in jaxpr.eqns:
        operands = [read(name) for name in equation.invars]
        graph.label = label or str(equation.source_info.name_stack)
        results = _run_equation(graph, equation, operands)
        # Entries of a symbolic array may all have become numbers; it stays symbolic.
        dtype = object if any(map(_is_symbolic, operands)) else None
        for name, result in zip(equation.outvars, results, strict=True):
            values[name] = np.asarray(result, dtype)
    return [read(name) for name in jaxpr.outvars]


def _unroll(graph: Graph, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Run a loop of known length, turn by turn."""
    parameters = equation.params
    turn = parameters["jaxpr"]
    constants = parameters["num_consts"]
    carries = constants + parameters["num_carry"]
    carry = operands[constants:carries]
    turns = range(parameters["length"])
    rows: list[Arrays] = []
    for k in reversed(turns) if parameters["reverse"] else turns:
        slices = [np.asarray(x[k]) for x in operands[carries:]]
        arguments = [*operands[:constants], *carry, *slices]
        results = _run(graph, graph.label, turn.jaxpr, turn.consts, arguments)
        carry = results[: parameters["num_carry"]]
        rows.append(results[parameters["num_carry"] :])
    if parameters["reverse"]:
        rows.reverse()
    stacks = [np.stack(entries) for entries in zip(*rows, strict=True)]
    return [*carry, *stacks]


def _run_equation(graph: Graph, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Run one equation: a call of another jaxpr, a move of entries, or arithmetic."""
    name = equation.primitive.name
    if name == "scan":
        return _unroll(graph, equation, operands)
    jaxpr = _called_jaxpr(equation)
    if jaxpr is not None:
        if isinstance(jaxpr, ClosedJaxpr):
            return _run(graph, graph.label, jaxpr.jaxpr, jaxpr.consts, operands)
        return _run(graph, graph.label, jaxpr, [], operands)
    if name in _MOVEMENTS:
        return _as_list(equation, _MOVEMENTS[name](*operands, **equation.params))
    if name == "convert_element_type":
        return [_convert(operands[0], np.dtype(equation.params["new_dtype"]))]
    if any(map(_is_symbolic, operands)):
        return _translate(equation, operands)
    return _on_numbers(equation, *operands)


def _called_jaxpr(equation: JaxprEqn):
    """Return the jaxpr that an equation calls, else None."""
    if equation.primitive.name in _REASONS_FOR_REFUSAL:
        return None
    keys = ("jaxpr", "call_jaxpr", "fun_jaxpr")
    return next((equation.params[k] for k in keys if k in equation.params), None)


def trace(function: Callable, *inputs: Shape | np.ndarray) -> Program:
    """Translate a function of a few arrays into a scalar program.

    The function is ordinary JAX: arithmetic, elementwise functions, `jnp.where` and
    comparisons, sums, matrix products, and movements of entries; also `jvp`, `jacfwd`,
    `vjp` and `linear_transpose` of these. Loops of known length are unrolled. Constants
    are folded and equal expressions are merged.

    The trace is in float64, whatever the precision of the process. Folding `0 x` to 0
    hides a NaN in x: check inputs beforehand.

    Args:
        function: Function of one array for each input; returns any PyTree of arrays.
        inputs: Shape of each argument, or an object array that mixes `FREE` entries
            with numbers; the numbers become constants of the program.
    """
    graph = Graph()
    arguments = [_argument(graph, k, x) for k, x in enumerate(inputs)]
    input_shapes = tuple(x.shape for x in arguments)
    with double_precision():
        avals = [jax.ShapeDtypeStruct(shape, np.float64) for shape in input_shapes]
        make_jaxpr = jax.make_jaxpr(function, return_shape=True)
        jaxpr, result = make_jaxpr(*avals)
        leaves = _run(graph, "", jaxpr.jaxpr, jaxpr.consts, arguments)

    outputs = []
    for leaf in leaves:
        entries = _entries(leaf).ravel()
        outputs += map(scalar.as_number, entries)
    output_shapes = tuple(np.shape(x) for x in leaves)
    structure = jax.tree.structure(result)
    return assemble(input_shapes, outputs, output_shapes, structure)


def _argument(graph: Graph, number: int, description: Shape | np.ndarray):
    """Return an input of the function as an array of scalars and numbers."""
    if isinstance(description, tuple):
        description = np.full(description, FREE, object)
    description = np.asarray(description)
    entries = np.empty(description.shape, object)
    for position, value in enumerate(description.ravel()):
        if value is FREE:
            entries.flat[position] = graph.node(Operation.INPUT, number, position)
        else:
            entries.flat[position] = float(value)
    return entries
