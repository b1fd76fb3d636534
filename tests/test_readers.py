"""Every reader on files that are damaged at random: a result that is finite, or a sentence."""

import random
import sys
from pathlib import Path

import pytest

from jaxid.errors import InputError

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

import fuzz

FILES = 40


@pytest.mark.parametrize("target", fuzz.TARGETS)
def test_damaged_files_end_in_a_sentence(target, tmp_path):
    read, good, chance = fuzz.reader(target, tmp_path), fuzz.seeds(target), random.Random(7)
    for one in good:
        read(one)
    for _ in range(FILES):
        data = fuzz.mutated(chance.choice(good), chance)
        try:
            read(data)
        except Exception as error:
            if not isinstance(error, InputError | OSError):
                raise AssertionError(f"{type(error).__name__} on {data[:2000]!r}") from error


def test_objects_in_archives_are_refused_and_never_run(tmp_path):
    import numpy as np

    from jaxid.io import read_arrays

    ran = tmp_path / "ran"

    class Trap:
        def __reduce__(self):
            return Path.touch, (ran,)

    trap = np.empty(1, dtype=object)
    trap[0] = Trap()
    np.savez(tmp_path / "trap.npz", q=trap)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read_arrays(tmp_path / "trap.npz")
    assert not ran.exists()
