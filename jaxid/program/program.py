"""A scalar program: a sequence of scalar operations without branches, and its results."""

import functools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.errors import InputError

from .scalar import Graph, Operand, Operation, Scalar, live_scalars, rewrite

Reference = int | float
"""An operand or a result: the position of a node (int) or a constant (float)."""


class Node(NamedTuple):
    """An operation; an `INPUT` has the input's number and the entry's position as operands."""

    operation: Operation
    operands: tuple[Reference, ...]

    @property
    def uses(self) -> tuple[int, ...]:
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

    input_shapes: tuple[
        tuple[int, ...], ...
    ]  # shapes of the inputs, without batch axes
    nodes: tuple[Node, ...] = field(
        repr=False
    )  # operations; each one reads only nodes before it
    # packed result: for each entry of each output, in order, a node or a constant
    outputs: tuple[Reference, ...] = field(repr=False)
    output_shapes: tuple[
        tuple[int, ...], ...
    ]  # shapes of the outputs, without batch axes
    structure: Any = field(repr=False)  # pyTree structure of the function's result

    @functools.cached_property
    def counts(self) -> OperationCounts:
        """Numbers of operations of the program."""
        operations = Counter(node.operation for node in self.nodes)

        def count(*traits: str) -> int:
            return sum(
                n for x, n in operations.items() if x.traits.intersection(traits)
            )

        return OperationCounts(
            multiplications=operations[Operation.MULTIPLY],
            additions=operations[Operation.ADD] + operations[Operation.SUBTRACT],
            negations=operations[Operation.NEGATE],
            divisions=operations[Operation.DIVIDE],
            functions=count("function"),
            selections=count("truth", "choice"),
        )

    @functools.cached_property
    def uses(self) -> tuple[int, ...]:
        """Number of nodes and outputs that read each node."""
        uses = [0] * len(self.nodes)
        for k in (k for node in self.nodes for k in node.uses):
            uses[k] += 1
        for x in self.outputs:
            if isinstance(x, int):
                uses[x] += 1
        return tuple(uses)

    @functools.cached_property
    def distinct(self) -> tuple[tuple[int, ...], np.ndarray]:
        """Nodes of the packed result, and for each entry the number of its node, or -1."""
        numbers: dict[int, int] = {}
        nodes = (x if isinstance(x, int) else None for x in self.outputs)
        entries = [
            -1 if x is None else numbers.setdefault(x, len(numbers)) for x in nodes
        ]
        return tuple(numbers), np.array(entries, int)

    def pack(self, distinct: Sequence[Any]) -> list[Any]:
        """Return the packed result from its distinct values; constants are floats."""
        pairs = zip(self.distinct[1].tolist(), self.outputs, strict=True)
        return [distinct[k] if k >= 0 else constant for k, constant in pairs]

    @functools.cached_property
    def nonzeros(self) -> Any:
        """Boolean arrays in the structure of the outputs, False where an entry is always 0."""
        varies = np.array(
            [not (isinstance(x, float) and x == 0) for x in self.outputs], bool
        )
        return self.unpack(varies)

    def split(self, packed: Any) -> list[Any]:
        """Split values of the packed entries into those of each output."""
        ends = np.cumsum([math.prod(shape) for shape in self.output_shapes], dtype=int)
        return [packed[a:b] for a, b in zip([0, *ends], ends, strict=False)]

    def align(
        self, arrays: Sequence[Any], xp: ModuleType
    ) -> tuple[list[Any], tuple[int, ...]]:
        """Return the inputs with their own axes merged and the batch behind; the batch's shape."""
        if len(arrays) != len(self.input_shapes):
            wanted = len(self.input_shapes)
            raise InputError(
                f"The program takes {wanted} arrays, but got {len(arrays)}."
            )
        batches = []
        for k, (x, expected) in enumerate(zip(arrays, self.input_shapes, strict=True)):
            if x.shape[: len(expected)] != expected:
                raise InputError(
                    f"Input {k} must have shape {expected}, but has {x.shape}: put "
                    "the batch last."
                )
            batches.append(x.shape[len(expected) :])
        batch = np.broadcast_shapes(*batches) if batches else ()
        entries = []
        for x, shape, own in zip(arrays, self.input_shapes, batches, strict=True):
            size, missing = math.prod(shape), (1,) * (len(batch) - len(own))
            entries.append(
                xp.broadcast_to(x.reshape(size, *missing, *own), (size, *batch))
            )
        return entries, batch

    def unpack(self, packed: Any) -> Any:
        """Return an array [entries, *batch] in the structure of the traced function's result."""
        parts = zip(self.split(packed), self.output_shapes, strict=True)
        leaves = [
            entries.reshape((*shape, *packed.shape[1:])) for entries, shape in parts
        ]
        return jax.tree.unflatten(self.structure, leaves)


def assemble(
    input_shapes: tuple[tuple[int, ...], ...],
    outputs: Sequence[Operand],
    output_shapes: tuple[tuple[int, ...], ...],
    structure: Any,
) -> Program:
    """Make a program of the part of a graph that the outputs need."""
    outputs = rewrite(outputs)
    scalars = live_scalars(outputs)
    place = {scalar.index: k for k, scalar in enumerate(scalars)}

    def reference(x: Operand) -> Reference:
        return place[x.index] if isinstance(x, Scalar) else float(x)

    nodes = tuple(
        Node(s.operation, s.operands)
        if s.operation is Operation.INPUT
        else Node(s.operation, tuple(map(reference, s.operands)))
        for s in scalars
    )
    return Program(
        input_shapes, nodes, tuple(map(reference, outputs)), output_shapes, structure
    )


def record(program: Program, graph: Graph) -> list[Scalar]:
    """Write the nodes of a program into a graph; return the scalar of each."""
    scalars: list[Scalar] = []
    for node in program.nodes:
        is_input = node.operation is Operation.INPUT
        known = (
            scalars[x] if isinstance(x, int) and not is_input else x
            for x in node.operands
        )
        scalars.append(graph.node(node.operation, *known))
    return scalars


def select_outputs(program: Program, entries: np.ndarray) -> Program:
    """Return a program that computes only some results of a program."""
    scalars = record(program, Graph())
    chosen = (program.outputs[k] for k in entries.ravel())
    outputs = [scalars[x] if isinstance(x, int) else x for x in chosen]
    return assemble(
        program.input_shapes, outputs, (entries.shape,), jax.tree.structure(0)
    )
