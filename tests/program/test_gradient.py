"""The derivative of a program against that of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.program import trace
from jaxid.program.gradient import pull_back

FUNCTIONS = {
    "arithmetic": lambda x, y: jnp.stack([
        x[0] * x[1] - y / x[0],
        -x[1] + 3.0 * y,
        x[0] ** 3,
    ]),
    "circular": lambda x, y: jnp.stack([
        jnp.sin(x[0] * y),
        jnp.cos(x[1]) * jnp.sin(x[1]),
    ]),
    "functions": lambda x, y: jnp.stack([
        jnp.tanh(x[0]) + jnp.sinh(y),
        jnp.sqrt(x[1] ** 2 + 1.0) * jnp.exp(-y),
        jnp.log(2.0 + y) + jnp.arctan(x[0]) + jnp.tan(0.3 * y) + jnp.cosh(x[1]),
        jnp.arctan2(x[0], 1.5 + y) + jnp.log1p(y**2) + jnp.expm1(x[1])
        + jnp.cbrt(2.0 + y),
        jnp.arcsin(0.3 * y) + jnp.arccos(0.2 * y) + (2.0 + y) ** 1.7,
    ]),
    "choices": lambda x, y: jnp.stack([
        jnp.where(x[0] > 0.1, x[1] * y, x[1] ** 2),
        jnp.maximum(x[0], y) + jnp.minimum(x[1], 0.2),
        jnp.abs(x[1]) * jnp.sign(y),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_those_of_jax(name):
    function, random = FUNCTIONS[name], np.random.default_rng(0)
    program = trace(function, (2,), ())
    x, y = random.uniform(-0.9, 0.9, (2, 50)), random.uniform(-0.9, 0.9, 50)
    weights = random.standard_normal((len(program.outputs), 50))
    found = pull_back(program, weights, x, y)
    expected = jax.vmap(lambda x, y, w: jax.vjp(function, x, y)[1](w))(
        x.T, y, weights.T
    )
    np.testing.assert_allclose(found[0], expected[0].T, atol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-12)


def test_what_is_constant_has_no_derivative():
    program = trace(
        lambda x: jnp.stack([jnp.ones(()), 2.0 * x[0], jnp.zeros(())]), (2,)
    )
    (found,) = pull_back(program, np.ones((3, 4)), np.zeros((2, 4)))
    np.testing.assert_array_equal(found, [[2.0] * 4, [0.0] * 4])
