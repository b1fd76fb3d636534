"""Rules of CONTRIBUTING.md that a machine can check."""

import ast
import inspect
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer.main
from code_measures import CodeFile

import jaxid
import jaxid.cli.app

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "jaxid").rglob("*.py"))
README = ROOT / "README.md"
MAX_FILE_LINES = 500
MAX_FLAT_NAMES = 70
MAX_NODES_A_LINE = 10
"""Density of a function above which its steps need names."""


class Budget(NamedTuple):
    """Upper limits of the package's size and density; each may only fall.

    The goals are 155,000 nodes, 5.8 nodes a line, 3 % dense functions and 60 tuple
    assignments. `rollout` and `validation` count in the first only.
    """

    nodes: int = 226_200  # grows with new capabilities alone
    nodes_a_line: float = 5.9
    dense_functions: float = 0.3  # % of the functions of eight lines and more
    tuple_assignments: int = 13
    long_files: int = 0


BUDGET = Budget()
UNCOUNTED_ROOMS = {"rollout", "validation"}
FORBIDDEN_CALLS = {"print", "exit", "quit", "breakpoint", "sys.exit", "os._exit"}
HOMELESS = {"utils", "util", "helpers", "helper", "common", "misc"}

BARE_IMPORT = """
import sys
import jax
def settings():
    return {name: jax.config._read(name) for name in jax.config.values}
before = settings()
import jaxid.api
after = settings()
assert after == before, {k: v for k, v in after.items() if before.get(k, v) != v}
loaded = sorted({"matplotlib", "typer", "rich"} & set(sys.modules))
assert not loaded, f"import jaxid has loaded {loaded}"
from jax._src import xla_bridge
assert not xla_bridge._backends, "import jaxid has started a backend"
"""


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@cache
def _public() -> dict[str, Any]:
    """Return the flat public names and what they stand for, without the namespaces."""
    names = {name: getattr(jaxid, name) for name in dir(jaxid)}
    return {name: thing for name, thing in names.items() if not inspect.ismodule(thing)}


def _commands() -> list[str]:
    """Return the lines of the README's shell blocks."""
    blocks = re.findall(
        r"```(?:bash|sh)\n(.*?)```", README.read_text(encoding="utf-8"), re.S
    )
    return [
        line.strip() for block in blocks for line in block.splitlines() if line.strip()
    ]


@pytest.mark.parametrize("path", SOURCES, ids=_name)
def test_a_file_is_short_documented_and_behaves(path):
    tree, lines = _tree(path), path.read_text(encoding="utf-8").splitlines()
    wrong = []
    if not ast.get_docstring(tree):
        wrong.append("has no docstring")
    if HOMELESS & set(path.relative_to(ROOT).with_suffix("").parts):
        wrong.append("has a name without meaning: move its content where it belongs")
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            wrong.append(f"line {node.lineno}: an `assert`")
        # The process of a command ends itself, whatever its threads still do.
        ends = path.parts[-2:] == ("cli", "process.py")
        if (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) in FORBIDDEN_CALLS
            and not ends
        ):
            wrong.append(f"line {node.lineno}: a call of `{ast.unparse(node.func)}`")
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            wrong.append(f"line {node.lineno}: annotations must be real ones")
    wrong += [
        f"line {number}: a `{found[0]}`"
        for number, line in enumerate(lines, 1)
        if (found := re.search(r"TODO|FIXME|XXX", line))
    ]
    assert not wrong, f"{_name(path)}: " + "; ".join(wrong)


@cache
def _files() -> list[CodeFile]:
    return [CodeFile(path) for path in SOURCES]


def _counted_files() -> list[CodeFile]:
    """Return the files in whose density the budget counts."""
    package = ROOT / "jaxid"
    return [
        file
        for file in _files()
        if file.path.relative_to(package).parts[0] not in UNCOUNTED_ROOMS
    ]


def test_the_package_is_small():
    nodes = sum(len(file.nodes) for file in _files())
    assert nodes <= BUDGET.nodes


def test_the_code_is_not_dense():
    files = _counted_files()
    nodes = sum(len(file.nodes) for file in files)
    lines = sum(file.code_lines for file in files)
    assert nodes / lines <= BUDGET.nodes_a_line
    functions = [function for file in files for function in file.functions()]
    dense = [f for f in functions if f.density > MAX_NODES_A_LINE]
    assert 100 * len(dense) / len(functions) <= BUDGET.dense_functions, dense


def test_one_assignment_a_line():
    count = sum(file.tuple_assignments for file in _counted_files())
    assert count <= BUDGET.tuple_assignments


def test_files_are_short():
    long = [
        f"{_name(file.path)} has {length} lines"
        for file in _files()
        if (length := len(file.text.splitlines())) > MAX_FILE_LINES
    ]
    assert len(long) <= BUDGET.long_files, long


def test_docstrings_are_in_plain_english():
    """No summary begins with "What", no description of an argument with "Of"."""
    wrong = []
    for path in SOURCES:
        for node in ast.walk(_tree(path)):
            if not isinstance(node, ast.Expr) or not isinstance(
                node.value, ast.Constant
            ):
                continue
            text = str(node.value.value)
            if text.startswith("What ") or re.search(r"^ +\w+: Of\b", text, re.M):
                wrong.append(f"{_name(path)}, line {node.lineno}")
    assert not wrong


def test_errors_of_users_are_input_errors():
    wrong = [
        f"{_name(path)}, line {node.lineno}"
        for path in SOURCES
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.Raise) and node.exc
        if ast.unparse(node.exc).startswith("ValueError")
    ]
    assert not wrong


def test_every_abstract_class_has_at_most_three_abstract_methods():
    for path in SOURCES:
        for node in ast.walk(_tree(path)):
            if not isinstance(node, ast.ClassDef):
                continue
            abstract = [
                f.name
                for f in node.body
                if isinstance(f, ast.FunctionDef)
                and any(
                    ast.unparse(d).endswith("abstractmethod") for d in f.decorator_list
                )
            ]
            assert len(abstract) <= 3, f"{_name(path)}: `{node.name}` has {abstract}"
            assert not abstract or node.name.startswith("Abstract"), (
                f"{_name(path)}: {node.name}"
            )


def test_importing_changes_nothing_and_loads_nothing_heavy():
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", BARE_IMPORT],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_public_names_are_few():
    assert len(_public()) <= MAX_FLAT_NAMES, (
        f"{len(_public())} flat names: use namespaces"
    )


def test_benchmarks_and_notebooks_use_public_names():
    """Their only import of the package is `import jaxid as jid`.

    References, which stand in for a part of the package, may use its parts.
    """
    scripts = [*ROOT.glob("benchmarks/**/*.py"), *ROOT.glob("notebooks/*.py")]
    scripts = [path for path in scripts if path.parent.name != "references"]
    private = [
        f"{_name(path)}: {line.strip()}"
        for path in scripts
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s*(from jaxid\b|import jaxid\.)", line)
    ]
    assert scripts
    assert not private


def test_namespaces_hold_their_own_names():
    foreign = []
    for namespace in dir(jaxid):
        module = getattr(jaxid, namespace)
        if not inspect.ismodule(module):
            continue
        for name, thing in vars(module).items():
            home = getattr(thing, "__module__", None) or getattr(thing, "__name__", "")
            belongs = home in ("", "builtins") or home.startswith("jaxid")
            if not name.startswith("_") and not belongs:
                foreign.append(f"{namespace}.{name}")
    assert not foreign


@pytest.mark.parametrize("name", sorted(_public()))
def test_a_public_name_is_documented_with_units(name):
    thing = getattr(jaxid, name)
    docstring = inspect.getdoc(thing)
    assert docstring, f"`{name}` has no docstring"
    if inspect.isfunction(thing):
        annotations = inspect.get_annotations(thing)
        floats = [k for k, v in annotations.items() if v is float and k != "return"]
        for argument in floats:
            described = re.search(
                rf"^\s*{argument}: (.+(?:\n {{8,}}.+)*)", docstring, re.M
            )
            assert described, f"`{name}` does not document `{argument}`"
            assert re.search(r"\[[^\]]+\]|[Ff]raction|relative", described[1]), (
                f"`{name}`: the unit of `{argument}` is missing"
            )


def test_ci_runs_what_the_readme_promises():
    steps = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    commands = [c for c in _commands() if c.startswith("python3 -m venv")]
    assert len(commands) == 2, "the README has two commands: the job and the tests"
    for command in commands:
        assert command in steps, f".ci/run does not run `{command}`"
    assert steps.rstrip().endswith(commands[1])


def test_commands_in_the_readme_exist():
    group = typer.main.get_command(jaxid.cli.app.app)
    named = re.findall(r"\bjaxid (?!_)([a-z]+)\b", "\n".join(_commands()))
    assert named
    assert set(named) <= set(group.commands), sorted(set(named) - set(group.commands))


def test_links_between_the_documents_lead_somewhere():
    documents = [
        README,
        ROOT / "CONTRIBUTING.md",
        ROOT / "CHANGELOG.md",
        *ROOT.glob("docs/*.md"),
    ]
    dead = []
    for document in documents:
        for target in re.findall(
            r"\]\(([^)#\s]+)[^)]*\)", document.read_text(encoding="utf-8")
        ):
            if (
                not target.startswith("http")
                and not (document.parent / target).exists()
            ):
                dead.append(f"{_name(document)}: {target}")
    assert not dead


def test_names_in_the_documents_exist():
    unknown = []
    for document in [README, ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")]:
        text = document.read_text(encoding="utf-8")
        for name in re.findall(r"\bjid\.([A-Za-z_]\w*(?:\.\w+)*)", text):
            thing = jaxid
            for part in name.split("."):
                thing = getattr(thing, part, None)
            if thing is None:
                unknown.append(f"{_name(document)}: jid.{name}")
    assert not unknown
