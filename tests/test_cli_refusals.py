"""What no experiment file, log or report may hold: one sentence each, never a traceback."""

import io
import sys
from pathlib import Path

import pytest
from test_cli import EXPERIMENT, folder, refused, run  # noqa: F401

from jaxid.cli.main import main
from jaxid.trajectory.files import load_trajectory

pytestmark = pytest.mark.usefixtures("blank_figures")

KEYS = [
    ('time = "t"', 'time = "t"\ntime_unit = "ns"', "has 2e+11 samples in a second: check"),
    ('time = "t"', 'time = "t"\nforce_delay = inf', "the delay must be a finite time [s]"),
    ('time = "t"', 'time = "t"\nforce_delay = 100', "but the longest segment of `a` lasts 6 s"),
    ("cutoff = 10", "cutoff = 99", "take one of 1 samples at most"),
]


@pytest.mark.parametrize(("key", "wrong", "sentence"), KEYS, ids=range(len(KEYS)))
def test_keys(folder, run, key, wrong, sentence):  # noqa: F811
    assert key in EXPERIMENT
    (folder / "e.toml").write_text(EXPERIMENT.replace(key, wrong))
    assert refused(run("inspect", "e.toml", "a.csv"), sentence)


def test_logs(folder, run):  # noqa: F811
    text = (folder / "a.csv").read_text()
    lines = text.splitlines()

    def log(content, *sentences, name="x.csv"):
        encoded = content.encode() if isinstance(content, str) else content
        (folder / name).write_bytes(encoded)
        return refused(run("inspect", "experiment.toml", name), *sentences)

    assert log(lines[0] + "\n", "`x.csv` has a header, but no rows")
    assert log("\n".join([*lines[:9], "1,2,3,4,5,6"]), "with 5 columns in every line: repair")
    assert log(text.encode("utf-16"), "`x.csv` is text in UTF-16: save it again in UTF-8")
    assert log(b"PK\3\4abc", "`x.npz` is no NPZ file", name="x.npz")


def test_logs_that_are_named_twice(folder, run):  # noqa: F811
    said = "`a.csv` is given twice"
    assert refused(run("identify", "experiment.toml", "a.csv", "./a.csv"), said)


def test_a_motion_is_not_written_over_other_files(folder, run):  # noqa: F811
    said = "`a.csv` is there already, and no motion of `jaxid excite`"
    assert refused(run("excite", "experiment.toml", "-o", "a.csv"), said)
    assert refused(run("excite", "experiment.toml", "-o", "motion"), "`motion` must end in .csv")
    (folder / "truth.json").write_text("{}")
    assert refused(run("excite", "experiment.toml", "-o", "truth.csv"), "`truth.json` is there al")
    (folder / "mine.ros.yaml").write_text("mine")
    assert refused(
        run("excite", "experiment.toml", "-o", "mine.csv"), "`mine.ros.yaml` is there al"
    )
    (folder / "pictures").mkdir()
    (folder / "pictures" / "joints.png").write_text("mine")
    said = f"`{Path('pictures') / 'joints.png'}` is there already"
    assert refused(run("excite", "experiment.toml", "-o", "pictures.csv"), said)


def test_damaged_results(folder, run):  # noqa: F811
    for name in "ab":
        assert run("identify", "experiment.toml", f"{name}.csv", "-o", name)[0] == 0
    path = folder / "b" / "model.json"
    whole = path.read_text(encoding="utf-8")
    for damaged in (whole[:-20], whole.replace('"rows": [', '"rows": [1, ', 1), "{}", "[]"):
        path.write_text(damaged, encoding="utf-8")
        assert refused(run("compare", "a", "b"), "model.json")
    path.unlink()
    assert refused(run("compare", "a", "b"), "holds no `model.json`")


def test_files_of_nothing_but_brackets(folder, run):  # noqa: F811
    for name in ("deep", "deeper"):
        (folder / name).mkdir()
    for path in (folder / "deep" / "model.json", folder / "deep.json"):
        path.write_text(100_000 * "[")
    said = "brackets are nested too deeply"
    assert refused(run("compare", "deep", "deeper"), "model.json")
    assert refused(run("identify", "experiment.toml", "a.csv", "-o", "deep"), "but no report")
    assert refused(run("excite", "experiment.toml", "-o", "deep.csv"), "`deep.json` is there al")
    with pytest.raises(ValueError, match=said):
        load_trajectory(folder / "deep.json")
    nested = '{"kind": "PaddedToCycle", "inner": '
    head = '{"format": "jaxid trajectory", "version": 2, "trajectory": '
    (folder / "deep.json").write_text(head + 900 * nested + "1" + 901 * "}")
    with pytest.raises(ValueError, match="is damaged"):
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


def test_one_column_is_one_channel(folder, run):  # noqa: F811
    swapped = 'angles = ["q1", "q2"]\nforces = ["tau1", "q2"]'
    text = EXPERIMENT.replace('angles = "q{}"\nforces = "tau{}"', swapped)
    (folder / "e.toml").write_text(text)
    said = "the column `q2` of `a.csv` is used for `angles` and `forces`"
    assert refused(run("inspect", "e.toml", "a.csv"), said)
    (folder / "e.toml").write_text(text.replace('["tau1", "q2"]', '["tau1", "tau1"]'))
    assert refused(run("inspect", "e.toml", "a.csv"), "the column `tau1` of `a.csv` is used twice")


def test_numbers_that_nothing_measures(folder, run):  # noqa: F811
    lines = (folder / "a.csv").read_text().splitlines()
    lines[7] = "0.03,1e31,0,0,0"
    (folder / "x.csv").write_text("\n".join(lines))
    said = "column `q1` of `x.csv`, line 8, is 1e+31 in size, which nothing measures"
    assert refused(run("inspect", "experiment.toml", "x.csv"), said)


def test_rates_that_cannot_be(folder, run):  # noqa: F811
    (folder / "e.toml").write_text(EXPERIMENT.replace('"t"', '"t"\ntime_unit = "s"'))
    lines = (folder / "a.csv").read_text().splitlines()
    rows = [line.split(",", 1) for line in lines[1:]]
    slow = [lines[0], *(f"{1e3 * float(t):g},{rest}" for t, rest in rows)]
    (folder / "x.csv").write_text("\n".join(slow))
    said = "sampling rate of 0.2 Hz: take a lower one, or log faster than 20 Hz. Few robots log so"
    assert refused(run("inspect", "e.toml", "x.csv"), said, "check `time_unit`")


def test_a_urdf_that_is_not_there(folder, run):  # noqa: F811
    text = EXPERIMENT.replace('builtin = "planar_arm"', 'urdf = "lost.urdf"')
    (folder / "e.toml").write_text(text)
    said = "`lost.urdf` is no file: paths in an experiment file are relative to its folder; mend"
    assert refused(run("inspect", "e.toml"), "`urdf`", said)


def test_results_that_cannot_run_code(folder, run):  # noqa: F811
    assert run("identify", "experiment.toml", "a.csv", "-o", "r")[0] == 0
    path = folder / "r" / "model.json"
    for content in (b"", b"PK", path.read_bytes()[:900]):
        path.write_bytes(content)
        result = run("identify", "experiment.toml", "r", "b.csv", "-o", "s")
        assert refused(result, "is no model file")
    assert not (folder / "s").exists()


def test_a_disk_without_room(folder, run, monkeypatch):  # noqa: F811
    import errno
    import os

    from jaxid.report import result_files

    def full(path, content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(result_files, "write_json", full)
    result = run("identify", "experiment.toml", "a.csv")
    assert refused(result, "No space left on device: nothing was written; make room")
    assert not (folder / "report").exists()
