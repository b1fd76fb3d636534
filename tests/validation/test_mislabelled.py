"""A diagnosis names the one mistake that was made in a log's columns, nothing else."""

import dataclasses
import re

import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import CoulombFriction, RigidBodies, ViscousFriction
from jaxid.errors import InputError
from jaxid.identification.identify import identify
from jaxid.measurement.filters import Subsample, ZeroPhaseButterworth
from jaxid.measurement.observations import observe
from jaxid.measurement.recording import Recording
from jaxid.robot.limits_and_drives import Drives, Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import random_fourier_series
from jaxid.validation.clipped_forces import clipped_forces, limited_forces
from jaxid.validation.descriptions import DescribedLog
from jaxid.validation.diagnosis import diagnose, mistakes_in_logs
from jaxid.validation.filtered_log import FilteredLog
from jaxid.validation.gravity_witness import gravity_witness
from jaxid.validation.mistake_search import find_mistakes

# Forces of a joint act on its neighbours; the last two motors move the last joint
# together.
COUPLED = np.diag([50.0, -60.0, 40.0, 30.0])
COUPLED[3, 2] = 30.0
AXES = np.array([[0.0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0]])
ROBOT = Robot(
    "arm",
    revolute=(True,) * 4,
    axis=AXES,
    rotation=np.tile(np.eye(3), (4, 1, 1)),
    offset=np.array([[0, 0, 0.3], [0, 0, 0.2], [0.5, 0, 0], [0.4, 0, 0]]),
    limits=Limits(
        4,
        position_min=[-2.8, -1.8, -2.5, -2.8],
        position_max=[2.8, 1.8, 2.5, 2.8],
        velocity=[2.0] * 4,
        force=[80.0, 150.0, 60.0, 12.0],
    ),
    drives=Drives(4, reduction=COUPLED),
)
BASE = base_parameters(
    Model(ROBOT, (RigidBodies(), ViscousFriction(), CoulombFriction()))
)
DT = 0.005
SIZES = {"m": 2.0, "mx": 0.1, "my": 0.2, "mz": 0.3, "A": 0.1, "B": 0.1, "C": 0.1}
SIZES |= {"fv": 1.0, "fc": 2.0}
BODIES = np.array(
    [SIZES.get(name.rstrip("0123456789"), 0.0) for name in BASE.model.parameter_names]
)


@pytest.fixture(scope="module")
def motors():
    """Motor angles and torques of a noisy log: friction is as large as other forces."""
    model = BASE.model
    t = DT * np.arange(2400)
    motion = random_fourier_series(ROBOT, omega=0.6, seed=5).motion(t)
    forces = np.asarray(model.inverse_dynamics(BODIES, motion))
    forces = forces + np.random.default_rng(0).normal(0.0, 0.3, forces.shape)
    drives = ROBOT.drives
    return np.asarray(drives.motor_angles(motion.q)), np.asarray(
        drives.motor_torques(forces)
    )


def log_of(
    angles,
    forces,
    angles_on_motor_side=True,
    forces_on_motor_side=True,
    angle_unit="rad",
):
    sides = {
        "angles_on_motor_side": angles_on_motor_side,
        "forces_on_motor_side": forces_on_motor_side,
    }
    log = Recording.of(angles, forces, sample_time=DT, **sides)
    log = dataclasses.replace(log, angle_unit=angle_unit)
    return log, observe(log, ROBOT, ZeroPhaseButterworth(8.0), Subsample(5))


def revealed(diagnosis, fit):
    """Return the findings that a fit adds to those of the log alone."""
    findings = diagnosis.with_fit(fit).findings
    return findings[: len(findings) - len(diagnosis.findings)]


@pytest.fixture(scope="module")
def said(motors):
    fit = identify(BASE, log_of(*motors)[1])

    def mistakes(*arguments, **sides):
        log, o = log_of(*arguments, **sides)
        return revealed(diagnose(log, ROBOT, observations=o), fit)

    return mistakes


def test_a_good_log_has_no_findings_and_prints_its_limits(motors):
    log, o = log_of(*motors)
    fit = identify(BASE, o)
    diagnosis = diagnose(log, ROBOT, fit)
    alone = diagnose(log, ROBOT, observations=o)
    assert revealed(alone, fit) == ()
    findings = set(alone.findings)
    assert findings <= set(diagnosis.findings)
    with pytest.raises(InputError, match="give the recording"):
        diagnose(o, ROBOT)
    text = str(diagnosis)
    assert all(name in text for name in ROBOT.joint_names)
    assert text.count("!") >= len(diagnosis.findings)


SCALES = {
    "one scale of all": (0.0145, "rad"),
    "calibrated ranges": (np.array([0.0157, 0.0163, 0.0167, 0.0160]), "rad"),
    "the unit is stated": (np.pi / 180, "deg"),
    "counts": (0.0153, "0.0153"),
}


@pytest.mark.parametrize("name", SCALES)
def test_no_unit_is_proposed_whose_factor_the_log_does_not_show(motors, said, name):
    angles, forces = motors
    scale, angle_unit = SCALES[name]
    texts = said(angles / scale, forces, angle_unit=angle_unit)
    assert not any("to be in deg" in text or "to be in re" in text for text in texts)
    if angle_unit == "rad":
        assert "an unnamed unit, roughly deg" in texts[0]


@pytest.mark.parametrize(("joint", "channel"), [(3, "force"), (3, "angle")])
def test_a_sign_is_found_in_the_motors_columns_by_friction_that_must_brake(
    motors, said, joint, channel
):
    angles, forces = motors
    name, signs = ROBOT.joint_names[joint], np.where(np.arange(4) == joint, -1.0, 1.0)
    wrong = (angles, forces * signs) if channel == "force" else (angles * signs, forces)
    (sentence,) = said(*wrong)
    assert f"the sign of the {channel} of joint `{name}` seems to be wrong" in sentence


def test_motors_columns_that_are_exchanged_are_found(motors, said):
    angles, forces = motors
    (sentence,) = said(angles, forces[:, [0, 1, 3, 2]])
    names = f"`{ROBOT.joint_names[2]}` and `{ROBOT.joint_names[3]}`"
    assert sentence.startswith(f"the forces of joints {names} seem to be exchanged")


def test_units_and_sides_are_found(motors, said):
    angles, forces = motors
    (sentence,) = said(np.rad2deg(angles), forces)
    assert (
        "the angles of the log seem to be in deg (`recording.angle_unit`)" in sentence
    )
    (sentence,) = said(np.deg2rad(angles), forces, angle_unit="deg")
    assert "seem to be in rad, not in deg (`recording.angle_unit`)" in sentence
    (sentence,) = said(angles, forces, angles_on_motor_side=False)
    assert "the angles of the log seem to be the motors' (`recording.side`" in sentence
    (sentence,) = said(angles, forces, forces_on_motor_side=False)
    assert (
        "the forces of the log seem to be the motors' (`recording.forces_side = \"mo"
        in sentence
    )


def test_whole_joints_and_zeros_of_angles_are_found(motors, said):
    angles, forces = motors
    order = [1, 0, 2, 3]
    (sentence,) = said(angles[:, order], forces[:, order])
    assert sentence.startswith(
        "angles and forces of joints `joint1` and `joint2` seem to be"
    )
    q = np.asarray(ROBOT.drives.joint_angles(angles)) - np.pi / 2 * (np.arange(4) == 2)
    (sentence,) = said(np.asarray(ROBOT.drives.motor_angles(q)), forces)
    assert sentence.startswith("the angle of joint `joint3` seems to lack 90 degrees")


def test_mistakes_of_any_amount_are_found(motors, said):
    angles, forces = motors
    q = np.asarray(ROBOT.drives.joint_angles(angles)) - 0.3 * (np.arange(4) == 2)
    (sentence,) = said(np.asarray(ROBOT.drives.motor_angles(q)), forces)
    assert "the angle of joint `joint3` seems to lack 17 degrees" in sentence
    (sentence,) = said(angles, forces * [1.0, 1.5, 1.0, 1.0])
    assert sentence.startswith(
        "the force of joint `joint2` in the log seems to be 1.5 times the true one "
        "(`recording.force_gains` of 0.66)"
    )
    (sentence,) = said(angles, forces * [1.0, 1.1, 1.0, 1.0])
    assert sentence.startswith("possible, but not sure: the force of joint `joint2` in")
    assert "(`recording.force_gains` of 0.91)" in sentence
    (sentence,) = said(angles[8:], forces[:-8])
    assert sentence.startswith(
        "the forces of the log seem to be 41 ms late (`recording.force_delay = 0.04"
    )


def test_logs_are_judged_together_and_the_wrong_one_is_named(motors):
    angles, forces = motors
    pairs = [log_of(angles, forces), log_of(angles, forces * [1.0, 1.0, 1.0, -1.0])]
    logs = [
        observations.replace(name=name)
        for name, (_, observations) in zip("ab", pairs, strict=True)
    ]
    examined = [
        diagnose(log, ROBOT, observations=o)
        for (log, _), o in zip(pairs, logs, strict=True)
    ]
    found = mistakes_in_logs(examined, identify(BASE, logs)).certain
    assert any(
        text.startswith("b: the sign of the force of joint `joint4` seems to be wrong")
        for text in found
    )
    good = [examined[0], examined[0]]
    assert mistakes_in_logs(good, identify(BASE, logs[:1])).certain == ()


def test_forces_without_gravity_are_named_in_spite_of_dry_friction(motors, said):
    """Drivers that report torques without gravity are common."""
    angles, forces = motors
    drives = ROBOT.drives
    q = np.asarray(drives.joint_angles(angles))
    rest = np.zeros_like(q)
    gravity = BASE.model.inverse_dynamics(BODIES, Motion(q, rest, rest))
    (sentence,) = said(angles, forces - np.asarray(drives.motor_torques(gravity)))
    assert sentence.startswith("the forces seem not to contain gravity")


def test_commands_in_place_of_measured_angles_are_named(motors):
    """A servo lags behind its commands, and encoders round."""
    angles, forces = motors
    increment = 2 * np.pi / 2**12
    measured_angles = increment * np.round(angles / increment)
    commanded_angles = np.roll(angles, -20, axis=0)[:-20]
    logs = [
        log_of(x, forces[:-20])[0] for x in (commanded_angles, measured_angles[:-20])
    ]
    commanded, measured = logs
    mistakes = find_mistakes(BASE.model, [commanded], None, [measured])
    (sentence,) = mistakes.explained
    assert sentence.startswith(
        "the columns of angles and of `recording.commands` seem to be exchanged"
    )
    assert find_mistakes(BASE.model, [measured], None, [commanded]).explained == ()


def test_gravity_of_the_files_bodies_is_a_witness(motors):
    """Without Coriolis terms and with other bodies, nothing but gravity is missing."""
    log, _ = log_of(*motors)
    bodies = BODIES[: 10 * ROBOT.joints].reshape(ROBOT.joints, 10)
    described_log = DescribedLog(BASE.model, FilteredLog(ROBOT, [log]))
    fit = described_log.judge.fit(described_log.rows)
    witness = gravity_witness(described_log, fit, bodies)
    assert witness.difference < 0.05
    assert abs(witness.multiple - 1.0) < 0.05
    assert not witness.is_different
    lighter = gravity_witness(described_log, fit, 0.7 * bodies)
    assert abs(lighter.multiple - 1 / 0.7) < 0.05
    assert not lighter.is_different
    reversed_witness = gravity_witness(described_log, fit, -bodies)
    assert reversed_witness.is_absent
    assert "`robot.gravity`" in reversed_witness.sentence


def test_a_force_that_is_friction_alone_has_no_friction_by_load_if_strict(motors):
    """That column would be the force itself, and would hide every mistake."""
    log, _ = log_of(*motors)
    forces = np.asarray(log.forces).copy()
    forces[:, 1] = 5.0 * np.sign(np.gradient(np.asarray(log.angles)[:, 1]))
    filtered_log = FilteredLog(ROBOT, [dataclasses.replace(log, forces=forces)])
    assert filtered_log.friction_shares[1] > 0.9
    counts = {}
    for is_strict in (False, True):
        described_log = DescribedLog(BASE.model, filtered_log, is_strict)
        columns = described_log.rows.columns
        counts[is_strict] = np.count_nonzero(np.abs(columns).max(axis=(0, 1)) > 0.0)
    assert counts[True] == counts[False] - np.count_nonzero(
        filtered_log.friction_shares > 0.85
    )


@pytest.mark.parametrize("is_clipped", [False, True])
def test_a_sensor_that_clips_is_told_from_a_drive_at_its_limit(motors, is_clipped):
    log, _ = log_of(*motors)
    forces = np.asarray(log.forces).copy()
    limit = 0.8 * forces[:, 1].max()
    if is_clipped:
        forces[:, 1] = np.minimum(forces[:, 1], limit)
    else:
        forces[np.argsort(forces[:, 1])[-60:], 1] = forces[:, 1].max()
    log = dataclasses.replace(log, forces=forces)
    limits = list(limited_forces(log))
    assert [x.joint for x in limits] == [1]
    assert clipped_forces(BASE.model, log, limits) == (limits if is_clipped else [])


def test_a_push_of_a_person_is_named_with_its_time(motors, said):
    angles, forces = motors
    push = np.zeros_like(forces)
    push[1000:1160, :2] = 0.7 * np.abs(forces[:, :2]).max(axis=0)
    (sentence,) = said(angles, forces + push)
    start, stop = map(float, re.findall(r"from (\S+) to (\S+) s", sentence)[0])
    assert sentence.startswith("something seems to push the robot")
    assert abs(start - 5.0) < 0.1
    assert abs(stop - 5.8) < 0.1


def test_a_friction_that_drifts_is_no_push(motors, said):
    angles, forces = motors
    growth = np.linspace(0.0, 1.0, len(forces))[:, None] ** 2
    drift = growth * forces.std(axis=0) * np.sign(np.gradient(angles, axis=0))
    assert not any("push" in sentence for sentence in said(angles, forces + drift))


def test_a_push_in_one_of_two_logs_is_named_with_the_log(motors):
    angles, forces = motors
    push = np.zeros_like(forces)
    push[1000:1160, :2] = 0.7 * np.abs(forces[:, :2]).max(axis=0)
    pairs = [log_of(angles, forces), log_of(angles, forces + push)]
    logs = [
        observations.replace(name=name)
        for name, (_, observations) in zip("ab", pairs, strict=True)
    ]
    examined = [
        diagnose(log, ROBOT, observations=o)
        for (log, _), o in zip(pairs, logs, strict=True)
    ]
    (sentence,) = mistakes_in_logs(examined, identify(BASE, logs)).certain
    assert sentence.startswith("b: something seems to push the robot from 5")


def test_a_late_force_of_one_joint_and_a_wrong_ratio_are_named(motors, said):
    angles, forces = motors
    late = forces.copy()
    late[12:, 1] = forces[:-12, 1]
    (sentence,) = said(angles, late)
    assert sentence.startswith("the force of joint `joint2` seems to be 6")
    q = np.asarray(ROBOT.drives.joint_angles(angles)) * [1.0, 1.0, 1.25, 1.0]
    (sentence,) = said(np.asarray(ROBOT.drives.motor_angles(q)), forces)
    assert "the gear ratio of joint `joint3` seems to be wrong" in sentence
    assert "its angle is 0.8" in sentence


def described(**change):
    """Return what is said of the log if the robot is described wrongly."""

    def mistakes(motors):
        robot = ROBOT.replace(**change)
        base = base_parameters(Model(robot, BASE.model.terms))
        log, o = log_of(*motors)
        fit = identify(base, o)
        return revealed(diagnose(log, robot, observations=o), fit)

    return mistakes


@pytest.mark.parametrize(
    "gravity", [(0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (0.0, -9.81, 0.0)]
)
def test_gravity_is_named_and_not_a_sign(motors, gravity):
    (sentence,) = described(gravity=np.array(gravity))(motors)
    assert sentence.startswith("gravity seems to be [0, 0, -9.81] (`robot.gravity`)")


@pytest.mark.parametrize(
    ("joint", "axis", "words"), [(1, (0, -1, 0), "reversed"), (2, (1, 0, 0), "(0 1 0)")]
)
def test_an_axis_is_named_and_not_a_sign(motors, joint, axis, words):
    wrong = AXES.copy()
    wrong[joint] = axis
    (sentence,) = described(axis=wrong)(motors)
    assert sentence.startswith(
        f"the axis of joint `joint{joint + 1}` seems to be {words}"
    )


def test_what_no_single_mistake_explains_is_no_cure(motors):
    offset = np.array(ROBOT.offset)
    offset[2] += (-0.5, 0.4, 0.3)
    wrong = AXES.copy()
    wrong[3] = 0, 1, 0
    texts = described(axis=wrong, offset=offset)(motors)
    assert not any("seem" in text for text in texts)


@pytest.mark.parametrize(
    ("factor", "words"), [(1e3, "all joints need"), (1e-3, "no joint needs")]
)
def test_forces_in_another_unit_are_one_doubt_and_not_four(motors, factor, words):
    log, o = log_of(motors[0], factor * motors[1])
    doubts = [w for w in diagnose(log, ROBOT, observations=o).findings if "force" in w]
    assert len(doubts) == 1
    assert doubts[0].startswith(words)
    assert (
        "check `recording.force_unit`, `torque_constants`, `forces_side` with "
        in doubts[0]
    )


@pytest.mark.parametrize("joints", [[1], [0, 3], [0, 1, 2]])
def test_forces_of_some_joints_beyond_their_limits_are_one_doubt(motors, joints):
    log, o = log_of(*motors)
    peaks = diagnose(log, ROBOT, observations=o).statistics.force
    shares = np.ones(4)
    shares[joints] = 1.6
    limits = dataclasses.replace(ROBOT.limits, joints=4, force=peaks / shares)
    robot = ROBOT.replace(limits=limits)
    (doubt,) = diagnose(log, robot, observations=o).findings
    for j in range(4):
        assert (f"`joint{j + 1}`" in doubt) == (j in joints)
    first_joint = joints[0]
    peak = peaks[first_joint]
    assert f"{peak:.3g} of {peak / 1.6:.3g} N m" in doubt
    assert "`recording.force_unit`" in doubt


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("position_max", "leave their ranges"),
        ("velocity", "are faster than their limits"),
    ],
)
def test_ranges_and_speeds_beyond_limits_are_a_doubt(motors, limit, words):
    log, o = log_of(*motors)
    statistics = diagnose(log, ROBOT, observations=o).statistics
    peaks = {"position_max": statistics.highest, "velocity": statistics.speed}
    numbers = np.array(getattr(ROBOT.limits, limit))
    numbers[2] = 0.7 * peaks[limit][2]
    limits = dataclasses.replace(ROBOT.limits, joints=4, **{limit: numbers})
    (doubt,) = diagnose(log, ROBOT.replace(limits=limits), observations=o).findings
    assert doubt.startswith(f"joints {words}")
    assert re.findall(r"`joint\d`", doubt) == ["`joint3`"]
