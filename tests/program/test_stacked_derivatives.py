"""Derivatives of stacked results against those that JAX finds itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import SIZE, chain, random_functions, samples

from jaxid.program import lower, trace


def assert_derivatives(lowered, *x, groups=None, tolerance=1e-12):
    """Compare stacked results, their tangents, and cotangents of the inputs."""
    batch = np.broadcast_shapes(*(np.shape(a)[1:] for a in x))
    axis, dtype = max(len(batch) - 1, 0), x[0].dtype
    groups = (tuple(range(len(lowered.program.outputs))),) if groups is None else groups

    def one_by_one(*x):
        packed = [jnp.broadcast_to(jnp.asarray(y, dtype), batch) for y in lowered(*x)]
        empty = jnp.zeros((*batch[:axis], 0, *batch[axis:]), dtype)
        return [jnp.stack([packed[k] for k in g], axis) if g else empty for g in groups]

    def derivative(function, *x):
        values, pull = jax.vjp(function, *x)
        tangents = jax.jvp(function, x, tuple(jnp.sin(2.0 * y) for y in x))[1]
        return values, pull([jnp.cos(3.0 * y) for y in values]), tangents

    def close(a, b):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)
        assert (a.dtype, a.shape) == (b.dtype, b.shape)

    found = jax.jit(lambda *x: derivative(lambda *y: lowered.stacked(groups, *y), *x))(*x)
    jax.tree.map(close, found, jax.jit(lambda *x: derivative(one_by_one, *x))(*x))


@given(random_functions(smooth=True))
@settings(max_examples=3, deadline=None, derandomize=True)
def test_the_same_as_jax_finds(function):
    lowered = lower(trace(function, (SIZE,), (SIZE,)))
    assert_derivatives(lowered, *samples(1, (4,)), tolerance=1e-10)


def test_under_vmap():
    lowered = lower(trace(chain, (3,), (3,)))
    x = [jnp.asarray(a) for a in samples(2, (2, 6))]
    assert_derivatives(lowered, *(a[:, 0] for a in x))
    groups = (tuple(range(9)),)
    pulled = jax.jit(jax.grad(lambda *a: jnp.sum(lowered.stacked(groups, *a)[0] ** 3)))
    mapped = jax.vmap(pulled, in_axes=1, out_axes=1)(*x)
    np.testing.assert_allclose(mapped[:, 1], pulled(*(a[:, 1] for a in x)), rtol=1e-12)


def test_kinks_choices_constants_and_repeated_results():
    def function(q, p):
        low = jnp.minimum(q[0], p[1]) * jnp.abs(q[1]) / (2.0 + p[0] ** 2)
        choice = jnp.where(q[2] > p[2], low, jnp.sqrt(1.0 + p[0] ** 2))
        return jnp.stack([choice, -choice, 0.0 * q[0], 3.0 - choice, jnp.arctan2(q[0], p[1]), low])

    assert_derivatives(lower(trace(function, (3,), (3,))), *samples(3, (5,)))
    constants = lower(trace(lambda q: jnp.stack([0.0 * q[0], 0.0 * q[1] + 2.0]), (3,)))
    assert_derivatives(constants, *samples(3, (5,), count=1))


def test_single_precision_broadcasting_and_no_samples():
    lowered = lower(trace(chain, (3,), (3,)))
    q, p = (np.asarray(x, np.float32) for x in samples(4, (5,)))
    assert_derivatives(lowered, q, p[:, :1], tolerance=1e-4)
    assert_derivatives(lowered, q[:, :0], p[:, :0])


@pytest.mark.parametrize("batch", [(), (2, 5)], ids=str)
def test_groups_and_batches(batch):
    lowered = lower(trace(chain, (3,), (3,)))
    size = len(lowered.program.outputs)
    groups = (tuple(range(size)), (size - 1, 0, 0), ())
    assert_derivatives(lowered, *samples(5, batch), groups=groups)
