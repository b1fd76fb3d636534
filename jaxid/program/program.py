"""A scalar program: a sequence of scalar operations, and its results."""

import dataclasses
import functools
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import Indices, Texts
from jaxid.errors import InputError

from .scalar import Graph, Operand, Operation, Scalar, live_scalars

Shape = tuple[int, ...]
"""Shape of an array."""
Shapes = tuple[Shape, ...]
"""Shapes of arrays, in order."""
Reference = int | float
"""An operand or a result: the position of a node (int) or a constant (float)."""


class Node(NamedTuple):
    """An operation; the operands of an `INPUT` are its number and entry."""

    operation: Operation
    operands: tuple[Reference, ...]

    @property
    def uses(self) -> Indices:
        """Positions of the nodes that are operands."""
        if self.operation is Operation.INPUT:
            return ()
        return tuple(x for x in self.operands if isinstance(x, int))

    @property
    def place(self) -> tuple[int, int]:
        """Number of the input and position of the entry, for an `INPUT`."""
        number, entry = self.operands
        return int(number), int(entry)


class OperationCounts(NamedTuple):
    """Numbers of operations of a program."""

    multiplications: int  # multiplications
    additions: int  # additions and subtractions
    divisions: int  # divisions
    functions: int  # calls of sin, cos, sqrt, tanh and similar functions
    selections: int  # comparisons, choices, absolute values and signs
    negations: int  # changes of sign

    @property
    def total(self) -> int:
        """Number of operations except negations, which cost nothing inside a sum."""
        return sum(self) - self.negations

    def __str__(self):
        return ", ".join(f"{number} {name}" for name, number in self._asdict().items())


@dataclass(frozen=True, eq=False)
class Program:
    """A function as a sequence of scalar operations; made by `trace`.

    Equality and hash are by identity, so that a program can be static metadata under
    `jit`.
    """

    # shapes of the inputs, without batch axes
    input_shapes: Shapes
    # operations; each one reads only nodes before it
    nodes: tuple[Node, ...] = field(repr=False)
    # packed result: for each entry of each output, in order, a node or a constant
    outputs: tuple[Reference, ...] = field(repr=False)
    # shapes of the outputs, without batch axes
    output_shapes: Shapes
    structure: Any = field(repr=False)  # tree structure of the function's result
    # for each node the `jax.named_scope` of the function in which it was made
    labels: Texts = field(default=(), repr=False)
    # the same program as loops over its equal parts (`Loops`), or None
    loops: Any = field(default=None, repr=False)

    @functools.cached_property
    def counts(self) -> OperationCounts:
        """Numbers of operations of the program."""
        operations = Counter(node.operation for node in self.nodes)

        def count(*traits):
            members = [x for x in operations if x.traits.intersection(traits)]
            return sum(operations[x] for x in members)

        return OperationCounts(
            multiplications=operations[Operation.MULTIPLY],
            additions=operations[Operation.ADD] + operations[Operation.SUBTRACT],
            negations=operations[Operation.NEGATE],
            divisions=operations[Operation.DIVIDE],
            functions=count("function"),
            selections=count("truth", "choice"),
        )

    @functools.cached_property
    def uses(self) -> Indices:
        """Number of nodes and outputs that read each node."""
        counts = Counter(x for x in self.outputs if isinstance(x, int))
        for node in self.nodes:
            counts.update(node.uses)
        return tuple(counts[k] for k in range(len(self.nodes)))

    @functools.cached_property
    def distinct(self) -> tuple[Indices, np.ndarray]:
        """Nodes of the packed result, and for each entry its number, or -1."""
        nodes = dict.fromkeys(x for x in self.outputs if isinstance(x, int))
        numbers = {node: number for number, node in enumerate(nodes)}
        entries = [numbers[x] if isinstance(x, int) else -1 for x in self.outputs]
        return tuple(nodes), np.array(entries, int)

    def pack(self, distinct: Sequence[Any]) -> list[Any]:
        """Return the packed result from its distinct values; constants are floats."""
        pairs = zip(self.distinct[1].tolist(), self.outputs, strict=True)
        return [distinct[k] if k >= 0 else constant for k, constant in pairs]

    @functools.cached_property
    def nonzeros(self) -> Any:
        """Boolean outputs, False where an entry is always 0."""
        nonzeros = [isinstance(x, int) or x != 0.0 for x in self.outputs]
        return self.unpack(np.array(nonzeros, bool))

    def split(self, packed: Any) -> list[Any]:
        """Split values of the packed entries into those of each output."""
        sizes = [math.prod(shape) for shape in self.output_shapes]
        ends = np.cumsum([0, *sizes])
        return [packed[start:end] for start, end in itertools.pairwise(ends)]

    def align(self, arrays: Sequence[Any], xp: ModuleType) -> tuple[list[Any], Shape]:
        """Return the inputs as [entries, *batch], and the batch's shape."""
        count = len(self.input_shapes)
        if len(arrays) != count:
            raise InputError(
                f"The program takes {count} arrays, but got {len(arrays)}."
            )
        batches = []
        pairs = zip(arrays, self.input_shapes, strict=True)
        for k, (x, shape) in enumerate(pairs):
            axes = len(shape)
            if x.shape[:axes] != shape:
                raise InputError(
                    f"Input {k} must have shape {shape}, "
                    f"but has {x.shape}: put the batch last."
                )
            batches.append(x.shape[axes:])
        batch = np.broadcast_shapes(*batches) if batches else ()

        entries = []
        for x, shape, axes in zip(arrays, self.input_shapes, batches, strict=True):
            size = math.prod(shape)
            absent_axes = (1,) * (len(batch) - len(axes))
            rows = x.reshape(size, *absent_axes, *axes)
            entries.append(xp.broadcast_to(rows, (size, *batch)))
        return entries, batch

    def unpack(self, packed: Any) -> Any:
        """Return an array [entries, *batch] as the function returns it."""
        parts = zip(self.split(packed), self.output_shapes, strict=True)
        batch = packed.shape[1:]
        leaves = [entries.reshape((*shape, *batch)) for entries, shape in parts]
        return jax.tree.unflatten(self.structure, leaves)


def assemble(
    input_shapes: Shapes,
    outputs: Sequence[Operand],
    output_shapes: Shapes,
    structure: Any,
) -> Program:
    """Make a program of the part of a graph that the outputs need."""
    scalars = live_scalars(outputs)
    place = {scalar.index: k for k, scalar in enumerate(scalars)}

    def reference(x):
        return place[x.index] if isinstance(x, Scalar) else float(x)

    nodes = []
    for scalar in scalars:
        # The operands of an input are its number and entry.
        operands = scalar.operands
        if scalar.operation is not Operation.INPUT:
            operands = tuple(map(reference, operands))
        nodes.append(Node(scalar.operation, operands))
    results = tuple(map(reference, outputs))
    labels = tuple(scalar.label for scalar in scalars)
    return Program(
        input_shapes, tuple(nodes), results, output_shapes, structure, labels
    )


def record(program: Program, graph: Graph) -> list[Scalar]:
    """Write the nodes of a program into a graph; return the scalar of each."""
    scalars: list[Scalar] = []
    for node in program.nodes:
        operands: list[Any] = list(node.operands)
        if node.operation is not Operation.INPUT:
            operands = [scalars[x] if isinstance(x, int) else x for x in operands]
        scalars.append(graph.node(node.operation, *operands))
    return scalars


def select_outputs(program: Program, entries: np.ndarray) -> Program:
    """Return a program that computes only some results of a program."""
    scalars = record(program, Graph())
    references = [program.outputs[k] for k in entries.ravel()]
    outputs = [scalars[x] if isinstance(x, int) else x for x in references]
    selection = assemble(
        program.input_shapes, outputs, (entries.shape,), jax.tree.structure(0)
    )
    if program.loops is None:
        return selection
    rows = program.loops.results[entries.ravel()]
    loops = program.loops._replace(results=rows)
    return dataclasses.replace(selection, loops=loops)
