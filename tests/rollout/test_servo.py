"""Identification of position-controlled joints against MuJoCo and known parameters."""

import dataclasses

import mujoco
import numpy as np
import pytest
import servo_arm
import simulated_joints
from simulated_joints import ENCODER, INDEX

import jaxid as jid
from jaxid.export.servo_actuators import export_servo_mjcf, simulator_values
from jaxid.rollout.servo import LOWER


def test_the_arms_parameters_are_found(fit):
    K = np.array(servo_arm.KP)
    truth = {"B": servo_arm.DAMPING / K, "F": servo_arm.FRICTION / K}
    for symbol, values in truth.items():
        np.testing.assert_allclose(fit.parameters[:, INDEX[symbol]], values, rtol=0.02)
    assert fit.hold
    armature = simulator_values(fit)["armature"][1]
    assert armature == pytest.approx(servo_arm.ARMATURE[1], rel=0.02)
    assert fit.stiffness[1] == pytest.approx(K[1], rel=0.01)
    # The arm has no other effects, and no bias beside its weight.
    assert not fit.free[:, [INDEX[x] for x in ("mu", "Fs", "um", "ki", "f")]].any()
    assert not fit.free[1, INDEX["b"]]
    assert fit.notes == ()


def test_the_simulation_follows_another_motion(fit):
    log = servo_arm.log(9)
    errors = fit.validate(log)
    assert errors.total().max() < 1e-3
    assert (errors.total("linear") > 3 * errors.total()).all()
    assert fit.window_errors(log, 1.0).max() < 1e-3


def test_every_sample_counts_in_the_errors_though_something_holds_the_robot(fit):
    log = servo_arm.log(9, block=0.05)
    errors = fit.validate(log)
    (path,) = fit.simulate(log)
    assert path.shape == log.angles.shape
    squares = (path - log.angles) ** 2
    np.testing.assert_allclose(errors.total(), np.sqrt(squares.mean(axis=0)))
    assert errors.total()[1] > 0.02


def test_samples_within_contacts_that_were_given_count_nowhere(fit):
    """A table holds the second joint in one of four motions, again and again."""
    logs = [servo_arm.log(k) for k in range(4)]
    held = logs[1] = servo_arm.log(1, block=0.05)
    near = held.angles[:, 1] > 0.045
    edges = np.flatnonzero(np.diff(near.astype(int), prepend=0, append=0))
    times = np.append(held.time, held.time[-1])[edges].reshape(-1, 2)
    spans = [(start - 0.05, end + 0.2) for start, end in times.tolist()]
    known = jid.identify_rollout(
        logs, servo_arm.bodies(False), contacts={held.name: spans}
    )
    np.testing.assert_allclose(known.stiffness[1], servo_arm.KP[1], rtol=0.02)
    assert known.left_out > 50
    assert f"{known.left_out} samples within them are left out" in str(known)

    errors = known.validate(logs)
    assert errors.total().max() < 1e-3
    inside = [(held.time >= a) & (held.time <= b) for a, b in spans]
    outside = ~np.any(inside, axis=0)
    assert f"every sample but {np.sum(~outside)} within the given contacts" in str(
        errors
    )
    (path,) = known.simulate(held)
    squares = (path - held.angles)[outside] ** 2
    np.testing.assert_allclose(errors.rms()[1], np.sqrt(squares.mean(axis=0)))
    assert known.window_errors(logs).max() < 2e-3
    assert fit.validate(logs).total()[1] > 0.01
    with pytest.raises(jid.InputError, match="`contacts`"):
        jid.identify_rollout(logs, contacts=[(2.0, 1.0)])


@pytest.mark.parametrize("horizon", [0.1, 1.0])
def test_windows_do_not_smooth_a_fast_motion_away(fit, horizon):
    """A chirp to 8 Hz of a perfect model, whose commands come late."""
    t = 0.01 * np.arange(1500)
    phase = 2 * np.pi * (0.5 * t + 0.25 * t**2)
    commands = 0.2 * np.sin(phase)[:, None] * [1.0, -1.0]
    truth = {"J": 2e-3, "B": 0.05, "F": 0.01, "d": 0.09}
    log = simulated_joints.log(commands, dt=0.01, **truth)
    rows = simulated_joints.parameter_rows(2, **truth)
    perfect = dataclasses.replace(fit, parameters=rows, hold=False, bodies=None)
    assert perfect.window_errors(log, horizon).max() < ENCODER
    rows[:, INDEX["B"]] *= 1.2
    wrong = dataclasses.replace(perfect, parameters=rows)
    assert wrong.window_errors(log, horizon).min() > 3 * ENCODER


def test_samples_have_the_deviations_and_degrees_of_freedom_of_the_fit(fit):
    few_dof = np.full_like(fit.uncertainty.dof, 3.0)
    uncertainty = dataclasses.replace(fit.uncertainty, dof=few_dof)
    few = dataclasses.replace(fit, uncertainty=uncertainty)
    draws = few.samples(4000, seed=1)[:, fit.free] - fit.parameters[fit.free]
    lower, upper = np.quantile(draws, [0.025, 0.975], axis=0)
    # 97.5 % of Student's t with three degrees of freedom.
    half_width = 3.182 * fit.uncertainty.standard_deviations
    limits = LOWER[np.nonzero(fit.free)[1]]
    is_inside = fit.parameters[fit.free] - 20 * half_width > limits
    half_range = 0.5 * (upper - lower)
    np.testing.assert_allclose(half_range[is_inside], half_width[is_inside], rtol=0.1)
    assert is_inside.sum() > 3


def test_mujoco_moves_like_the_simulation(fit, tmp_path):
    paths = export_servo_mjcf(fit, tmp_path / "arm.xml", samples=2, timestep=0.001)
    assert len({p.read_text() for p in paths}) == 3
    require_motion_of_mujoco(paths[0], servo_arm.log(9))


def require_motion_of_mujoco(path, log):
    """Require that MuJoCo, with held and late commands, moves as in the log."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data, delay = mujoco.MjData(model), model.numeric("delay").data
    sent = np.asarray(log.forces)
    positions = np.zeros_like(sent)
    for k in range(20 * len(sent)):
        if k % 20 == 0:
            positions[k // 20] = data.qpos
        indices = np.maximum(0, np.floor((k * 0.001 - delay) / 0.02).astype(int))
        data.ctrl[:] = sent[indices, [0, 1]]
        mujoco.mj_step(model, data)
    # Integral actions of MuJoCo begin at zero: what they have to carry comes late.
    settled_errors = (positions - log.angles)[100:]
    assert np.sqrt(np.mean(settled_errors**2, axis=0)).max() < 1.5e-3


def test_integral_action_of_a_servo_that_saturates_is_found_and_exported(tmp_path):
    """Logs of MuJoCo's PID controller; the proportional gain is known."""
    pid = {"ki": 3.0, "limit": 1.6}
    logs = [servo_arm.log(k, **pid) for k in range(4)]
    fit = jid.identify_rollout(logs, servo_arm.bodies(False), stiffness=servo_arm.KP)
    np.testing.assert_allclose(fit.parameters[:, INDEX["ki"]], 3.0, rtol=0.02)
    np.testing.assert_array_equal(fit.stiffness, servo_arm.KP)
    values = simulator_values(fit)
    np.testing.assert_allclose(values["effort_limit"], 1.6, rtol=0.02)
    # MuJoCo damps at the end of its steps of 1 ms: half of it acts as inertia.
    damping = np.array(servo_arm.DAMPING)
    armature = servo_arm.ARMATURE + 0.5e-3 * damping
    np.testing.assert_allclose(values["armature"], armature, rtol=0.02)
    np.testing.assert_allclose(values["damping"], damping, rtol=0.02)
    other = servo_arm.log(9, **pid)
    assert fit.validate(other).total().max() < 1e-3
    assert fit.window_errors(other).max() < 1e-3
    proportional = servo_arm.log(9)
    difference = np.sqrt(np.mean((proportional.angles - other.angles) ** 2, axis=0))
    assert difference.min() > 10e-3
    path = export_servo_mjcf(fit, tmp_path / "arm.xml", timestep=0.001)[0]
    require_motion_of_mujoco(path, other)


def test_a_feed_forward_of_the_velocity_is_found():
    feed = np.array([0.5, 0.8])
    logs = [servo_arm.log(k, feed=tuple(feed)) for k in range(4)]
    fit = jid.identify_rollout(logs, servo_arm.bodies(False), stiffness=servo_arm.KP)
    assert not fit.hold
    for j, truth in enumerate(feed / servo_arm.KP):
        assert fit.parameters[j, INDEX["f"]] == pytest.approx(truth, rel=0.05)
        # MuJoCo's steps of 1 ms act half a step early, about.
        (delay,) = [c for c in fit.combinations if (c.joint, c.name) == (j, "d")]
        lower, upper = delay.interval()
        assert lower - 1e-4 < servo_arm.DELAY - 0.5e-3 < upper + 1e-4
    assert fit.validate(servo_arm.log(9, feed=tuple(feed))).total().max() < 1e-3


def test_an_effect_that_is_not_determined_is_left_out_and_named():
    """One of two equal joints saturates; the other one moves too little to show it."""
    logs = []
    for k in range(4):
        commands = simulated_joints.commands(k, [0.5, 0.06])
        limit = np.array([0.12, 1e3])
        log = simulated_joints.log(commands, J=4e-3, B=0.08, F=0.01, d=0.02, um=limit)
        logs.append(log)
    fit = jid.identify_rollout(logs, joint_names=["left_hip", "right_hip"])
    limits = fit.parameters[:, INDEX["um"]]
    assert limits[0] == pytest.approx(0.12, rel=0.02)
    assert limits[1] == 1e3
    notes = [x for x in fit.notes if "left out" in x]
    (note,) = [x for x in notes if "Largest torque" in x]
    assert "right_hip" in note
    assert "left_hip" not in note


def test_damping_and_delay_of_a_slow_ramp_are_merged():
    """Without acceleration only the lag is seen: damping over stiffness plus delay."""
    random = np.random.default_rng(0)
    logs = []
    for speed in (0.04, -0.04, 0.02, -0.02):
        sent = speed * 0.02 * np.arange(400)[:, None]
        path = simulated_joints.path_of(sent, J=1e-4, B=0.06, d=0.02, F=0.01)
        noise = random.uniform(-ENCODER, ENCODER, path.shape)
        measured = ENCODER * np.round((path + noise) / ENCODER)
        logs.append(jid.Recording.of(measured, sent, sample_time=0.02))
    fit = jid.identify_rollout(logs)
    (lag,) = [c for c in fit.combinations if c.name.startswith("B ")]
    assert " d" in lag.name
    lower, upper = lag.interval(0.999)
    B, d = lag.coefficients[[INDEX["B"], INDEX["d"]]]
    # Delays of held commands are half a sample shorter.
    delay = 0.01 if fit.hold else 0.02
    assert lower < B * 0.06 + d * delay < upper


def test_commands_of_the_wrong_sign_are_named():
    logs = []
    for k in range(4):
        commands = simulated_joints.commands(k, [0.4, 0.3])
        log = simulated_joints.log(commands, J=4e-3, B=0.08)
        signs = np.array([-1.0, 1.0])
        angles = signs * log.angles
        logs.append(jid.Recording.of(angles, log.forces, sample_time=0.02))
    shares = []
    fit = jid.identify_rollout(logs, progress=lambda _, share: shares.append(share))
    signed = [note for note in fit.notes if "check signs" in note]
    assert all(note.startswith("joint 1") for note in signed)
    assert len(signed) > 0
    assert min(shares) >= 0.0
    assert max(shares) <= 1.0
    assert len(shares) > 5


@pytest.mark.parametrize("stiffness", [0.0, np.inf, [1.0, 2.0, 3.0]])
def test_a_stiffness_that_does_not_fit_is_rejected(stiffness):
    with pytest.raises(jid.InputError, match="`stiffness`"):
        jid.identify_rollout(servo_arm.log(0), stiffness=stiffness)


def test_logs_that_cannot_be_used_are_rejected():
    still = jid.Recording.of(np.zeros((200, 1)), np.zeros((200, 1)), sample_time=0.02)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(still)
    short = jid.Recording.of(np.zeros((20, 1)), np.zeros((20, 1)), sample_time=0.02)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(short)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(servo_arm.log(0), joint_names=["one"])
    with pytest.raises(jid.InputError, match="`alike`"):
        jid.identify_rollout(servo_arm.log(0), alike=[["hip"]])
