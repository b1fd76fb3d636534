"""A scalar program: a straight line of scalar operations, and where its results go."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.errors import InputError
from jaxid.program.operation import COMPARISONS, FUNCTIONS, LOGIC, Operation
from jaxid.program.rewrite import live, rewrite
from jaxid.program.scalar import Graph, Operand, Scalar

Reference = int | float
"""An operand or a result: the position of a node (int) or a constant (float)."""


class Node(NamedTuple):
    """One operation. The operands of an `INPUT` are the input's number and the entry's position."""

    operation: Operation
    operands: tuple[Reference, ...]

    @property
    def uses(self) -> tuple[int, ...]:
        """Positions of the nodes that this one reads."""
        if self.operation is Operation.INPUT:
            return ()
        return tuple(x for x in self.operands if isinstance(x, int))

    @property
    def place(self) -> tuple[int, int]:
        """The input's number and the entry's position, of an `INPUT`."""
        number, entry = self.operands
        return int(number), int(entry)


@dataclass(frozen=True)
class OperationCounts:
    """How many operations of each kind a program does."""

    multiplications: int
    additions: int
    """Additions and subtractions."""
    negations: int
    divisions: int
    functions: int
    """Calls of sin, cos, sqrt, tanh and their kin."""
    selections: int
    """Comparisons, choices, absolute values and signs."""

    @property
    def total(self) -> int:
        """All operations except negations, which are free inside a sum."""
        return (
            self.multiplications
            + self.additions
            + self.divisions
            + self.functions
            + self.selections
        )

    def __str__(self):
        return (
            f"{self.multiplications} multiplications, {self.additions} additions, "
            f"{self.divisions} divisions, {self.functions} functions, "
            f"{self.selections} selections, {self.negations} negations"
        )


@dataclass(frozen=True, eq=False)
class Program:
    """A function as a straight line of scalar operations; made by `trace`.

    Equality and hash are by identity, so that a program can be static metadata under `jit`.
    """

    input_shapes: tuple[tuple[int, ...], ...]
    """The shapes of the inputs, without batch axes."""
    nodes: tuple[Node, ...] = field(repr=False)
    """The operations; each one reads only nodes that stand before it."""
    outputs: tuple[Reference, ...] = field(repr=False)
    """The packed result: for each entry of each output, in order, a node or a constant."""
    output_shapes: tuple[tuple[int, ...], ...]
    structure: Any = field(repr=False)
    """How the outputs stand in what the function returned."""

    @functools.cached_property
    def counts(self) -> OperationCounts:
        """How many operations of each kind the program does."""

        def count(*kinds: Operation) -> int:
            return sum(node.operation in kinds for node in self.nodes)

        return OperationCounts(
            multiplications=count(Operation.MULTIPLY),
            additions=count(Operation.ADD, Operation.SUBTRACT),
            negations=count(Operation.NEGATE),
            divisions=count(Operation.DIVIDE),
            functions=count(*FUNCTIONS),
            selections=count(
                *COMPARISONS,
                *LOGIC,
                Operation.SELECT,
                Operation.MAXIMUM,
                Operation.MINIMUM,
                Operation.ABSOLUTE,
                Operation.SIGN,
            ),
        )

    @property
    def nonzeros(self) -> Any:
        """Boolean arrays in the structure of the outputs: False where an entry is always 0."""
        return self.arrange([not (isinstance(x, float) and x == 0) for x in self.outputs], bool)

    def arrange(self, entries: Sequence, dtype: Any) -> Any:
        """One value for each packed entry, as NumPy arrays in the structure of the outputs."""
        leaves, start = [], 0
        for shape in self.output_shapes:
            size = int(np.prod(shape, dtype=int))
            leaves.append(np.array(entries[start : start + size], dtype).reshape(shape))
            start += size
        return jax.tree.unflatten(self.structure, leaves)

    def batch_shape(self, shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        """The trailing batch axes of arrays with these shapes, broadcast against each other.

        Raises:
            InputError: If the arrays are not as many as the inputs, or a shape does
                not begin with its input's.
        """
        if len(shapes) != len(self.input_shapes):
            raise InputError(
                f"The program takes {len(self.input_shapes)} arrays (of shapes "
                f"{', '.join(map(str, self.input_shapes))} and batch axes behind), "
                f"but got {len(shapes)}."
            )
        for k, (given, expected) in enumerate(zip(shapes, self.input_shapes, strict=True)):
            if given[: len(expected)] != expected:
                raise InputError(
                    f"Input {k} of the program must have shape {expected} with batch axes behind, "
                    f"but has shape {given}: put the batch last."
                )
        batches = [s[len(e) :] for s, e in zip(shapes, self.input_shapes, strict=True)]
        return np.broadcast_shapes(*batches) if batches else ()


def assemble(
    input_shapes: tuple[tuple[int, ...], ...],
    outputs: Sequence[Operand],
    output_shapes: tuple[tuple[int, ...], ...],
    structure: Any,
) -> Program:
    """Writes the live part of a graph as a program; what no output needs is left out."""
    outputs = rewrite(outputs)
    scalars = live(outputs)
    place = {scalar.index: k for k, scalar in enumerate(scalars)}

    def reference(x: Operand) -> Reference:
        return place[x.index] if isinstance(x, Scalar) else float(x)

    nodes = tuple(
        Node(s.operation, s.operands)
        if s.operation is Operation.INPUT
        else Node(s.operation, tuple(map(reference, s.operands)))
        for s in scalars
    )
    return Program(input_shapes, nodes, tuple(map(reference, outputs)), output_shapes, structure)


def chosen(program: Program, entries: np.ndarray) -> Program:
    """The program of some of a program's results: what they do not need is left out.

    Args:
        program: Of which some results are wanted.
        entries: Their positions in the packed result, in the shape of the new result.
    """
    graph = Graph()
    scalars: list[Scalar] = []

    def operand(x: Reference) -> Operand:
        return scalars[x] if isinstance(x, int) else x

    for node in program.nodes:
        is_input = node.operation is Operation.INPUT
        operands = node.operands if is_input else tuple(map(operand, node.operands))
        scalars.append(graph.node(node.operation, *operands))
    outputs = [operand(program.outputs[k]) for k in entries.ravel()]
    return assemble(program.input_shapes, outputs, (entries.shape,), jax.tree.structure(0))
