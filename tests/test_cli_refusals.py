"""What no experiment file, log or report may hold: one sentence each, no traceback."""

import io
import os
import subprocess
import sys

import pytest
from test_cli import (  # noqa: F401
    EXPERIMENT,
    ROOT,
    first,
    folder,
    material,
    refused,
    run,
)

from jaxid.cli.app import main

KEYS = [
    ('"t"', '"t"\ntime_unit = "ns"', "has 2e+11 samples in a second: check"),
    ('"t"', '"t"\nforce_delay = 100', "but the longest segment of `a` lasts 6 s"),
    ("cutoff = 10", "cutoff = 99", "use a step of at most 1 samples"),
    ('"q{}"', '["q1"]', "for each joint"),
    ('"q{}"', '["q1", "tau1"]', "`tau1` of `a.csv` is used"),
    *(
        (
            "[filter]",
            f"[model]\ncoulomb = {{ {key} = {value} }}\n[filter]",
            f"coulomb.{key}` must be",
        )
        for key, value in (("epsilon", "inf"), ("epsilon", "500"))
    ),
    (
        "[limits]",
        "gravity = [0, 0, 1e308]\n[limits]",
        "no quantity is larger than 1e+12",
    ),
    (
        'builtin = "planar_arm"',
        'urdf = "lost.urdf"',
        "`lost.urdf` is not a file: paths are relative",
    ),
]


@pytest.mark.parametrize(("key", "wrong", "sentence"), KEYS, ids=range(len(KEYS)))
def test_keys(folder, run, key, wrong, sentence):  # noqa: F811
    assert key in EXPERIMENT
    (folder / "e.toml").write_text(EXPERIMENT.replace(key, wrong))
    assert refused(run("inspect", "e.toml", "a.csv"), sentence)


COMMANDS = [
    ("inspect none.toml", "`none.toml` does not exist"),
    ("identify experiment.toml none.csv", "`none.csv` does not exist"),
    (
        "identify no.toml none.csv --verify x.csv",
        "`no.toml`, `none.csv`, `x.csv` do not exist",
    ),
    ("identify experiment.toml a.csv --verify b.csv c.csv", "repeat it before `c.csv`"),
    ("identify experiment.toml a.csv --verify=b.csv c.csv", "repeat it before `c.csv`"),
    ("identify experiment.toml a.csv ./a.csv", "`a.csv` is given twice"),
    (
        "identify experiment.toml a.csv --split 2",
        "`--split` must lie between 0 and 1, like 0.6",
    ),
    (
        "identify experiment.toml a.csv --verify ./a.csv",
        "`a.csv` is given both for the fit and",
    ),
    ("identify experiment.toml loop.csv", "`loop.csv` does not exist"),
    (
        "identify experiment.toml image.csv",
        "`image.csv` is not text",
    ),
    (
        "identify experiment.toml long.csv",
        "line 4, 5, 6, 7, 8 and 2 more (6 cells, but 5 columns) of `long.csv`",
    ),
    (
        "identify experiment.toml still.csv",
        "no joint moves in `still`: name other columns",
    ),
    ("init none.urdf", "none.urdf"),
    (
        "excite experiment.toml -o a.csv",
        "`a.csv` already exists, and is not a motion of `jaxid exc",
    ),
    (
        "identify a.csv experiment.toml",
        "`a.csv` is a log; the experiment file comes first, then the logs",
    ),
    ("inspect a.csv", "`a.csv` is a log; the experiment file comes first"),
    ("inspect arm.urdf", "`jaxid init arm.urdf > experiment.toml` writes one"),
    ("excite experiment.toml -o motion", "`motion` must end in .csv"),
    ("excite experiment.toml -o truth.csv", "`truth.json` already exi"),
    ("excite experiment.toml -o mine.csv", "`mine.ros.yaml` already exi"),
    ("excite experiment.toml -o pictures.csv", "report.html` already exists"),
]


@pytest.mark.parametrize(("words", "sentence"), COMMANDS, ids=range(len(COMMANDS)))
def test_commands(folder, run, words, sentence):  # noqa: F811
    (folder / "truth.json").write_text("{}")
    (folder / "mine.ros.yaml").write_text("mine")
    (folder / "pictures").mkdir()
    (folder / "pictures" / "report.html").write_text("mine")
    (folder / "loop.csv").symlink_to("loop.csv")
    (folder / "arm.urdf").write_text("<robot/>")
    (folder / "image.csv").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    header, *rows = (folder / "a.csv").read_text().splitlines()
    rows[2:9] = [row + ",1" for row in rows[2:9]]
    (folder / "long.csv").write_text("\n".join([header, *rows]))
    still = [f"{0.005 * k:.3f},0.1,0.2,0,0" for k in range(len(rows))]
    (folder / "still.csv").write_text("\n".join([header, *still]))
    before = sorted(folder.rglob("*"))
    assert refused(run(*words.split()), sentence)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    "words", ["identify experiment.toml", "idntify", "identify a b --splt"]
)
def test_words_that_no_command_knows(folder, run, words):  # noqa: F811
    code, _, err = run(*words.split())
    assert code == 2
    assert "Traceback" not in err


LIGHT = """
import contextlib, io, sys
from jaxid.cli.app import main
for words in sys.stdin.read().splitlines():
    sys.argv = ["jaxid", *words.split()]
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    loaded = {"jax", "scipy", "polars"} & set(sys.modules)
    print(code, *loaded, words, file=sys.stderr)
"""
QUICKLY = [
    "-h",
    "identify -h",
    "--version",
    "idntify",
    "identify experiment.toml",
    "identify experiment.toml a.csv --splt 2",
    "identify experiment.toml a.csv --split 2",
    "identify none.toml a.csv",
    "identify experiment.toml none.csv",
    "identify experiment.toml a.csv -o a.csv",
    "identify experiment.toml a.csv --verify b.csv c.csv",
    "identify no_toml.toml a.csv",
    "identify a.csv experiment.toml",
    "identify table.toml a.csv",
    "inspect key.toml",
    "inspect column.toml a.csv",
    "identify experiment.toml a.csv --verify empty.csv",
    "excite inner.toml",
    "inspect kind.toml",
    "inspect unit.toml",
    "excite range.toml",
    "excite family.toml",
    "excite list.toml",
    "payload lost.toml a.csv --loaded b.csv",
    "init none.urdf",
    "init broken.urdf",
    "inspect broken.toml",
    "export none --to c",
    "compare a.csv a.csv",
    "excite experiment.toml -o motion",
    "excite experiment.toml --resume",
    "identify experiment.toml a.csv -o foreign",
    "inspect angles.toml a.csv",
    "gains experiment.toml a.csv --loaded b.csv",
    "export foreign --to c",
    "compare foreign a.csv",
    "agree foreign foreign",
]


def test_refusals_come_before_jax_is_loaded(folder):  # noqa: F811
    wrong_files = {
        "no_toml": "[robot",
        "table": EXPERIMENT.replace("[rows]", "[row]"),
        "key": EXPERIMENT.replace("cutoff", "cut_off"),
        "column": EXPERIMENT.replace("tau{}", "torque{}"),
        "angles": EXPERIMENT.replace("angles =", "velocities ="),
        "inner": EXPERIMENT + "[model]\ncoulomb = { epsilom = 1 }",
        "kind": EXPERIMENT.replace("cutoff = ", "cutoff = true # "),
        "unit": EXPERIMENT.replace("[recording]", "[recording]\nangle_unit = 'grad'"),
        "range": EXPERIMENT + "[excitation]\nstarts = 0",
        "family": EXPERIMENT + "[excitation]\ncriterion = 'f_optimal'",
        "list": EXPERIMENT + "[collision]\nboxes = [{ name = 1 }]",
        "broken": EXPERIMENT.replace('builtin = "planar_arm"', 'urdf = "broken.urdf"'),
        "lost": EXPERIMENT.replace('builtin = "planar_arm"', 'urdf = "lost.urdf"'),
    }
    for name, text in wrong_files.items():
        (folder / f"{name}.toml").write_text(text)
    (folder / "empty.csv").write_text("")
    (folder / "foreign").mkdir()
    (folder / "foreign" / "mine.txt").write_text("")
    (folder / "broken.urdf").write_text('<robot name="arm"><link>')
    done = subprocess.run(
        [sys.executable, "-c", LIGHT],
        input="\n".join(QUICKLY),
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    ends = [f"{2 * (k > 2)} {words}" for k, words in enumerate(QUICKLY)]
    found = [line for line in done.stderr.splitlines() if line in ends]
    assert found == ends, done.stderr


HEAVY = {
    "scipy.signal",
    "scipy.spatial",
    "scipy.stats",
    "optimistix",
    "plotly",
    "matplotlib",
}
"""Parts of the package's libraries that an `inspect` without logs does not need."""


def test_inspect_without_logs_loads_only_what_it_needs(folder):  # noqa: F811
    script = (
        "import sys; from jaxid.cli import app\n"
        "try: app.main()\n"
        "except SystemExit: print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "inspect", "experiment.toml"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    modules = set(done.stderr.split())
    assert "jax" in modules
    assert not modules & {*HEAVY, "jaxid.rollout", "jaxid.demo"}


def test_damaged_results(folder, first, run):  # noqa: F811
    path = first / "model.json"
    whole = path.read_text(encoding="utf-8")
    for damaged in (whole[:-20], 100_000 * "[", "{}", "", "PK"):
        path.write_text(damaged, encoding="utf-8")
        arguments = ("first", "--to", "c", "-o", "arm.c")
        assert refused(run("export", *arguments), "model.json")
    assert not (folder / "arm.c").exists()


def test_a_terminal_of_few_characters_shows_the_rest_as_marks(folder, monkeypatch):  # noqa: F811
    terminal = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "argv", ["jaxid", "inspect", "experiment.toml", "-v"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    terminal.flush()
    assert b"kg m?" in terminal.buffer.getvalue()
