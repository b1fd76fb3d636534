"""A scalar program on NumPy arrays, always in float64.

For few samples, and for decisions that must not depend on the precision in which JAX runs.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.program.operation import NUMPY, TRUTH_VALUED, Operation
from jaxid.program.program import Program, Reference

_BLOCK = 1024
"""Samples at a time: the values that are alive at once then stay in the cache."""


def _select(condition, if_true, if_false, out: np.ndarray) -> np.ndarray:
    np.copyto(out, if_false)
    np.copyto(out, if_true, where=condition)
    return out


class _Step(NamedTuple):
    function: Callable
    operands: tuple[Reference, ...]
    result: int
    in_place: bool


class _Plan(NamedTuple):
    """Which cell holds which value: first the results' cells, then cells that are used again."""

    loads: tuple[tuple[int, int, int], ...]
    steps: tuple[_Step, ...]
    results: dict[int, int]
    cells: int


@functools.lru_cache(maxsize=64)
def _plan(program: Program) -> _Plan:
    results: dict[int, int] = {}
    for x in program.outputs:
        if isinstance(x, int):
            results.setdefault(x, len(results))
    last_use = {k: position for position, node in enumerate(program.nodes) for k in node.uses}
    cell, idle, cells, loads, steps = dict(results), [], len(results), [], []
    for position, node in enumerate(program.nodes):
        if position not in cell:
            if idle:
                cell[position] = idle.pop()
            else:
                cell[position], cells = cells, cells + 1
        if node.operation is Operation.INPUT:
            number, entry = node.place
            loads.append((cell[position], number, entry))
            continue
        operands = tuple(cell[x] if isinstance(x, int) else x for x in node.operands)
        function = _select if node.operation is Operation.SELECT else NUMPY[node.operation]
        in_place = node.operation not in TRUTH_VALUED
        steps.append(_Step(function, operands, cell[position], in_place))
        # Only now: no operation may write over an operand that it still reads.
        idle += [cell[k] for k in set(node.uses) if last_use[k] == position and k not in results]
    return _Plan(tuple(loads), tuple(steps), results, cells)


def evaluate(program: Program, *arrays: AnyArray) -> Any:
    """Computes the outputs of a program in NumPy.

    Args:
        program: Made by `trace`.
        arrays: For each input an array of the input's shape and any batch axes behind it.

    Returns:
        The outputs in the structure of the traced function, each with the batch axes last.

    Raises:
        InputError: If the arrays do not fit to the program's inputs.
    """
    plan = _plan(program)
    table, batch = _evaluate(program, plan, arrays)
    leaves, start = [], 0
    for shape in program.output_shapes:
        size = int(np.prod(shape, dtype=int))
        leaf = np.empty((size, table.shape[1]))
        for row, x in zip(leaf, program.outputs[start : start + size], strict=True):
            row[:] = table[plan.results[x]] if isinstance(x, int) else x
        leaves.append(leaf.reshape((*shape, *batch)))
        start += size
    return jax.tree.unflatten(program.structure, leaves)


def evaluate_packed(program: Program, *arrays: AnyArray) -> list[np.ndarray | float]:
    """Computes the packed result of a program in NumPy: constants stay numbers.

    Args:
        program: Made by `trace`.
        arrays: For each input an array of the input's shape and any batch axes behind it.

    Returns:
        For each entry of each output, in order, an array of the batch's shape, or
        the constant that the entry always is. Equal entries share one array.
    """
    plan = _plan(program)
    table, batch = _evaluate(program, plan, arrays)
    rows = [row.reshape(batch) for row in table]
    return [rows[plan.results[x]] if isinstance(x, int) else x for x in program.outputs]


def _evaluate(
    program: Program, plan: _Plan, arrays: tuple[AnyArray, ...]
) -> tuple[np.ndarray, tuple[int, ...]]:
    """One row for each distinct node among the outputs, and the batch's shape."""
    given = [np.asarray(x, np.float64) for x in arrays]
    batch = program.batch_shape([x.shape for x in given])
    samples = int(np.prod(batch, dtype=int))
    inputs = []
    for x, shape in zip(given, program.input_shapes, strict=True):
        own = x.shape[len(shape) :]
        aligned = x.reshape((*shape, *(1,) * (len(batch) - len(own)), *own))
        whole = np.broadcast_to(aligned, (*shape, *batch))
        inputs.append(whole.reshape(int(np.prod(shape, dtype=int)), samples))
    table = np.empty((len(plan.results), samples))
    scratch = np.empty((plan.cells - len(plan.results), min(samples, _BLOCK)))
    with np.errstate(all="ignore"):
        for start in range(0, samples, _BLOCK):
            block = slice(start, min(start + _BLOCK, samples))
            width = block.stop - block.start
            _run(plan, [x[:, block] for x in inputs], [*table[:, block], *scratch[:, :width]])
    return table, batch


def _run(plan: _Plan, inputs: list[np.ndarray], cells: list[np.ndarray]) -> None:
    values = list(cells)
    for target, number, entry in plan.loads:
        values[target][:] = inputs[number][entry]
    for function, operands, result, in_place in plan.steps:
        read = [values[x] if isinstance(x, int) else x for x in operands]
        if in_place:
            values[result] = function(*read, out=cells[result])
        else:
            values[result] = function(*read)
