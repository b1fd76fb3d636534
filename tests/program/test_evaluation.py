"""Programs in NumPy and in Python's floats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import SIZE, chain, random_functions, reference, samples

from jaxid.errors import InputError
from jaxid.program import evaluate, evaluate_rows, packed_entries, to_python, trace


def flat(program, *x):
    return np.concatenate([np.ravel(v) for v in jax.tree.leaves(evaluate(program, *x))])


@pytest.mark.parametrize("batch", [(), (1023,), (1024,), (2500,), (3, 2), (0,)])
def test_any_batch_shape_and_block(batch):
    program, x = trace(chain, (3,), (3,)), samples(0, batch)
    got, flattened = evaluate(program, *x), x.reshape(2, 3, -1)
    assert got.shape == (3, 3, *batch)
    if flattened.shape[-1]:
        want = reference(chain, *flattened).reshape(3, 3, *batch)
        np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-14)


def test_batches_are_broadcast_and_results_are_float64():
    program = trace(lambda a, b: a * b, (2,), (2,))
    b = np.arange(8).reshape(2, 4)
    got = evaluate(program, np.ones(2, np.float32), b)
    np.testing.assert_array_equal(got, b)
    assert got.dtype == np.float64


def test_distinct_results_are_computed_once_and_constants_not_at_all():
    program = trace(lambda x: jnp.array([x, 0.0, x, 2.5]), ())
    rows = evaluate_rows(program, np.arange(3.0))
    np.testing.assert_array_equal(rows, [np.arange(3.0)])
    expected = [[x, 0.0, x, 2.5] for x in range(3)]
    np.testing.assert_array_equal(
        packed_entries(program, rows, np.arange(4)).T, expected
    )


def test_inputs_are_not_changed():
    x = np.arange(2.0)
    same, _ = evaluate(trace(lambda x: (x, x + 1.0), (2,)), x)
    same[:] = 9.0
    np.testing.assert_array_equal(x, [0.0, 1.0])


def test_choices_as_results_and_as_operands_over_several_blocks():
    program = trace(
        lambda x: (jnp.where(x > 0, x, 2.0), jnp.where(x > 0, x, -x) * 3.0), ()
    )
    x = np.linspace(-1, 1, 3001)
    a, b = evaluate(program, x)
    np.testing.assert_array_equal(a, np.where(x > 0, x, 2.0))
    np.testing.assert_allclose(b, 3.0 * np.abs(x), rtol=1e-15)


def test_nan_and_infinity_are_kept_without_warnings():
    program = trace(
        lambda x: (jnp.sin(x), 1.0 / x, jnp.sign(x), jnp.maximum(x, 0.0)), ()
    )
    sine, reciprocal, sign, maximum = evaluate(program, np.array([np.nan, np.inf, 0.0]))
    assert np.isnan(sine[:2]).all()
    assert np.isnan([reciprocal[0], sign[0], maximum[0]]).all()
    assert reciprocal[2] == np.inf


def test_invalid_inputs_are_rejected():
    program = trace(lambda a, b: a + b, (3,), (3,))
    with pytest.raises(InputError, match="takes 2 arrays"):
        evaluate(program, np.ones(3))
    with pytest.raises(InputError, match=r"Input 1 .* shape \(3,\)"):
        evaluate(program, np.ones(3), np.ones((5, 3)))


@given(function=random_functions())
@settings(max_examples=10, deadline=None, derandomize=True)
def test_python_equals_numpy(function):
    program, x = trace(function, (SIZE,), (SIZE,)), samples(3, ())
    np.testing.assert_allclose(
        to_python(program)(*x.tolist()), flat(program, *x), rtol=1e-13, atol=1e-14
    )


def test_shared_values_and_long_lines_in_python():
    program, x = trace(chain, (3,), (3,)), samples(0, ())
    np.testing.assert_allclose(
        to_python(program)(*x.tolist()), flat(program, *x), rtol=1e-12
    )


@pytest.mark.parametrize("x", [-2.0, -0.0, 0.0, 0.5, np.inf, np.nan])
def test_choices_signs_and_constants_in_python(x):
    def function(x):
        y = jnp.where((x > 0) & ~(x > 1) | (x != x), x, -3.0)
        return (
            y,
            jnp.sign(x),
            jnp.maximum(x, 0.25),
            jnp.minimum(x, np.inf),
            jnp.abs(x),
            np.inf * x,
        )

    program = trace(function, ())
    np.testing.assert_array_equal(to_python(program)([x]), flat(program, np.array(x)))


def test_python_returns_floats_and_raises_its_own_errors():
    assert to_python(trace(lambda x: jnp.array([x[0], 0.0, -1.5]), (2,)))(
        [2.0, 3.0]
    ) == (
        2,
        0,
        -1.5,
    )
    assert to_python(trace(lambda x: x, (0,)))([]) == ()
    with pytest.raises(ZeroDivisionError):
        to_python(trace(lambda x: 1.0 / x, ()))([0.0])


@pytest.mark.parametrize("limit", [1e-3, 0.8, 7.0, 1e5, 1e9])
def test_sines_and_cosines_in_numpy_are_exact_to_two_last_bits(limit):
    program = trace(lambda x: (jnp.sin(x), jnp.cos(x), 2.0 * jnp.sin(x)), ())
    quarter_turns = np.array([1, 2, 3, 4, 5, 6, 63661]) * (np.pi / 4)
    random = np.random.default_rng(0).uniform(-limit, limit, 20000)
    x = np.concatenate([[0.0, -0.0], quarter_turns, -quarter_turns, random])
    sine, cosine, double = evaluate(program, x)
    # The library's own are exact to half a bit.
    np.testing.assert_allclose(sine, np.sin(x), atol=3e-16, rtol=3e-16)
    np.testing.assert_allclose(cosine, np.cos(x), atol=3e-16, rtol=0)
    np.testing.assert_array_equal(double, 2.0 * sine)
    np.testing.assert_array_equal([sine[0], cosine[0]], [0.0, 1.0])
