"""Speeds at which dry friction changes its direction: known ones, MuJoCo's rail."""

import mujoco
import numpy as np
import pytest
import virtual

import jaxid as jid
from jaxid.dynamics.terms import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    StribeckFriction,
    Tanh,
)
from jaxid.workflow import Setup

SPEEDS = np.array([0.02, 0.05])
ROBOT = jid.robots.planar_arm(2, 0.5).replace(limits=jid.Limits(force=[60.0, 20.0]))
BODIES = jid.RigidBodies(), jid.ViscousFriction(), jid.RotorInertia()


def base_of(*terms):
    return jid.base_parameters(jid.Model(ROBOT, (*BODIES, *terms)))


def log_of(transition=None, still=()):
    """Observations of friction with the transition, with noise of 1 %."""
    model = jid.Model(ROBOT, (*BODIES, CoulombFriction(transition or Tanh(SPEEDS))))
    p = virtual.standard_parameters(model)
    return virtual.observations(model, p, samples=4000, noise=0.02, still=still)


def found_speeds(base):
    return base.model.terms[-1].transition.epsilon


@pytest.mark.parametrize("term", [CoulombFriction, AsymmetricCoulombFriction])
def test_speeds_of_known_friction(term):
    """With noise of a hundredth of the forces they come out within a tenth."""
    base = jid.identify_transition_speeds(base_of(term()), log_of())
    np.testing.assert_allclose(found_speeds(base), SPEEDS, rtol=0.1)


def test_speeds_that_are_given_are_kept():
    base = base_of(CoulombFriction(Tanh(0.3)))
    assert jid.identify_transition_speeds(base, log_of()) is base
    fit = Setup(base, filter=jid.ZeroPhaseButterworth(10.0)).fit(
        jid.RegressionProblem(base, [log_of()])
    )
    assert found_speeds(fit.base) == 0.3
    assert not any("epsilon" in note for note in fit.notes)


def test_all_logs_count_and_a_joint_at_rest_keeps_the_usual_speed():
    base = base_of(CoulombFriction())
    still_log = log_of(still=(1,))
    speeds = found_speeds(jid.identify_transition_speeds(base, still_log))
    assert speeds[1] == 0.01
    logs = [still_log, log_of()]
    speeds = found_speeds(jid.identify_transition_speeds(base, logs))
    np.testing.assert_allclose(speeds, SPEEDS, rtol=0.1)


def test_without_dry_friction_no_speed_is_better_than_the_usual_one():
    model = jid.Model(ROBOT, BODIES)
    p = virtual.standard_parameters(model)
    log = virtual.observations(model, p, samples=2000)
    base = jid.identify_transition_speeds(base_of(CoulombFriction()), log)
    top_speeds = np.abs(np.asarray(log.motion.qd)).max(axis=0)
    shares = found_speeds(base) / top_speeds
    assert np.all((shares > 0.002) & (shares < 0.2))


def test_a_setup_finds_them_says_so_and_saves_them(tmp_path):
    setup = Setup(base_of(CoulombFriction()), filter=jid.ZeroPhaseButterworth(10.0))
    fit = setup.fit(jid.RegressionProblem(setup.base, [log_of()]))
    np.testing.assert_allclose(found_speeds(fit.base), SPEEDS, rtol=0.1)
    (note,) = [note for note in fit.notes if "epsilon" in note]
    assert "rad/s" in note
    loaded = jid.load_fit(fit.save(tmp_path / "arm.json"))
    np.testing.assert_array_equal(found_speeds(loaded.base), found_speeds(fit.base))


def test_stribeck_speeds_are_found_again():
    """Without noise they are found to a fraction of the ratio between two trials."""
    true_speeds = np.array([0.2, 0.3])
    model = jid.Model(ROBOT, (*BODIES, StribeckFriction(true_speeds, 2.0, Tanh(0.02))))
    p = virtual.standard_parameters(model, seed=3)
    log = virtual.observations(model, p, samples=1500)
    base = jid.friction_laws.identify_stribeck_speeds(base_of(StribeckFriction()), log)
    np.testing.assert_allclose(base.model.terms[-1].speed, true_speeds, rtol=0.2)
    with pytest.raises(jid.InputError, match="StribeckFriction"):
        jid.friction_laws.identify_stribeck_speeds(base_of(CoulombFriction()), log)


RAIL = """<mujoco><option timestep="0.0005"/><worldbody><body>
<joint name="rail" type="slide" axis="1 0 0" damping="180" frictionloss="60"/>
<inertial pos="0 0 0" mass="40" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
"""Rail with viscous friction of 180 N s/m and dry friction of 60 N."""


def rail_log(top_speed):
    """Angles and forces of the rail, which MuJoCo moves to and fro by a controller."""
    model = mujoco.MjModel.from_xml_string(RAIL)
    data = mujoco.MjData(model)
    rates = np.array([1.0, 1.7, 2.9])
    samples = 5000
    angles = np.zeros((samples, 1))
    forces = np.zeros((samples, 1))
    data.qvel[0] = top_speed
    for k in range(4 * samples):
        x = rates * data.time
        position = top_speed / 3 * np.sum(np.sin(x) / rates)
        speed = top_speed / 3 * np.sum(np.cos(x))
        servo = 60000 * (position - data.qpos[0]) + 2500 * (speed - data.qvel[0])
        data.qfrc_applied[0] = servo
        forces[k // 4] += servo / 4
        if k % 4 == 2:
            angles[k // 4] = data.qpos[0]
        mujoco.mj_step(model, data)
    forces += np.random.default_rng(0).normal(size=forces.shape)
    return jid.Recording.of(angles, forces, sample_time=0.002)


@pytest.mark.parametrize("top_speed", [0.05, 0.3])
def test_friction_of_a_rail_in_mujoco(top_speed, tmp_path):
    """With 0.01 m/s for both motions, no viscous friction of the slow one is left."""
    path = tmp_path / "rail.xml"
    path.write_text(RAIL)
    setup = Setup(jid.load_mjcf(path), filter=jid.ZeroPhaseButterworth(10.0))
    log = setup.observe(rail_log(top_speed))
    fit = setup.fit(jid.RegressionProblem(setup.base, [log]))
    low, high = fit.intervals().T
    for name, truth in (("fv1", 180.0), ("fc1", 60.0)):
        k = fit.base.names.index(name)
        assert low[k] < truth < high[k]
        assert abs(fit.parameters[k] / truth - 1) < 0.2
