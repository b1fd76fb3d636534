"""Essential parameters, filters chosen by data, and identification axis by axis."""

import numpy as np
import pytest
import virtual

import jaxid as jid
from jaxid.identification.essential import restricted
from jaxid.identification.stepwise import friction_parameters

ROBOT = jid.robots.planar_arm(3)
MODEL = jid.Model(
    ROBOT, (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.ConstantOffset())
)
BASE = jid.base_parameters(MODEL)
P = virtual.standard_parameters(MODEL, seed=1)
WLS = jid.WeightedLeastSquares(jid.Unweighted())


def without_offsets():
    """Parameters of an arm whose offsets, and the viscous friction of joint 2, are nothing."""
    p = P.copy()
    for k, name in enumerate(MODEL.parameter_names):
        if name.startswith("fo") or name == "fv2":
            p[k] = 0.0
    return p


def test_parameters_that_are_nothing_are_left_out():
    p = without_offsets()
    o = virtual.observations(MODEL, p, noise=0.3, samples=800)
    fit = jid.identify(BASE, o, WLS)
    found = jid.essential_parameters(fit, o, cost=0.001)
    assert {"fo1", "fo2", "fo3", "fv2"} <= set(found.left_out)
    truth = BASE.from_standard(p)
    large = {n for n, x in zip(BASE.names, np.asarray(truth), strict=True) if abs(x) > 0.2}
    assert large <= set(found.fit.base.names)
    assert found.fit.base.size == BASE.size - len(found.left_out)
    kept = [BASE.names.index(n) for n in found.fit.base.names]
    off = np.abs(found.fit.parameters - np.asarray(truth)[kept])
    assert (off < 5 * found.fit.standard_deviations).all()
    # What is left is known better than before.
    ratio = found.fit.standard_deviations / fit.standard_deviations[kept]
    assert ratio.max() < 1.2
    assert ratio.min() < 0.9


def test_the_path_leads_from_all_parameters_to_one_with_growing_error():
    o = virtual.observations(MODEL, without_offsets(), noise=0.3, samples=400)
    found = jid.essential_parameters(jid.identify(BASE, o, WLS), o)
    assert [s.left for s in found.path] == list(range(BASE.size, 0, -1))
    assert found.path[0].name == ""
    assert len({s.name for s in found.path}) == BASE.size
    errors = [s.error for s in found.path]
    assert (np.diff(errors) >= -1e-12).all()
    assert found.path[0].error == pytest.approx(found.full.residual, rel=1e-9)
    smallest = min(s.held_out for s in found.path)
    assert found.chosen.held_out <= 1.02 * smallest
    after = found.path[found.path.index(found.chosen) + 1]
    assert after.held_out > 1.02 * smallest
    assert f"{found.chosen.left} of {BASE.size} base parameters are essential" in str(found)


def test_a_restricted_model_is_the_model_with_zeros():
    kept = [0, 3, 5, 8]
    base = restricted(BASE, kept)
    p = np.zeros(BASE.size)
    p[kept] = [1.0, 2.0, -1.0, 0.5]
    motion = virtual.motion(3, 20)
    np.testing.assert_allclose(
        base.inverse_dynamics(p[kept], motion), BASE.inverse_dynamics(p, motion), atol=1e-12
    )
    assert base.names == tuple(BASE.names[k] for k in kept)


def test_elimination_refuses_other_observations():
    o = virtual.observations(MODEL, P, noise=0.3)
    fit = jid.identify(BASE, o, WLS)
    with pytest.raises(ValueError, match="must be those that the fit was made of"):
        jid.essential_parameters(fit, virtual.observations(MODEL, P, samples=300))
    with pytest.raises(ValueError, match="`cost` must be a share"):
        jid.essential_parameters(fit, o, cost=-0.1)


STEPWISE = jid.Stepwise(weights=jid.Unweighted())


@pytest.mark.parametrize("robot", [ROBOT, jid.robots.tx90l_on_rail()], ids=["planar", "rail"])
def test_exact_forces_give_the_same_axis_by_axis(robot):
    model = jid.Model(robot, MODEL.terms)
    base = jid.base_parameters(model)
    p = virtual.standard_parameters(model, seed=2)
    o = virtual.observations(model, p, samples=600)
    fit = jid.identify(base, o, STEPWISE)
    truth = np.asarray(base.from_standard(p))
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-5, atol=1e-5)
    assert not fit.notes


def test_axis_by_axis_is_what_it_says():
    """The last joint by its own rows, the one before with these parameters subtracted."""
    o = virtual.observations(MODEL, P, noise=0.5)
    theta, forces, joint = virtual.dense(BASE, o)
    p, known = np.zeros(BASE.size), []
    for j in (2, 1, 0):
        own = theta[joint == j]
        new = [k for k in range(BASE.size) if np.any(own[:, k]) and k not in known]
        left = forces[joint == j] - own @ p
        p[new] = np.linalg.lstsq(own[:, new], left, rcond=None)[0]
        known += new
    fit = jid.identify(BASE, o, STEPWISE)
    np.testing.assert_allclose(fit.parameters, p, rtol=1e-8, atol=1e-8)


def test_errors_are_handed_on_as_the_estimate_says():
    """The matrix of the estimate moves it by a disturbance as identifying again does."""
    o = virtual.observations(MODEL, P, noise=0.5)
    rows = jid.RegressionProblem(BASE, [o])
    estimate = STEPWISE(rows)
    disturbance = 1e-3 * np.random.default_rng(7).normal(size=np.shape(o.forces))
    moved = STEPWISE(
        jid.RegressionProblem(BASE, [o.replace(forces=np.asarray(o.forces) + disturbance)])
    )
    g = np.zeros(BASE.size)
    for chunk in rows.chunks():
        for channel in estimate.influence.channels(chunk, o.reduce(disturbance)[chunk.rows]):
            g[list(channel.columns)] += channel.instruments.T @ channel.disturbance
    np.testing.assert_allclose(
        estimate.inverse @ g, moved.parameters - estimate.parameters, rtol=1e-6, atol=1e-10
    )


def test_friction_first_from_single_axes():
    o = virtual.observations(MODEL, P, noise=0.3, samples=600)
    singles = tuple(
        virtual.observations(
            MODEL, P, noise=0.01, seed=j, still=tuple(k for k in range(3) if k != j)
        )
        for j in range(3)
    )
    estimator = jid.Stepwise(singles, jid.Unweighted())
    fit = jid.identify(BASE, o, estimator)
    truth, friction = np.asarray(BASE.from_standard(P)), sorted(friction_parameters(BASE))
    assert {BASE.names[k][:2] for k in friction} == {"fv", "fc"}
    settled = [k for k in friction if fit.standard_deviations[k] == 0.0]
    assert len(settled) >= 4
    np.testing.assert_allclose(fit.parameters[settled], truth[settled], atol=0.02)
    assert any("come from motions of single axes" in note for note in fit.notes)
    with pytest.raises(ValueError, match="must hold motions of one axis each"):
        jid.identify(BASE, o, jid.Stepwise((o,), jid.Unweighted()))


def test_both_ways_side_by_side():
    o = virtual.observations(MODEL, P, noise=2.0, samples=600)
    both = jid.identify_stepwise(BASE, o, STEPWISE)
    assert both.at_once_error < both.stepwise_error
    assert "identification at once serves better" in str(both)
    lines = both.table.splitlines()
    assert len(lines) == 1 + BASE.size
    assert lines[1].startswith(BASE.names[0])
    assert np.abs(both.differences).max() < 6


@pytest.fixture(scope="module")
def noisy_log():
    """20 s at 250 Hz: encoders of 16 bits, torque noise, motion up to 2 Hz."""
    t = np.arange(0.0, 20.0, 0.004)
    w = 2 * np.pi * np.array([0.3, 0.9, 2.0])
    rng = np.random.default_rng(11)
    phase, a = rng.uniform(0, 6, (3, 3)), np.array([0.7, 0.3, 0.12])[:, None]
    angles = [np.sum(a * np.sin(w[:, None] * s + phase), axis=0) for s in t]
    q = np.array(angles)
    qd = np.array([np.sum(a * w[:, None] * np.cos(w[:, None] * s + phase), axis=0) for s in t])
    qdd = np.array(
        [-np.sum(a * w[:, None] ** 2 * np.sin(w[:, None] * s + phase), axis=0) for s in t]
    )
    forces = np.asarray(MODEL.inverse_dynamics(P, jid.Motion(q, qd, qdd)))
    bits = 2 * np.pi / 2**16
    noise = rng.normal(0.0, 0.5, forces.shape)
    return jid.Recording.of(bits * np.round(q / bits), forces + noise, time=t)


CUTOFFS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 100.0)


def test_a_filter_is_chosen_between_too_low_and_too_high(noisy_log):
    candidates = jid.butterworth_candidates(0.004, CUTOFFS)
    told = []
    found = jid.choose_filter(BASE, noisy_log, candidates, estimator=WLS, progress=told.append)
    chosen = CUTOFFS[found.best]
    assert 4.0 <= chosen <= 32.0
    assert found.filter.cutoff == chosen
    assert found.curve[0] > 1.5 * found.curve.min()
    assert found.curve[-1] > 1.1 * found.curve.min()
    assert found.correlations[0] > found.correlations[-1]
    assert told[-1] == 1.0
    assert f"a cut-off of {chosen:.3g} Hz" in str(found)


def test_whiteness_may_decide_among_good_candidates(noisy_log):
    candidates = jid.butterworth_candidates(0.004, (4.0, 8.0, 16.0))
    found = jid.choose_filter(
        BASE, noisy_log, candidates, estimator=WLS, criterion=jid.WhitestResidual(cost=10.0)
    )
    assert found.best == int(np.argmin(np.abs(found.correlations)))


def test_candidates_are_decimated_to_their_band():
    candidates = jid.butterworth_candidates(0.001)
    cutoffs = [c.filter.cutoff for c in candidates]
    assert cutoffs[0] == pytest.approx(1.0)
    assert cutoffs[-1] == pytest.approx(100.0)
    for c in candidates:
        c.decimation.check(c.filter.cutoff, 0.001)
        assert 4.9 < 1000.0 / c.decimation.factor / c.filter.cutoff < 10.1
    with pytest.raises(ValueError, match="`candidates` must hold at least one"):
        jid.choose_filter(BASE, (), [])
