"""Folders that are written whole or not at all."""

import os
import stat
from pathlib import Path

import pytest

from jaxid.simulation.folder import written_whole


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
