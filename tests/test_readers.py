"""Every reader on files that are damaged or hostile: a result, or a sentence."""

import random
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from file_samples import SAMPLES
from mutated_files import (
    HOSTILE,
    damage,
    empty,
    folder_in_its_place,
    other_format,
    read_one,
)

DAMAGED_FILES = 4


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    return tmp_path_factory.mktemp("originals")


@pytest.mark.parametrize("kind", SAMPLES)
def test_damaged_files_end_in_a_sentence(originals, tmp_path, kind):
    sample = SAMPLES[kind]
    original = originals / kind
    original.mkdir()
    sample.write(original)
    result, words = read_one(sample, original)
    has_reader = kind != "xacro" or shutil.which("xacro") is not None
    assert (result == "ok") == has_reader, words
    writers = [empty, other_format]
    if not kind.startswith("mjcf, "):  # of which MuJoCo warns in a log of its own
        writers.append(folder_in_its_place)
    for number in range(len(writers) + DAMAGED_FILES):
        folder = tmp_path / f"{number}"
        shutil.copytree(original, folder)
        if number < len(writers):
            writers[number](folder / sample.target)
        else:
            chance = random.Random(f"{kind} {number}")
            damage(folder / sample.target, sample.is_text, chance)
        result, words = read_one(sample, folder)
        assert result in ("ok", "refused"), words


def refused(kind, folder, write):
    """Return the sentence that refuses a hostile file."""
    sample = SAMPLES[kind]
    sample.write(folder)
    write(folder / sample.target)
    result, words = read_one(sample, folder)
    assert result == "refused", words
    return words


@pytest.mark.parametrize("kind", ["mcap", "ros 1, bz2"])
def test_chunks_of_bags_that_expand_to_gigabytes(tmp_path, kind):
    assert "needs 2.15e+09 bytes" in refused(kind, tmp_path, *HOSTILE[kind])


def test_long_lists_in_cells_are_no_columns(tmp_path):
    words = refused("lerobot", tmp_path, HOSTILE["lerobot"][0])
    assert "has no column `observation.state[0]`" in words


def test_meshes_without_vertices(tmp_path):
    words = refused("obj", tmp_path, lambda path: path.write_text("v 0 0\n"))
    assert "`" in words


def test_models_with_other_base_parameters(tmp_path):
    def change(path):
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace('"dependent": [', '"dependent": [1, '))

    assert "`dependent`" in refused("model", tmp_path, change)


@pytest.mark.parametrize("cell", ["\x1b[31m0.5", "x" * 100_000, "0.5\x00"])
def test_sentences_fold_long_cells_and_print_no_control_sequences(tmp_path, cell):
    def change(path):
        lines = path.read_text().splitlines()
        lines[5] = lines[5].replace(",", f",{cell}", 1)
        path.write_text("\n".join(lines))

    words = refused("csv", tmp_path, change)
    assert words.isprintable()
    assert len(words) < 500


class Trap:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def test_objects_in_archives_are_rejected_and_never_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "trap.npz", q=np.array([Trap()]))
    with pytest.raises(InputError, match="allow_pickle=False"):
        read_recording(tmp_path / "trap.npz", Columns("q", "q", sample_time=0.1))
    assert not Path("executed").exists()
