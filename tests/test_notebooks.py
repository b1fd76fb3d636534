"""Notebooks are kept: one preamble, .py and .ipynb in step, executed, without paths."""

import itertools
import json
import re
from pathlib import Path

import jupytext
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
COUNT = 15
"""Notebooks, numbered from 01 without gaps."""
LARGEST = 2_000_000
"""Bytes of all notebooks together."""
# Where a machine keeps things: a home, a temporary folder, installed packages, a drive.
PATH = re.compile(
    r"/(home|root|tmp|usr|opt|var|work|private)/|site-packages|\b[A-Z]:\\"
)


def _notebook(source: Path) -> dict:
    return json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))


def _text(lines: list[str] | str) -> str:
    return "".join(lines)


def _code(source: Path) -> list[dict]:
    return [c for c in _notebook(source)["cells"] if c["cell_type"] == "code"]


@pytest.fixture(params=SOURCES, ids=lambda path: path.stem)
def source(request):
    return request.param


def test_there_are_notebooks_and_each_has_its_pair():
    assert [path.stem[:2] for path in SOURCES] == [
        f"{k:02}" for k in range(1, COUNT + 1)
    ]
    assert {p.stem for p in FOLDER.glob("*.ipynb")} == {p.stem for p in SOURCES}


def test_text_and_notebook_say_the_same(source):
    said = [(c.cell_type, c.source) for c in jupytext.read(source).cells]
    kept = [(c["cell_type"], _text(c["source"])) for c in _notebook(source)["cells"]]
    assert kept == said, f"run `python notebooks/run_all.py {source.stem[:2]} --write`"


def test_all_begin_alike_and_end_with_what_was_learned(source):
    cells = _notebook(source)["cells"]
    assert _text(_code(source)[0]["source"]) == _text(_code(SOURCES[0])[0]["source"])
    assert _text(cells[0]["source"]).startswith(f"# {source.stem[:2]} · ")
    assert "## What you learned" in _text(cells[-1]["source"])


def test_it_was_executed_from_top_to_bottom_without_an_error(source):
    cells = _code(source)
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))
    kinds = {o["output_type"] for c in cells for o in c["outputs"]}
    assert kinds <= {"stream", "display_data", "execute_result"}
    streams = {
        o["name"] for c in cells for o in c["outputs"] if o["output_type"] == "stream"
    }
    assert streams <= {"stdout"}, "a warning is shown"


def test_it_has_pictures_and_nothing_of_a_machine(source):
    outputs = [o for c in _code(source) for o in c["outputs"]]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 2
    for output in outputs:
        words = [_text(output.get("text", ""))]
        words += [
            _text(v) for k, v in output.get("data", {}).items() if k.startswith("text/")
        ]
        found = PATH.search(" ".join(words))
        assert not found, f"{source.stem}: {found}"
    assert all(not c["metadata"] for c in _code(source))
    assert set(_notebook(source)["metadata"]) == {"kernelspec"}


def test_links_of_the_notebooks_lead_somewhere(source):
    text = " ".join(_text(c["source"]) for c in _notebook(source)["cells"])
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert (FOLDER / target).exists(), target


def test_each_leads_to_the_next_one():
    for here, following in itertools.pairwise(SOURCES):
        last = _text(_notebook(here)["cells"][-1]["source"])
        assert re.search(rf"Next: \[[^\]]+\]\({following.stem}\.ipynb\)", last), (
            here.stem
        )


def test_they_are_small():
    assert sum(p.stat().st_size for p in FOLDER.glob("*.ipynb")) < LARGEST
