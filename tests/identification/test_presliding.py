"""Friction with memory: its law against an ODE, its length from data, all alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import virtual
from scipy.integrate import solve_ivp

import jaxid as jid
from jaxid.dynamics.terms import CoulombFriction, Presliding, SquareRootFriction, Tanh
from jaxid.errors import InputError
from jaxid.identification.friction_laws.presliding_lengths import (
    LENGTHS as LENGTHS_TRIED,
)
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.friction_state import with_memory
from jaxid.simulation.friction_and_ripple import LuGreFriction
from jaxid.simulation.virtual import Sensors, VirtualRobot, random_bodies
from jaxid.trajectory.spline import (
    DEGREE,
    PiecewisePolynomial,
    interpolate_at_rest,
    spline_polynomials,
)

ROBOT = jid.robots.planar_arm(2, 0.5).replace(limits=jid.Limits(force=[60.0, 20.0]))
LENGTHS = np.array([4e-3, 2e-3])


def model_of(transition):
    terms = (jid.RigidBodies(), jid.ViscousFriction(), CoulombFriction(transition))
    return jid.Model(ROBOT, (*terms, jid.RotorInertia()))


def step_by_step(q, lengths, start):
    """States of Dahl's law, written down sample by sample."""
    states = [np.array(start, float)]
    for change in np.diff(q, axis=0):
        way = np.sign(change)
        states.append(way + (states[-1] - way) * np.exp(-np.abs(change) / lengths))
    return np.array(states)


def log_of(samples=6000, noise=0.0, segments=None, filter=None, seed=4):
    """Observations whose dry friction has memory, with forces from the loop above."""
    m = virtual.motion(2, samples, seed=seed)
    rest = model_of(Tanh())
    p = virtual.standard_parameters(rest)
    dry = np.array([rest.parameter_names.index(f"fc{j}") for j in (1, 2)])
    levels = p[dry].copy()
    p[dry] = 0.0
    segments = ((0, samples),) if segments is None else segments
    start = [np.tanh(np.asarray(m.qd[a]) / 0.01) for a, _ in segments]
    parts = zip(segments, start, strict=True)
    s = np.concatenate(
        [step_by_step(np.asarray(m.q)[a:b], LENGTHS, x) for (a, b), x in parts]
    )
    forces = rest.inverse_dynamics(p, m) + levels * s
    forces = forces + noise * np.random.default_rng(seed).normal(size=forces.shape)
    options = {
        "sample_time": 10.0 / (samples - 1),
        "segments": segments,
        "filter": filter,
    }
    return jid.Observations.of(m.q, m.qd, m.qdd, forces, **options), levels


def test_the_state_solves_the_differential_equation_and_does_not_depend_on_time():
    law, t = Presliding(length=0.3), np.linspace(0.0, 6.0, 4001)
    q, qd = np.sin(2 * t) + 0.2 * t, lambda t: 2 * np.cos(2 * t) + 0.2

    def change(t, s):
        return qd(t) / 0.3 * (1 - s * np.sign(qd(t)))

    s = solve_ivp(
        change, (0, 6), [0.4], t_eval=t, rtol=1e-9, atol=1e-9, max_step=1e-3
    ).y[0]
    found = law.states(q[:, None], np.array([0.4]))[:, 0]
    np.testing.assert_allclose(found, s, atol=2e-3)
    # Standing still keeps it, and every other sample of one way leaves it the same.
    still = np.repeat(q, 3)[:, None]
    np.testing.assert_allclose(
        law.states(still, np.array([0.4]))[::3, 0], found, atol=1e-12
    )
    turns = np.flatnonzero(np.diff(np.sign(np.diff(q)))) + 1
    few = law.states(q[[0, *turns, -1], None], np.array([0.4]))[:, 0]
    np.testing.assert_allclose(few, found[[0, *turns, -1]], atol=1e-12)


def test_batches_of_paths_and_jax_give_the_same():
    q = np.cumsum(np.random.default_rng(1).normal(size=(3, 50, 2)), axis=1) * 1e-3
    law, start = Presliding(length=LENGTHS), np.full((3, 2), -0.5)
    wanted = np.stack(
        [step_by_step(x, LENGTHS, y) for x, y in zip(q, start, strict=True)]
    )
    np.testing.assert_allclose(law.states(q, start), wanted, atol=1e-13)
    m = jid.Motion(q, 0 * q, 0 * q)
    model, p = model_of(law), virtual.standard_parameters(model_of(law))

    traced = jax.jit(lambda q: model.inverse_dynamics(p, jid.Motion(q, 0 * q, 0 * q)))
    np.testing.assert_allclose(
        traced(jnp.asarray(q)), model.inverse_dynamics(p, m), rtol=1e-9, atol=1e-9
    )


def test_forces_and_lengths_are_found():
    log, levels = log_of(noise=0.02)
    base = jid.identify_presliding(jid.base_parameters(model_of(Presliding())), log)
    np.testing.assert_allclose(base.model.memory.length, LENGTHS, rtol=0.08)
    fit = jid.identify(base, log)
    found = [fit.parameters[base.names.index(f"fc{j}")] for j in (1, 2)]
    np.testing.assert_allclose(found, levels, rtol=0.02)
    # Prediction takes the samples of a motion as a path.
    m = log.motion
    np.testing.assert_allclose(fit.predict(m), log.forces, atol=0.2)


def test_a_motor_that_turns_two_axes_has_a_state_of_its_own():
    A = np.array([[1.0, 0.0], [0.6, 1.0]])
    drives = jid.Drives(reduction=np.diag([50.0, 80.0]) @ A)
    law, m = Presliding(LENGTHS, motors=A), virtual.motion(2, 4000, seed=4)
    terms = (CoulombFriction(law), jid.terms.CoupledDrives(law))
    model = jid.Model(ROBOT.replace(drives=drives), terms)
    q, qd = np.asarray(m.q), np.asarray(m.qd)
    start = np.tanh(qd[0] / 0.01), np.tanh(qd[0] @ A.T / 0.01)
    joints, motors = (
        step_by_step(x, LENGTHS, s) for x, s in zip((q, q @ A.T), start, strict=True)
    )
    names = model.parameter_names
    p = np.zeros(len(names))
    p[[names.index(x) for x in ("fc1", "fc2", "fcm2")]] = 2.0, 1.5, 0.7
    wanted = joints * [2.0, 1.5] + 0.7 * motors[:, 1:] * A[1]
    np.testing.assert_allclose(model.inverse_dynamics(p, m), wanted, atol=1e-9)


def test_a_joint_that_does_not_move_is_taken_to_slide_at_once():
    log, _ = log_of()
    m = log.motion
    still = np.array([1.0, 0.0])
    log = log.replace(motion=jid.Motion(m.q * still, m.qd * still, m.qdd * still))
    base = jid.identify_presliding(jid.base_parameters(model_of(Presliding())), log)
    assert base.model.memory.length[1] == LENGTHS_TRIED[0]


SEGMENT = 5000


@pytest.mark.parametrize("filtered", [False, True])
def test_segments_of_a_log_and_streams_agree(filtered):
    cut = jid.ZeroPhaseButterworth(20.0) if filtered else None
    samples = 3 * SEGMENT + 100
    log, _ = log_of(
        samples, segments=((0, SEGMENT + 7), (SEGMENT + 7, samples)), filter=cut
    )
    law = Presliding(LENGTHS)
    base = jid.base_parameters(model_of(law))
    states = with_memory(log, law).motion.state
    for a, b in log.segments:
        first_state = np.asarray(law.settled(np.asarray(log.motion.qd)[a]))
        expected = law.states(np.asarray(log.motion.q)[a:b], first_state)
        np.testing.assert_allclose(states[a:b], expected, atol=1e-12)

    class Streamed(RegressionProblem):
        compiled_samples = 1

    plain, streamed = (
        kind(base, log).factors for kind in (RegressionProblem, Streamed)
    )
    w = np.ones(2)
    for (R, z), (S, y) in [(plain.weighted(w), streamed.weighted(w))]:
        np.testing.assert_allclose(
            S.T @ S, R.T @ R, rtol=1e-7, atol=1e-7 * np.abs(R.T @ R).max()
        )
        np.testing.assert_allclose(S.T @ y, R.T @ z, rtol=1e-6, atol=1e-6)
    if not filtered:
        # What an independent loop gives is explained exactly, in both segments.
        p = jid.identify(base, log)
        assert p.residual < 1e-9


def test_presliding_of_another_law_is_found_with_coarse_encoders():
    """Bent bristles (LuGre) in a servo, 14-bit encoders, rests and small moves."""
    viscous, dry = np.array([2.0, 0.8]), np.array([6.0, 2.5])
    friction = LuGreFriction(viscous, dry, dry, deflection=LENGTHS)
    bodies = random_bodies(ROBOT, np.array([4.0, 2.0]), np.random.default_rng(3))
    sensors = Sensors(2 * np.pi / 2**14, np.array([0.15, 0.06]), np.array([0.1, 0.04]))
    values = np.concatenate([bodies.ravel(), [0.4, 0.1]])
    arm = VirtualRobot(
        ROBOT, (jid.RigidBodies(), jid.RotorInertia()), values, friction, sensors
    )
    logs, slow = [], None
    for seed in (1, 2):
        rng, points = np.random.default_rng(seed), []
        for number, point in enumerate(rng.uniform(-1.2, 1.2, (24, 2))):
            points += [point] * (7 if number % 4 == 0 else 1)
            if number % 4 == 2:
                points += [point + 0.02 * rng.uniform(-1, 1, 2) for _ in range(2)]
        spline = interpolate_at_rest(
            np.linspace(0.0, 24.0, len(points)), np.array(points)
        )
        knots = spline.t[DEGREE:-DEGREE]
        motion = PiecewisePolynomial(knots, spline_polynomials(spline))
        run = arm.track(motion, seed=seed, sample_time=2e-3)
        rows = jid.Subsample(5)
        logs.append(
            jid.observe(run.recording, ROBOT, jid.ZeroPhaseButterworth(20.0), rows)
        )
        slow = np.abs(np.asarray(run.actual.qd)[logs[-1].instants]) < 0.05
    errors = []
    for transition in (Tanh(), Presliding()):
        base = jid.base_parameters(model_of(transition))
        if base.model.memory is not None:
            base = jid.identify_presliding(base, logs[0])
            np.testing.assert_allclose(base.model.memory.length, LENGTHS, rtol=0.2)
        found = jid.validate(jid.identify(base, logs[0]), logs[1]).errors[0].errors
        errors.append(np.sqrt(np.mean(found**2, axis=0, where=slow)))
    assert (errors[1] < errors[0] / 3).all()


def test_what_cannot_have_memory_says_so():
    base, (log, _) = jid.base_parameters(model_of(Presliding())), log_of(400)
    m = log.motion
    with pytest.raises(InputError, match="memory"):
        jid.identify_batch(
            base, jid.Motion(*(x[None] for x in (m.q, m.qd, m.qdd))), log.forces[None]
        )
    with pytest.raises(InputError, match="Presliding"):
        jid.identify_presliding(jid.base_parameters(model_of(Tanh())), log)
    terms = (CoulombFriction(Presliding(1e-3)), SquareRootFriction(Presliding(2e-3)))
    with pytest.raises(InputError, match="must share one"):
        jid.Model(ROBOT, terms).memory  # noqa: B018
    with pytest.raises(InputError, match="positive"):
        Presliding(length=0.0)


def test_a_model_file_keeps_the_memory(tmp_path):
    log, _ = log_of(1000)
    fit = jid.identify(jid.base_parameters(model_of(Presliding(LENGTHS))), log)
    again = jid.load_fit(fit.save(tmp_path / "model.json"))
    np.testing.assert_array_equal(again.predict(log.motion), fit.predict(log.motion))
