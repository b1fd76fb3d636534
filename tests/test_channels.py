"""Doubts about a log's channels: each is raised by its own slip, and by nothing that is sane."""

import dataclasses

import numpy as np
import pytest

from jaxid.experiment.channels import rate_doubts, stuck_doubts, unit_doubts
from jaxid.measurement.recording import Recording
from jaxid.robot.drives import Drives
from jaxid.robot.library import panda, planar_arm
from jaxid.trajectory.fourier import random_fourier_series

ROBOT = panda().replace(drives=Drives(7, reduction=[100.0, -100, 100, 100, 50, 50, 50]))
T = np.arange(0.0, 10.0, 0.005)
Q = np.asarray(random_fourier_series(ROBOT, omega=0.6, seed=3).motion(T).q)


def units(angles, on_motor_side=False):
    return unit_doubts(ROBOT, angles.min(axis=0), angles.max(axis=0), on_motor_side)


def test_sane_angles_raise_no_doubt():
    assert units(Q) == []
    assert unit_doubts(planar_arm(2), np.full(2, -9.0), np.full(2, 9.0), False) == []


def test_degrees_are_recognised():
    (said,) = units(np.rad2deg(Q))
    assert "would not if those in the log were degrees" in said


def test_radians_that_are_taken_for_degrees_are_recognised():
    (said,) = units(np.deg2rad(Q))
    assert "are the angles of the log in radians" in said


def test_motor_angles_are_recognised():
    motors = np.asarray(ROBOT.drives.motor_angles(Q))
    (said,) = units(motors)
    assert 'the motors\' (`recording.side = "motor"`)' in said
    assert units(motors, on_motor_side=True) == []


@pytest.mark.parametrize(("rate", "doubted"), [(1.0, 1), (100.0, 0), (1e4, 0), (1e6, 1)])
def test_a_rate_that_no_robot_has_is_doubted(rate, doubted):
    assert len(rate_doubts(1.0 / rate)) == doubted


def log(forces):
    return Recording.of(Q, forces, sample_time=0.005)


def sane(step):
    """Forces that go with the motion, with noise, rounded as a drive rounds them."""
    random = np.random.default_rng(1)
    forces = 30.0 * np.sin(Q) + 5.0 * np.sign(np.gradient(Q, axis=0))
    forces += random.normal(0.0, 0.1, Q.shape)
    return step * np.round(forces / step) if step else forces


@pytest.mark.parametrize("step", [0.0, 0.01, 0.3])
def test_sane_forces_raise_no_doubt(step):
    assert stuck_doubts(ROBOT, log(sane(step))) == []


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_forces_that_are_cut_off_are_recognised(level):
    forces = sane(0.01)
    top = level * forces[:, 2].max()
    forces[:, 2] = np.minimum(forces[:, 2], top)
    (said,) = stuck_doubts(ROBOT, log(forces))
    assert f"the forces of joint `{ROBOT.joint_names[2]}` stay at {top:.3g} in " in said


def test_a_channel_that_is_constant_is_recognised():
    forces = sane(0.01)
    forces[:, 4] = 1.25
    (said,) = stuck_doubts(ROBOT, log(forces))
    assert f"the forces of joint `{ROBOT.joint_names[4]}` are 1.25 throughout" in said


def test_a_robot_that_holds_still_at_its_largest_force_is_not_cut_off():
    moving, forces = Q.copy(), np.round(np.abs(sane(0.01)), 2)
    still = slice(1200, 1800)
    moving[still] = moving[1200]
    forces[still] = forces.max(axis=0) + 1.0
    held = dataclasses.replace(log(forces), angles=moving)
    assert stuck_doubts(ROBOT, held) == []
