import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import SIZE, chain, random_functions, samples

from jaxid.program import BarrierFence, DivisionFence, NoFence, Reversible, lower, trace, unpack

FENCES = (NoFence(), BarrierFence(), DivisionFence())


def pulled(lowered, *x):
    """Packed results, and the cotangents of the inputs for others at random."""

    def packed(*x):
        return [y for y in lowered(*x) if not isinstance(y, float)]

    def both(*x):
        values, pull = jax.vjp(packed, *x)
        random = np.random.default_rng(0)
        return values, pull([jnp.asarray(random.normal(size=y.shape), y.dtype) for y in values])

    return jax.jit(both)(*x)


def assert_close(a, b, tolerance=1e-12):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance), a, b
    )


@given(random_functions(smooth=True))
@settings(max_examples=8, deadline=None, derandomize=True)
def test_the_same_as_jax_finds(function):
    lowered = lower(trace(function, (SIZE,), (SIZE,)))
    x = samples(1, (4,))
    assert_close(pulled(Reversible(lowered), *x), pulled(lowered, *x), 1e-10)


@pytest.mark.parametrize("fence", FENCES, ids=lambda f: type(f).__name__)
def test_behind_each_fence(fence):
    lowered = lower(trace(chain, (3,), (3,)), fence)
    x = [jnp.asarray(a) for a in samples(2, (2, 6))]
    assert_close(pulled(Reversible(lowered), *x), pulled(lowered, *x))
    mapped = jax.vmap(lambda *a: pulled(Reversible(lowered), *a), in_axes=1)(*x)
    each = [pulled(lowered, *(a[:, k] for a in x)) for k in range(2)]
    assert_close(mapped, jax.tree.map(lambda *a: jnp.stack(a), *each))


def test_kinks_choices_constants_and_repeated_results():
    def function(q, p):
        low = jnp.minimum(q[0], p[1]) * jnp.abs(q[1]) / (2.0 + p[0] ** 2)
        chosen = jnp.where(q[2] > p[2], low, jnp.sqrt(1.0 + p[0] ** 2))
        return jnp.stack([chosen, -chosen, 0.0 * q[0], 3.0 - chosen, jnp.arctan2(q[0], p[1]), low])

    lowered = lower(trace(function, (3,), (3,)))
    x = samples(3, (5,))[:, :3]
    assert_close(pulled(Reversible(lowered), *x), pulled(lowered, *x))
    dense = unpack(lowered.program, Reversible(lowered)(*x), (5,), float)
    assert_close(dense, lowered.dense(*x))


def test_single_precision_broadcasting_and_no_samples():
    lowered = lower(trace(chain, (3,), (3,)))
    q, p = (np.asarray(x, np.float32) for x in samples(4, (5,)))
    one = p[:, :1]
    found, expected = pulled(Reversible(lowered), q, one), pulled(lowered, q, one)
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(found))
    assert found[1][1].shape == one.shape
    assert_close(found, expected, 1e-4)
    assert_close(pulled(Reversible(lowered), q[:, :0], p[:, :0])[1], (q[:, :0], p[:, :0]))


@pytest.mark.parametrize("batch", [(), (5,), (2, 5)], ids=str)
def test_stacked_entries(batch):
    lowered = lower(trace(chain, (3,), (3,)))
    x = [jnp.asarray(a) for a in samples(5, batch)]
    size = len(lowered.program.outputs)
    groups = (tuple(range(size)), (size - 1, 0, 0), ())
    axis = max(len(batch) - 1, 0)

    def one_by_one(*x):
        packed = [jnp.broadcast_to(y, batch) for y in lowered(*x)]
        arrays = [jnp.stack([packed[k] for k in group], axis) for group in groups[:2]]
        return [*arrays, jnp.zeros((*batch[:axis], 0, *batch[axis:]))]

    def both(function):
        values, pull = jax.vjp(function, *x)
        return values, pull([jnp.cos(y) for y in values])

    found = jax.jit(lambda: both(lambda *x: Reversible(lowered).stacked(groups, *x)))()
    assert_close(found, jax.jit(lambda: both(one_by_one))())


def test_results_that_never_vary():
    lowered = lower(trace(lambda q: jnp.stack([0.0 * q[0], 0.0 * q[1] + 2.0]), (3,)))
    assert Reversible(lowered)(np.ones((3, 4))) == [0.0, 2.0]
