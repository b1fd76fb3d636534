"""JAX runs in float32 unless told: computing in float32 is refused with the cure.

All else gives the numbers of float64. One process for each precision goes through all
entry points.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import patience

SCRIPT = Path(__file__).with_name("single_precision.py")
ROUNDED = {"trajectory": 1e-5, "dynamics": 1e-5}
"""Cases that are arithmetic of JAX on what it is given, right to its precision."""


def test_float32_is_refused_or_gives_the_numbers_of_float64(tmp_path):
    environment = {
        **os.environ,
        "PYTHONPATH": str(SCRIPT.parent.parent),
        "JAX_PLATFORMS": "cpu",
    }
    commands = (
        [sys.executable, str(SCRIPT), flag, str(tmp_path / flag)] for flag in "01"
    )
    processes = [subprocess.Popen(command, env=environment) for command in commands]
    try:
        assert [p.wait(timeout=patience.SECONDS) for p in processes] == [0, 0]
    finally:
        for p in processes:
            p.kill()
    single, double = (
        json.loads((tmp_path / f / "found.json").read_text()) for f in "01"
    )
    for name, found in single.items():
        if name in double:
            assert len(found) > 0, name
            tolerance = ROUNDED.get(name, 1e-12)
            np.testing.assert_allclose(
                found, double[name], tolerance, 1e-12, err_msg=name
            )
        else:
            said = (
                r"RuntimeError: .* needs float64, but JAX runs in float32.*ENABLE_X64=1"
            )
            assert re.match(said, found), name
