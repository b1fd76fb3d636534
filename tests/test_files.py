"""Folders that are written whole or not at all."""

import json
import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.excitation.state import load_state
from jaxid.experiment.folder import refuse_foreign_folder, refuse_foreign_table
from jaxid.files import require_place, written_whole
from jaxid.report.content import SCHEMA


def test_nothing_is_seen_before_the_end(tmp_path):
    folder = tmp_path / "deep" / "folder"
    with written_whole(folder) as staging:
        (staging / "a").write_text("a")
        assert not folder.parent.exists()
    assert (folder / "a").read_text() == "a"
    assert [p.name for p in tmp_path.iterdir()] == ["deep"]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o777 & ~umask


def test_a_failure_changes_nothing(tmp_path):
    (tmp_path / "a").write_text("old")

    def fail(folder):
        with written_whole(folder) as staging:
            (staging / "a").write_text("new")
            raise KeyboardInterrupt

    for folder in (tmp_path, tmp_path / "new" / "folder"):
        with pytest.raises(KeyboardInterrupt):
            fail(folder)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_other_files_stay(tmp_path):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").write_text("mine")
    with written_whole(tmp_path) as staging:
        (staging / "a").write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    assert (tmp_path / "b").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_relative_folder_is_meant_from_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with written_whole(Path("report")) as staging:
        (staging / "a").write_text("a")
    assert (tmp_path / "report" / "a").exists()


def test_a_failure_among_the_moves_brings_the_old_files_back(tmp_path, monkeypatch):
    for name in "ac":
        (tmp_path / name).write_text("old")
    real = os.replace

    def fail(source, target):
        if Path(target) == tmp_path / "c" and Path(source).read_text() == "new":
            raise OSError("disk full")
        real(source, target)

    def write():
        with written_whole(tmp_path) as staging:
            for name in "abcd":
                (staging / name).write_text("new")
            monkeypatch.setattr(os, "replace", fail)

    with pytest.raises(OSError, match="disk full"):
        write()
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"a": "old", "c": "old"}


def test_a_folder_in_a_files_place_is_not_touched(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine").write_text("mine")

    def write():
        with written_whole(tmp_path) as staging:
            (staging / "a").write_text("new")
            (staging / "b").write_text("new")

    with pytest.raises(ValueError, match="must be a file, but is a folder"):
        write()
    assert [p.name for p in tmp_path.iterdir()] == ["b"]
    assert (tmp_path / "b" / "mine").read_text() == "mine"


def test_a_single_file_is_there_at_every_moment(tmp_path, monkeypatch):
    """What is killed between any two calls of the system leaves the old state or the new one."""
    place, seen, real = tmp_path / "state.npz", [], os.replace
    place.write_text("old")

    def watched(source, target):
        seen.append(place.read_text())
        real(source, target)
        seen.append(place.read_text())

    monkeypatch.setattr(os, "replace", watched)
    with written_whole(tmp_path) as staging:
        (staging / "state.npz").write_text("new")
    assert seen == ["old", "new"]
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_what_tells_that_all_is_there_goes_first_and_comes_last(tmp_path, monkeypatch):
    for name in ("result.json", "figure.png"):
        (tmp_path / name).write_text("old")
    seen, real = [], os.replace

    def watched(source, target):
        real(source, target)
        seen.append({p.name: p.read_text() for p in tmp_path.glob("[!.]*")})

    monkeypatch.setattr(os, "replace", watched)
    with written_whole(tmp_path) as staging:
        for name in ("result.json", "figure.png"):
            (staging / name).write_text("new")
    assert "result.json" not in seen[0]
    assert seen[1] == {"figure.png": "new"}
    assert seen[-1] == {"figure.png": "new", "result.json": "new"}


def test_a_folder_that_another_run_has_made_meanwhile_is_joined(tmp_path):
    with written_whole(tmp_path / "report") as staging:
        (staging / "a").write_text("mine")
        with written_whole(tmp_path / "report") as other:
            (other / "a").write_text("theirs")
            (other / "b").write_text("theirs")
    assert {p.name: p.read_text() for p in (tmp_path / "report").iterdir()} == {
        "a": "mine",
        "b": "theirs",
    }
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


def start(script, folder):
    paths = [str(Path(__file__).resolve().parent.parent), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "-c", script, str(folder)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def write(folder, *names, text="new"):
    with written_whole(folder, outdated) as staging:
        for name in names:
            (staging / name).write_text(text)
        (staging / "result.json").write_text(json.dumps({"files": names}))


def outdated(folder):
    try:
        return json.loads((folder / "result.json").read_text())["files"]
    except OSError:
        return []


WAITS = """
import sys
from pathlib import Path
from jaxid.files import require_place, written_whole
with written_whole(Path(sys.argv[1])) as staging:
    (staging / "a").write_text("theirs")
    print(staging.parent.name, flush=True)
    input()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks for folders")
@pytest.mark.parametrize("there", [True, False])
def test_what_a_killed_process_has_left_hidden_goes_and_nothing_else(tmp_path, there):
    folder = tmp_path / "report"
    if there:
        folder.mkdir()
    place = folder if there else tmp_path
    for mine in (".jaxid-notes", ".jaxid-00000000-0123456789ab"):  # of the user, of another machine
        (place / mine).mkdir()
    (place / ".jaxid-file").write_text("mine")
    kept = {p.name for p in place.iterdir()}
    other = start(WAITS, folder)
    try:
        hidden = other.stdout.readline().strip()
        write(tmp_path / "beside" if not there else folder, "b")
        assert (place / hidden / "new" / "a").read_text() == "theirs"
        other.send_signal(signal.SIGKILL)
        other.wait(60)
    finally:
        other.kill()
        other.communicate()
    assert (place / hidden).exists()
    write(folder, "b")
    left = {p.name for p in place.iterdir()}
    new = {"b", "result.json"} if there else {"report", "beside"}
    assert left == kept | new


KILLED = """
import json, os, signal, sys
from pathlib import Path
from jaxid import files

def write(folder, *names):
    with files.written_whole(folder, outdated) as staging:
        for name in (*names, "common"):
            (staging / name).write_text(names[0])
        (staging / "result.json").write_text(json.dumps({"files": [*names, "common"]}))

def outdated(folder):
    try:
        return json.loads((folder / "result.json").read_text())["files"]
    except OSError:
        return []

real, moves = os.replace, 0
for kill in range(8):
    folder = Path(sys.argv[1]) / str(kill)
    write(folder, "a")
    (folder / "mine").write_text("mine")
    number = os.fork()
    if not number:
        def counted(*paths):
            global moves
            if moves == kill:
                os.kill(os.getpid(), signal.SIGKILL)
            moves += 1
            real(*paths)
        os.replace = counted
        write(folder, "b", "c")
        os._exit(0)
    killed = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    found = {p.name: p.read_text() for p in folder.iterdir() if p.is_file()}
    write(folder, "d")
    end = {p.name: p.read_text() for p in folder.iterdir()}
    print(json.dumps([killed, found, end]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks for folders")
def test_a_kill_before_any_of_the_moves_leaves_no_mixture(tmp_path):
    process = start(KILLED, tmp_path)
    turns = [json.loads(line) for line in process.communicate(timeout=120)[0].splitlines()]
    assert process.returncode == 0
    assert [code for code, _, _ in turns] == [-signal.SIGKILL] * 6 + [0] * 2
    for _, found, end in turns:
        if "result.json" in found:
            names = json.loads(found["result.json"])["files"]
            assert {found[name] for name in names} == {names[0]}
        # Nothing of either result is left, and nothing hidden.
        assert set(end) == {"d", "common", "result.json", "mine"}


def test_files_of_an_earlier_result_go_with_it(tmp_path, monkeypatch):
    write(tmp_path, "a", "b", text="old")
    (tmp_path / "mine").write_text("mine")
    before = {p.name: p.read_text() for p in tmp_path.iterdir()}
    real = os.replace

    def fail(source, target):
        if Path(target) == tmp_path / "result.json" and Path(source).parent != tmp_path:
            monkeypatch.setattr(os, "replace", real)
            raise OSError("disk full")
        real(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path, "b", "c")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == before
    write(tmp_path, "b", "c")
    assert {p.name for p in tmp_path.iterdir()} == {"b", "c", "result.json", "mine"}


def test_a_file_may_be_written_whole_in_a_folder_that_is(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxid.files.PATIENCE", 0.1)
    with written_whole(tmp_path / "report") as staging, written_whole(staging) as inner:
        (inner / "model.json").write_text("{}")
    assert [p.name for p in (tmp_path / "report").iterdir()] == ["model.json"]


def test_a_report_that_was_killed_among_its_moves_may_be_replaced(tmp_path):
    (tmp_path / "errors.png").write_text("of the report")
    with pytest.raises(ValueError, match="holds files but no report"):
        refuse_foreign_folder(tmp_path, force=False)
    hidden = tmp_path / ".jaxid-00000000-0123456789ab" / "old"
    hidden.mkdir(parents=True)
    (hidden / "result.json").write_text(json.dumps({"schema": SCHEMA}))
    refuse_foreign_folder(tmp_path, force=False)


def test_a_run_takes_away_what_is_there_when_its_turn_comes(tmp_path):
    """Not what was there when it began: that may be another run's by then."""
    folder = tmp_path / "report"
    write(folder, "a", text="first")
    with written_whole(folder, outdated) as staging:
        (staging / "b").write_text("second")
        (staging / "result.json").write_text(json.dumps({"files": ["b"]}))
        write(folder, "c", text="third")
    assert {p.name for p in folder.iterdir()} == {"b", "result.json"}


def test_a_state_without_arrays_is_none(tmp_path):
    np.savez(tmp_path / "state.npz")
    with pytest.raises(ValueError, match="is no saved state of a design: remove it"):
        load_state(tmp_path / "state.npz", "digest", ())


def test_a_place_where_nothing_can_be_is_named_before_the_work(tmp_path):
    link = tmp_path / "report"
    link.symlink_to(tmp_path / "gone")
    with pytest.raises(ValueError, match=r"`.*report` is a link to `.*gone`, which is not there"):
        refuse_foreign_folder(link, force=False)
    with pytest.raises(ValueError, match="is a link to"), written_whole(link / "deep"):
        pass
    require_place(tmp_path / "new" / "deep")
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_what_cannot_be_written_has_the_name_that_was_given():
    for refuse in (
        lambda: refuse_foreign_folder(Path("/proc/self/report"), force=False),
        lambda: refuse_foreign_table(Path("/proc/report/table.csv")),
    ):
        with pytest.raises(OSError) as caught:
            refuse()
        assert caught.value.filename in ("/proc/self/report", "/proc/report")
