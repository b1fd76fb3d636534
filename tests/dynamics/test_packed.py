"""The packed regressor against the dense one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid as jid
from jaxid.dynamics.dispatch import FEW

TERMS = (jid.RigidBodies(), jid.ViscousFriction(), jid.ConstantOffset(), jid.RotorInertia())


@pytest.fixture(scope="module")
def model():
    return jid.Model(jid.robots.planar_arm(), TERMS)


def random_motion(model, samples):
    x = np.random.default_rng(0).uniform(-2, 2, (3, samples, model.robot.joints))
    return jid.Motion(*x)


@pytest.mark.parametrize("samples", [1, 30, FEW + 3])
@pytest.mark.parametrize("in_jax", [False, True])
def test_operators_are_those_of_the_dense_matrix(model, samples, in_jax):
    base = jid.base_parameters(model)
    motion = random_motion(model, samples)
    if in_jax:
        motion = jax.tree.map(jnp.asarray, motion)
    for owner in (model, base):
        packed = owner.packed_regressor(motion)
        theta = np.asarray(owner.regressor(motion))
        stacked = theta.swapaxes(0, 1).reshape(-1, owner.size)
        random = np.random.default_rng(1)
        w = random.uniform(0.5, 2, model.robot.joints)
        weighted = (theta * w[:, None]).reshape(-1, owner.size)
        information = weighted.T @ weighted
        assert packed.shape == stacked.shape == packed.matrix().shape
        assert packed.matrix().flags.f_contiguous
        np.testing.assert_allclose(packed.matrix(), stacked, rtol=0, atol=1e-13)
        np.testing.assert_allclose(packed.gram(w), information, atol=1e-9 * samples)
        R = packed.factor(w)
        assert np.array_equal(R, np.triu(R))
        np.testing.assert_allclose(R.T @ R, information, atol=1e-9 * samples)


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

    def log_det(q):
        packed = model.packed_regressor(jid.Motion(q, motion.qd, motion.qdd))
        return jnp.linalg.slogdet(packed.gram() + jnp.eye(model.size))[1]

    def dense(q):
        theta = model.regressor(jid.Motion(q, motion.qd, motion.qdd)).reshape(-1, model.size)
        return jnp.linalg.slogdet(theta.T @ theta + jnp.eye(model.size))[1]

    np.testing.assert_allclose(jax.jit(jax.grad(log_det))(motion.q), jax.grad(dense)(motion.q))


def test_refuses_batches_and_traced_geometry(model):
    motion = random_motion(model, 6)
    with pytest.raises(ValueError, match=r"shape \[samples, joints\], but has \(2, 3, "):
        model.packed_regressor(jax.tree.map(lambda x: x.reshape(2, 3, -1), motion))

    @eqx.filter_jit
    def traced(model):
        return model.packed_regressor(motion).gram()

    with pytest.raises(ValueError, match="geometry is known"):
        traced(jax.tree.map(jnp.asarray, model))
