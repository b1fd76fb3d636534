"""The equations that docstrings cite and the table in docs/equations.md agree.

A module whose docstrings cite an equation stands in that equation's row: by its name,
that of a package around it, or that of something in it. A range such as "(Eqs. 1-12)"
needs no entry.
"""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TABLE = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
ROWS = {
    int(number): [re.findall(r"`([^`]+)`", cell) for cell in (where, tests)]
    for number, where, tests in re.findall(
        r"^\| (\d+) \|.*\| (.*) \| (.*) \|$", TABLE, re.M
    )
}
CITATION = re.compile(r"\bEqs?\.\s+(\d+(?:\s*(?:[-,]|and)\s*\d+)*)")
RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


def _cited(docstring: str) -> tuple[set[int], set[int]]:
    """Return the equations cited one by one, and those within ranges."""
    text = " ".join(CITATION.findall(docstring))
    ranges = [range(int(first), int(last) + 1) for first, last in RANGE.findall(text)]
    return {int(n) for n in re.findall(r"\d+", RANGE.sub("", text))}, set().union(
        *ranges
    )


@cache
def _definitions() -> dict[str, tuple[str, str]]:
    """Return module and docstring of all modules, classes and functions by name."""
    definitions = {}

    def collect(node, name, module):
        definitions[name] = module, ast.get_docstring(node) or ""
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                collect(child, f"{name}.{child.name}", module)

    for file in sorted((ROOT / "jaxid").rglob("*.py")):
        name = ".".join(file.relative_to(ROOT / "jaxid").with_suffix("").parts)
        name = name.removesuffix(".__init__")
        collect(ast.parse(file.read_text(encoding="utf-8")), name, name)
    return definitions


def _within(name: str, outer: str) -> bool:
    return f"{name}.".startswith(f"{outer}.")


def test_rows_are_in_order():
    assert list(ROWS) == sorted(ROWS)
    assert set(ROWS) <= set(range(1, 40))


def test_each_cited_equation_has_a_row_that_names_the_module():
    missing = set()
    for module, docstring in _definitions().values():
        single, ranges = _cited(docstring)
        missing |= {f"Eq. {n}: a row" for n in (single | ranges) - set(ROWS)}
        for n in single & set(ROWS):
            if not any(_within(module, x) or _within(x, module) for x in ROWS[n][0]):
                missing.add(f"Eq. {n}: `{module}`")
    assert not missing, "docs/equations.md lacks\n" + "\n".join(sorted(missing))


@pytest.mark.parametrize("number", ROWS)
def test_a_row_names_what_exists_and_cites_it(number):
    names, tests = ROWS[number]
    assert names
    assert tests
    assert [test for test in tests if not (ROOT / test).is_file()] == []
    for name in names:
        inside = [d for x, (_, d) in _definitions().items() if _within(x, name)]
        assert any(number in set.union(*_cited(d)) for d in inside), name
