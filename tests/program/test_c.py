"""C code against NumPy and extended precision; no branches but those of the loops."""

import ctypes
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from sample_functions import SIZE, every_operation, random_functions, samples

from jaxid.errors import InputError
from jaxid.program import evaluate, trace
from jaxid.program.c_writer import CWriter

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="no C compiler (gcc)"
)
HEAD = (
    "#include <float.h>\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"
)
WARNINGS = ("-Wall", "-Wextra", "-pedantic", "-Werror", "-O1")


def c_code(program, name="run", double=True):
    inputs = [f"x{k}" for k in range(len(program.input_shapes))]
    outputs = [f"y{k}" for k in range(len(program.output_shapes))]
    writer = CWriter(double)
    definition = writer.definition(program, name, inputs, outputs)
    linkage = '#ifdef __cplusplus\nextern "C"\n#endif\n'
    return f"{HEAD}{linkage}{writer.declaration(name, inputs, outputs)};\n{definition}"


def compile_c(folder, text, *flags, language="c"):
    source, target = folder / "program.c", folder / "program.so"
    source.write_text(text)
    flags = ["-x", language, *flags, "-fPIC", "-shared"]
    subprocess.run(["gcc", *flags, str(source), "-o", str(target), "-lm"], check=True)
    return target


@pytest.fixture
def compiled(tmp_path_factory):
    """Compile a program and return it as a Python function of one sample."""

    def compile_(program, double=True, language="c"):
        standard = {"c": "-std=c99", "c++": "-std=c++11"}[language]
        folder, text = tmp_path_factory.mktemp("c"), c_code(program, double=double)
        run = ctypes.CDLL(
            str(compile_c(folder, text, standard, *WARNINGS, language=language))
        ).run
        dtype = np.float64 if double else np.float32

        def call(*inputs):
            given_ = [np.ascontiguousarray(x, dtype) for x in inputs]
            sizes = [int(np.prod(s)) for s in program.output_shapes]
            results = [np.full(max(size, 1), np.nan, dtype) for size in sizes]
            run(*(ctypes.c_void_p(x.ctypes.data) for x in (*given_, *results)))
            return [r[:k] for r, k in zip(results, sizes, strict=True)]

        return call

    return compile_


def assert_equal_to_numpy(call, program, *x, tolerance):
    for got, want in zip(call(*x), jax.tree.leaves(evaluate(program, *x)), strict=True):
        np.testing.assert_allclose(got, np.ravel(want), rtol=tolerance, atol=tolerance)


@given(function=random_functions())
@settings(
    max_examples=4,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_c_equals_numpy(compiled, function):
    program = trace(function, (SIZE,), (SIZE,))
    assert_equal_to_numpy(compiled(program), program, *samples(0, ()), tolerance=1e-15)


@pytest.mark.parametrize("language", ["c", "c++"])
@pytest.mark.parametrize("double", [True, False])
def test_every_operation_in_both_precisions_and_languages(compiled, double, language):
    def function(x, unused):
        return (
            every_operation(*x),
            np.array([0.0, 1.5, -2.0, np.inf, -np.inf, np.nan]),
            jnp.zeros((0, 2)),
        )

    program = trace(function, (2,), (3,))
    run, tolerance = compiled(program, double, language), 4e-16 if double else 1e-6
    for x in ([0.3, -0.4], [-1.2, 2.0], [0.7, 0.5]):
        assert_equal_to_numpy(
            run, program, np.array(x), np.zeros(3), tolerance=tolerance
        )


def test_nan_is_kept_by_choices(compiled):
    program = trace(
        lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, y), jnp.sign(x + y)), (), ()
    )
    run = compiled(program)
    for x, y in ((np.nan, 1.0), (1.0, np.nan)):
        assert np.isnan(np.concatenate(run(x, y))).all()


def test_inputs_are_read_before_an_output_is_written():
    text = c_code(trace(lambda x: x[::-1] * 2.0, (3,)))
    body = text[text.rindex("{") :]
    assert body.rindex("x0[") < body.index("y0[")


@pytest.mark.parametrize("names", [["2arm"], ["for"], ["t3"], ["arm", "q", "q"]])
def test_invalid_names_are_rejected(names):
    with pytest.raises(InputError, match="names in C code"):
        CWriter(True).declaration(names[0], names[1:], ())


# As accurate as without fused multiplications and additions, which some flags allow.
FLAGS = {"plain": ["-std=c99"], "fused": ["-march=native", "-ffp-contract=fast"]}


@pytest.fixture(scope="module", params=[(d, f) for d in (True, False) for f in FLAGS])
def library(request, tmp_path_factory):
    """Return the precision, writer, file and function of sines, cosines and tanh."""
    double, flags = request.param
    program = trace(lambda x: (jnp.sin(x), jnp.cos(x), jnp.tanh(x)), (5,))
    writer = CWriter(double, "arm", [program])
    text = (
        HEAD
        + writer.library()
        + writer.definition(program, "run", ["x"], ["s", "c", "h"])
    )
    target = compile_c(tmp_path_factory.mktemp("library"), text, "-O2", *FLAGS[flags])
    opened, dtype = ctypes.CDLL(str(target)), np.float64 if double else np.float32

    def call(x):
        x = np.ascontiguousarray(x, dtype)
        found = [np.zeros_like(x) for _ in range(3)]
        for k in range(len(x)):
            opened.run(*(ctypes.c_void_p(a[k].ctypes.data) for a in (x, *found)))
        return x.astype(np.longdouble), found

    return double, writer, target, call


def test_the_library_has_only_what_is_needed_for_an_even_number(library):
    assert library[1].widths == {"sine_cosine": 6, "tanh": 6}
    assert "tanh" not in CWriter(True, "arm", [trace(jnp.sin, (2,))]).library()
    assert CWriter(True, "arm", [trace(jnp.exp, (2,))]).library() == ""


def test_accuracy_of_the_library(library):
    double, writer, _, run = library
    allowed, random = (2e-16, 1.2e-7)[not double], np.random.default_rng(0)
    for size in (0.8, 3.0, 50.0, 6.28 * writer.turns):
        x, found = run(random.uniform(-size, size, (400, 5)))
        for got, function in zip(found, (np.sin, np.cos, np.tanh), strict=True):
            assert np.abs(got - function(x)).max() < allowed
    x, (_, _, h) = run(10.0 ** random.uniform(-6, 0, (400, 5)))
    assert np.abs(h / np.tanh(x) - 1).max() < 4 * allowed


def test_angles_without_a_known_sine_give_nan(library):
    _, writer, _, run = library
    far = 6.29 * writer.turns
    for bad in (np.nan, np.inf, -np.inf, far, -far, 1e18, -1e30, 2.0**63):
        x = np.full((1, 5), 0.3)
        x[0, 2] = bad
        _, (s, c, h) = run(x)
        assert np.isnan([s[0, 2], c[0, 2]]).all()
        assert np.isnan(h[0, 2]) if np.isnan(bad) else h[0, 2] == np.sign(bad)
        assert np.isfinite(np.delete([s, c, h], 2, axis=2)).all()


def test_no_branch_but_those_of_the_loops(library):
    if shutil.which("objdump") is None:
        pytest.skip("no objdump on this machine")
    command = ["objdump", "-d", "--no-show-raw-insn", str(library[2])]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    blocks = [
        b for b in text.split("\n\n") if re.search("<(run|arm_)", b.split("\n")[0])
    ]
    jumps = re.findall(r"\sj(?!mp)[a-z]+\s", "".join(blocks))
    assert blocks
    assert len(jumps) <= 2, jumps
