"""The packed regressor against the dense one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid as jid
from jaxid.program.sample_methods import MAX_SAMPLES_IN_NUMPY

TERMS = (
    jid.RigidBodies(),
    jid.ViscousFriction(),
    jid.ConstantOffset(),
    jid.RotorInertia(),
)


@pytest.fixture(scope="module")
def model():
    return jid.Model(jid.robots.planar_arm(), TERMS)


def random_motion(model, samples):
    x = np.random.default_rng(0).uniform(-2, 2, (3, samples, model.robot.joints))
    return jid.Motion(*x)


@pytest.mark.parametrize("samples", [1, MAX_SAMPLES_IN_NUMPY + 3])
@pytest.mark.parametrize("in_jax", [False, True])
def test_the_matrix_is_the_dense_one(model, samples, in_jax):
    base = jid.base_parameters(model)
    motion = random_motion(model, samples)
    if in_jax:
        motion = jax.tree.map(jnp.asarray, motion)
    for owner in (model, base):
        theta = np.asarray(owner.regressor(motion))
        matrix = owner.packed_regressor(motion).matrix()
        stacked = theta.swapaxes(0, 1).reshape(-1, owner.size)
        assert matrix.flags.f_contiguous
        np.testing.assert_allclose(matrix, stacked, rtol=0, atol=1e-13)


def test_constant_entries_are_kept_and_zeros_are_not_stored(model):
    packed = model.packed_regressor(random_motion(model, 5))
    n = model.robot.joints
    offsets = [model.parameter_names.index(f"fo{i + 1}") for i in range(n)]
    for joint, own in enumerate(packed.places):
        assert (offsets[joint], 1.0) in own
        assert 0.0 not in [x for _, x in own if isinstance(x, float)]
    assert len({id(x) for x in packed.values}) == len(packed.values)


def test_goes_through_jit_and_gradients(model):
    motion = jax.tree.map(jnp.asarray, random_motion(model, 20))
    places = enumerate(model.packed_regressor(motion).places)
    own = {x: (j, k) for j, row in places for k, x in row if isinstance(x, int)}

    def packed(q):
        return model.packed_regressor(jid.Motion(q, motion.qd, motion.qdd)).values

    def dense(q):
        theta = model.regressor(jid.Motion(q, motion.qd, motion.qdd))
        return [theta[:, j, k] for _, (j, k) in sorted(own.items())]

    def slope(entries):
        return jax.grad(lambda q: sum(jnp.sum(jnp.cos(x)) for x in entries(q)))

    found, expected = (jax.jit(slope(x))(motion.q) for x in (packed, dense))
    np.testing.assert_allclose(found, expected)


def test_refuses_batches_and_traced_geometry(model):
    motion = random_motion(model, 6)
    with pytest.raises(
        ValueError, match=r"shape \[samples, joints\], but has \(2, 3, "
    ):
        model.packed_regressor(jax.tree.map(lambda x: x.reshape(2, 3, -1), motion))

    @eqx.filter_jit
    def traced(model):
        return model.packed_regressor(motion).values

    with pytest.raises(ValueError, match="geometry is known"):
        traced(jax.tree.map(jnp.asarray, model))
