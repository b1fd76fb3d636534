"""Open-loop rollouts of a pendulum with two links, whose motion MuJoCo simulates."""

import dataclasses

import driven_pendulum
import jax
import numpy as np
import pytest

import jaxid as jid
from jaxid.dynamics.terms import HardSign
from jaxid.rollout.torque import TorqueRollout, Windows

TERMS = (jid.RigidBodies(), jid.ViscousFriction())


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.xml"
    path.write_text(driven_pendulum.XML)
    return path


@pytest.fixture(scope="module")
def base(path):
    return jid.base_parameters(jid.Model(jid.load_mjcf(path), TERMS))


def _observed(base, seed, **options):
    log = driven_pendulum.log(seed, **options)
    return jid.observe(log, base.model.robot, jid.ZeroPhaseButterworth(30.0))


@pytest.fixture(scope="module")
def logs(base):
    return _observed(base, 0), _observed(base, 1)


@pytest.fixture(scope="module")
def fit(base, logs):
    """The fit to the first log."""
    return jid.rollout.identify_torque_rollout(base, logs[0], horizon=0.1)


def test_late_torques_are_found_and_the_simulation_is_closer(base, logs, fit):
    found, other = fit, logs[1]
    assert found.errors_at(other, 0.2).max() < 2e-3
    assert (
        found.errors_at(other, 0.2) < 0.2 * found.errors_at(other, 0.2, found.start)
    ).all()
    delay = float(found.unknowns[base.size])
    # A held torque is half a sample later than an interpolated one.
    assert delay == pytest.approx(driven_pendulum.LATE + 0.001, abs=5e-4)
    damping = found.parameters[[base.names.index(x) for x in ("fv1", "fv2")]]
    np.testing.assert_allclose(damping, driven_pendulum.DAMPING, rtol=0.1)
    assert "delay" in str(found)


def test_agreement_names_the_delay_of_one_run(fit):
    run = fit.run
    late = run.parameters.copy()
    late[-1] += 0.01
    runs = [run._replace(name=name) for name in ("first", "second")]
    odd = run._replace(name="late", parameters=late)
    result = jid.agreement([*runs, odd])
    assert run.names[-1] == run.kinds[-1] == "delay"
    assert result.odd_names == ("late",)


def test_torques_that_determine_no_simulation_are_refused(base):
    log = driven_pendulum.log(0)
    # The torques of both joints are exchanged.
    forces = np.asarray(log.forces)[:, ::-1]
    wrong = jid.Recording.of(log.angles, forces, sample_time=log.sample_time)
    seen = jid.observe(wrong, base.model.robot, jid.ZeroPhaseButterworth(30.0))
    with pytest.raises(
        jid.InputError, match=r"larger errors after 0\.1 s than a joint"
    ):
        jid.rollout.identify_torque_rollout(base, seen, horizon=0.1)


def test_consecutive_windows_start_from_measured_states(logs, fit):
    errors = fit.validate(logs[1])
    (time,), (measured,), (simulated,) = errors.time, errors.measured, errors.simulated
    samples = np.searchsorted(logs[1].time, time - 1e-9)
    np.testing.assert_array_equal(np.diff(samples), 1)
    np.testing.assert_array_equal(measured.T, np.asarray(logs[1].motion.q)[samples])
    steps = round(0.1 / 0.002)
    residuals = np.abs(simulated - measured).reshape(2, -1, steps)
    # The first sample of a window is one step behind the measured state.
    assert (residuals[..., 0].max(axis=1) < 0.1 * residuals[..., -1].max(axis=1)).all()
    ends = np.sqrt(np.mean(residuals[..., -1] ** 2, axis=1))
    np.testing.assert_allclose(ends, fit.errors_at(logs[1], 0.1), rtol=0.3)
    assert (errors.total() < 0.5 * errors.total("fit_of_torques")).all()


def test_rollouts_take_the_bias_of_noisy_encoders_away(path, base):
    log = _observed(base, 0, late=-0.001, noise=3e-4)
    fit = jid.rollout.identify_torque_rollout(base, log, horizon=0.1)
    bodies = jid.robots.urdf_parameters(path)
    truth = np.asarray(base.from_standard([*bodies, *driven_pendulum.DAMPING]))
    torque_fit, rollouts = (
        np.linalg.norm(p - truth) / np.linalg.norm(truth)
        for p in (fit.start, fit.parameters)
    )
    assert torque_fit > 0.1
    assert rollouts < 0.003


def test_derivatives_agree_with_differences(base, logs):
    rollout = TorqueRollout(base, logs[0].sample_time)
    windows = Windows.of(logs[:1], 0.1, 1.0)
    x = np.append(np.asarray(jid.identify(base, logs[0]).parameters), 0.0041)
    errors = jax.jit(lambda x: rollout.errors(x, windows))
    jacobian = jax.jit(jax.jacfwd(errors))(x)
    for k in range(len(x)):
        step = np.zeros_like(x)
        step[k] = 1e-6
        ends = [errors(x + s * step) for s in (1, -1)]
        difference = np.asarray(ends[0] - ends[1]) / 2e-6
        scale = max(np.abs(difference).max(), 1e-3)
        derivative = np.asarray(jacobian)[..., k]
        np.testing.assert_allclose(derivative, difference, atol=1e-6 * scale)


def test_what_cannot_be_simulated_is_rejected(base, logs):
    robot = base.model.robot
    hard = jid.Model(robot, (*TERMS, jid.CoulombFriction(HardSign())))
    tool = dataclasses.replace(
        robot, tool=jid.Tool(1, mass=0.1, centre_of_mass=[0.0, 0.0, -0.1])
    )
    for model, name in ((hard, "Tanh"), (jid.Model(tool, TERMS), "tool")):
        with pytest.raises(jid.InputError, match=f"`{name}"):
            jid.rollout.identify_torque_rollout(jid.base_parameters(model), logs[0])
    with pytest.raises(jid.InputError, match="`observations`"):
        jid.rollout.identify_torque_rollout(base, logs[0], horizon=100.0)


def test_an_interrupted_search_ends_with_the_best_so_far(base, logs, fit):
    def interrupt(stage, fraction):
        raise KeyboardInterrupt

    best = jid.rollout.identify_torque_rollout(
        base, logs[0], horizon=0.1, progress=interrupt
    )
    assert not best.converged
    assert fit.converged
    # Only the first step was done, which linearises at the fit of torques.
    np.testing.assert_allclose(best.parameters, best.start)
