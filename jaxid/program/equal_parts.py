"""Equal parts of a long program, which are compiled once and run in loops.

The bodies of a robot have equal equations with different numbers. A function names its
parts by `jax.named_scope`: `motion_1`, `motion_2` and so on are turns of one loop.
Parts with the same operations become one short program, whose inputs are the numbers
and the values of each turn.
"""

import graphlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from .program import Node, Program, Reference
from .scalar import Operation

CIRCULAR_FUNCTIONS = (Operation.SINE, Operation.COSINE)
FIRST = "first"
"""Name of what all loops need, as sines and cosines."""
FINAL = "final"
"""Name of what needs the results of loops."""


class Part(NamedTuple):
    """Some nodes of a program; input 0 holds numbers, input 1 values that vary.

    Attributes:
        nodes: Nodes of the part.
        numbers: Positions of its numbers in the whole program.
        values: Positions of its values there.
        places: Positions in the part of its nodes, by those in the whole program.
    """

    nodes: tuple[Node, ...]
    numbers: list[int]
    values: list[int]
    places: dict[int, int]


class Loop(NamedTuple):
    """Parts of one kind, one after the other, on rows of values.

    Attributes:
        programs: Programs of the different parts.
        choices: Number of the program of each turn.
        numbers: Numbers of each turn, filled up with zeros.
        sources: Rows of the values of each turn, filled up with zeros.
        start: First row of the results.
        size: Number of rows of each turn.
    """

    programs: tuple[Program, ...]
    choices: np.ndarray
    numbers: np.ndarray
    sources: np.ndarray
    start: int
    size: int

    @property
    def stop(self) -> int:
        """Row behind the results."""
        return self.start + len(self.choices) * self.size


class Loops(NamedTuple):
    """A program as loops over its parts, on rows of values.

    The first rows are the entries of all inputs, in order.

    Attributes:
        loops: Loops in their order.
        constants: Constants of the packed result, whose rows follow those of the
            inputs.
        results: Row of each entry of the packed result.
    """

    loops: tuple[Loop, ...]
    constants: np.ndarray
    results: np.ndarray

    @property
    def repetition(self) -> float:
        """Operations of all turns, relative to those of the different parts."""
        run = 0
        compiled = 0
        for loop in self.loops:
            operations = np.array([part.counts.total for part in loop.programs])
            run += operations[loop.choices].sum()
            compiled += operations.sum()
        return run / compiled


def find_equal_parts(program: Program, numbers: np.ndarray) -> Loops | None:
    """Return a program as loops over its parts.

    Args:
        program: Program whose input 0 holds numbers that do not vary.
        numbers: These numbers.

    Returns:
        Loops whose inputs are the other inputs of the program; None if the parts need
        each other in another order.
    """
    constants = _constants(program, numbers)
    names = _names(program, constants)
    try:
        groups = list(_turns_of_loops(program, names))
    except graphlib.CycleError:
        return None
    shared_nodes = _shared_nodes(program, names)
    values = [constants.get(x) if isinstance(x, int) else x for x in program.outputs]
    constant_results = sorted({x for x in values if x is not None})
    inputs = sum(math.prod(shape) for shape in program.input_shapes[1:])
    rows = _input_rows(program)
    start = inputs + len(constant_results)
    loops = []
    for turns in groups:
        parts = [_part(program, positions, constants) for positions in turns]
        loop = _loop(parts, shared_nodes, constants, rows, start)
        if loop is None:
            return None
        loops.append(loop)
        start = loop.stop
    entries = []
    for reference, value in zip(program.outputs, values, strict=True):
        if value is None:
            entries.append(rows[reference])
        else:
            entries.append(inputs + constant_results.index(value))
    return Loops(tuple(loops), np.array(constant_results), np.array(entries, np.int32))


def _loop(
    parts: Sequence[Part],
    shared_nodes: set[int],
    constants: Mapping[int, float],
    rows: dict[int, int],
    start: int,
) -> Loop | None:
    """Return parts as a loop, and add the rows of their results to those of all nodes.

    None if a part needs a later one.
    """
    results = _results(parts, shared_nodes)
    size = max(map(len, results.values()))
    sources = []
    for turn, part in enumerate(parts):
        if not rows.keys() >= set(part.values):
            return None
        sources.append([rows[x] for x in part.values])
        first_row = start + turn * size
        places = results[part.nodes]
        for position, place in part.places.items():
            if place in places:
                rows[position] = first_row + places.index(place)
    programs = [_program(nodes, places) for nodes, places in results.items()]
    choices = [list(results).index(part.nodes) for part in parts]
    numbers = [[constants[x] for x in part.numbers] for part in parts]
    return Loop(
        tuple(programs),
        np.array(choices, np.int32),
        _filled_up(numbers, float),
        _filled_up(sources, np.int32),
        start,
        size,
    )


def _constants(program: Program, numbers: np.ndarray):
    """Return values of the nodes that depend on numbers only, by their positions."""
    constants: dict[int, float] = {}
    for position, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT:
            number, entry = node.place
            if number == 0:
                constants[position] = float(numbers[entry])
        elif all(x in constants for x in node.uses):
            operands = [
                constants[x] if isinstance(x, int) else x for x in node.operands
            ]
            constants[position] = node.operation.on_constants(*operands)
    return constants


def _input_rows(program: Program):
    """Return the rows of the nodes that are inputs, except numbers."""
    sizes = [math.prod(shape) for shape in program.input_shapes[1:]]
    starts = np.cumsum([0, *sizes])
    rows = {}
    for position, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT and node.place[0] > 0:
            number, entry = node.place
            rows[position] = int(starts[number - 1]) + entry
    return rows


def _names(program: Program, constants: Mapping[int, float]):
    """Return the name of the part of each node; inputs and constants have none.

    Other nodes without a part are in `FIRST` if parts need them, else in `FINAL`.
    """
    names: dict[int, str] = {}
    needed_nodes: set[int] = set()
    for position in reversed(range(len(program.nodes))):
        node = program.nodes[position]
        if node.operation is Operation.INPUT or position in constants:
            continue
        name = program.labels[position]
        # Sines and cosines of all coordinates are vectorised together.
        is_angle = all(x not in names and not program.nodes[x].uses for x in node.uses)
        if node.operation in CIRCULAR_FUNCTIONS and is_angle:
            name = ""
        if not name:
            name = FIRST if position in needed_nodes else FINAL
        if name != FINAL:
            needed_nodes.update(node.uses)
        names[position] = name
    return names


def _shared_nodes(program: Program, names: Mapping[int, str]):
    """Return the nodes that are results, or operands of another part."""
    shared_nodes = {x for x in program.outputs if isinstance(x, int)}
    for position, name in names.items():
        uses = program.nodes[position].uses
        shared_nodes.update(x for x in uses if names.get(x) != name)
    return shared_nodes


def _turns_of_loops(
    program: Program, names: Mapping[int, str]
) -> Iterator[list[list[int]]]:
    """Yield the nodes of each turn of each loop.

    Raises:
        graphlib.CycleError: If two loops need each other.
    """
    loops: dict[str, dict[str, list[int]]] = {}
    sorter = graphlib.TopologicalSorter()
    for position in sorted(names):
        name = names[position]
        kind = _kind(name)
        turns = loops.setdefault(kind, {})
        turns.setdefault(name, []).append(position)
        sorter.add(kind)
        for x in program.nodes[position].uses:
            if x in names and _kind(names[x]) != kind:
                sorter.add(kind, _kind(names[x]))
    for kind in sorter.static_order():
        yield list(loops[kind].values())


def _kind(name: str):
    """Return the name of a part without its numbers: that of its loop."""
    return re.sub(r"[\d_]", "", name)


def _part(
    program: Program, positions: Sequence[int], constants: Mapping[int, float]
) -> Part:
    """Return some nodes as a part."""
    part = Part((), [], [], {})
    nodes: list[Node] = []
    inputs: dict[int, int] = {}
    for position in positions:
        node = program.nodes[position]
        operands: list[Reference] = []
        for x in node.operands:
            if not isinstance(x, int):
                operands.append(x)
                continue
            if x not in part.places and x not in inputs:
                entries = part.numbers if x in constants else part.values
                number = 0 if x in constants else 1
                inputs[x] = len(nodes)
                nodes.append(Node(Operation.INPUT, (number, len(entries))))
                entries.append(x)
            operands.append(part.places.get(x, inputs.get(x, 0)))
        part.places[position] = len(nodes)
        nodes.append(Node(node.operation, tuple(operands)))
    return part._replace(nodes=tuple(nodes))


def _results(parts: Sequence[Part], shared_nodes: set[int]):
    """Return the nodes that any of some equal parts must hand on, by their nodes."""
    results: dict[tuple[Node, ...], list[int]] = {}
    for part in parts:
        places = results.setdefault(part.nodes, [])
        for position, place in part.places.items():
            if position in shared_nodes and place not in places:
                places.append(place)
    return results


def _program(nodes: tuple[Node, ...], results: Sequence[int]):
    """Return a part as a program."""
    counts = [0, 0]
    for node in nodes:
        if node.operation is Operation.INPUT:
            counts[node.place[0]] += 1
    shapes = tuple((count,) for count in counts)
    structure = jax.tree.structure(0)
    return Program(shapes, nodes, tuple(results), ((len(results),),), structure)


def _filled_up(rows: Sequence[Sequence[float]], dtype: type) -> np.ndarray:
    """Return lists of different lengths as one matrix."""
    matrix = np.zeros((len(rows), max(map(len, rows))), dtype)
    for row, entries in enumerate(rows):
        matrix[row, : len(entries)] = entries
    return matrix
