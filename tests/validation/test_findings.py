"""Each finding about a log without a model is raised by its own mistake alone."""

import dataclasses

import numpy as np
import pytest

from jaxid.measurement.recording import Recording
from jaxid.robot.library import panda
from jaxid.robot.limits_and_drives import Drives
from jaxid.trajectory.fourier import random_fourier_series
from jaxid.validation.clipped_forces import limited_forces
from jaxid.validation.clock import clock_finding, held_forces
from jaxid.validation.diagnosis import diagnose
from jaxid.validation.sensor_checks import (
    channel_findings,
    constant_forces,
    repeated_channels,
)

ROBOT = panda().replace(drives=Drives(7, reduction=[100.0, -100, 100, 100, 50, 50, 50]))
DT = 0.005
T = np.arange(0.0, 10.0, DT)
Q = np.asarray(random_fourier_series(ROBOT, omega=0.6, seed=3).motion(T).q)
NOISE = np.random.default_rng(1).normal(0.0, 0.1, Q.shape)
TAU = 30.0 * np.sin(Q) + 5.0 * np.sign(np.gradient(Q, axis=0)) + NOISE
NAME = ROBOT.joint_names[2]


def faults(angles=Q, forces=TAU, **more):
    return channel_findings(ROBOT, Recording.of(angles, forces, sample_time=DT, **more))


def changed(x, rows, value):
    x = x.copy()
    x[rows, 2] = value
    return x


@pytest.mark.parametrize("count", [0.0, 1e-4, 2e-3])
def test_sane_logs_have_none_however_coarse(count):
    angles = count * np.round(Q / count) if count else Q
    forces = 0.3 * np.round(TAU / 0.3) if count else TAU
    assert faults(angles, forces) == []
    assert faults(angles[:100], forces[:100]) == []


def test_joints_that_take_turns_stand_and_are_not_held():
    """They stop as gently as ever, and stand exactly, while others move."""
    way = np.concatenate([np.linspace(0, 1, 800), np.ones(400), np.linspace(1, 0, 800)])
    turns = np.stack(
        [np.roll(3 * way**2 - 2 * way**3, 250 * j) for j in range(7)], axis=1
    )
    turns[:, 1:] = np.where(T[:, None] < 1.25 * np.arange(1, 7), 0.0, turns[:, 1:])
    assert [
        text for _, text in faults(turns, TAU[: len(turns)]) if "angle" in text
    ] == []


def test_held_angles_are_named_with_their_times():
    ((joint, text),) = faults(changed(Q, slice(600, None), Q[600, 2]))
    assert joint == 2
    assert f"the angle of joint `{NAME}` stays at" in text
    assert "from 3 s to 9.995 s" in text
    ((_, text),) = faults(changed(Q, slice(600, 700), 0.0))
    assert "stays at 0 from 3 s to 3.495 s" in text


@pytest.mark.parametrize("value", [0.0, TAU[600, 2]])
@pytest.mark.parametrize("stop", [700, None])
def test_held_forces_are_named_with_their_times(value, stop):
    ((joint, text),) = faults(forces=changed(TAU, slice(600, stop), value))
    until = "9.995" if stop is None else "3.495"
    assert joint == 2
    assert f"`{NAME}` stay at {value:.3g} from 3 s to {until} s" in text


@pytest.mark.parametrize("samples", [1, 3])
def test_spikes_are_named_with_their_times(samples):
    angles = Q.copy()
    angles[501 : 501 + samples, 4] += 0.1
    angles[1200, 4] -= 0.1
    ((joint, text),) = faults(angles)
    assert joint == 4
    assert "and back at 2.505 s, and 1 more" in text


@pytest.mark.parametrize("on_motor_side", [False, True])
def test_turns_that_start_again_are_named(on_motor_side):
    angles = (100.0 if on_motor_side else 4.0) * Q
    assert faults(angles, angles_on_motor_side=on_motor_side) == []
    angles[:, 1] = (angles[:, 1] + np.pi) % (2 * np.pi) - np.pi
    ((joint, text),) = faults(angles, angles_on_motor_side=on_motor_side)
    owner = "the motor of joint" if on_motor_side else "joint"
    assert joint == 1
    assert (
        f"the angle of {owner} `{ROBOT.joint_names[1]}` jumps by a full turn (6.283)"
        in text
    )
    assert any("a full turn (360)" in text for _, text in faults(np.rad2deg(angles)))


def test_fast_motors_and_gaps_are_no_faults():
    """Half a turn and more from one sample to the next, but smoothly."""
    assert np.abs(np.diff(600.0 * Q, axis=0)).max() > np.pi
    assert faults(600.0 * Q, angles_on_motor_side=True) == []
    log = Recording.of(Q, TAU, time=np.where(T < 4.0, T, T + 30.0))
    angles = np.where(T[:, None] < 4.0, Q, Q + 7.0)
    assert channel_findings(ROBOT, dataclasses.replace(log, angles=angles)) == []


def test_a_column_that_is_there_twice_is_named():
    standing = Q.copy()
    standing[:, 1:3] = 0.5
    assert repeated_channels(ROBOT, Recording.of(standing, TAU, sample_time=DT)) == []
    forces = TAU.copy()
    forces[:, 2] = forces[:, 1]
    (text,) = repeated_channels(ROBOT, Recording.of(Q, forces, sample_time=DT))
    names = ROBOT.joint_names
    assert f"the forces of joints `{names[1]}` and `{names[2]}` are the same" in text


@pytest.mark.parametrize("step", [0.5, 2.0, 5.0])
def test_coarse_steps_of_forces_are_no_limits(step):
    log = Recording.of(Q, step * np.round(TAU / step), sample_time=DT)
    assert list(limited_forces(log)) == constant_forces(ROBOT, log) == []


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_forces_that_are_cut_off_are_a_remark(level):
    forces = 0.01 * np.round(TAU / 0.01)
    top = level * forces[:, 2].max()
    forces[:, 2] = np.minimum(forces[:, 2], top)
    diagnosis = diagnose(Recording.of(Q, forces, sample_time=DT), ROBOT)
    (note,) = diagnosis.notes
    assert f"the forces of joint `{NAME}` stay at {top:.3g} in " in note
    assert not any("stay at" in text for text in diagnosis.findings)
    log = Recording.of(Q, changed(TAU, slice(None), 1.25), sample_time=DT)
    (text,) = constant_forces(ROBOT, log)
    assert f"the forces of joint `{NAME}` are 1.25 throughout" in text
    # A robot that holds still at its largest force is not cut off.
    moving, forces = Q.copy(), np.round(np.abs(TAU), 2)
    moving[1200:1800] = moving[1200]
    forces[1200:1800] = forces.max(axis=0) + 1.0
    assert list(limited_forces(Recording.of(moving, forces, sample_time=DT))) == []


ROWS = np.arange(len(T))
LATE = np.random.default_rng(2)
CLOCKS = {
    "even": (ROWS, ""),
    "lost": (np.delete(ROWS, np.arange(50, 1900, 60)), "rows seem to be lost"),
    "repeated": (
        np.insert(ROWS, np.arange(50, 1900, 60), np.arange(50, 1900, 60)),
        "rows seem to be repeated",
    ),
    "jittering": (ROWS + 0.5 * LATE.normal(size=len(ROWS)), "seems to jitter"),
    "at half the rate": (2 * (ROWS // 2), ""),
}


@pytest.mark.parametrize("increment", [0.0, 1e-4])
@pytest.mark.parametrize("name", CLOCKS)
def test_rows_that_do_not_belong_to_their_times_are_named(name, increment):
    rows, words = CLOCKS[name]
    angles = np.array([np.interp(rows, ROWS, q) for q in Q.T]).T
    angles = angles + 1e-6 * LATE.normal(size=angles.shape)
    if increment:
        angles = increment * np.round(angles / increment)
    if name == "at half the rate":
        angles = angles[rows]
    forces = np.zeros_like(angles)
    text = clock_finding(Recording.of(angles, forces, sample_time=DT))
    assert words in text
    assert bool(words) == bool(text)
    if words:
        assert "name the column of times" in text
        # The cure is none where times are named.
        time = DT * np.arange(len(angles))
        text = clock_finding(Recording.of(angles, forces, time=time))
        assert words in text
        assert "name the column of times" not in text


def test_stamps_of_a_robot_that_samples_unevenly_are_right():
    time = np.sort(T + 0.4 * DT * LATE.uniform(-1, 1, len(T)))
    angles = np.array([np.interp(time, T, q) for q in Q.T]).T
    assert clock_finding(Recording.of(angles, TAU, time=time)) == ""
    text = clock_finding(Recording.of(Q, TAU, time=time))
    assert "give `recording.sample_time`" in text or text == ""


@pytest.mark.parametrize("count", [2e-3, 2 * np.pi / 2**13])
def test_coarse_encoders_and_slow_motion_lose_no_rows(count):
    angles = count * np.round(Q / count)
    assert clock_finding(Recording.of(angles, TAU, sample_time=DT)) == ""
    increments = np.round(1.03 * np.arange(len(Q)))
    angles = 2 * np.pi / 2**17 * np.outer(increments, np.arange(7) == 0)
    assert clock_finding(Recording.of(angles, TAU, sample_time=DT)) == ""


def test_forces_that_are_updated_slowly_are_named():
    forces = TAU.copy()
    forces[:, 2] = np.repeat(TAU[::8, 2], 8)
    (text,) = held_forces(ROBOT, Recording.of(Q, forces, sample_time=DT))
    assert f"the force of joint `{NAME}` is held for 40 ms" in text
    assert held_forces(ROBOT, Recording.of(Q, np.round(TAU), sample_time=DT)) == []


def test_a_log_without_motion_is_one_sentence():
    still = Recording.of(0.001 * Q, TAU, sample_time=DT)
    found = [text for text in diagnose(still, ROBOT).findings if "mov" in text]
    assert len(found) == 1
    assert "leave this log out" in found[0]


@pytest.mark.parametrize(
    ("samples", "factor", "words"),
    [(0, 1, ""), (8, 1, " ms later"), (0, 2, "are 2 times")],
)
def test_velocities_are_compared_with_the_angles(samples, factor, words):
    velocities = factor * np.roll(np.gradient(Q, DT, axis=0), samples, axis=0)
    log = Recording.of(Q, TAU, sample_time=DT, velocities=velocities)
    found = [
        text for text in diagnose(log, ROBOT).findings if "the velocities of" in text
    ]
    assert all(words in text for text in found)
    assert len(found) == (1 if words else 0), "one cause is one sentence"
    assert all(name in text for text in found for name in ROBOT.joint_names)


def test_noisy_forces_that_are_held_are_named_also_at_constant_speed():
    angles = np.cumsum(np.full_like(Q, 0.002), axis=0)
    ((joint, text),) = faults(angles, changed(TAU, slice(600, 700), TAU[600, 2]))
    assert joint == 2
    assert "stay at" in text
    assert faults(angles, np.round(np.cumsum(np.full_like(Q, 1e-4), axis=0), 2)) == []
