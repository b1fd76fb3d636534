"""Simulation of joints behind position servos, against scipy and MuJoCo."""

import jax.numpy as jnp
import numpy as np
import pytest
import servo_arm
from scipy.signal import lsim
from simulated_joints import INDEX, commands, motion_of, parameter_rows, path_of

from jaxid.rollout import ServoMotion, ServoSimulator
from jaxid.rollout.dry_friction import slip_of


def test_a_linear_joint_moves_as_scipys():
    t = 0.02 * np.arange(500)
    sent = np.sin(3.0 * t) * (1.0 - np.exp(-t))
    path = path_of(sent[:, None], J=4e-3, B=0.08, d=0.0, F=0.0, f=0.03)[:, 0]
    fine = np.linspace(0.0, t[-1], 20 * 499 + 1)
    system = ([0.03, 1.0], [4e-3, 0.08, 1.0])
    _, exact, _ = lsim(system, np.interp(fine, t, sent), fine)
    assert np.abs(path - exact[::20]).max() < 1e-4


@pytest.mark.parametrize("J", [1e-7, 1e-5, 1e-3])
def test_a_ramp_is_followed_steadily_whatever_the_inertia(J):
    """Both stages of a step have own commands: else inertia counts without cause."""
    sent = 0.02 * 0.2 * np.arange(500)[:, None]
    path = path_of(sent, J=J, B=0.05, F=0.01, d=0.01)[200:, 0]
    np.testing.assert_allclose(np.diff(path), 0.02 * 0.2, rtol=1e-9)
    lag = sent[200:, 0] - path
    np.testing.assert_allclose(lag, 0.2 * (0.05 + 0.01) + 0.01, rtol=1e-9)


def test_a_joint_within_its_friction_does_not_creep():
    sent = np.concatenate([np.linspace(0.0, 0.5, 100), np.full(400, 0.5)])
    path = path_of(sent[:, None], J=4e-3, B=0.08, F=0.02, b=-0.01)[:, 0]
    at_rest = path[200:]
    assert np.ptp(at_rest) == 0.0
    # It stops where the friction and the bias hold it, short of the command.
    assert 0.0 < 0.5 - at_rest[0] < 0.02 + 0.01


def test_held_commands_that_jump_within_a_step_act_at_their_instant():
    """A joint with friction leads or lags by as little as 3 urad, for any delay."""
    delays = np.array([0.0105, 0.0110, 0.0117, 0.0120])
    sent = np.tile(commands(3, [0.6], 300), len(delays))
    motion = motion_of(sent)
    rows = parameter_rows(len(delays), J=4e-3, B=0.05, d=delays, F=0.02)
    paths = [
        ServoSimulator(motion, step, True).positions(rows, motion.start)[0]
        for step in (0.0025, 0.0002)
    ]
    leads = (paths[0] - paths[1]) * np.sign(np.gradient(paths[1], axis=1))
    assert np.abs(leads.mean(axis=1)).mean() < 3e-6


def test_a_joint_that_turns_around_keeps_its_velocity():
    """The force turns the joint in a stage: friction first brakes, then opposes it."""
    force, inertia, friction, w = -3.0, 100.0, 1.0, 0.02
    arguments = (jnp.array(y) for y in (force, inertia, friction, inertia, w))
    slip = slip_of(*arguments, 1.0)
    u = (force + inertia * w - friction * float(slip.direction)) / inertia
    # Part of the stage until the joint is at rest.
    braking_share = w * inertia / (friction - force)
    assert u == pytest.approx((force + friction) * (1.0 - braking_share) / inertia)
    arguments = (jnp.array(y) for y in (-0.5, inertia, friction, inertia, 0.01))
    assert not slip_of(*arguments, 1.0).is_moving


VALUES = {"J": 5e-3, "B": 0.06, "d": 0.013, "b": 0.01, "a": 0.08, "F": 0.015, "mu": 0.3}
VALUES |= {"Fs": 0.004, "vs": 0.07, "um": 0.15}
CASES = [
    ({}, False, None),
    ({}, True, True),
    ({"ki": 4.0}, True, None),
    ({"ki": 4.0, "f": 0.02}, False, True),
]


def arm_in_motion(values, hold, coupled):
    """Return a simulator of the arm, its parameters, and its initial states."""
    t = 0.02 * np.arange(300)[:, None]
    motion = motion_of(
        0.4 * np.sin([2.0, 2.7] * t) + 0.1 * np.sin([9.0, 7.0] * t + 1.0)
    )
    bodies = None if coupled is None else servo_arm.bodies(coupled)
    simulator = ServoSimulator(motion, 0.01, hold, bodies)
    rows = parameter_rows(2, **VALUES, **values) * np.array([[1.0], [1.1]])
    start = motion.start + np.array([0.01, 0.2, 0.0])
    return simulator.in_agreement(rows, start), rows, start


@pytest.mark.parametrize(("values", "hold", "coupled"), CASES)
def test_sensitivities_agree_with_differences(values, hold, coupled):
    simulator, rows, start = arm_in_motion(values, hold, coupled)
    unknowns = np.concatenate([rows[None], start], axis=-1)
    _, S = simulator.sensitivities(rows, start)

    def path(unknowns):
        split = unknowns[..., : rows.shape[-1]], unknowns[..., rows.shape[-1] :]
        return simulator.positions(*split)[0]

    symbols = [*VALUES, *values]
    indices = [*(INDEX[symbol] for symbol in symbols), -3, -2, -1]
    for k in indices:
        if k == INDEX["d"] and "f" in values:
            # Rates of interpolated commands jump at samples: a difference over a small
            # time does not see it.
            continue
        # Joints are simulated along known loads: each has own derivatives.
        step = np.zeros_like(unknowns)
        step[..., k] = 1e-6 * np.maximum(np.abs(unknowns[..., k]), 1e-2)
        difference = path(unknowns + step) - path(unknowns - step)
        difference = difference / (2.0 * step[0, :, k, None])
        error = np.abs(S[0, :, k] - difference)
        rounding = 16 * np.finfo(float).eps / step[0, :, k].min()
        # A kink within a step shifts single samples.
        limit = 1e-6 * max(np.abs(difference).max(), 1e-3) + rounding
        assert np.quantile(error, 0.98) < limit, k


def test_a_feed_forward_that_comes_late_has_the_sensitivity_of_its_delay():
    simulator, rows, start = arm_in_motion({"f": 0.05}, False, None)
    _, S = simulator.sensitivities(rows, start)
    ends = []
    for sign in (1.0, -1.0):
        other_rows = rows.copy()
        other_rows[:, INDEX["d"]] += sign * 0.01
        ends.append(simulator.positions(other_rows, start)[0])
    difference = (ends[0] - ends[1]) / 0.02
    error = np.abs(S[0, :, INDEX["d"]] - difference)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(difference**2))


@pytest.mark.parametrize("feed", [None, (0.5, 0.8)])
def test_joints_that_shake_each_other_move_as_in_mujoco(feed):
    """Steps of 10 and 2.5 ms, against MuJoCo's of 0.1 ms with nearly rigid friction."""
    K = np.array(servo_arm.KP)
    rows = parameter_rows(
        2,
        J=np.array(servo_arm.ARMATURE) / K,
        B=servo_arm.DAMPING / K,
        a=1.0 / K,
        F=servo_arm.FRICTION / K,
        d=servo_arm.DELAY - 5e-5,
        f=0.0 if feed is None else feed / K,
    )
    log = servo_arm.log(3, duration=10.0, step=1e-4, rounding=1e-9, feed=feed)
    motion = ServoMotion.of([log])
    start = motion.start * [1.0, 0.0, 0.0]
    errors = []
    for step in (0.01, 0.0025):
        simulator = ServoSimulator(motion, step, feed is None, servo_arm.bodies(True))
        path = simulator.in_agreement(rows, start).positions(rows, start)[0]
        mean_squares = np.mean((path.T - log.angles) ** 2, axis=0)
        errors.append(np.sqrt(mean_squares).max())
    assert errors[0] < 2e-4
    assert errors[1] < (3e-5 if feed is None else 8e-5)
