"""Every constraint: derivatives, one sample like many, words; and each one's own oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import CoulombFriction, HardSign, RigidBodies
from jaxid.excitation.constraints import (
    Clearance,
    JointForces,
    MotorTorques,
    NominalForces,
    TipAcceleration,
    TipSpeed,
    Workspace,
    tip_motion,
)
from jaxid.robot import library
from jaxid.robot.collision import Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.joints import Drives, Limits
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
EXPECTED = NominalForces(BASE, NOMINAL, ROOT @ ROOT.T, deviations=2.0)
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
    (("trunk", "forearm"), ("upper arm", "hand"), ("hand", "ground"), ("forearm", "table")),
)
FAMILY = {
    "forces": JointForces(EXPECTED),
    "known forces": JointForces(NominalForces(BASE, NOMINAL), margin=0.0),
    "motors": MotorTorques(EXPECTED, margin=0.2),
    "speed": TipSpeed(1.5),
    "acceleration": TipAcceleration(8.0),
    "workspace": Workspace((-0.3, 0.2, -np.inf), (0.4, 0.9, np.inf)),
    "clearance": Clearance(SHAPES),
}
SERIES = random_fourier_series(ROBOT, omega=1.2, harmonics=3, seed=2)
MOTION = SERIES.motion(np.linspace(0.0, SERIES.duration, 40))


def shifted(motion, direction, h):
    parts = (motion.q, motion.qd, motion.qdd)
    return Motion(*(x + h * d for x, d in zip(parts, direction, strict=True)))


@pytest.mark.parametrize("name", FAMILY)
def test_derivatives_are_central_differences(name):
    constraint = FAMILY[name]
    direction = np.random.default_rng(1).standard_normal((3, *MOTION.q.shape))
    weight = np.random.default_rng(2).standard_normal((40, len(constraint.entries(ROBOT))))

    @jax.jit
    def total(h):
        return jnp.sum(weight * constraint(ROBOT, shifted(MOTION, jnp.asarray(direction), h)))

    gradient = jax.jit(jax.grad(lambda m: jnp.sum(weight * constraint(ROBOT, m))))(MOTION)
    parts = [gradient.q, gradient.qd, gradient.qdd]
    along = sum(float(jnp.sum(g * d)) for g, d in zip(parts, direction, strict=True))
    size = np.sqrt(sum(float(jnp.sum(g**2)) for g in parts))
    h = 1e-5
    # Fourth order, so that only rounding is left.
    quotient = (8 * (total(h) - total(-h)) - (total(2 * h) - total(-2 * h))) / (12 * h)
    assert abs(along - float(quotient)) <= 1e-6 * size * np.linalg.norm(direction) / 30


@pytest.mark.parametrize("name", FAMILY)
def test_a_sample_is_judged_by_itself_and_under_jit_and_vmap(name):
    constraint = FAMILY[name]
    many = np.asarray(constraint(ROBOT, MOTION))
    assert many.shape == (40, len(constraint.entries(ROBOT)))
    np.testing.assert_allclose(constraint(ROBOT, MOTION[7]), many[7], atol=1e-10)
    folded = Motion(*(x.reshape(4, 10, 3) for x in (MOTION.q, MOTION.qd, MOTION.qdd)))
    mapped = jax.jit(jax.vmap(lambda m: constraint(ROBOT, m)))(folded)
    np.testing.assert_allclose(mapped.reshape(many.shape), many, atol=1e-9)


@pytest.mark.parametrize("name", FAMILY)
def test_words_name_what_is_exceeded(name):
    constraint = FAMILY[name]
    entries = constraint.entries(ROBOT)
    assert len({(e.name, e.least) for e in entries}) == len(entries)
    found = constraint.describe(ROBOT, np.asarray(constraint(ROBOT, MOTION)))
    assert [f.name for f in found] == [e.name for e in entries]
    assert all(e.size > 0 for e in entries)
    for f in found:
        word = "with" if f.value <= 0 else "short" if f.least else "exceeds"
        assert f"{abs(f.excess):.3g} {f.unit}" in str(f)
        assert word in str(f)


def test_forces_are_the_regressors_with_tool_and_deviations():
    theta = np.asarray(BASE.regressor(MOTION))
    forces = theta @ NOMINAL + np.asarray(BASE.model.tool_forces(MOTION))
    deviation = np.sqrt(np.einsum("sjb,bc,sjc->sj", theta, ROOT @ ROOT.T, theta))
    limited = [0, 2]
    limits = np.asarray(ROBOT.limits.force)[limited]
    expected = (np.abs(forces) + 2 * deviation)[:, limited] / (0.9 * limits) - 1
    np.testing.assert_allclose(FAMILY["forces"](ROBOT, MOTION), expected, atol=1e-9)
    known = np.abs(forces)[:, limited] / limits - 1
    np.testing.assert_allclose(FAMILY["known forces"](ROBOT, MOTION), known, atol=1e-9)


def test_the_margin_covers_what_is_uncertain():
    draws = NOMINAL + np.random.default_rng(5).standard_normal((2000, BASE.size)) @ ROOT.T
    theta = np.asarray(BASE.regressor(MOTION[:5]))[:, [0, 2]]
    tool = np.asarray(BASE.model.tool_forces(MOTION[:5]))[:, [0, 2]]
    forces = np.einsum("sjb,db->dsj", theta, draws) + tool
    bound = (np.asarray(FAMILY["forces"](ROBOT, MOTION[:5])) + 1) * [0.9 * 60.0, 0.9 * 9.0]
    # Two deviations, and more where the other side is as far: 97.7 % or more, but not all.
    assert 0.965 < (np.abs(forces) <= bound).mean() < 0.9999


def test_a_joint_that_turns_round_may_need_friction_to_either_side():
    terms = (RigidBodies(), CoulombFriction(HardSign()))
    base = base_parameters(Model(ROBOT, terms))
    p = np.random.default_rng(3).standard_normal(base.size)
    p[[k for k, name in enumerate(base.names) if name.startswith("fc")]] = [5.0, 3.0, 1.0]
    constraint = JointForces(NominalForces(base, p), margin=0.0)
    limits = np.array([60.0, 9.0])

    def needed(motion):
        forces = base.inverse_dynamics(p, motion) + base.model.tool_forces(motion)
        return np.abs(np.asarray(forces))[:, [0, 2]] / limits - 1

    coarse = Motion(*(np.asarray(x) for x in (MOTION.q, MOTION.qd, MOTION.qdd)))
    values = np.asarray(constraint(ROBOT, coarse))
    assert (values >= needed(coarse) - 1e-12).all()
    width = 0.02 * np.asarray(ROBOT.limits.velocity)
    for side in (-1.0, 1.0):
        turning = Motion(coarse.q, side * 0.2 * width + 0 * coarse.qd, coarse.qdd)
        other = Motion(coarse.q, -side * 0.2 * width + 0 * coarse.qd, coarse.qdd)
        assert (np.asarray(constraint(ROBOT, turning)) >= needed(other) - 1e-3).all()
    fast = (np.abs(coarse.qd) > 2 * width).all(axis=1)
    assert fast.sum() > 10
    np.testing.assert_allclose(values[fast], needed(coarse)[fast], atol=1e-12)
    # No jump is left for which a solver would have to know the instant.
    speeds = np.linspace(-0.2, 0.2, 2001)[:, None] * np.ones(3)
    still = Motion(0 * speeds + 0.3, speeds, 0 * speeds)
    assert np.abs(np.diff(np.asarray(constraint(ROBOT, still)), axis=0)).max() < 3e-3
    assert np.abs(np.diff(needed(still), axis=0)).max() > 0.1


def test_coupled_motors_share_joints():
    values = np.asarray(MotorTorques(NominalForces(BASE, NOMINAL), margin=0.0)(ROBOT, MOTION))
    forces = np.asarray(BASE.inverse_dynamics(NOMINAL, MOTION) + BASE.model.tool_forces(MOTION))
    torques = np.linalg.solve(np.asarray(ROBOT.drives.reduction).T, forces.T).T
    expected = np.abs(torques[:, [0, 2]]) / [1.0, 0.4] - 1
    np.testing.assert_allclose(values, expected, atol=1e-10)
    names = [e.name for e in FAMILY["motors"].entries(ROBOT)]
    assert names == [f"the torque of motor {k}" for k in (1, 3)]


def test_the_tip_moves_as_its_difference_quotients():
    t, h = np.linspace(0.3, 4.0, 9), 1e-4
    ahead, now, behind = (tip_motion(ROBOT, SERIES.motion(t + s * h)) for s in (1, 0, -1))
    speed = (ahead.position - behind.position) / (2 * h)
    np.testing.assert_allclose(now.velocity, speed, atol=1e-6)
    acceleration = (ahead.velocity - behind.velocity) / (2 * h)
    np.testing.assert_allclose(now.acceleration, acceleration, atol=1e-5)
    values = TipSpeed(1.5)(ROBOT, SERIES.motion(t))[:, 0]
    np.testing.assert_allclose(1.5 * (1 + values), np.linalg.norm(now.velocity, axis=1), rtol=1e-6)


def test_the_workspace_counts_in_half_edges():
    p = np.asarray(tip_motion(ROBOT, MOTION).position)
    values = np.asarray(FAMILY["workspace"](ROBOT, MOTION))
    np.testing.assert_allclose(values[:, 0], (p[:, 0] - 0.4) / 0.35, atol=1e-10)
    np.testing.assert_allclose(values[:, 1], (-0.3 - p[:, 0]) / 0.35, atol=1e-10)
    np.testing.assert_allclose(values[:, 3], (0.2 - p[:, 1]) / 0.35, atol=1e-10)


def test_clearance_is_that_of_the_model():
    gaps = np.asarray(SHAPES.clearance(ROBOT, MOTION.q))
    values = np.asarray(Clearance(SHAPES, distance=0.05)(ROBOT, MOTION))
    np.testing.assert_allclose(values, (0.05 - gaps) / 0.1, atol=1e-9)
    found = Clearance(SHAPES, distance=0.05).describe(ROBOT, values)
    worst = int(np.argmin(gaps.min(axis=0)))
    assert found[worst].excess == pytest.approx(0.05 - gaps.min(), abs=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NominalForces(BASE, NOMINAL[:3]), "`parameters`"),
        (lambda: NominalForces(BASE, NOMINAL, np.eye(3)), "`covariance`"),
        (lambda: NominalForces(BASE, NOMINAL, -np.eye(BASE.size)), "`covariance`"),
        (lambda: NominalForces(BASE, NOMINAL, deviations=-1.0), "`deviations`"),
        (lambda: TipSpeed(0.0), "`limit`"),
        (lambda: TipAcceleration(-1.0), "`limit`"),
        (lambda: Workspace((0, 0, 0), (1, 0, 1)), "`low`"),
        (lambda: Workspace((0, 0), (1, 1)), "`low`"),
        (lambda: Workspace([-np.inf] * 3, [np.inf] * 3), "`low`"),
    ],
)
def test_refuses(make, message):
    with pytest.raises(ValueError, match=message):
        make()
