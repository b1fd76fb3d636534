"""Faults of single channels are named with their times, on both sides of the gears."""

import dataclasses

import numpy as np
import pytest

from jaxid.diagnosis.sensor_faults import channel_faults, stuck_findings
from jaxid.measurement.recording import Recording
from jaxid.robot.library import panda
from jaxid.trajectory.fourier import random_fourier_series

ROBOT = panda()
DT = 0.005
T = np.arange(0.0, 10.0, DT)
Q = np.asarray(random_fourier_series(ROBOT, omega=0.6, seed=3).motion(T).q)
NOISE = np.random.default_rng(1).normal(0.0, 0.1, Q.shape)
TAU = 30.0 * np.sin(Q) + 5.0 * np.sign(np.gradient(Q, axis=0)) + NOISE


def faults(angles=Q, forces=TAU, **more):
    return channel_faults(ROBOT, Recording.of(angles, forces, sample_time=DT, **more))


def changed(x, rows, value):
    x = x.copy()
    x[rows, 2] = value
    return x


@pytest.mark.parametrize("count", [0.0, 1e-4, 2e-3])
def test_sane_logs_have_none_however_coarse(count):
    angles = count * np.round(Q / count) if count else Q
    forces = np.round(TAU, 0 if count else 9)
    assert faults(angles, forces) == []
    assert faults(angles[:100], forces[:100]) == []


def test_joints_that_take_turns_stand_and_are_not_held():
    """They stop as gently as ever, and stand exactly, while others move."""
    way = np.concatenate([np.linspace(0, 1, 800), np.ones(400), np.linspace(1, 0, 800)])
    smooth = 3 * way**2 - 2 * way**3
    turns = np.stack([np.roll(smooth, 250 * j) if j else smooth for j in range(7)], axis=1)
    turns[:, 1:] = np.where(T[:, None] < 1.25 * np.arange(1, 7), 0.0, turns[:, 1:])
    forces = TAU[: len(turns)]
    assert [f for f in faults(turns, forces) if "of joint" in f.text and "angle" in f.text] == []


def test_held_angles_are_named_with_their_times():
    (found,) = faults(changed(Q, slice(600, None), Q[600, 2]))
    assert found.joint == 2
    assert f"the angle of joint `{ROBOT.joint_names[2]}` stays at" in found.text
    assert "from 3 s to 9.995 s" in found.text
    (found,) = faults(changed(Q, slice(600, 700), 0.0))
    assert "stays at 0 from 3 s to 3.495 s" in found.text


@pytest.mark.parametrize("value", [0.0, TAU[600, 2]])
@pytest.mark.parametrize("stop", [700, None])
def test_held_forces_are_named_with_their_times(value, stop):
    (found,) = faults(forces=changed(TAU, slice(600, stop), value))
    assert found.joint == 2
    until = "9.995" if stop is None else "3.495"
    assert f"stay at {value:.3g} from 3 s to {until} s" in found.text


@pytest.mark.parametrize("samples", [1, 3])
def test_spikes_are_named_with_their_times(samples):
    angles = Q.copy()
    angles[501 : 501 + samples, 4] += 0.1
    angles[1200, 4] -= 0.1
    (found,) = faults(angles)
    assert found.joint == 4
    assert "and back at 2.505 s, and 1 more" in found.text


@pytest.mark.parametrize("on_motor_side", [False, True])
def test_turns_that_start_again_are_named(on_motor_side):
    angles = (100.0 if on_motor_side else 4.0) * Q
    assert faults(angles, angles_on_motor_side=on_motor_side) == []
    angles[:, 1] = (angles[:, 1] + np.pi) % (2 * np.pi) - np.pi
    (found,) = faults(angles, angles_on_motor_side=on_motor_side)
    assert found.joint == 1
    assert "jumps by a full turn (6.283)" in found.text
    owner = "the motor of joint" if on_motor_side else "joint"
    assert f"the angle of {owner} `{ROBOT.joint_names[1]}` jumps" in found.text
    assert "undo the wrapping" in found.text
    degrees = np.rad2deg(angles)
    assert any("a full turn (360)" in f.text for f in faults(degrees))


def test_fast_motors_do_not_wrap():
    """Half a turn and more from one sample to the next, but smoothly."""
    angles = 600.0 * Q
    assert np.abs(np.diff(angles, axis=0)).max() > np.pi
    assert faults(angles, angles_on_motor_side=True) == []


def test_gaps_are_no_faults():
    log = Recording.of(Q, TAU, time=np.where(T < 4.0, T, T + 30.0))
    angles = np.where(T[:, None] < 4.0, Q, Q + 7.0)
    assert len(log.segments) == 2
    assert channel_faults(ROBOT, dataclasses.replace(log, angles=angles)) == []


def log(forces):
    return Recording.of(Q, forces, sample_time=DT)


def sane(step):
    """Forces that go with the motion, with noise, rounded as a drive rounds them."""
    random = np.random.default_rng(1)
    forces = 30.0 * np.sin(Q) + 5.0 * np.sign(np.gradient(Q, axis=0))
    forces += random.normal(0.0, 0.1, Q.shape)
    return step * np.round(forces / step) if step else forces


@pytest.mark.parametrize("step", [0.0, 0.01, 0.3])
def test_sane_forces_raise_no_doubt(step):
    assert stuck_findings(ROBOT, log(sane(step))) == []


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_forces_that_are_cut_off_are_recognised(level):
    forces = sane(0.01)
    top = level * forces[:, 2].max()
    forces[:, 2] = np.minimum(forces[:, 2], top)
    (said,) = stuck_findings(ROBOT, log(forces))
    assert f"the forces of joint `{ROBOT.joint_names[2]}` stay at {top:.3g} in " in said


def test_a_channel_that_is_constant_is_recognised():
    forces = sane(0.01)
    forces[:, 4] = 1.25
    (said,) = stuck_findings(ROBOT, log(forces))
    assert f"the forces of joint `{ROBOT.joint_names[4]}` are 1.25 throughout" in said


def test_a_robot_that_holds_still_at_its_largest_force_is_not_cut_off():
    moving, forces = Q.copy(), np.round(np.abs(sane(0.01)), 2)
    still = slice(1200, 1800)
    moving[still] = moving[1200]
    forces[still] = forces.max(axis=0) + 1.0
    held = dataclasses.replace(log(forces), angles=moving)
    assert stuck_findings(ROBOT, held) == []
