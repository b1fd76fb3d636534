"""Estimates against dense least squares, known truths, and the laws of weights."""

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.program.sample_methods import in_numpy
from jaxid.result_table import Status

PLAIN = jid.estimators.LeastSquares()


@pytest.fixture(scope="module")
def p(base):
    return standard_parameters(base.model)


@pytest.fixture(scope="module")
def noisy(base, p):
    return observations(base.model, p, noise=np.array([0.5, 0.1]))


@pytest.fixture(scope="module")
def still(base, p):
    """The second joint never moves."""
    return observations(base.model, p, still=(1,))


@pytest.mark.parametrize(
    ("estimator", "weights"),
    [(PLAIN, [1.0, 1.0]), (jid.WeightedLeastSquares(), [1 / 40.0, 1 / 5.0])],
)
def test_least_squares_equal_numpy_on_the_dense_matrix(base, noisy, estimator, weights):
    theta, forces, joint = dense(base, noisy)
    w = np.array(weights)[joint]
    weighted = w[:, None] * theta
    expected, *_ = np.linalg.lstsq(weighted, w * forces, rcond=None)
    fit = jid.identify(base, noisy, estimator)
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-10)
    np.testing.assert_allclose(fit.weights, weights)
    numbers, scaled = fit.condition_numbers, weighted / np.linalg.norm(weighted, axis=0)
    np.testing.assert_allclose(
        [fit.condition_number, numbers.weighted, numbers.scaled],
        [np.linalg.cond(x) for x in (theta, weighted, scaled)],
        rtol=1e-8,
    )
    error = theta @ expected - forces
    relative = np.linalg.norm(error) / np.linalg.norm(forces)
    np.testing.assert_allclose(fit.residual, relative, rtol=1e-9)
    rms = [np.sqrt(np.mean(error[joint == j] ** 2)) for j in range(2)]
    np.testing.assert_allclose(fit.residual_rms, rms, rtol=1e-9)
    assert (fit.undetermined, fit.notes) == ((), ())


def test_residual_variances_find_the_noise_of_each_joint(base, p):
    noise = np.array([0.5, 0.02])
    o = observations(base.model, p, samples=4000, noise=noise)
    fit = jid.identify(
        base, o, jid.WeightedLeastSquares(jid.estimators.ResidualVariances())
    )
    np.testing.assert_allclose(1 / fit.weights, noise, rtol=0.05)


def test_a_robot_without_force_limits_is_weighted_by_residuals():
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2)))
    o = observations(base.model, standard_parameters(base.model), noise=0.1)
    fit = jid.identify(base, o)
    variances = jid.WeightedLeastSquares(jid.estimators.ResidualVariances())
    np.testing.assert_array_equal(
        fit.parameters, jid.identify(base, o, variances).parameters
    )
    assert fit.notes == ()
    consistent = jid.identify(base, o, jid.PhysicallyConsistent())
    np.testing.assert_array_equal(consistent.weights, fit.weights)


@pytest.mark.parametrize("weights", [[1.0, 1.0], [0.2, 3.0]])
def test_naive_covariance_is_that_of_independent_noise_of_each_joint(
    base, noisy, weights
):
    """Right also where weights are not the reciprocals of the standard deviations."""
    estimator = jid.WeightedLeastSquares(jid.estimators.GivenWeights(np.array(weights)))
    fit = jid.identify(base, noisy, estimator)
    theta, forces, joint = dense(base, noisy)
    squares = (theta @ fit.parameters - forces) ** 2
    free = 1.0 - base.size / len(forces)
    variances = np.array(
        [squares[joint == j].sum() / (free * np.sum(joint == j)) for j in (0, 1)]
    )
    w = np.array(weights)[joint][:, None]
    gain = np.linalg.pinv(w * theta) * w.T
    expected = gain * variances[joint] @ gain.T
    np.testing.assert_allclose(
        fit.uncertainty.naive_covariance, expected, rtol=1e-7, atol=1e-12
    )
    independent = jid.uncertainty.IndependentRows()
    textbook = jid.identify(base, noisy, estimator, uncertainty=independent)
    np.testing.assert_allclose(textbook.covariance, fit.uncertainty.naive_covariance)


def test_a_known_tool_is_taken_off():
    arm = jid.robots.planar_arm(2, 0.4)
    tool = {
        "mass": 1.5,
        "centre_of_mass": (0.05, 0.02, 0.0),
        "inertia": 0.01 * np.eye(3),
    }
    bare, base = (
        jid.base_parameters(jid.Model(r)) for r in (arm, arm.with_tool(**tool))
    )
    p = standard_parameters(base.model)
    o = observations(base.model, p)
    fit = jid.identify(base, o, PLAIN)
    np.testing.assert_allclose(fit.parameters, base.from_standard(p), rtol=1e-9)
    assert np.abs(jid.identify(bare, o, PLAIN).parameters - fit.parameters).max() > 0.05
    assert jid.validate(fit, o).errors[0].relative < 1e-11


def test_a_joint_that_never_moves_is_named_and_the_rest_is_right(base, p, still):
    fit = jid.identify(base, still, PLAIN)
    named = {k for d in fit.undetermined for k in d.parts}
    first, second = base.names.index("fv1"), base.names.index("fv2")
    assert {second, base.names.index("fc2")} <= named
    assert fit.undetermined[0].uncertainty == np.inf
    assert "fv2" in " ".join(d.sentence(base) for d in fit.undetermined)
    np.testing.assert_allclose(
        fit.parameters[first], base.from_standard(p)[first], rtol=1e-8
    )
    assert np.isinf(fit.standard_deviations[second])
    assert jid.validate(fit, still).errors[0].relative < 1e-10
    # However small the deviation, nothing undetermined is trusted.
    assert fit.trust[second] is Status.BAD
    assert fit.determination[0].status is Status.BAD
    assert set(jid.identify(base, observations(base.model, p), PLAIN).trust) == {
        Status.GOOD
    }


@pytest.mark.parametrize(
    "solution",
    [jid.estimators.Complete(), jid.estimators.Ridge()],
)
def test_a_log_of_a_joint_that_stands_gives_no_absurd_estimates(base, p, solution):
    """From recorded angles, whose differences must not make columns of rounding."""
    o = observations(base.model, p, still=(1,), samples=2000, noise=0.1)
    log = jid.Recording.of(np.asarray(o.motion.q) + 0.3, o.forces, sample_time=0.005)
    rows = jid.observe(log, base.model.robot, jid.ZeroPhaseButterworth(10.0))
    fit = jid.identify(base, rows, jid.estimators.LeastSquares(solution))
    assert np.abs(fit.parameters).max() < 1e3
    unmoved = [base.names.index(name) for name in ("fv2", "fc2")]
    np.testing.assert_allclose(fit.parameters[unmoved], 0.0, atol=1e-9)
    assert np.isinf(fit.standard_deviations[unmoved]).all()


def test_forces_that_are_all_zero_are_no_crash(base):
    o = observations(base.model, np.zeros(base.model.size))
    fit = jid.identify(base, o)
    np.testing.assert_allclose(fit.parameters, 0.0, atol=1e-12)
    assert np.isnan(jid.validate(fit, o).errors[0].relative)


def test_ridge_solves_its_normal_equations_and_says_what_it_pulls(base, noisy):
    fit = jid.identify(
        base, noisy, jid.estimators.LeastSquares(jid.estimators.Ridge(0.1))
    )
    theta, forces, _ = dense(base, noisy)
    scale = np.linalg.norm(theta, axis=0)
    A = theta / scale
    strength = 0.1 * np.linalg.norm(A, 2)
    x = np.linalg.solve(A.T @ A + strength**2 * np.eye(base.size), A.T @ forces)
    np.testing.assert_allclose(fit.parameters, x / scale, rtol=1e-9)
    ridge = jid.estimators.LeastSquares(jid.estimators.Ridge(0.3))
    (note,) = jid.identify(base, noisy, ridge).notes
    assert f"of {base.size} combinations of parameters" in note


def test_cross_validation_pulls_only_where_data_are_poor(base, p):
    chosen = jid.estimators.LeastSquares(jid.estimators.CrossValidated())
    clean = jid.identify(base, observations(base.model, p, noise=1e-3), chosen)
    assert clean.solution.strength < 2e-3
    poor = observations(base.model, p, samples=60, noise=20.0)
    fits = [jid.identify(base, poor, estimator) for estimator in (chosen, PLAIN)]
    assert fits[0].solution.strength > 1e-2
    fresh = observations(base.model, p, samples=800, seed=9)
    errors = [jid.validate(f, fresh).errors[0].relative for f in fits]
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.parametrize(
    ("joints", "force", "samples", "message"),
    [
        (3, [40.0, 5.0, 2.0], 40, "have 2 joints, the robot 3"),
        (2, [40.0, 5.0], 5, "10 rows for 12 base parameters: record longer"),
    ],
)
def test_refusals(base, p, joints, force, samples, message):
    robot = jid.robots.planar_arm(joints, 0.4).replace(
        limits=jid.Limits(joints, force=force)
    )
    other = jid.base_parameters(jid.Model(robot, base.model.terms))
    with pytest.raises(ValueError, match=message):
        jid.identify(other, observations(base.model, p, samples=samples))


def test_what_a_log_does_not_move_is_open_however_small_its_noise(base, p):
    """A joint that hardly moves: its columns are small, but not those of rounding."""
    good = observations(base.model, p, noise=1e-3)
    motion = good.motion
    scale = np.array([1.0, 1e-3])
    q, qd, qdd = (np.asarray(x) * scale for x in (motion.q, motion.qd, motion.qdd))
    noise = 1e-3 * np.random.default_rng(3).standard_normal(q.shape)
    model = base.model
    forces = in_numpy(model, model.forces, q, qd, qdd, shared=(p,)) + noise
    weak = jid.Observations.of(q, qd, qdd, forces, sample_time=good.sample_time)
    fit = jid.identify(base, weak, PLAIN)
    viscous = base.names.index("fv2")
    assert not jid.identify(base, good, PLAIN).undetermined
    assert viscous in {k for d in fit.undetermined for k in d.parts}
    # The fit itself is as good as the noise.
    assert fit.residual < 2e-3
    assert fit.open_shares[viscous] > 0.1 > fit.open_shares[base.names.index("fv1")]
