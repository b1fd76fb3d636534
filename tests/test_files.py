"""Folders that are written whole or not at all."""

import os
import stat
from pathlib import Path

import pytest

from jaxid.files import written_whole


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
