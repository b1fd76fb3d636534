"""Methods as users hand them to `jax.jit` and `jax.vmap`: bound, without a lambda."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import LinearSpring
from jaxid.robot.library import planar_arm
from jaxid.robot.limits_and_drives import Drives
from jaxid.trajectory.fourier import random_fourier_series

ROBOT = planar_arm(2)
MODEL = Model(ROBOT)
BASE = base_parameters(MODEL)
SERIES = random_fourier_series(ROBOT, omega=1.0)
DRIVES = Drives(2, reduction=[[10.0, 0.0], [2.0, 20.0]], zero=[0.1, 0.2])
Q, QD, QDD = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 2)))
MOTION = Motion(Q, QD, QDD)
P = jnp.linspace(1.0, 2.0, MODEL.size)
P_BASE = jnp.linspace(1.0, 2.0, BASE.size)
METHODS = {
    "model.regressor": (MODEL.regressor, (MOTION,)),
    "model.inverse_dynamics": (MODEL.inverse_dynamics, (P, MOTION)),
    "model.kinetic_energy": (MODEL.kinetic_energy, (P, Q, QD)),
    "model.tool_forces": (MODEL.tool_forces, (MOTION,)),
    "base.regressor": (BASE.regressor, (MOTION,)),
    "base.mass_matrix": (BASE.mass_matrix, (P_BASE, Q)),
    "base.from_standard": (BASE.from_standard, (P,)),
    "base.to_standard": (BASE.to_standard, (P_BASE,)),
    "series.motion": (SERIES.motion, (Q[:, 0],)),
    "drives.joint_angles": (DRIVES.joint_angles, (Q,)),
    "drives.motor_torques": (DRIVES.motor_torques, (Q,)),
}


@pytest.mark.parametrize("name", METHODS)
def test_a_bound_method_goes_through_jit(name):
    method, arguments = METHODS[name]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        jax.jit(method)(*arguments),
        method(*arguments),
    )


def test_many_parameters_by_vmap():
    found = jax.vmap(MODEL.inverse_dynamics, in_axes=(0, None))(
        jnp.stack([P, 3 * P]), MOTION
    )
    np.testing.assert_allclose(found[1], 3 * found[0], rtol=1e-12)


def test_equal_models_have_equal_hashes_and_others_do_not():
    same, other = (
        Model(planar_arm(2)),
        Model(planar_arm(2).replace(gravity=np.zeros(3))),
    )
    assert hash(same.regressor) == hash(MODEL.regressor)
    assert hash(other.regressor) != hash(MODEL.regressor)
    assert hash(MODEL.tool_forces) != hash(MODEL.regressor)


def test_a_bound_method_of_a_model_that_is_traced():
    """A derivative by a number of the model, through a compiled method of the model."""

    def size(rest):
        model = Model(ROBOT, (LinearSpring(rest),))
        return jnp.sum(jax.jit(model.regressor)(MOTION) ** 2)

    found = jax.grad(size)(jnp.array([0.3, -0.2]))
    np.testing.assert_allclose(
        found, -2 * np.sum(np.asarray(Q) - np.array([0.3, -0.2]), axis=0), rtol=1e-12
    )
