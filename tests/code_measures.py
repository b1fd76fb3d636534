"""Size and density of Python code, counted in the nodes of its syntax tree.

A node is an expression or a statement; imports and docstrings do not count. No line
break changes this size. Nodes a line say how much a reader must take in at once.
"""

import ast
import io
import tokenize
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

TRIVIA = {
    tokenize.COMMENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.INDENT,
    tokenize.NEWLINE,
    tokenize.NL,
}
MIN_FUNCTION_LINES = 8
"""Lines of a function from which its density says something."""


class FunctionSize(NamedTuple):
    """Size of the body of a function, its docstring apart."""

    place: str
    nodes: int
    lines: int

    @property
    def density(self) -> float:
        """Nodes a line."""
        return self.nodes / self.lines


class CodeFile:
    """A file of Python code and its measures."""

    def __init__(self, path: Path):
        self.path = path
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text, filename=str(path))

    @cached_property
    def nodes(self) -> list[ast.stmt | ast.expr]:
        """Statements and expressions that are no import and no docstring."""
        nodes = (n for n in ast.walk(self.tree) if isinstance(n, ast.stmt | ast.expr))
        return [n for n in nodes if n.lineno not in self._text_lines]

    @cached_property
    def code_lines(self) -> int:
        """Number of lines that hold code."""
        lines = set()
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type not in TRIVIA:
                lines.update(range(token.start[0], token.end[0] + 1))
        return len(lines - self._text_lines)

    @cached_property
    def tuple_assignments(self) -> int:
        """Number of assignments such as `a, b = x, y`."""
        return sum(
            isinstance(node, ast.Assign)
            and isinstance(node.targets[0], ast.Tuple)
            and isinstance(node.value, ast.Tuple)
            for node in self.nodes
        )

    def functions(self) -> Iterator[FunctionSize]:
        """Yield the sizes of all functions that are not short."""
        for function in ast.walk(self.tree):
            if not isinstance(function, ast.FunctionDef):
                continue
            first = 1 if ast.get_docstring(function) is not None else 0
            statements = function.body[first:]
            nodes = [
                node
                for statement in statements
                for node in ast.walk(statement)
                if isinstance(node, ast.stmt | ast.expr)
            ]
            lines = set()
            for node in nodes:
                lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
            if len(lines) >= MIN_FUNCTION_LINES:
                place = f"{self.path}:{function.lineno} {function.name}"
                yield FunctionSize(place, len(nodes), len(lines))

    @cached_property
    def _text_lines(self) -> set[int]:
        """Lines of imports and docstrings."""
        lines = set()
        for node in ast.walk(self.tree):
            is_import = isinstance(node, ast.Import | ast.ImportFrom)
            if is_import or _is_docstring(node):
                lines.update(range(node.lineno, node.end_lineno + 1))
        return lines


def _is_docstring(node: ast.AST) -> bool:
    """Return whether a node is a text that stands alone: a docstring."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
