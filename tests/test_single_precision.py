"""JAX runs in float32 unless told: what then computes in float32 is refused with the cure.

All else gives the numbers of float64. One process for each precision goes through all entry points.
"""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).with_name("single_precision.py")
ROUNDED = {"trajectory": 1e-5, "dynamics": 1e-5}
"""Cases that are arithmetic of JAX on what it is given, right to its precision."""


def names(variable):
    """The strings of the script's `CASES` or `REFUSED`, without running it."""
    for node in ast.parse(SCRIPT.read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == variable:
            keys = node.value.keys if isinstance(node.value, ast.Dict) else node.value.elts
            return [ast.literal_eval(key) for key in keys]
    raise AssertionError(variable)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("precision")
    paths = [str(SCRIPT.parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(p for p in paths if p),
        "JAX_PLATFORMS": "cpu",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, str(SCRIPT), flag, str(folder / flag)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for flag in "01"
    ]
    try:
        outputs = [p.communicate(timeout=300) for p in processes]
    finally:
        for p in processes:
            p.kill()
    assert [p.returncode for p in processes] == [0, 0], outputs
    return [json.loads((folder / flag / "found.json").read_text()) for flag in "01"]


@pytest.mark.parametrize("name", names("REFUSED"))
def test_what_computes_in_jax_is_refused_with_the_cure(found, name):
    said = found[0][name]
    assert isinstance(said, str), "was not refused"
    assert said.startswith("RuntimeError: ")
    assert " needs float64, but JAX runs in float32" in said
    assert 'jax.config.update("jax_enable_x64", True)' in said
    assert "JAX_ENABLE_X64=1" in said


@pytest.mark.parametrize("name", [n for n in names("CASES") if n not in names("REFUSED")])
def test_all_else_gives_the_numbers_of_float64(found, name):
    single, double = (one[name] for one in found)
    assert not isinstance(double, str), double
    assert not isinstance(single, str), single
    assert len(single) > 0
    np.testing.assert_allclose(single, double, rtol=ROUNDED.get(name, 1e-12), atol=1e-12)
