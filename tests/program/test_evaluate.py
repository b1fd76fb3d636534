import jax.numpy as jnp
import numpy as np
import pytest
from sample_functions import chain, reference, samples

from jaxid.program import evaluate, evaluate_packed, trace


@pytest.mark.parametrize("batch", [(), (1,), (7,), (1023,), (1024,), (2500,), (3, 2), (0,)])
def test_any_batch_shape_and_block(batch):
    program = trace(chain, (3,), (3,))
    x = samples(0, batch)
    got = evaluate(program, *x)
    assert got.shape == (3, 3, *batch)
    flat = x.reshape(2, 3, -1)
    if flat.shape[-1]:
        want = reference(chain, *flat).reshape(3, 3, *batch)
        np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-14)


def test_batches_are_broadcast():
    program = trace(lambda a, b: a * b, (2,), (2,))
    a, b = np.ones((2,)), np.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(evaluate(program, a, b), b)


def test_packed_results_keep_constants_and_share_arrays():
    program = trace(lambda x: jnp.array([x, 0.0, x, 2.5]), ())
    first, zero, second, constant = evaluate_packed(program, np.arange(3.0))
    np.testing.assert_array_equal(first, np.arange(3.0))
    assert first is second
    assert (zero, constant) == (0.0, 2.5)


def test_results_are_float64_whatever_comes():
    program = trace(lambda x: x / 3.0, ())
    assert evaluate(program, np.ones(2, np.float32)).dtype == np.float64
    assert evaluate(program, np.array([1, 2])).dtype == np.float64


def test_inputs_are_not_changed_and_results_are_not_shared():
    program = trace(lambda x: (x, x + 1.0), (2,))
    x = np.arange(2.0)
    same, _ = evaluate(program, x)
    same[:] = 9.0
    np.testing.assert_array_equal(x, [0.0, 1.0])


def test_choices_as_results_and_as_operands_over_several_blocks():
    program = trace(lambda x: (jnp.where(x > 0, x, 2.0), jnp.where(x > 0, x, -x) * 3.0), ())
    x = np.linspace(-1, 1, 3001)
    a, b = evaluate(program, x)
    np.testing.assert_array_equal(a, np.where(x > 0, x, 2.0))
    np.testing.assert_allclose(b, 3.0 * np.abs(x), rtol=1e-15)


def test_nan_and_infinity_come_through_without_warnings():
    program = trace(lambda x: (jnp.sin(x), 1.0 / x, jnp.sign(x), jnp.maximum(x, 0.0)), ())
    sine, reciprocal, sign, maximum = evaluate(program, np.array([np.nan, np.inf, 0.0]))
    assert np.isnan(sine[:2]).all()
    assert np.isnan([reciprocal[0], sign[0], maximum[0]]).all()
    assert reciprocal[2] == np.inf


def test_wrong_inputs_are_refused():
    program = trace(lambda a, b: a + b, (3,), (3,))
    with pytest.raises(ValueError, match="takes 2 arrays"):
        evaluate(program, np.ones(3))
    with pytest.raises(ValueError, match=r"Input 1 of the program must have shape \(3,\)"):
        evaluate(program, np.ones(3), np.ones((5, 3)))
