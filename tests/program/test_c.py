import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from sample_functions import SIZE, chain, random_functions, samples

from jaxid.program import evaluate, to_c, trace

STRICT = ["-Wall", "-Wextra", "-pedantic", "-Werror", "-O1", "-fPIC", "-shared"]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Compiles a program and returns it as a Python function of one sample."""
    if shutil.which("gcc") is None:
        pytest.skip("no C compiler (gcc) on this machine")
    folder, count = tmp_path_factory.mktemp("c"), iter(range(10**6))

    def compile_(program, double=True, language="c"):
        stem = folder / f"program{next(count)}"
        source, library = stem.with_suffix(".c"), stem.with_suffix(".so")
        source.write_text(to_c(program, "run", double=double))
        standard = {"c": "-std=c99", "c++": "-std=c++11"}[language]
        subprocess.run(
            ["gcc", "-x", language, standard, *STRICT, str(source), "-o", str(library), "-lm"],
            check=True,
        )
        run = ctypes.CDLL(str(library)).run
        dtype = np.float64 if double else np.float32

        def call(*inputs):
            given_ = [np.ascontiguousarray(x, dtype) for x in inputs]
            sizes = [int(np.prod(s)) for s in program.output_shapes]
            results = [np.full(max(size, 1), np.nan, dtype) for size in sizes]
            run(*(ctypes.c_void_p(x.ctypes.data) for x in (*given_, *results)))
            return [r[:k] for r, k in zip(results, sizes, strict=True)]

        return call

    return compile_


def flat(program, *x):
    return [np.ravel(v) for v in jax.tree.leaves(evaluate(program, *x))]


@given(function=random_functions())
@settings(
    max_examples=8,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_c_equals_numpy(compiled, function):
    program = trace(function, (SIZE,), (SIZE,))
    x = samples(0, ())
    for got, want in zip(compiled(program)(*x), flat(program, *x), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("language", ["c", "c++"])
@pytest.mark.parametrize("double", [True, False])
def test_every_operation_in_both_precisions_and_languages(compiled, double, language):
    def function(x, unused):
        a, b = x
        inside = 0.9 * jnp.sin(a)
        return (
            jnp.stack(
                [
                    jnp.tan(inside), jnp.arcsin(inside), jnp.arccos(inside), jnp.arctan(a),
                    jnp.sinh(a), jnp.cosh(a), jnp.tanh(a), jnp.sqrt(a * a), jnp.cbrt(a), jnp.exp(a),
                    jnp.log(a * a), jnp.expm1(a), jnp.log1p(b * b), jnp.abs(a) ** 0.3, jnp.sign(b),
                    jnp.arctan2(a, b), 1.0 / a, jnp.minimum(a, b), jnp.maximum(a, b), -a,
                    jnp.where((a > 0) & (b < 1) | ~(b != 0.5), a, -b), a - 1e-7 * b, 1e20 * a,
                ]
            ),
            np.array([0.0, 1.5, -2.0, np.inf, -np.inf, np.nan]),
            jnp.zeros((0, 2)),
        )  # fmt: skip

    program = trace(function, (2,), (3,))
    run = compiled(program, double, language)
    tolerance = 4e-16 if double else 1e-6
    for x in ([0.3, -0.4], [-1.2, 2.0], [0.7, 0.5]):
        for got, want in zip(
            run(x, np.zeros(3)), flat(program, np.array(x), np.zeros(3)), strict=True
        ):
            np.testing.assert_allclose(got, want, rtol=tolerance, atol=tolerance)


def test_nan_comes_through_choices(compiled):
    program = trace(lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, y), jnp.sign(x + y)), (), ())
    run = compiled(program)
    for x, y in ((np.nan, 1.0), (1.0, np.nan)):
        assert np.isnan(np.concatenate(run(x, y))).all()


def test_inputs_are_read_before_an_output_is_written():
    program = trace(lambda x: x[::-1] * 2.0, (3,))
    text = to_c(program, "swap")
    body = text[text.rindex("{") :]
    assert body.rindex("input0[") < body.index("output0[")


def test_names_and_documentation_in_the_source():
    text = to_c(trace(chain, (3,), (3,)), "arm", ["q", "qd"], ["v"])
    assert "void arm(const double *q, const double *qd, double *v)" in text
    assert "multiplications" in text
    assert "static" not in text
    assert text.count("v[") == 9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("2arm",), "names in C code"),
        (("for",), "names in C code"),
        (("t3",), "names in C code"),
        (("arm", ["q"]), "`inputs`"),
        (("arm", ["q", "q"]), "names in C code"),
    ],
)
def test_bad_names_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        to_c(trace(chain, (3,), (3,)), *arguments)
