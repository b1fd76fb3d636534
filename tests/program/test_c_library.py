"""Sine, cosine and tanh in C against extended precision; no branches but those of the loops."""

import ctypes
import re
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.program import CWriter, trace

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler (gcc)")
SIZE = 5
HEAD = "#include <float.h>\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"
# As accurate as without a fused multiplication and addition, which some flags allow.
FLAGS = {"plain": ["-std=c99"], "fused": ["-march=native", "-ffp-contract=fast"]}
program = trace(lambda x: (jnp.sin(x), jnp.cos(x), jnp.tanh(x)), (SIZE,))


@pytest.fixture(scope="module", params=[(d, f) for d in (True, False) for f in FLAGS])
def built(request, tmp_path_factory):
    double, flags = request.param
    writer = CWriter(double, "arm", [program])
    names = (["x"], ["s", "c", "h"])
    text = writer.definition(program, "run", *names)
    path = tmp_path_factory.mktemp("library") / "library.c"
    path.write_text(HEAD + writer.library() + text)
    target = path.with_suffix(".so")
    command = ["gcc", "-O2", *FLAGS[flags], "-shared", "-fPIC", str(path), "-o", str(target)]
    subprocess.run(command, check=True)
    return double, writer, target


@pytest.fixture(scope="module")
def run(built):
    double, _, target = built
    opened, dtype = ctypes.CDLL(str(target)), np.float64 if double else np.float32

    def call(x):
        x = np.ascontiguousarray(x, dtype)
        found = [np.zeros_like(x) for _ in range(3)]
        for k in range(len(x)):
            opened.run(*(ctypes.c_void_p(a[k].ctypes.data) for a in (x, *found)))
        return x.astype(np.longdouble), found

    return call


def test_only_as_many_as_are_needed_and_an_even_number(built):
    _, writer, _ = built
    assert writer.widths == {"sine_cosine": 6, "tanh": 6}
    assert "tanh" not in CWriter(True, "arm", [trace(jnp.sin, (2,))]).library()
    assert CWriter(True, "arm", [trace(jnp.exp, (2,))]).library() == ""


def test_accuracy(built, run):
    double, writer, _ = built
    allowed, random = (2e-16, 1.2e-7)[not double], np.random.default_rng(0)
    for size in (0.8, 3.0, 50.0, 6.28 * writer.turns):
        x, found = run(random.uniform(-size, size, (400, SIZE)))
        for got, function in zip(found, (np.sin, np.cos, np.tanh), strict=True):
            assert np.abs(got - function(x)).max() < allowed
    x, (_, _, h) = run(10.0 ** random.uniform(-6, 0, (400, SIZE)))
    assert np.abs(h / np.tanh(x) - 1).max() < 4 * allowed


def test_what_cannot_be_known_is_nan(built, run):
    _, writer, _ = built
    far = 6.29 * writer.turns
    for bad in (np.nan, np.inf, -np.inf, far, -far, 1e18, -1e30, 2.0**63):
        x = np.full((1, SIZE), 0.3)
        x[0, 2] = bad
        _, (s, c, h) = run(x)
        assert np.isnan([s[0, 2], c[0, 2]]).all()
        assert np.isnan(h[0, 2]) if np.isnan(bad) else h[0, 2] == np.sign(bad)
        assert np.isfinite(np.delete([s, c, h], 2, axis=2)).all()


def test_no_branch_but_those_of_the_loops(built):
    if shutil.which("objdump") is None:
        pytest.skip("no objdump on this machine")
    command = ["objdump", "-d", "--no-show-raw-insn", str(built[2])]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    blocks = [b for b in text.split("\n\n") if re.search("<(run|arm_)", b.split("\n")[0])]
    jumps = re.findall(r"\sj(?!mp)[a-z]+\s", "".join(blocks))
    assert blocks
    assert len(jumps) <= 2, jumps
