from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.program import sine_cosine

PI = Fraction(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899"
)
pair = jax.jit(sine_cosine)


def exact(x: float) -> tuple[float, float]:
    """Sine and cosine by their series in rational numbers."""
    r = Fraction(float(x))
    r -= round(r / (2 * PI)) * 2 * PI
    r = Fraction(int(r * 2**200), 2**200)
    sine, cosine, term = Fraction(0), Fraction(0), Fraction(1)
    for k in range(48):
        if k % 2:
            sine += term * (-1) ** (k // 2)
        else:
            cosine += term * (-1) ** (k // 2)
        term = Fraction(int(term * r / (k + 1) * 2**200), 2**200)
    return sine, cosine


def errors(x):
    got = [np.asarray(v, np.float64) for v in pair(jnp.asarray(x))]
    want = [exact(v) for v in x]
    return max(
        abs(float(Fraction(float(g)) - w[k]))
        for k in (0, 1)
        for g, w in zip(got[k], want, strict=True)
    )


@pytest.mark.parametrize("limit", [0.8, 7.0, 1e3, 1e5, 3e9])
def test_double_precision_is_exact_to_the_last_bit_or_so(limit):
    x = np.random.default_rng(0).uniform(-limit, limit, 150)
    assert errors(x) < 1.5e-16


@pytest.mark.parametrize("limit", [0.8, 7.0, 1e3, 1e5])
def test_single_precision(limit):
    x = np.random.default_rng(1).uniform(-limit, limit, 150).astype(np.float32)
    assert errors(x) < 1e-7


def test_near_the_edges_of_the_quarter_turns():
    k = np.concatenate([np.arange(-9, 10), [1001, 63661, 2_000_000_001]])
    x = np.concatenate([np.nextafter(k * (np.pi / 4), s * np.inf) for s in (-1, 1)])
    assert errors(x) < 1.5e-16


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zero_is_exact_and_what_has_no_sine_is_nan(dtype):
    x = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 1e30], dtype)
    sine, cosine = map(np.asarray, pair(x))
    assert sine.dtype == dtype
    np.testing.assert_array_equal(sine[:2], x[:2])
    np.testing.assert_array_equal(cosine[:2], 1)
    assert np.isnan(sine[2:]).all()
    assert np.isnan(cosine[2:]).all()


def test_derivatives_are_exact_also_the_second_and_across_quarters():
    x = np.linspace(-8, 8, 101)
    first = jax.vmap(jax.grad(lambda v: sine_cosine(v)[0]))(x)
    np.testing.assert_allclose(first, np.cos(x), atol=2e-16, rtol=0)
    second = jax.vmap(jax.grad(jax.grad(lambda v: sine_cosine(v)[1])))(x)
    np.testing.assert_allclose(second, -np.cos(x), atol=2e-16, rtol=0)
    _, tangent = jax.jvp(sine_cosine, (jnp.asarray(x),), (jnp.full_like(x, 2.0),))
    np.testing.assert_allclose(tangent[1], -2 * np.sin(x), atol=4e-16, rtol=0)
