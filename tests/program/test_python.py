import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import SIZE, chain, random_functions, samples

from jaxid.program import evaluate, to_python, trace


def flat(program, *x):
    return np.concatenate([np.ravel(v) for v in jax.tree.leaves(evaluate(program, *x))])


@given(function=random_functions())
@settings(max_examples=15)
def test_python_equals_numpy(function):
    program = trace(function, (SIZE,), (SIZE,))
    x = samples(3, ())
    run = to_python(program)
    np.testing.assert_allclose(run(*x.tolist()), flat(program, *x), rtol=1e-13, atol=1e-14)


def test_shared_values_and_long_lines():
    program = trace(chain, (3,), (3,))
    x = samples(0, ())
    np.testing.assert_allclose(to_python(program)(*x.tolist()), flat(program, *x), rtol=1e-12)


@pytest.mark.parametrize("x", [-2.0, -0.0, 0.0, 0.5, np.inf, np.nan])
def test_choices_signs_and_constants(x):
    def function(x):
        y = jnp.where((x > 0) & ~(x > 1) | (x != x), x, -3.0)
        return y, jnp.sign(x), jnp.maximum(x, 0.25), jnp.minimum(x, np.inf), jnp.abs(x), np.inf * x

    program = trace(function, ())
    np.testing.assert_array_equal(to_python(program)([x]), flat(program, np.array(x)))


def test_results_are_floats_and_constants_are_kept():
    run = to_python(trace(lambda x: jnp.array([x[0], 0.0, -1.5]), (2,)))
    assert run([2.0, 3.0]) == (2.0, 0.0, -1.5)
    assert to_python(trace(lambda x: x, (0,)))([]) == ()


def test_what_is_not_defined_raises():
    with pytest.raises(ZeroDivisionError):
        to_python(trace(lambda x: 1.0 / x, ()))([0.0])
