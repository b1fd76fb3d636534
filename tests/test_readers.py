"""Damaged files end in a sentence for the user: a few hundred random changes of good ones."""

import contextlib
import random
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import jaxid as jid
from jaxid.io import read_arrays

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))
from faults import URDF, damaged


@pytest.fixture(scope="module")
def samples():
    """Return good files by name, as text, and functions that read them."""
    t = 0.01 * np.arange(60)
    lines = ["time,q1,q2,tau1,tau2"]
    lines += [f"{x:.2f},{np.sin(x):.6f},{np.cos(x):.6f},{x:.6f},{-x:.6f}" for x in t]
    columns = jid.Columns(angles="q{}", forces="tau{}", time="time")
    return {
        "log.csv": ("\n".join(lines), lambda path: jid.read_recording(path, columns)),
        "arm.urdf": (URDF, jid.load_urdf),
        "model.json": ('{"schema": "jaxid-model/1", "checksum": "0", "fit": {}}', jid.load),
    }


@pytest.mark.parametrize("name", ["log.csv", "arm.urdf", "model.json"])
def test_a_damaged_file_is_read_or_refused_in_a_sentence(name, samples, tmp_path):
    good, read = samples[name]
    chance, target = random.Random(name), tmp_path / name
    for _ in range(150):
        target.write_bytes(damaged(good.encode(), chance))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with contextlib.suppress(jid.InputError, OSError):
                read(target)


def test_objects_in_archives_are_rejected_and_never_executed(tmp_path):
    executed = tmp_path / "executed"

    class Trap:
        def __reduce__(self):
            return Path.touch, (executed,)

    trap = np.empty(1, dtype=object)
    trap[0] = Trap()
    np.savez(tmp_path / "trap.npz", q=trap)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read_arrays(tmp_path / "trap.npz")
    assert not executed.exists()
