"""A scalar program without a compiler: on NumPy arrays, or on single floats.

NumPy is for few samples, and for decisions that must not depend on the precision in
which JAX runs; it computes in float64. Floats are for a loop in which each sample needs
the one before, such as a simulation: NumPy would pay its overhead for every operation
and XLA take seconds to compile, whereas Python runs a program of a thousand operations
in some thirty microseconds at once.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray

from .program import Node, Program, Reference
from .scalar import Operation

PYTHON_FORMATS = {
    Operation.NEGATE: "-{0}",
    Operation.NOT: "not {0}",
    Operation.SELECT: "{1} if {0} else {2}",
    Operation.MAXIMUM: "{0} if {0} > {1} or {0} != {0} else {1}",
    Operation.MINIMUM: "{0} if {0} < {1} or {0} != {0} else {1}",
    Operation.SIGN: "1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else {0}",
    Operation.POWER: "{0} ** {1}",
}
"""Operations that Python writes in its own way."""
MAX_LENGTH = 200
"""Number of characters up to which an expression is written within another one."""
BLOCK = 2048
"""Samples at a time, so that intermediate values stay in the processor's cache."""


class Plan(NamedTuple):
    """A program as one function on cells of memory, which nodes share."""

    loads: list[tuple[int, int, int]]  # cell, number of its input, and entry there
    run: Callable[[list[np.ndarray]], None]  # all operations, on the cells
    cells: int  # number of cells; those of the results come first


def evaluate(program: Program, *arrays: AnyArray) -> Any:
    """Compute the outputs of a program in NumPy, as the function returns them."""
    rows, batch = _evaluate(program, arrays)
    entries = packed_entries(program, rows, np.arange(len(program.outputs)))
    return program.unpack(entries.reshape(len(entries), *batch))


def evaluate_rows(program: Program, *arrays: AnyArray) -> np.ndarray:
    """Compute the distinct results that vary in NumPy: [results, samples]."""
    return _evaluate(program, arrays)[0]


def packed_entries(
    program: Program, rows: np.ndarray, entries: np.ndarray
) -> np.ndarray:
    """Return some entries [entries, samples] of the packed result."""
    numbers = program.distinct[1][entries]
    is_varying = numbers >= 0
    values = np.empty((len(entries), rows.shape[1]))
    values[is_varying] = rows[numbers[is_varying]]
    constants = [program.outputs[k] for k in entries[~is_varying]]
    values[~is_varying] = np.array(constants, float)[:, None]
    return values


@functools.lru_cache(maxsize=64)
def _plan(program: Program):
    """Write a program as one function, since a loop would cost as much."""
    program = _with_half_tangents(program)
    cells, count = _allocate_cells(program)
    loads = []
    lines = []
    names = {}
    scope = {"where": _select, "inf": np.inf, "nan": np.nan}
    for position, node in enumerate(program.nodes):
        cell = f"c{cells[position]}"
        names[position] = cell
        if node.operation is Operation.INPUT:
            loads.append((cells[position], *node.place))
            continue
        spellings = [names[x] if isinstance(x, int) else repr(x) for x in node.operands]
        operands = ", ".join(spellings)
        numpy_function = node.operation.numpy
        function = numpy_function.__name__
        scope.setdefault(function, numpy_function)
        if "truth" in node.operation.traits:
            names[position] = f"t{position}"
            lines.append(f"t{position} = {function}({operands})")
        else:
            lines.append(f"{function}({operands}, out={cell})")
    cell_names = "".join(f"c{k}, " for k in range(count))
    body = "".join(f"    {line}\n" for line in lines)
    exec(f"def run(cells):\n    [{cell_names}] = cells\n{body}", scope)
    return Plan(loads, scope["run"], count)


def _with_half_tangents(program: Program):
    """Return the program with sines and cosines from tangents of half the angles.

    NumPy's tangent takes an eighth of the time of its sine or cosine on processors with
    AVX-512, and as long elsewhere. The result errs by at most 2.5e-16 at any angle.
    """
    nodes: list[Node] = []
    references: list[int] = []  # places of the program's nodes
    half_tangents: dict[int, tuple[int, int, int]] = {}  # with square and divisor

    def place(operation: Operation, *operands: Reference) -> int:
        """Return the place of a new node."""
        nodes.append(Node(operation, operands))
        return len(nodes) - 1

    def reference(x: Reference) -> Reference:
        """Return an operand or a result of the program in the new one."""
        return references[x] if isinstance(x, int) else x

    for node in program.nodes:
        if node.operation not in (Operation.SINE, Operation.COSINE):
            is_input = node.operation is Operation.INPUT
            operands = node.operands if is_input else map(reference, node.operands)
            references.append(place(node.operation, *operands))
            continue
        (angle,) = node.uses
        if angle not in half_tangents:
            half_angle = place(Operation.MULTIPLY, 0.5, references[angle])
            tangent = place(Operation.TANGENT, half_angle)
            square = place(Operation.MULTIPLY, tangent, tangent)
            divisor = place(Operation.ADD, 1.0, square)
            half_tangents[angle] = tangent, square, divisor
        tangent, square, divisor = half_tangents[angle]
        if node.operation is Operation.SINE:
            numerator = place(Operation.ADD, tangent, tangent)
        else:
            numerator = place(Operation.SUBTRACT, 1.0, square)
        references.append(place(Operation.DIVIDE, numerator, divisor))
    outputs = tuple(map(reference, program.outputs))
    return dataclasses.replace(program, nodes=tuple(nodes), outputs=outputs, labels=())


def _allocate_cells(program: Program):
    """Return the cell of each node, and the number of cells; results keep theirs."""
    results = {node: k for k, node in enumerate(program.distinct[0])}
    last_use = {}
    for position, node in enumerate(program.nodes):
        for operand in node.uses:
            last_use[operand] = position

    cells = []
    idle_cells = []
    count = len(results)
    for position, node in enumerate(program.nodes):
        if position in results:
            cells.append(results[position])
        elif idle_cells:
            cells.append(idle_cells.pop())
        else:
            cells.append(count)
            count += 1
        # Only now: no operation may overwrite an operand that it still reads.
        for operand in set(node.uses):
            if last_use[operand] == position and operand not in results:
                idle_cells.append(cells[operand])
    return cells, count


def _select(condition, if_true, if_false, out: np.ndarray):
    """Choose like `np.where`, into an array that is there already."""
    np.copyto(out, if_false)
    np.copyto(out, if_true, where=condition)
    return out


def _evaluate(program: Program, arrays: tuple[AnyArray, ...]):
    """Return the results that vary [results, samples], and the batch."""
    plan = _plan(program)
    numbers = [np.asarray(x, np.float64) for x in arrays]
    aligned_arrays, batch = program.align(numbers, np)
    samples = math.prod(batch)
    inputs = [x.reshape(len(x), samples) for x in aligned_arrays]

    # Results are written in place; intermediate values need only rows of one block.
    count = len(program.distinct[0])
    results = np.empty((count, samples))
    scratch = np.empty((plan.cells - count, min(samples, BLOCK)))
    with np.errstate(all="ignore"):
        for start in range(0, samples, BLOCK):
            stop = min(start + BLOCK, samples)
            block = slice(start, stop)
            scratch_cells = scratch[:, : stop - start]
            cells = [*results[:, block], *scratch_cells]
            for cell, number, entry in plan.loads:
                row = inputs[number][entry]
                cells[cell][:] = row[block]
            plan.run(cells)
    return results, batch


def to_python(program: Program) -> Callable[..., tuple[float, ...]]:
    """Make a function of lists of floats.

    It takes the entries of each input in C order, and returns the entries of all
    outputs, one after the other. Division by zero, and functions outside their domain,
    raise Python's own errors, where NumPy gives infinities and NaN.
    """
    # The text of these operations repeats their operands: to write an operand's own
    # expression there would compute it twice.
    repeating_operations = (Operation.MAXIMUM, Operation.MINIMUM, Operation.SIGN)
    repeated_operands = set()
    for node in program.nodes:
        if node.operation in repeating_operations:
            repeated_operands.update(node.uses)

    # The first lines unpack the inputs.
    lines = []
    for k, shape in enumerate(program.input_shapes):
        size = math.prod(shape)
        entries = "".join(f"x{k}_{entry}, " for entry in range(size))
        if entries:
            lines.append(f"({entries}) = x{k}")

    texts: list[str] = []  # name or expression of each node
    for position, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT:
            number, entry = node.place
            texts.append(f"x{number}_{entry}")
            continue
        operands = [_spell(x, texts) for x in node.operands]
        text = node.operation.spell(operands, PYTHON_FORMATS)
        # A value that is needed once is written where it is needed, unless the line
        # gets long.
        is_read_once = program.uses[position] == 1
        is_read_once &= position not in repeated_operands
        if is_read_once and len(text) <= MAX_LENGTH:
            texts.append(f"({text})")
        else:
            lines.append(f"t{position} = {text}")
            texts.append(f"t{position}")

    results = "".join(f"{_spell(x, texts)}, " for x in program.outputs)
    inputs = range(len(program.input_shapes))
    names = ", ".join(f"x{k}" for k in inputs)
    body = "".join(f"    {line}\n" for line in lines)
    scope = {name: x for name, x in vars(math).items() if not name.startswith("_")}
    exec(f"def run({names}):\n{body}    return ({results})\n", scope)
    return scope["run"]


def _spell(x: Reference, nodes: list[str]):
    """Write an operand in Python, from the texts of the nodes before."""
    if isinstance(x, int):
        return nodes[x]
    if math.isfinite(x):
        return f"({x!r})"
    # Python has no literals for infinities and NaN: `math` has their names.
    sign = "-" if x < 0 else ""
    return f"({sign}{abs(x)})"
