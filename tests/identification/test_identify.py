"""Estimates against dense least squares, known truths, and the laws of weights."""

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.table import Status

WEIGHTED = jid.WeightedLeastSquares(jid.estimators.ResidualVariances(0))


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.ConstantOffset())
    robot = jid.robots.planar_arm(2, 0.4).replace(limits=jid.Limits(2, force=[40.0, 5.0]))
    return jid.base_parameters(jid.Model(robot, terms))


@pytest.fixture(scope="module")
def noisy(base):
    p = standard_parameters(base.model)
    return observations(base.model, p, noise=np.array([0.5, 0.1]))


@pytest.mark.parametrize(
    ("estimator", "weights"),
    [
        (jid.estimators.LeastSquares(), [1.0, 1.0]),
        (jid.WeightedLeastSquares(), [1 / 40.0, 1 / 5.0]),
    ],
)
def test_least_squares_equal_numpy_on_the_dense_matrix(base, noisy, estimator, weights):
    theta, forces, joint = dense(base, noisy)
    w = np.array(weights)[joint]
    expected, *_ = np.linalg.lstsq(w[:, None] * theta, w * forces, rcond=None)
    fit = jid.identify(base, noisy, estimator)
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-10)
    np.testing.assert_allclose(fit.weights, weights)
    np.testing.assert_allclose(fit.condition_number, np.linalg.cond(theta), rtol=1e-8)
    weighted = w[:, None] * theta
    np.testing.assert_allclose(fit.condition_numbers.weighted, np.linalg.cond(weighted), rtol=1e-8)
    scaled = weighted / np.linalg.norm(weighted, axis=0)
    np.testing.assert_allclose(fit.condition_numbers.scaled, np.linalg.cond(scaled), rtol=1e-8)
    error = theta @ expected - forces
    np.testing.assert_allclose(
        fit.residual, np.linalg.norm(error) / np.linalg.norm(forces), rtol=1e-9
    )
    rms = [np.sqrt(np.mean(error[joint == j] ** 2)) for j in range(2)]
    np.testing.assert_allclose(fit.residual_rms, rms, rtol=1e-9)


def test_weights_count_only_relative_to_each_other(base, noisy):
    half = base.model.robot.replace(limits=jid.Limits(2, force=[20.0, 2.5]))
    other = jid.base_parameters(jid.Model(half, base.model.terms))
    a, b = jid.identify(base, noisy), jid.identify(other, noisy)
    np.testing.assert_allclose(a.parameters, b.parameters, rtol=1e-11)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-9)


def test_residual_variances_find_the_noise_of_each_joint(base):
    p = standard_parameters(base.model)
    noise = np.array([0.5, 0.02])
    o = observations(base.model, p, samples=4000, noise=noise)
    fit = jid.identify(base, o, jid.WeightedLeastSquares(jid.estimators.ResidualVariances()))
    np.testing.assert_allclose(1 / fit.weights, noise, rtol=0.05)
    assert fit.undetermined == ()


@pytest.mark.parametrize("estimator", [jid.estimators.LeastSquares(), WEIGHTED])
def test_naive_covariance_is_that_of_many_draws_of_independent_noise(base, estimator):
    p = standard_parameters(base.model)
    truth = np.asarray(base.from_standard(p))
    draws = [
        jid.identify(
            base,
            observations(base.model, p, samples=120, noise=np.array([0.5, 0.05]), noise_seed=seed),
            estimator,
            uncertainty=jid.uncertainty.IndependentRows(),
        )
        for seed in range(200)
    ]
    deviations = np.array([(f.parameters - truth) / f.standard_deviations for f in draws])
    # The mean of 200 squares of a standard normal scatters by sqrt(2/200) = 0.1.
    np.testing.assert_allclose(np.mean(deviations**2, axis=0), 1.0, atol=0.4)
    assert abs(np.mean(deviations**2) - 1.0) < 0.12
    assert np.abs(deviations.mean(axis=0)).max() < 0.25


def test_several_recordings_are_fitted_together(base):
    p = standard_parameters(base.model)
    two = [observations(base.model, p, noise=0.4, seed=s, noise_seed=s) for s in (1, 2)]
    stacked = [np.concatenate(x) for x in zip(*(dense(base, o) for o in two), strict=True)]
    expected, *_ = np.linalg.lstsq(stacked[0], stacked[1], rcond=None)
    fit = jid.identify(base, two, jid.estimators.LeastSquares())
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-10)
    assert fit.rows == (800, 800)


def test_seven_axes_are_recovered_without_noise():
    base = jid.base_parameters(jid.Model(jid.robots.tx90l_on_rail()))
    p = standard_parameters(base.model)
    fit = jid.identify(base, observations(base.model, p, samples=600))
    truth = np.asarray(base.from_standard(p))
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-8, atol=1e-8)
    assert fit.residual < 1e-12


def test_a_known_tool_is_taken_off():
    robot = jid.robots.planar_arm(2, 0.4).with_tool(
        mass=1.5, centre_of_mass=(0.05, 0.02, 0.0), inertia=0.01 * np.eye(3)
    )
    bare = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4)))
    base = jid.base_parameters(jid.Model(robot))
    p = standard_parameters(base.model)
    o = observations(base.model, p)
    fit = jid.identify(base, o, jid.estimators.LeastSquares())
    np.testing.assert_allclose(fit.parameters, base.from_standard(p), rtol=1e-9)
    with_tool = jid.identify(bare, o, jid.estimators.LeastSquares())
    assert np.abs(with_tool.parameters - fit.parameters).max() > 0.05
    errors = jid.validate(fit, o).errors[0]
    assert errors.relative < 1e-11


def test_a_joint_that_never_moves_is_named_and_the_rest_is_right(base):
    p = standard_parameters(base.model)
    o = observations(base.model, p, still=(1,))
    fit = jid.identify(base, o, jid.estimators.LeastSquares())
    named = {base.names[k] for d in fit.undetermined for k in d.parts}
    assert {"fv2", "fc2"} <= named
    assert fit.undetermined[0].uncertainty == np.inf
    first = base.names.index("fv1")
    np.testing.assert_allclose(fit.parameters[first], base.from_standard(p)[first], rtol=1e-8)
    assert np.isinf(fit.standard_deviations[base.names.index("fv2")])
    assert jid.validate(fit, o).errors[0].relative < 1e-10
    assert "fv2" in " ".join(d.sentence(base) for d in fit.undetermined)


@pytest.mark.parametrize(
    "solution", [jid.estimators.Complete(), jid.estimators.Truncated(), jid.estimators.Ridge()]
)
def test_a_log_of_a_joint_that_stands_gives_no_absurd_estimates(base, solution):
    """From the recorded angles on, whose differences must not make columns out of rounding."""
    robot, p = base.model.robot, standard_parameters(base.model)
    o = observations(base.model, p, still=(1,), samples=2000, noise=0.1)
    log = jid.Recording.of(np.asarray(o.motion.q) + 0.3, o.forces, sample_time=0.005)
    fit = jid.identify(
        base,
        jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0)),
        jid.estimators.LeastSquares(solution),
    )
    assert np.abs(fit.parameters).max() < 1e3
    open_ = [base.names.index(name) for name in ("fv2", "fc2")]
    np.testing.assert_allclose(fit.parameters[open_], 0.0, atol=1e-9)
    assert np.isinf(fit.standard_deviations[open_]).all()


def test_columns_of_nothing_but_rounding_count_as_zero():
    rng = np.random.default_rng(0)
    R = rng.normal(size=(20, 3)) * [1.0, 1e-13, 1.0]
    d = Decomposition.of(R, rng.normal(size=20))
    p = d.solve(jid.estimators.Complete().inverse(d.values))
    assert p[1] == 0.0
    assert np.abs(p).max() < 10.0


def test_what_a_solution_pulls_is_said(base, noisy):
    assert jid.identify(base, noisy).notes == ()
    for solution in (jid.estimators.Ridge(0.3), jid.estimators.Truncated(0.3)):
        (note,) = jid.identify(base, noisy, jid.estimators.LeastSquares(solution)).notes
        assert f"of {base.size} directions" in note
        assert "not how far this pull takes them from the truth" in note


def test_forces_that_are_all_zero_are_no_crash(base):
    o = observations(base.model, np.zeros(base.model.size))
    fit = jid.identify(base, o)
    np.testing.assert_allclose(fit.parameters, 0.0, atol=1e-12)
    assert np.isnan(jid.validate(fit, o).errors[0].relative)


def test_well_excited_data_leave_nothing_open(base, noisy):
    assert jid.identify(base, noisy).undetermined == ()


def test_truncated_solution_leaves_weak_directions_at_zero(base, noisy):
    weights = np.ones(2)
    blocks = jid.RegressionProblem(base, [noisy]).blocks
    d = Decomposition.of(*blocks.total.weighted(weights))
    share = float(d.values[4] / d.values[0]) * 0.999
    fit = jid.identify(base, noisy, jid.estimators.LeastSquares(jid.estimators.Truncated(share)))
    along = np.asarray(d.directions) @ (np.asarray(d.scale) * fit.parameters)
    np.testing.assert_allclose(along[5:], 0.0, atol=1e-12 * np.abs(along).max())
    complete = jid.identify(base, noisy, jid.estimators.LeastSquares())
    full = np.asarray(d.directions) @ (np.asarray(d.scale) * complete.parameters)
    np.testing.assert_allclose(along[:5], full[:5], rtol=1e-10)


def test_ridge_solves_its_normal_equations(base, noisy):
    fit = jid.identify(base, noisy, jid.estimators.LeastSquares(jid.estimators.Ridge(0.1)))
    theta, forces, _ = dense(base, noisy)
    scale = np.linalg.norm(theta, axis=0)
    A = theta / scale
    strength = 0.1 * np.linalg.norm(A, 2)
    x = np.linalg.solve(A.T @ A + strength**2 * np.eye(base.size), A.T @ forces)
    np.testing.assert_allclose(fit.parameters, x / scale, rtol=1e-9)


def test_cross_validation_leaves_clean_data_alone(base):
    o = observations(base.model, standard_parameters(base.model), noise=1e-3)
    fit = jid.identify(base, o, jid.estimators.LeastSquares(jid.estimators.CrossValidated()))
    assert fit.solution.strength < 2e-3


def test_cross_validation_pulls_where_data_are_poor(base):
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=60, noise=20.0)
    fit = jid.identify(base, o, jid.estimators.LeastSquares(jid.estimators.CrossValidated()))
    plain = jid.identify(base, o, jid.estimators.LeastSquares())
    fresh = observations(base.model, p, samples=800, seed=9)
    assert fit.solution.strength > 1e-2
    errors = [jid.validate(f, fresh).errors[0].relative for f in (fit, plain)]
    assert errors[0] < 0.8 * errors[1]


def test_refusals(base, noisy):
    with pytest.raises(ValueError, match="at least one recording, but is empty"):
        jid.identify(base, ())
    other = jid.base_parameters(jid.Model(jid.robots.planar_arm(3)))
    with pytest.raises(ValueError, match="have 2 joints, but `planar arm, 3 joints` has 3"):
        jid.identify(other, noisy)
    short = observations(base.model, standard_parameters(base.model), samples=5)
    with pytest.raises(ValueError, match=r"10 rows for 1[0-9] base parameters: record longer"):
        jid.identify(base, short)
    unknown = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), base.model.terms))
    with pytest.raises(ValueError, match=r"largest force of joint `joint1` .* is not known"):
        jid.identify(unknown, noisy)


def test_what_is_undetermined_is_not_trusted_however_small_its_deviation(base):
    p = standard_parameters(base.model)
    fit = jid.identify(base, observations(base.model, p, still=(1,)), jid.estimators.LeastSquares())
    parts = {k for d in fit.undetermined for k in d.parts}
    assert parts
    assert all(fit.trust[k] is Status.BAD for k in parts)
    good = jid.identify(base, observations(base.model, p), jid.estimators.LeastSquares())
    assert set(good.trust) == {Status.GOOD}
