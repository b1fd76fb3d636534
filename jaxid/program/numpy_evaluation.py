"""A scalar program without a compiler: on NumPy arrays, or on single floats.

NumPy is for few samples, and for decisions that must not depend on the precision in
which JAX runs; it computes in float64. Floats are for a loop in which each sample needs
the one before, such as a
simulation: NumPy would pay its overhead for every operation and XLA take seconds to
    compile,
whereas Python runs a program of a thousand operations in some thirty microseconds at
once.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray

from .program import Program, Reference
from .scalar import Operation

_BLOCK = 2048
"""Samples at a time, so that intermediate values stay in the processor's cache."""


_Plan = tuple[tuple[tuple[int, int, int], ...], Callable[[list[np.ndarray]], None], int]
"""Cell, input's number and entry's position for each entry that is read; function that does all
operations on the cells; number of cells. Those of the results come first, others are
reused."""


def evaluate(program: Program, *arrays: AnyArray) -> Any:
    """Compute the outputs of a program, in the structure of the traced function, in NumPy."""
    rows, batch = _evaluate(program, arrays)
    entries = packed_entries(program, rows, np.arange(len(program.outputs)))
    return program.unpack(entries.reshape(len(entries), *batch))


def evaluate_rows(program: Program, *arrays: AnyArray) -> np.ndarray:
    """Compute the distinct results of a program that vary, in NumPy: [results, samples]."""
    return _evaluate(program, arrays)[0]


def packed_entries(
    program: Program, rows: np.ndarray, entries: np.ndarray
) -> np.ndarray:
    """Return some entries of the packed result [entries, samples] from its distinct values."""
    found, number = (
        np.empty((len(entries), rows.shape[1])),
        program.distinct[1][entries],
    )
    varies = number >= 0
    found[varies] = rows[number[varies]]
    constants = [program.outputs[k] for k in entries[~varies]]
    found[~varies] = np.array(constants, float)[:, None]
    return found


@functools.lru_cache(maxsize=64)
def _plan(program: Program) -> _Plan:
    results = {node: k for k, node in enumerate(program.distinct[0])}
    last_use = {
        k: position for position, node in enumerate(program.nodes) for k in node.uses
    }
    cell, idle, cells, loads = dict(results), [], len(results), []
    # Written as one function, since a loop over the operations takes as long as a short
    # operation.
    lines, scope, names = [], {"where": _select, "inf": np.inf, "nan": np.nan}, {}
    for position, node in enumerate(program.nodes):
        if position not in cell:
            if idle:
                cell[position] = idle.pop()
            else:
                cell[position], cells = cells, cells + 1
        own = f"c{cell[position]}"
        if node.operation is Operation.INPUT:
            number, entry = node.place
            loads.append((cell[position], number, entry))
            names[position] = own
            continue
        operands = ", ".join(
            names[x] if isinstance(x, int) else repr(x) for x in node.operands
        )
        function = node.operation.numpy.__name__
        scope.setdefault(function, node.operation.numpy)
        if "truth" in node.operation.traits:
            names[position] = f"t{position}"
            lines.append(f"t{position} = {function}({operands})")
        else:
            names[position] = own
            lines.append(f"{function}({operands}, out={own})")
        # Only now: no operation may overwrite an operand that it still reads.
        idle += [
            cell[k]
            for k in set(node.uses)
            if last_use[k] == position and k not in results
        ]
    unpack = "".join(f"c{k}, " for k in range(cells))
    body = "".join(f"    {line}\n" for line in lines)
    exec(f"def run(cells):\n    [{unpack}] = cells\n{body}", scope)
    return tuple(loads), scope["run"], cells


def _select(condition, if_true, if_false, out: np.ndarray) -> np.ndarray:
    np.copyto(out, if_false)
    np.copyto(out, if_true, where=condition)
    return out


def _evaluate(
    program: Program, arrays: tuple[AnyArray, ...]
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the distinct results that vary [results, samples], and the batch's shape."""
    loads, run, count = _plan(program)
    aligned, batch = program.align([np.asarray(x, np.float64) for x in arrays], np)
    samples = math.prod(batch)
    inputs = [x.reshape(len(x), samples) for x in aligned]
    table = np.empty((len(program.distinct[0]), samples))
    scratch = np.empty((count - len(table), min(samples, _BLOCK)))
    with np.errstate(all="ignore"):
        for start in range(0, samples, _BLOCK):
            block = slice(start, min(start + _BLOCK, samples))
            cells = [*table[:, block], *scratch[:, : block.stop - block.start]]
            for target, number, entry in loads:
                cells[target][:] = inputs[number][entry, block]
            run(cells)
    return table, batch


def to_python(program: Program) -> Callable[..., tuple[float, ...]]:
    """Make a function of lists of floats.

    It takes the entries of each input in C order, and returns the entries of all
    outputs, one after the other. Division by zero, and functions outside their domain,
    raise Python's own errors, where NumPy gives infinities and NaN.
    """
    formats = {
        Operation.NEGATE: "-{0}",
        Operation.NOT: "not {0}",
        Operation.SELECT: "{1} if {0} else {2}",
        Operation.MAXIMUM: "{0} if {0} > {1} or {0} != {0} else {1}",
        Operation.MINIMUM: "{0} if {0} < {1} or {0} != {0} else {1}",
        Operation.SIGN: "1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else {0}",
        Operation.POWER: "{0} ** {1}",
    }
    repeating = (Operation.MAXIMUM, Operation.MINIMUM, Operation.SIGN)
    repeated = {
        k for node in program.nodes if node.operation in repeating for k in node.uses
    }
    lines = [
        f"({''.join(f'x{k}_{entry}, ' for entry in range(math.prod(shape)))}) = x{k}"
        for k, shape in enumerate(program.input_shapes)
        if math.prod(shape)
    ]
    spelled: list[str] = []

    def spell(x: Reference) -> str:
        if isinstance(x, int):
            return spelled[x]
        # Python has no literals for infinities and NaN: `math` has their names.
        return f"({x!r})" if math.isfinite(x) else f"({'-' if x < 0 else ''}{abs(x)!s})"

    for position, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT:
            number, entry = node.place
            spelled.append(f"x{number}_{entry}")
            continue
        text = node.operation.spell([spell(x) for x in node.operands], formats)
        # A value that is needed once is written where it is needed, unless the line
        # gets long.
        if (
            program.uses[position] == 1
            and position not in repeated
            and len(text) <= 200
        ):
            spelled.append(f"({text})")
        else:
            lines.append(f"t{position} = {text}")
            spelled.append(f"t{position}")
    results = "".join(f"{spell(x)}, " for x in program.outputs)
    names = ", ".join(f"x{k}" for k in range(len(program.input_shapes)))
    body = "".join(f"    {line}\n" for line in lines)
    scope = {
        name: getattr(math, name) for name in dir(math) if not name.startswith("_")
    }
    exec(f"def run({names}):\n{body}    return ({results})\n", scope)
    return scope["run"]
