"""The equations that docstrings cite and the table in docs/equations.md say the same.

What to do when it fails: a function that cites an equation stands, with its module's name, in that
equation's row of the table; what a row names exists and cites the equation. A module or a class may
stand there for all that is inside it. A range, as in "(Eqs. 1-12)", is a summary: it only needs the
rows to exist.
"""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "equations.md"
CITATION = re.compile(r"\bEqs?\.\s+(\d+(?:\s*(?:[-,]|and)\s*\d+)*)")
RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


@cache
def _docstrings() -> dict[str, str]:
    """Docstrings of all modules, classes and functions, by their names below `jaxid`."""
    found = {}

    def collect(node, name):
        found[name] = ast.get_docstring(node) or ""
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                collect(child, f"{name}.{child.name}")

    for file in sorted((ROOT / "jaxid").rglob("*.py")):
        parts = file.relative_to(ROOT / "jaxid").with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            collect(ast.parse(file.read_text(encoding="utf-8")), name)
    return found


def _cited(docstring: str) -> tuple[set[int], set[int]]:
    """Equations cited one by one, and those within ranges."""
    single, ranges = set(), set()
    for numbers in CITATION.findall(docstring):
        for first, last in RANGE.findall(numbers):
            ranges |= set(range(int(first), int(last) + 1))
        single |= {int(n) for n in re.findall(r"\d+", RANGE.sub("", numbers))}
    return single, ranges


@cache
def _rows() -> list[tuple[int, list[str], list[str]]]:
    """Equation, names and test files of each row."""
    rows = []
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[0].isdigit():
            where, tests = (re.findall(r"`([^`]+)`", cell) for cell in cells[-2:])
            rows.append((int(cells[0]), where, tests))
    return rows


def _names_of(equation: int) -> list[str]:
    return next((where for number, where, _ in _rows() if number == equation), [])


def _within(name: str, outer: str) -> bool:
    return name == outer or name.startswith(outer + ".")


def test_rows_are_in_order_and_come_once():
    numbers = [number for number, _, _ in _rows()]
    assert numbers == sorted(set(numbers))
    assert numbers[0] == 1
    assert numbers[-1] <= 39


def test_what_docstrings_cite_stands_in_the_table():
    numbers = {number for number, _, _ in _rows()}
    wrong = []
    for name, docstring in _docstrings().items():
        single, ranges = _cited(docstring)
        for n in sorted((single | ranges) - numbers):
            wrong.append(f"`{name}` cites Eq. {n}, which has no row: add one")
        for n in sorted(single & numbers):
            if not any(_within(name, row) or _within(row, name) for row in _names_of(n)):
                wrong.append(f"`{name}` cites Eq. {n}: add it to the row of Eq. {n}")
    assert not wrong, "docs/equations.md:\n" + "\n".join(wrong)


@pytest.mark.parametrize("number", [number for number, _, _ in _rows()])
def test_a_row_names_what_exists_and_cites_it(number):
    _, where, tests = next(row for row in _rows() if row[0] == number)
    assert where, f"docs/equations.md: the row of Eq. {number} names no function, class or module"
    assert tests, f"docs/equations.md: the row of Eq. {number} names no test"
    for name in where:
        assert name in _docstrings(), f"docs/equations.md, Eq. {number}: there is no `{name}`"
        inside = [d for n, d in _docstrings().items() if _within(n, name)]
        cites = any(number in set.union(*_cited(d)) for d in inside)
        assert cites, f"docs/equations.md: `{name}` stands for Eq. {number}, but does not cite it"
    for test in tests:
        assert (ROOT / test).is_file(), f"docs/equations.md, Eq. {number}: there is no `{test}`"


@pytest.mark.parametrize(
    ("text", "single", "ranges"),
    [
        ("… of one body (Eq. 10).", {10}, set()),
        ("(Eqs. 16, 18)", {16, 18}, set()),
        ("(Eqs. 20-22, 24; Sec. 5)", {24}, {20, 21, 22}),
        ("(Eq. 37, Fig. 10)", {37}, set()),
        ("(Eqs. 1\n    and 2)", {1, 2}, set()),
        ("Equal to 5, sequence 7.", set(), set()),
    ],
)
def test_citations_are_read_as_they_are_written(text, single, ranges):
    assert _cited(text) == (single, ranges)
