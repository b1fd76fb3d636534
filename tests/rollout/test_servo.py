"""Identification of position-controlled joints against MuJoCo and scipy."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import servo_arm

import jaxid as jid
from jaxid.export.servo_actuators import (
    export_servo_mjcf,
    simulator_table,
    simulator_values,
)
from jaxid.rollout.coupled import CoupledSimulator
from jaxid.rollout.coupled_refinement import Refinement
from jaxid.rollout.determined_combinations import _Rows
from jaxid.rollout.dry_friction import Slip
from jaxid.rollout.identify import mask
from jaxid.rollout.least_squares import bounded_step, minimise
from jaxid.rollout.motion import ServoMotion, state_at
from jaxid.rollout.servo import (
    INDEX,
    LOWER,
    START,
    balanced_integral,
    with_integral,
)
from jaxid.rollout.uncoupled import ServoSimulator


def _one_joint(commands, load=0.0, **parameters):
    """Return a simulator of one joint and its parameters [1, 1, parameters]."""
    sent = np.asarray(commands, float)[:, None]
    motion = ServoMotion.of(
        [jid.Recording.of(0 * sent + sent[0], sent, sample_time=0.02)]
    )
    motion = motion.replace(load=np.full_like(motion.load, load))
    x = START.copy()
    for symbol, value in parameters.items():
        x[INDEX[symbol]] = value
    return ServoSimulator(motion, 0.01), x[None, None]


def test_a_linear_joint_moves_as_scipys():
    from scipy.signal import lsim

    t = 0.02 * np.arange(500)
    sent = np.sin(3.0 * t) * (1.0 - np.exp(-t))
    simulator, x = _one_joint(sent, J=4e-3, B=0.08, d=0.0, F=0.0)
    path = simulator.paths(x)[0, 0, 0]
    fine = np.linspace(0.0, t[-1], 20 * 499 + 1)
    _, exact, _ = lsim(([1.0], [4e-3, 0.08, 1.0]), np.interp(fine, t, sent), fine)
    assert np.abs(path - exact[::20]).max() < 1e-4


@pytest.mark.parametrize("J", [1e-7, 1e-5, 1e-3])
def test_a_ramp_is_followed_steadily_whatever_the_inertia(J):
    """Both stages of a step have own commands: else inertia counts without cause."""
    speed = 0.2
    simulator, x = _one_joint(0.02 * speed * np.arange(400), J=J, B=0.05, F=0.01)
    coupled = CoupledSimulator(simulator.motion, 0.01, False, None)
    path = coupled.positions(coupled.simulate(x[0]))[0, 0, 200:400]
    np.testing.assert_allclose(np.diff(path), 0.02 * speed, rtol=1e-9)
    np.testing.assert_allclose(simulator.paths(x)[0, 0, 0, 200:400], path, rtol=1e-9)


def test_a_joint_within_its_friction_does_not_creep():
    sent = np.concatenate([np.linspace(0.0, 0.5, 100), np.full(600, 0.5)])
    simulator, x = _one_joint(sent, J=4e-3, B=0.08, F=0.02, a=0.1, load=0.1)
    path = simulator.paths(x)[0, 0, 0]
    at_rest = path[200:]
    assert np.ptp(at_rest) == 0.0
    # It stops where the friction and the load hold it, short of the command.
    assert 0.0 < 0.5 - at_rest[0] < 0.02 + 0.01


def test_no_inertia_is_allowed():
    simulator, x = _one_joint(np.linspace(0.0, 1.0, 200), J=1e-7, B=0.05, d=0.0, F=0.0)
    path = simulator.paths(x)[0, 0, 0]
    speed = 1.0 / (199 * 0.02)
    assert path[150] == pytest.approx(150 * 0.02 * speed - 0.05 * speed, abs=1e-3)


VALUES = {"J": 5e-3, "B": 0.06, "d": 0.013, "b": 0.01, "a": 0.08, "F": 0.015, "mu": 0.3}
VALUES |= {"Fs": 0.004, "vs": 0.07, "um": 0.15}


def _arm(bodies, hold, ki=0.0):
    """Return a simulator of the arm, its parameters, and which of them matter."""
    t = 0.02 * np.arange(300)[:, None]
    sent = 0.4 * np.sin([2.0, 2.7] * t) + 0.1 * np.sin([9.0, 7.0] * t + 1.0)
    motion = ServoMotion.of([jid.Recording.of(sent, sent, sample_time=0.02)])
    motion = motion.replace(start=motion.start + np.array([[0.01], [0.2]]))
    x = np.tile(START, (2, 1))
    for symbol, value in VALUES.items():
        x[:, INDEX[symbol]] = value * np.array([1.0, 1.1])
    x[:, INDEX["ki"]] = ki
    free = np.ones(x.shape, bool)
    free[:, INDEX["ki"]] = ki > 0.0
    if ki > 0.0:
        motion = with_integral(motion, x, hold)
    free[:, INDEX["a"]] = free[:, INDEX["mu"]] = bodies is not None
    return CoupledSimulator(motion, 0.01, hold, bodies), x, free


CASES = [(x, hold, 0.0) for x in (None, False, True) for hold in (False, True)]


@pytest.mark.parametrize(
    ("coupled", "hold", "ki"), [*CASES, (None, False, 4.0), (True, True, 4.0)]
)
def test_sensitivities_agree_with_differences(coupled, hold, ki):
    bodies = None if coupled is None else servo_arm.bodies(coupled)
    simulator, x, free = _arm(bodies, hold, ki)
    S = simulator.sensitivities(x, simulator.simulate(x), free)[0]

    def path(x, start):
        motion = simulator.motion.replace(start=simulator.motion.start + start)
        other = dataclasses.replace(simulator, motion=motion)
        return other.positions(other.simulate(x))[0]

    for k, (joint, symbol) in enumerate(np.argwhere(free)):
        step = np.zeros_like(x)
        step[joint, symbol] = 1e-6 * x[joint, symbol]
        ends = path(x + step, 0.0), path(x - step, 0.0)
        difference = (ends[0] - ends[1]) / (2 * step[joint, symbol])
        error, scale = np.abs(S[..., k] - difference), np.abs(difference).max()
        # A kink within a step shifts single samples; differences of positions are
        # rounded, and integral actions sum this up.
        rounding = (16 if ki > 0.0 else 1) * np.finfo(float).eps / step[joint, symbol]
        assert np.quantile(error, 0.98) < 1e-6 * max(scale, 1e-3) + rounding, (
            joint,
            symbol,
        )
    size = simulator.motion.start[0].size
    for k in range(size):
        start = np.zeros_like(simulator.motion.start[0])
        start.ravel()[k] = 1e-6
        difference = (path(x, start) - path(x, -start)) / 2e-6
        assert np.quantile(np.abs(S[..., k - size] - difference), 0.98) < 1e-6


@pytest.mark.parametrize("ki", [0.0, 4.0])
def test_the_search_has_the_gauss_newton_matrix_of_uncoupled_joints(ki):
    simulator, x, free = _arm(None, False, ki)
    free[:] = True
    S = simulator.sensitivities(x, simulator.simulate(x), free)[0]
    counted = simulator.motion.counted[0]
    alone = ServoSimulator(simulator.motion, 0.01)
    r = (alone.paths(x[None])[0, 0] - simulator.motion.positions[0]) * counted
    cost, g, H = (z[0, 0] for z in alone.moments(x[None]))
    of_start = jax.jacfwd(
        lambda x: balanced_integral(x, simulator.motion.part(0), np.array(False))
    )(x)
    for j in range(2):
        own = S[j, :, j * len(START) : (j + 1) * len(START)]
        if ki > 0.0:
            # The search starts in balance, whatever the parameters.
            own = own + S[j, :, [j - 2]].T @ of_start[j, j][None]
        own = own * counted[j, :, None]
        np.testing.assert_allclose(cost[j], r[j] @ r[j], rtol=1e-9)
        np.testing.assert_allclose(g[j], own.T @ r[j], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(H[j], own.T @ own, rtol=1e-7, atol=1e-12)


def test_joints_that_shake_each_other_move_as_in_mujoco():
    """Steps of 10 and 2.5 ms, against MuJoCo's of 0.1 ms with nearly rigid friction."""
    K = np.array(servo_arm.KP)
    x = np.tile(START, (2, 1))
    values = {
        "J": np.array(servo_arm.ARMATURE) / K,
        "B": servo_arm.DAMPING / K,
        "a": 1.0 / K,
    }
    values |= {"F": servo_arm.FRICTION / K, "d": servo_arm.DELAY - 5e-5, "b": 0.0}
    for symbol, value in values.items():
        x[:, INDEX[symbol]] = value
    log = servo_arm.log(3, duration=10.0, step=1e-4, rounding=1e-9)
    motion = ServoMotion.of([log])
    motion = motion.replace(start=0.0 * motion.start)
    errors = []
    for step in (0.01, 0.0025):
        simulator = CoupledSimulator(motion, step, True, servo_arm.bodies(True))
        path = simulator.positions(simulator.simulate(x))[0, :, : len(log.angles)]
        errors.append(
            np.sqrt(np.mean((path - np.asarray(log.angles).T) ** 2, axis=1)).max()
        )
    assert errors[0] < 2e-4
    assert errors[1] < 2e-5


def test_a_joint_that_turns_around_keeps_its_velocity():
    """The force turns the joint in a stage: friction first brakes, then opposes it."""
    force, inertia, friction, w = -3.0, 100.0, 1.0, 0.02
    one = (jnp.array([y]) for y in (force, inertia, friction, inertia, w))
    slip = Slip.of(*one, jnp.ones(1))
    u = (force + inertia * w - friction * float(slip.direction[0])) / inertia
    rest = (
        w * inertia / (friction - force)
    )  # part of the stage until the joint is at rest
    assert u == pytest.approx((force + friction) * (1.0 - rest) / inertia)
    held = Slip.of(
        *(jnp.array([y]) for y in (-0.5, inertia, friction, inertia, 0.01)), jnp.ones(1)
    )
    assert float(held.free[0]) == 0.0


def test_steps_stay_within_bounds_and_the_others_follow():
    """The second parameter goes to its bound; the first one is then solved again."""
    H, x = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([0.0, 0.2])
    bounds = np.array([-9.0, 0.0]), np.array([9.0, 9.0])
    gradient = np.array([0.5, 1.0])
    step = bounded_step(gradient, H, x, np.ones(2, bool), bounds, 0.0)
    assert np.allclose(step, [(-0.5 + 0.2) / 2.0, -0.2])


def test_a_step_is_zero_where_derivatives_have_overflowed():
    gradient = np.array([[1.0, 2.0], [np.nan, 1.0]])
    information = np.array([np.eye(2), np.full((2, 2), np.inf)])
    bounds = (np.full(2, -9.0), np.full(2, 9.0))
    free = np.ones((2, 2), bool)
    step = bounded_step(gradient, information, np.zeros((2, 2)), free, bounds, 0.0)
    assert np.allclose(step, [[-1.0, -2.0], [0.0, 0.0]])


def test_the_batch_of_least_squares_respects_bounds():
    targets = np.array([[0.5, 2.0], [-3.0, 0.2]])

    def moments(x):
        r = x - targets
        return (r**2).sum(-1), r, np.tile(np.eye(2), (1, 2, 1, 1))

    free = np.array([[True, True], [True, False]])
    bounds = np.full(2, -1.0), np.full(2, 1.0)
    found = minimise(
        moments,
        lambda x: moments(x)[0],
        np.zeros((1, 2, 2)),
        free[None],
        bounds,
        tolerance=1e-14,
    )
    np.testing.assert_allclose(found.x[0], [[0.5, 1.0], [-1.0, 0.0]], atol=1e-6)


def test_the_arms_parameters_are_found(fit):
    K = np.array(servo_arm.KP)
    truth = {"B": servo_arm.DAMPING / K, "F": servo_arm.FRICTION / K}
    for symbol, values in truth.items():
        np.testing.assert_allclose(fit.parameters[:, INDEX[symbol]], values, rtol=0.02)
    assert fit.hold
    assert fit.bodies.coupled
    np.testing.assert_allclose(
        fit.parameters[:, INDEX["J"]][1], servo_arm.ARMATURE[1] / K[1], rtol=0.02
    )
    assert fit.stiffness[1] == pytest.approx(K[1], rel=0.01)
    assert fit.notes == ()


def test_the_simulation_follows_another_motion(fit):
    free = fit.validate(servo_arm.log(9, duration=20.0))
    assert free.total().max() < 0.7e-3
    assert (free.total("linear") > 3 * free.total()).all()


def test_every_sample_counts_in_the_errors_though_something_holds_the_robot(fit):
    log = servo_arm.log(9, duration=20.0, block=0.05)
    errors = fit.validate(log)
    (path,) = fit.simulate(log)
    squares = (path - log.angles)[25:] ** 2
    np.testing.assert_allclose(errors.total(), np.sqrt(squares.mean(axis=0)))
    assert errors.total()[1] > 0.02


def test_windows_and_segments(fit):
    log = servo_arm.log(9, duration=20.0)
    (path,) = fit.simulate(log)
    assert path.shape == log.angles.shape
    assert fit.window_errors(log, 1.0).max() < 4e-3


def test_windows_know_the_commands_before_them():
    """A late joint is far behind its command: so it must be at a window's start."""
    simulator, x = _one_joint(0.01 * np.arange(400), J=4e-3, B=0.05, d=0.09, F=0.01)
    motion = simulator.motion.replace(positions=simulator.paths(x)[0])
    windows = motion.windows(1.0)
    errors = (
        dataclasses.replace(simulator, motion=windows).paths(x)[:, 0]
        - windows.positions
    )
    assert np.abs(errors[1:]).max() < 1e-4


def test_candidates_are_simulated_together_as_alone():
    motion = ServoMotion.of([servo_arm.log(k, duration=6.0) for k in (0, 1)]).known()
    simulator = CoupledSimulator(motion, 0.01, True, servo_arm.bodies())
    x = np.tile(START, (2, 1))
    x[:, INDEX["a"]] = 0.08
    first = Refinement.of(simulator, x, mask(("J", "B", "a"))[None].repeat(2, axis=0))
    steps = [first.unknowns + 0.1 * k * np.abs(first.unknowns) for k in (1, 2)]
    for together, z in zip(first.with_unknowns(steps), steps, strict=True):
        (alone,) = first.with_unknowns([z])
        np.testing.assert_array_equal(together.unknowns, z)
        np.testing.assert_allclose(together.residuals, alone.residuals, atol=1e-12)
        assert np.abs(together.residuals - first.residuals).max() > 1e-3


def test_samples_have_the_deviations_and_degrees_of_freedom_of_the_fit(fit):
    few = dataclasses.replace(fit, dof=np.full_like(fit.dof, 3.0))
    draws = few.samples(4000, seed=1)[:, fit.free] - fit.parameters[fit.free]
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    half = 3.182 * np.sqrt(
        np.diag(fit.covariance)
    )  # 97.5 % of Student's t, three degrees
    inside = fit.parameters[fit.free] - 20 * half > LOWER[np.nonzero(fit.free)[1]]
    np.testing.assert_allclose(0.5 * (high - low)[inside], half[inside], rtol=0.1)
    assert inside.sum() > 3


def test_mujoco_moves_like_the_simulation(fit, tmp_path):
    paths = export_servo_mjcf(fit, tmp_path / "arm.xml", samples=2, timestep=0.001)
    assert len({p.read_text() for p in paths}) == 3
    _require_motion_of_mujoco(paths[0], servo_arm.log(9, duration=20.0))
    values = simulator_values(fit)
    np.testing.assert_allclose(values["armature"][1], servo_arm.ARMATURE[1], rtol=0.02)
    assert (
        "other joints" in str(simulator_table(fit)) or np.isfinite(fit.stiffness).all()
    )


def _require_motion_of_mujoco(path, log):
    """Require that MuJoCo, with held and late commands, moves as in the log."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data, delay = mujoco.MjData(model), model.numeric("delay").data
    measured, sent = np.asarray(log.angles), np.asarray(log.forces)
    path = np.zeros_like(measured)
    for k in range(20 * len(sent)):
        if k % 20 == 0:
            path[k // 20] = data.qpos
        at = np.maximum(0, np.floor((k * 0.001 - delay) / 0.02).astype(int))
        data.ctrl[:] = sent[at, [0, 1]]
        mujoco.mj_step(model, data)
    assert np.sqrt(np.mean((path - measured) ** 2, axis=0)).max() < 1.5e-3


def test_integral_action_is_found_and_exported(tmp_path):
    """Logs of MuJoCo's PID controller; the proportional gain is known."""
    logs = [servo_arm.log(k, duration=20.0, ki=3.0) for k in (0, 1)]
    options = {"friction": False, "saturation": False, "time_step": 0.005}
    options |= {"integral": True, "stiffness": servo_arm.KP}
    found = jid.identify_rollout(logs, servo_arm.bodies(), **options)
    np.testing.assert_allclose(found.parameters[:, INDEX["ki"]], 3.0, rtol=0.01)
    np.testing.assert_array_equal(found.stiffness, servo_arm.KP)
    values = simulator_values(found)
    np.testing.assert_allclose(values["armature"], servo_arm.ARMATURE, rtol=0.02)
    np.testing.assert_allclose(values["damping"], servo_arm.DAMPING, rtol=0.02)
    other = servo_arm.log(9, duration=20.0, ki=3.0)
    errors = found.validate(other).rms()[0]
    assert (errors < [0.7e-3, 2e-3]).all()
    assert found.window_errors(other).max() < 8e-3
    plain = servo_arm.log(9, duration=20.0)
    assert np.sqrt(np.mean((plain.angles - other.angles) ** 2, axis=0)).min() > 10e-3
    path = export_servo_mjcf(found, tmp_path / "arm.xml", timestep=0.001)[0]
    _require_motion_of_mujoco(path, other)


def test_integral_action_of_a_servo_that_saturates_is_found():
    logs = [servo_arm.log(k, duration=20.0, ki=3.0, limit=1.6) for k in (0, 1)]
    options = {
        "friction": False,
        "time_step": 0.005,
        "integral": True,
        "stiffness": servo_arm.KP,
    }
    found = jid.identify_rollout(logs, servo_arm.bodies(), **options)
    np.testing.assert_allclose(found.parameters[:, INDEX["ki"]], 3.0, rtol=0.02)
    limit = simulator_values(found)["effort_limit"]
    np.testing.assert_allclose(limit, 1.6, rtol=0.02)
    other = servo_arm.log(9, duration=20.0, ki=3.0, limit=1.6)
    assert found.validate(other).rms().max() < 3e-3


@pytest.mark.parametrize("stiffness", [0.0, np.inf, [1.0, 2.0, 3.0]])
def test_a_stiffness_that_does_not_fit_is_rejected(stiffness):
    with pytest.raises(jid.InputError, match="`stiffness`"):
        jid.identify_rollout(servo_arm.log(0, duration=10.0), stiffness=stiffness)


def test_deviations_are_at_least_those_of_independent_errors():
    """Errors that alternate have no part that slow sensitivities could average."""
    simulator, x, free = _arm(None, True)
    found = Refinement.of(simulator, x, free & mask(("J", "B", "d", "F"))[None])
    alternating = 1e-3 * (-1.0) ** np.arange(found.residuals.shape[-1])
    found.__dict__["residuals"] = alternating * simulator.motion.counted
    rows = _Rows.of(found)
    covariance, _ = rows.covariance(rows.columns, np.arange(8))
    independent = (
        np.diag(np.linalg.inv(rows.information)) / simulator.motion.counted[0, 0].sum()
    )
    assert (np.diag(covariance) > 0.999 * independent).all()


def test_stiffness_and_delay_of_a_slow_ramp_are_merged():
    """Without acceleration only the lag is seen: damping over stiffness plus delay."""
    step, random, logs = servo_arm.ENCODER, np.random.default_rng(0), []
    for speed in (0.04, -0.04, 0.02, -0.02):
        sent = speed * 0.02 * np.arange(500)
        simulator, x = _one_joint(sent, J=1e-4, B=0.06, d=0.02, F=0.01)
        path = simulator.paths(x)[0, 0, 0][: len(sent)]
        measured = step * np.round(
            (path + random.uniform(-step, step, len(path))) / step
        )
        logs.append(
            jid.Recording.of(measured[:, None], sent[:, None], sample_time=0.02)
        )
    found = jid.identify_rollout(logs, friction=False, saturation=False)
    (lag,) = [c for c in found.combinations if "B" in c.name.split()[0]]
    assert " d" in lag.name
    low, high = lag.interval(0.999)
    truth = float(
        lag.coefficients[0, INDEX["B"]] * 0.06 + lag.coefficients[0, INDEX["d"]] * 0.02
    )
    assert low < truth < high


def test_fast_logs_have_whole_steps():
    sent = np.sin(np.linspace(0.0, 3.0, 4000))[:, None]
    motion = ServoMotion.of([jid.Recording.of(sent, sent, sample_time=0.0005)])
    assert ServoSimulator(motion, 0.01).steps == 1
    assert CoupledSimulator(motion, 0.01, True, None).steps == 2


def test_commands_of_the_wrong_sign_are_named():
    t = 0.02 * np.arange(600)
    sent = 0.3 * np.sin(2.0 * t) + 0.1 * np.sin(7.0 * t)
    simulator, x = _one_joint(sent, J=4e-3, B=0.08, F=0.01)
    path = -simulator.paths(x)[0, 0, 0][: len(sent)]
    log = jid.Recording.of(path[:, None], sent[:, None], sample_time=0.02)
    found = jid.identify_rollout(log, friction=False, saturation=False)
    assert any("check signs" in note for note in found.notes)


def test_logs_that_cannot_be_used_are_rejected():
    still = jid.Recording.of(np.zeros((200, 1)), np.zeros((200, 1)), sample_time=0.02)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(still)
    short = jid.Recording.of(np.zeros((20, 1)), np.zeros((20, 1)), sample_time=0.02)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(short)
    moving = servo_arm.log(0, duration=10.0)
    with pytest.raises(jid.InputError, match="`logs`"):
        jid.identify_rollout(moving, joint_names=["one"])


@pytest.mark.parametrize("hertz", [0.5, 8.0])
def test_a_state_is_that_of_the_motion_slow_or_fast(hertz):
    """A parabola over a fifth of a second would cut the peaks of fast motions."""
    dt = 0.01
    time = dt * np.arange(200)
    pulsation = 2 * np.pi * hertz
    position = 0.2 * np.sin(pulsation * time)
    step = 3.8e-4
    measured = step * np.round(position / step)
    for index in (40, 77, 123):
        state = state_at(measured[None], index, dt).state[:, 0]
        velocity = 0.2 * pulsation * np.cos(pulsation * time[index])
        assert abs(state[0] - position[index]) < 1.5 * step
        assert abs(state[1] - velocity) < 0.03 * 0.2 * pulsation
