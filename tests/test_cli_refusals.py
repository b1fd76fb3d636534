"""What no experiment file, log or report may hold: one sentence each, never a traceback."""

import io
import sys

import pytest
from test_cli import EXPERIMENT, first, folder, material, refused, run  # noqa: F401

from jaxid.cli import main
from jaxid.trajectory.files import load_trajectory

pytestmark = pytest.mark.usefixtures("blank_figures", "compiled")

COLUMNS = 'angles = "q{}"\nforces = "tau{}"'
KEYS = [
    ('"t"', '"t"\ntime_unit = "ns"', "has 2e+11 samples in a second: check"),
    ('"t"', '"t"\nforce_delay = inf', "the delay must be a finite time [s]"),
    ('"t"', '"t"\nforce_delay = 100', "but the longest segment of `a` lasts 6 s"),
    ("cutoff = 10", "cutoff = 99", "take one of 1 samples at most"),
    ("cutoff = 10", "cutoff = -3", "e.toml: `filter`: `cutoff`"),
    ('"q{}"', '["q1"]', "for each joint"),
    (COLUMNS, 'angles = ["q1", "q2"]\nforces = ["tau1", "q2"]', "`q2` of `a.csv` is used for"),
    (COLUMNS, 'angles = ["q1", "q2"]\nforces = ["tau1", "tau1"]', "`tau1` of `a.csv` is used twi"),
    ('builtin = "planar_arm"', 'urdf = "lost.urdf"', "`lost.urdf` is no file: paths in an experim"),
]


@pytest.mark.parametrize(("key", "wrong", "sentence"), KEYS, ids=range(len(KEYS)))
def test_keys(folder, run, key, wrong, sentence):  # noqa: F811
    assert key in EXPERIMENT
    (folder / "e.toml").write_text(EXPERIMENT.replace(key, wrong))
    assert refused(run("inspect", "e.toml", "a.csv"), sentence)


def test_logs(folder, run):  # noqa: F811
    text = (folder / "a.csv").read_text()
    lines = text.splitlines()
    rows = [line.split(",", 1) for line in lines[1:]]
    slow = [lines[0], *(f"{1e3 * float(t):g},{rest}" for t, rest in rows)]
    huge = "column `q1` of `x.csv`, line 8, is not finite, or larger than any sensor"
    logs = {
        lines[0] + "\n": "`x.csv` has no rows",
        "\n".join([*lines[:9], "1,2,3,4,5,6"]): "with 5 columns in every line: repair",
        text.encode("utf-16"): "`x.csv` is text in UTF-16: save it again in UTF-8",
        "t,q1,q2,tau1,tau2\n0,0,0,0,0\n0.1,0,x,0,0\n": "line 3",
        "\n".join([*lines[:7], "0.03,1e31,0,0,0", *lines[8:]]): huge,
        "\n".join(slow): "log faster than 20 Hz, or check `time_unit`",
    }
    for content, sentence in logs.items():
        encoded = content.encode() if isinstance(content, str) else content
        (folder / "x.csv").write_bytes(encoded)
        assert refused(run("inspect", "experiment.toml", "x.csv"), sentence)
    (folder / "x.npz").write_bytes(b"PK\3\4abc")
    assert refused(run("inspect", "experiment.toml", "x.npz"), "`x.npz` is no NPZ file")


COMMANDS = [
    ("inspect none.toml", "`none.toml` is no file"),
    ("identify experiment.toml none.csv", "`none.csv` is no file"),
    ("identify experiment.toml a.csv --split 1.5", "between 0 and 1, like 0.6, but is 1.5"),
    ("identify experiment.toml a.csv ./a.csv", "`a.csv` is given twice"),
    ("identify experiment.toml a.csv --verify ./a.csv", "`a.csv` is given both to identify and"),
    ("init none.urdf", "none.urdf"),
    ("excite experiment.toml -o a.csv", "`a.csv` is there already, and no motion of `jaxid exc"),
    ("excite experiment.toml -o motion", "`motion` must end in .csv"),
    ("excite experiment.toml -o truth.csv", "`truth.json` is there al"),
    ("excite experiment.toml -o mine.csv", "`mine.ros.yaml` is there al"),
    ("excite experiment.toml -o pictures.csv", "joints.png` is there already"),
]


@pytest.mark.parametrize(("words", "sentence"), COMMANDS, ids=range(len(COMMANDS)))
def test_commands(folder, run, words, sentence):  # noqa: F811
    (folder / "truth.json").write_text("{}")
    (folder / "mine.ros.yaml").write_text("mine")
    (folder / "pictures").mkdir()
    (folder / "pictures" / "joints.png").write_text("mine")
    before = sorted(folder.rglob("*"))
    assert refused(run(*words.split()), sentence)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("words", ["identify experiment.toml", "idntify", "identify a b --splt"])
def test_words_that_no_command_knows(folder, run, words):  # noqa: F811
    code, _, err = run(*words.split())
    assert code == 2
    assert "Traceback" not in err


def test_damaged_results(folder, first, run):  # noqa: F811
    path = first / "model.json"
    whole = path.read_text(encoding="utf-8")
    (folder / "deep").mkdir()
    (folder / "deep" / "model.json").write_text(100_000 * "[")
    one_row_more = whole.replace('"rows": [', '"rows": [1, ', 1)
    for damaged in (whole[:-20], one_row_more, "{}", "[]", "", "PK"):
        path.write_text(damaged, encoding="utf-8")
        assert refused(run("compare", "first", "deep"), "model.json")
        arguments = ("experiment.toml", "first", "b.csv", "-o", "s")
        assert refused(run("identify", *arguments), "model.json")
    assert not (folder / "s").exists()
    path.unlink()
    assert refused(run("compare", "first", "deep"), "holds no `model.json`")
    assert refused(run("compare", "deep", "first"), "model.json")
    assert refused(run("identify", "experiment.toml", "a.csv", "-o", "deep"), "but no report")


def test_trajectories_of_nothing_but_brackets(folder, run):  # noqa: F811
    (folder / "deep.json").write_text(100_000 * "[")
    assert refused(run("excite", "experiment.toml", "-o", "deep.csv"), "`deep.json` is there al")
    with pytest.raises(ValueError, match="brackets are nested too deeply"):
        load_trajectory(folder / "deep.json")
    nested = '{"kind": "PaddedToCycle", "inner": '
    head = '{"format": "jaxid trajectory", "version": 2, "trajectory": '
    (folder / "deep.json").write_text(head + 900 * nested + "1" + 901 * "}")
    with pytest.raises(ValueError, match="is no trajectory file"):
        load_trajectory(folder / "deep.json")


def test_a_terminal_of_few_characters_shows_the_rest_as_marks(folder, monkeypatch):  # noqa: F811
    terminal = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "argv", ["jaxid", "inspect", "experiment.toml"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    terminal.flush()
    assert b"kg m?" in terminal.buffer.getvalue()
