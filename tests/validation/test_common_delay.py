"""Delay of forces in logs of MuJoCo with dry friction that sticks."""

import dataclasses

import mujoco
import numpy as np
import pytest

import jaxid as jid
from jaxid.validation.mistake_search import find_mistakes

ARM = """<mujoco><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body><joint name="j1" axis="0 1 0" damping="{0}" frictionloss="1"/>
<inertial mass="3" pos="0.2 0.02 0.1" diaginertia="0.05 0.06 0.04"/>
<body pos="0.4 0 0"><joint name="j2" axis="0 0.6 0.8" damping="{1}" frictionloss="0.6"/>
<inertial mass="1.5" pos="0.15 0 0.05" diaginertia="0.01 0.02 0.02"/>
</body></body></worldbody></mujoco>"""
DAMPING = np.array([0.8, 0.4])
STEP = 0.002


def record(seconds=12.0, seed=0):
    """Record the arm under the control of its joints."""
    model = mujoco.MjModel.from_xml_string(ARM.format(*DAMPING))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP))
    rates = 2 * np.pi * np.array([[0.2, 0.5, 0.9], [0.3, 0.6, 1.1]])
    phases = rates[:, :, None] * time + rng.uniform(0, 6, (2, 3, 1))
    goal = 0.35 * np.sin(phases).sum(axis=1).T
    goal_speed = 0.35 * (rates[:, :, None] * np.cos(phases)).sum(axis=1).T
    angles = np.zeros_like(goal)
    forces = np.zeros_like(goal)
    data.qpos[:] = goal[0]
    for k in range(len(time)):
        angles[k] = data.qpos
        gains = np.array([400.0, 120.0])
        forces[k] = gains * (goal[k] - data.qpos + 0.1 * (goal_speed[k] - data.qvel))
        data.qfrc_applied[:] = forces[k]
        mujoco.mj_step(model, data, 2)
    # A force that is held during a sample belongs to its middle.
    forces[1:] = 0.5 * (forces[1:] + forces[:-1])
    forces += 0.02 * rng.normal(size=forces.shape)
    return jid.Recording.of(angles, forces, time=time)


def late(recording, seconds):
    """Return the log with forces that stand later."""
    time = np.asarray(recording.time)
    columns = [np.interp(time - seconds, time, x) for x in recording.forces.T]
    return dataclasses.replace(recording, forces=np.stack(columns, axis=1))


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    """Return the setup of the arm."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM.format(0, 0))
    return jid.Setup(jid.load_mjcf(path))


@pytest.fixture(scope="module")
def log():
    """Return a log on time."""
    return record()


@pytest.mark.parametrize("seconds", [0.0, 0.005, 0.01])
def test_the_interval_holds_the_delay(setup, log, seconds):
    delay = jid.estimate_delay(setup.model, late(log, seconds))
    low, high = delay.interval()
    assert low < seconds < high
    assert delay.is_certain == (seconds > 0)
    assert high - low < 0.006


def test_a_delay_is_named_with_its_cure(setup, log):
    mistakes = find_mistakes(setup.model, [late(log, 0.006)])
    (sentence,) = (*mistakes.explained, *mistakes.doubts)
    assert "seem to be 6" in sentence
    assert "ms late" in sentence
    assert "force_delay = 0.0" in sentence
    mistakes = find_mistakes(setup.model, [log])
    assert mistakes.explained == mistakes.doubts == ()


def test_the_delay_of_one_joint_is_none_of_all(setup, log):
    forces = np.array(log.forces)
    forces[:, 1] = late(log, 0.02).forces[:, 1]
    spoilt = dataclasses.replace(log, forces=forces)
    assert not jid.estimate_delay(setup.model, spoilt).is_certain


def test_intervals_of_viscous_friction_hold_in_spite_of_a_delay(setup, log):
    is_viscous = [name.startswith("fv") for name in setup.base.names]
    for seconds in (0.0, 0.005, 0.01):
        recording = late(log, seconds)
        o = setup.observe(recording)
        fit = jid.identify(setup.base, o, setup.estimator)
        delay = jid.estimate_delay(setup.model, recording)
        wider_fit = jid.with_unknown_delay(fit, o, delay)
        errors = np.abs(wider_fit.parameters[is_viscous] - DAMPING)
        assert (errors <= wider_fit.uncertainty.half_widths()[is_viscous]).all()
        ratios = wider_fit.standard_deviations / fit.standard_deviations
        if seconds == 0.0:
            assert np.median(ratios) < 1.1
        else:
            assert (errors > fit.uncertainty.half_widths()[is_viscous]).any()


def test_the_derivative_of_estimates_is_that_of_late_forces(setup, log):
    """A known delay moves the estimates by the root of what it adds to variances."""
    base = setup.base
    estimator = jid.WeightedLeastSquares(jid.estimators.GivenWeights([1.0, 1.0]))
    motion_log = setup.observe(log)
    fit = jid.identify(base, motion_log, estimator)
    forces = np.asarray(fit.predict(motion_log.motion))
    time = motion_log.time
    estimates = []
    for shift in (-0.002, 0.002):
        shifted_forces = [np.interp(time - shift, time, x) for x in forces.T]
        o = motion_log.replace(forces=np.stack(shifted_forces, axis=1))
        estimates.append(jid.identify(base, o, estimator).parameters)
    changes = np.abs(estimates[1] - estimates[0]) / 2
    o = motion_log.replace(forces=forces)
    exact_fit = jid.identify(base, o, estimator)
    delay = jid.estimate_delay(setup.model, log)._replace(seconds=0.002, deviation=0.0)
    wider_fit = jid.with_unknown_delay(exact_fit, o, delay)
    added_variances = np.diag(wider_fit.covariance - exact_fit.covariance)
    np.testing.assert_allclose(np.sqrt(added_variances), changes, rtol=0.02, atol=1e-4)
