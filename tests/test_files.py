"""Files and folders that are written whole or not at all."""

import contextlib
import json
import os
import stat
from pathlib import Path

import pytest

from jaxid.cli.options import refuse_foreign_table, start
from jaxid.errors import InputError
from jaxid.io import atomic_folder, read_json, require_writable, write_text


def contents(folder):
    return {p.name: p.read_text() for p in folder.iterdir()}


def write(folder, *names, text="new"):
    with atomic_folder(folder, earlier_files) as staging:
        for name in names:
            (staging / name).write_text(text)
        (staging / "result.json").write_text(json.dumps({"files": names}))


def earlier_files(folder):
    try:
        return read_json(folder / "result.json")["files"]
    except OSError:
        return []


def test_nothing_is_seen_before_the_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path("deep/folder")
    with atomic_folder(folder) as staging:
        (staging / "a").write_text("a")
        assert not folder.parent.exists()
    assert contents(tmp_path / folder) == {"a": "a"}
    assert [p.name for p in tmp_path.iterdir()] == ["deep"]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o777 & ~umask


def test_a_failure_changes_nothing(tmp_path):
    (tmp_path / "a").write_text("old")
    for folder in (tmp_path, tmp_path / "new" / "folder"):
        with contextlib.suppress(KeyboardInterrupt), atomic_folder(folder) as staging:
            (staging / "a").write_text("new")
            raise KeyboardInterrupt
    assert contents(tmp_path) == {"a": "old"}


def test_other_files_stay_and_those_of_an_earlier_result_go(tmp_path):
    write(tmp_path, "a", "b", text="old")
    (tmp_path / "mine").write_text("mine")
    write(tmp_path, "b", "c")
    index = json.dumps({"files": ["b", "c"]})
    assert contents(tmp_path) == {
        "b": "new",
        "c": "new",
        "mine": "mine",
        "result.json": index,
    }


@pytest.mark.parametrize("calls", range(4))
def test_a_stop_before_any_of_the_moves_leaves_no_mixture(tmp_path, monkeypatch, calls):
    """A process killed between two calls leaves no JSON file beside others' files."""
    write(tmp_path, "a", "b", text="old")
    real, left = os.replace, iter(range(calls))

    def stop(source, target):
        if next(left, None) is None:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, "replace", stop)
    try:
        write(tmp_path, "b", "c")
    except KeyboardInterrupt:
        assert "result.json" not in contents(tmp_path)
    else:
        assert calls == 3
        assert set(contents(tmp_path)) == {"b", "c", "result.json"}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_a_single_file_is_there_at_every_moment(tmp_path, monkeypatch):
    place, seen, real = tmp_path / "state.json", [], os.replace
    place.write_text("old")

    def watched(source, target):
        seen.append(place.read_text())
        real(source, target)

    monkeypatch.setattr(os, "replace", watched)
    write_text(place, "new ü")
    assert (*seen, place.read_text(encoding="utf-8")) == ("old", "new ü")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_what_cannot_be_written_has_the_name_that_was_given():
    with pytest.raises(OSError) as caught:
        refuse_foreign_table(Path("/proc/report/table.csv"))
    assert caught.value.filename == "/proc/report"


def test_a_place_where_nothing_can_be_is_named_before_the_work(tmp_path):
    link, place = tmp_path / "report", tmp_path / "place"
    link.symlink_to(tmp_path / "gone")
    (place / "report").mkdir(parents=True)
    for refuse in (
        lambda: start(link),
        lambda: require_writable(link / "deep"),
        lambda: write(place, "a", "report"),
    ):
        with pytest.raises(InputError, match=r"`.*report`"):
            refuse()
    require_writable(place / "new" / "deep")
    assert [p.name for p in place.iterdir()] == ["report"]


def test_no_file_exhausts_a_reader(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="nested too deeply"):
        read_json(tmp_path / "deep.json")
