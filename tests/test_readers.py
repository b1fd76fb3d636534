"""Every reader on files that are damaged at random: a result, or a sentence."""

import random
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

import faults

FILES = 25


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readers")
    return folder, faults.readers(faults.example(folder))


@pytest.mark.parametrize("name", faults.FILES)
def test_damaged_files_end_in_a_sentence(readers, name):
    folder, read = readers[0], readers[1][name]
    good, chance, target = (
        (folder / name).read_bytes(),
        random.Random(7),
        folder / f"bad-{name}",
    )
    read(folder / name)
    for _ in range(FILES):
        data = faults.damaged(good, chance)
        target.write_bytes(data)
        try:
            read(target)
        except Exception as error:
            if not isinstance(error, InputError | OSError):
                raise AssertionError(
                    f"{type(error).__name__} on {data[:2000]!r}"
                ) from error


class Trap:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def test_objects_in_archives_are_rejected_and_never_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "trap.npz", q=np.array([Trap()]))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read_recording(tmp_path / "trap.npz", Columns("q", "q", sample_time=0.1))
    assert not Path("executed").exists()
