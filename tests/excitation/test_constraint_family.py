"""Every constraint: derivatives, one sample like many, words; and its own oracle."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import CoulombFriction, HardSign, RigidBodies
from jaxid.excitation.constraints import Clearance, ForceLimits, TipLimits, tip_motion
from jaxid.robot import library
from jaxid.robot.collision import Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.limits_and_drives import Drives, Limits
from jaxid.trajectory.fourier import random_fourier_series

# Three joints in a vertical plane; the third motor turns with the second joint.
ROBOT = library.planar_arm(3, [0.5, 0.4, 0.3]).replace(
    limits=Limits(
        3,
        position_min=[-2.0, -2.5, -2.5],
        position_max=[2.0, 2.5, 2.5],
        velocity=[3.0] * 3,
        acceleration=[9.0] * 3,
        force=[60.0, np.inf, 9.0],
    ),
    drives=Drives(
        3,
        reduction=[[30.0, 0.0, 0.0], [0.0, 45.0, 0.0], [0.0, 20.0, -32.0]],
        max_torques=[1.0, np.inf, 0.4],
    ),
)
ROBOT = ROBOT.with_tool(mass=0.8, centre_of_mass=(0.05, 0.01, 0.0))
BASE = base_parameters(Model(ROBOT, (RigidBodies(),)))
RANDOM = np.random.default_rng(0)
NOMINAL = RANDOM.standard_normal(BASE.size)
ROOT = 0.1 * RANDOM.standard_normal((BASE.size, BASE.size))
SHAPES = CollisionModel(
    ROBOT,
    (
        Capsule("trunk", -1, start=(0, -0.6, 0), end=(0, -0.1, 0), radius=0.1),
        Capsule("upper arm", 0, start=(0, 0, 0), end=(0.5, 0, 0), radius=0.06),
        Capsule("forearm", 1, start=(0, 0, 0.03), end=(0.4, 0, 0.03), radius=0.05),
        Capsule("hand", 2, start=(0.3, 0, 0.1), radius=0.05),
    ),
    (
        HalfSpace("ground", normal=(0.0, 1.0, 0.0), height=-0.6),
        Box("table", centre=(0.7, -0.3, 0.1), size=(0.3, 0.4, 1.0)),
    ),
    (
        ("trunk", "forearm"),
        ("upper arm", "hand"),
        ("hand", "ground"),
        ("forearm", "table"),
    ),
)
FAMILY = {
    "forces": ForceLimits(BASE, NOMINAL, ROOT @ ROOT.T),
    "known forces": ForceLimits(BASE, NOMINAL, margin=0.0),
    "tip": TipLimits(1.5, 8.0, (-0.3, 0.2, -np.inf), (0.4, 0.9, np.inf)),
    "clearance": Clearance(SHAPES, distance=0.05),
}
SERIES = random_fourier_series(ROBOT, omega=1.2, harmonics=3, seed=2)
MOTION = SERIES.motion(np.linspace(0.0, SERIES.duration, 40))
LIMITS = np.array([60.0, 9.0, 1.0, 0.4])


def limited(forces):
    """Forces of the first and third joint, then torques of their motors."""
    torques = np.asarray(forces) @ np.linalg.inv(np.asarray(ROBOT.drives.reduction))
    return np.concatenate([np.asarray(forces), torques], axis=-1)[..., [0, 2, 3, 5]]


@cache
def judged(name):
    """The compiled values of a constraint at the samples of the motion."""
    return np.asarray(jax.jit(lambda m: FAMILY[name](ROBOT, m))(MOTION))


@pytest.mark.parametrize("name", FAMILY)
def test_derivatives_are_central_differences(name):
    constraint = FAMILY[name]
    direction = jnp.asarray(
        np.random.default_rng(1).standard_normal((3, *MOTION.q.shape))
    )
    weight = np.random.default_rng(2).standard_normal(
        (40, len(constraint.entries(ROBOT)))
    )

    @jax.jit
    @jax.value_and_grad
    def total(parts):
        return jnp.sum(weight * constraint(ROBOT, Motion(*parts)))

    at = jnp.stack([MOTION.q, MOTION.qd, MOTION.qdd])
    _, gradient = total(at)
    h = 1e-5
    # Fourth order, so that only rounding is left.
    near, far = (
        total(at + k * h * direction)[0] - total(at - k * h * direction)[0]
        for k in (1, 2)
    )
    wrong = float(jnp.sum(gradient * direction) - (8 * near - far) / (12 * h))
    assert (
        abs(wrong) <= 1e-6 * np.linalg.norm(gradient) * np.linalg.norm(direction) / 30
    )


@pytest.mark.parametrize("name", FAMILY)
def test_a_sample_is_judged_by_itself_and_under_jit_and_vmap(name):
    constraint = FAMILY[name]
    many = judged(name)
    assert many.shape == (40, len(constraint.entries(ROBOT)))
    alone = jax.jit(lambda m: constraint(ROBOT, m))(MOTION[7])
    np.testing.assert_allclose(alone, many[7], atol=1e-10)
    folded = Motion(*(x.reshape(4, 10, 3) for x in (MOTION.q, MOTION.qd, MOTION.qdd)))
    mapped = jax.jit(jax.vmap(lambda m: constraint(ROBOT, m)))(folded)
    np.testing.assert_allclose(mapped.reshape(many.shape), many, atol=1e-9)


@pytest.mark.parametrize("name", FAMILY)
def test_words_name_what_is_exceeded(name):
    constraint = FAMILY[name]
    entries, values = constraint.entries(ROBOT), judged(name)
    assert len({(e.name, e.is_lower_limit) for e in entries}) == len(entries)
    for f, peak in zip(
        constraint.describe(ROBOT, values), values.max(axis=0), strict=True
    ):
        assert f.excess == pytest.approx(peak * f.size)
        word = (
            "to spare"
            if f.value <= 0
            else "falls short"
            if f.is_lower_limit
            else f"{100 * peak:.3g} %"
            if f.has_use
            else "exceeds"
        )
        assert word in str(f)
        assert f"{abs(f.excess):.3g} {f.unit}" in str(f)
        assert f"{f.limit:.4g} {f.unit}" in str(f)


def test_forces_are_the_regressors_with_tool_and_deviations():
    theta = np.asarray(BASE.regressor(MOTION))
    forces = theta @ NOMINAL + np.asarray(BASE.model.tool_forces(MOTION))
    to_motors = np.hstack([np.eye(3), np.linalg.inv(ROBOT.drives.reduction)])[
        :, [0, 2, 3, 5]
    ]
    rows = np.einsum("sjb,jm->smb", theta, to_motors)
    deviation = np.sqrt(np.einsum("smb,bc,smc->sm", rows, ROOT @ ROOT.T, rows))
    expected = (np.abs(limited(forces)) + 2 * deviation) / (0.9 * LIMITS) - 1
    np.testing.assert_allclose(FAMILY["forces"](ROBOT, MOTION), expected, atol=1e-9)
    known = np.abs(limited(forces)) / LIMITS - 1
    np.testing.assert_allclose(FAMILY["known forces"](ROBOT, MOTION), known, atol=1e-9)
    names = [f"the force of joint `{ROBOT.joint_names[k]}`" for k in (0, 2)]
    names += [f"the torque of motor {k}" for k in (1, 3)]
    assert [e.name for e in FAMILY["forces"].entries(ROBOT)] == names


def test_a_joint_that_turns_round_may_need_friction_to_either_side():
    base = base_parameters(Model(ROBOT, (RigidBodies(), CoulombFriction(HardSign()))))
    p = np.random.default_rng(3).standard_normal(base.size)
    p[[k for k, name in enumerate(base.names) if name.startswith("fc")]] = [
        5.0,
        3.0,
        1.0,
    ]
    constraint = ForceLimits(base, p, margin=0.0)

    def needed(motion):
        forces = base.inverse_dynamics(p, motion) + base.model.tool_forces(motion)
        return np.abs(limited(forces))[:, :2] / LIMITS[:2] - 1

    def values(motion):
        return np.asarray(constraint(ROBOT, motion))[:, :2]

    coarse = Motion(*(np.asarray(x) for x in (MOTION.q, MOTION.qd, MOTION.qdd)))
    assert (values(coarse) >= needed(coarse) - 1e-12).all()
    width = 0.02 * np.asarray(ROBOT.limits.velocity)
    for side in (-1.0, 1.0):
        turning, other = (
            Motion(coarse.q, sign * 0.2 * width + 0 * coarse.qd, coarse.qdd)
            for sign in (side, -side)
        )
        assert (values(turning) >= needed(other) - 1e-3).all()
    fast = (np.abs(coarse.qd) > 2 * width).all(axis=1)
    assert fast.sum() > 10
    np.testing.assert_allclose(values(coarse)[fast], needed(coarse)[fast], atol=1e-12)


def test_the_tip_moves_as_its_difference_quotients():
    t, h = np.linspace(0.3, 4.0, 9), 1e-4
    ahead, now, behind = (
        tip_motion(ROBOT, SERIES.motion(t + s * h)) for s in (1, 0, -1)
    )
    for order, atol in ((0, 1e-6), (1, 1e-5)):
        slope = (ahead[order] - behind[order]) / (2 * h)
        np.testing.assert_allclose(now[order + 1], slope, atol=atol)
    values = np.asarray(FAMILY["tip"](ROBOT, SERIES.motion(t)))
    sizes = [np.linalg.norm(x, axis=1) for x in now[1:]]
    np.testing.assert_allclose(
        [1.5, 8.0] * (1 + values[:, :2]), np.transpose(sizes), rtol=1e-6
    )
    # The box counts in tenths of a metre: upper sides, then lower ones.
    p = np.asarray(now[0])
    np.testing.assert_allclose(values[:, 2], (p[:, 0] - 0.4) / 0.1, atol=1e-10)
    np.testing.assert_allclose(values[:, 4], (-0.3 - p[:, 0]) / 0.1, atol=1e-10)
    np.testing.assert_allclose(values[:, 5], (0.2 - p[:, 1]) / 0.1, atol=1e-10)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ForceLimits(BASE, NOMINAL[:3]), "`parameters`"),
        (lambda: ForceLimits(BASE, NOMINAL, np.eye(3)), "`covariance`"),
        (lambda: ForceLimits(BASE, NOMINAL, -np.eye(BASE.size)), "`covariance`"),
        (lambda: TipLimits(0.0), "`speed`"),
        (lambda: TipLimits(low=(0, 0, 0), high=(1, 0, 1)), "`low`"),
        (lambda: TipLimits(low=(0, 0), high=(1, 1)), "`low`"),
    ],
)
def test_refuses(make, message):
    with pytest.raises(ValueError, match=message):
        make()
