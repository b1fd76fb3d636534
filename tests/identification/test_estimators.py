"""The family of estimators: laws for all members, and what each is for."""

import inspect

import numpy as np
import pytest
from scipy import optimize
from virtual import dense, observations, planar_base, standard_parameters

import jaxid as jid
from jaxid.identification.estimators.regularisation_and_weights import Decomposition
from jaxid.identification.estimators_by_name import ESTIMATORS
from jaxid.identification.factors import Factors

est = jid.estimators
MEASURED = est.ResidualVariances(0)
NOISE = np.array([0.5, 0.1])


@pytest.fixture(scope="module")
def base():
    return planar_base()


@pytest.fixture(scope="module")
def noisy(base):
    return observations(base.model, standard_parameters(base.model), noise=NOISE)


MEMBERS = 6
"""Number of the estimators that `members` returns."""


def members(o):
    return (
        est.LeastSquares(),
        jid.WeightedLeastSquares(MEASURED),
        jid.WeightedLeastSquares(est.ResidualVariances()),
        est.IterativelyReweighted(est.Huber(), MEASURED),
        est.IterativelyReweighted(est.Tukey(), MEASURED),
        est.InstrumentalVariables((o.motion,), MEASURED),
    )


@pytest.fixture(scope="module", params=range(MEMBERS))
def member(request, base, noisy):
    """Number of an estimator, and its fit."""
    return request.param, jid.identify(base, noisy, members(noisy)[request.param])


def test_the_laws_cover_every_estimator(noisy):
    tested = members(noisy)
    assert len(tested) == MEMBERS
    family = {
        c
        for _, c in inspect.getmembers(est, inspect.isclass)
        if issubclass(c, est.AbstractEstimator) and not inspect.isabstract(c)
    }
    # Shapes of friction need a model with such friction; a description estimates
    # nothing.
    family -= {est.EstimatorInWords}
    assert family == {type(e) for e in tested}, "add the estimator to `members`"


def test_every_estimator_finds_the_truth_without_noise(base, member):
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=100)
    fit = jid.identify(base, o, members(o)[member[0]])
    np.testing.assert_allclose(
        fit.parameters, base.from_standard(p), rtol=1e-7, atol=1e-7
    )


@pytest.fixture(scope="module")
def possible_bodies(base, noisy):
    """Standard parameters of bodies that can exist, well within all bounds."""
    consistent = jid.PhysicallyConsistent(pull=jid.consistency.EntropicPull(None, 10.0))
    return np.asarray(jid.identify(base, noisy, consistent).full_parameters)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_of_the_dict_finds_the_truth_without_noise(
    base, possible_bodies, name
):
    o = observations(base.model, possible_bodies, samples=100)
    needed = {"instrumental": {"references": (o.motion,)}}
    fit = jid.identify(base, o, ESTIMATORS[name](**needed.get(name, {})))
    truth = base.from_standard(possible_bodies)
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-6, atol=1e-6)


def test_every_estimator_follows_its_forces_and_judges_itself(base, noisy, member):
    """Forces, parameters, deviations in other units; the same undetermined ones."""
    (k, fit), c = member, 2.0**-13
    other = jid.identify(
        base, noisy.replace(forces=c * noisy.forces), members(noisy)[k]
    )
    size = c * np.abs(fit.parameters).max()
    np.testing.assert_allclose(
        other.parameters, c * np.asarray(fit.parameters), 1e-9, 1e-9 * size
    )
    np.testing.assert_allclose(
        other.standard_deviations, c * fit.standard_deviations, rtol=1e-8
    )
    assert other.undetermined == fit.undetermined
    truth = np.asarray(base.from_standard(standard_parameters(base.model)))
    z = (np.asarray(fit.parameters) - truth) / fit.standard_deviations
    assert np.sqrt(np.mean(z**2)) < 2.0
    assert 0.5 < np.median(fit.uncertainty.ratios) < 2.0


def test_every_estimator_goes_through_logs_in_parts(base, noisy, member, monkeypatch):
    monkeypatch.setattr(jid.RegressionProblem, "cached_numbers", 0)
    monkeypatch.setattr(jid.RegressionProblem, "samples_per_chunk", 130)
    k, whole = member
    parts = jid.identify(base, noisy, members(noisy)[k])
    np.testing.assert_allclose(parts.parameters, whole.parameters, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        parts.standard_deviations, whole.standard_deviations, rtol=1e-6
    )


def alone(base, noisy, k):
    """Estimate with a member from factors alone."""
    blocks = jid.RegressionProblem(base, [noisy]).blocks
    return members(noisy)[k](jid.RegressionProblem(base, blocks=blocks))


def weighted(weights):
    return jid.WeightedLeastSquares(est.GivenWeights(weights))


GIVEN = np.array([0.025, 0.2])
LINEAR = [
    est.LeastSquares(),
    weighted(GIVEN),
    jid.WeightedLeastSquares(est.GivenWeights(GIVEN), est.Ridge(0.1)),
]


@pytest.mark.parametrize("estimator", LINEAR)
def test_forces_that_add_up_give_parameters_that_do(base, noisy, estimator):
    first = np.asarray(noisy.forces)
    second = np.random.default_rng(4).normal(size=first.shape)
    logs = [noisy.replace(forces=x) for x in (first, second, first - 1.7 * second)]
    p, q, total = (
        np.asarray(jid.identify(base, o, estimator).parameters) for o in logs
    )
    np.testing.assert_allclose(
        total, p - 1.7 * q, rtol=1e-8, atol=1e-8 * np.abs(p).max()
    )


def test_only_the_ratio_of_weights_counts(base, noisy):
    one, other = (
        jid.identify(base, noisy, weighted(c * GIVEN)) for c in (1.0, 2.0**-40)
    )
    np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-9)
    np.testing.assert_allclose(
        other.standard_deviations, one.standard_deviations, rtol=1e-9
    )


def test_order_division_and_rows_that_do_not_count_change_nothing(base, noisy):
    """Rows are samples, since nothing is filtered; masked rows may hold anything."""
    random = np.random.default_rng(1)
    m, forces, order = (
        noisy.motion,
        np.asarray(noisy.forces),
        random.permutation(noisy.samples),
    )
    mixed = noisy.replace(motion=m[order], forces=forces[order])
    one, other = (jid.identify(base, o, weighted(GIVEN)) for o in (noisy, mixed))
    np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-10)
    np.testing.assert_allclose(other.residual_rms, one.residual_rms, rtol=1e-10)

    def solve(factors):
        return Decomposition.of(*factors.weighted(GIVEN)).solve()

    total, divided = (
        jid.RegressionProblem(base, [noisy], divisions=n).blocks.total for n in (10, 3)
    )
    padded = [j.append(np.zeros((7, len(j.columns) + 1))) for j in total.joints]
    for factors in (divided, Factors(tuple(padded), base.size)):
        np.testing.assert_allclose(solve(factors), solve(total), rtol=1e-11)

    mask = random.uniform(size=forces.shape) > 0.2
    spoilt = np.where(mask, forces, 1e6 * random.standard_normal(forces.shape))
    logs = [noisy.replace(mask=mask, forces=x) for x in (forces, spoilt)]
    one, other = (jid.identify(base, o, weighted(GIVEN)) for o in logs)
    np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-12)
    assert other.rows == one.rows == tuple(mask.sum(axis=0))


ONES = np.ones((3, 20, 3))
identify = inspect.unwrap(jid.identify)  # tests check annotations first, users do not
REFUSALS = [
    (lambda base, o: jid.identify(base, o, weighted([np.nan, 1.0])), "`weights`"),
    (
        lambda base, o: jid.identify(base, o, weighted(np.ones(3))),
        "`weights` must be 2 numbers",
    ),
    (lambda base, o: est.Ridge(np.nan), "`strength`"),
    (lambda base, o: est.Tukey(0.0), "`limit`"),
    (
        lambda base, o: jid.identify(base, o, est.InstrumentalVariables(())),
        "`references`",
    ),
    (lambda base, o: identify(base, o.motion), "`observations`"),
    (lambda base, o: identify(base.model, o), "`base`"),
    (
        lambda base, o: jid.identify(base, o, LINEAR[0]).predict(jid.Motion(*ONES)),
        "`motion`",
    ),
    *[
        (lambda base, o, k=k: alone(base, o, k), "the rows themselves")
        for k in range(3, 6)
    ],
]


@pytest.mark.parametrize(("make", "named"), REFUSALS)
def test_what_cannot_be_is_rejected(base, noisy, make, named):
    with pytest.raises((TypeError, ValueError), match=named):
        make(base, noisy)


@pytest.mark.parametrize("loss", [est.Huber(), est.Tukey()])
def test_a_loss_is_consistent_with_itself(loss):
    x = np.linspace(-8, 8, 4001)
    felt = x * loss.weight(x)
    np.testing.assert_allclose(
        np.gradient(felt, x)[1:-1], loss.slope(x)[1:-1], atol=0.6
    )
    smooth = np.abs(np.abs(x) - loss.limit) > 0.01
    np.testing.assert_allclose(
        np.gradient(felt, x)[smooth], loss.slope(x)[smooth], atol=5e-3
    )
    # 95 % of the precision of least squares where the noise is normal.
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    slope, square = (np.trapezoid(y * density, x) for y in (loss.slope(x), felt**2))
    assert slope**2 / square == pytest.approx(0.95, abs=0.002)


def test_huber_minimises_its_loss(base, noisy):
    """scipy's least squares with the same scales as an oracle."""
    wild = np.arange(noisy.samples) % 17 == 0
    o = noisy.replace(forces=np.asarray(noisy.forces) + 5.0 * wild[:, None])
    estimator = est.IterativelyReweighted(est.Huber(), MEASURED, tolerance=1e-9)
    fit = jid.identify(base, o, estimator)
    theta, forces, joint = dense(base, o)
    r = forces - theta @ fit.parameters
    scale = np.array([1.4826 * np.median(np.abs(r[joint == j])) for j in range(2)])[
        joint
    ]
    size = np.asarray(fit.weights)[joint] * scale
    c = est.Huber().limit

    def residuals(p):
        x = np.abs((forces - theta @ p) / scale)
        return size * np.sqrt(np.where(x <= c, x**2, 2 * c * x - c**2))

    start = np.linalg.lstsq(theta, forces, rcond=None)[0]
    found = optimize.least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    np.testing.assert_allclose(fit.parameters, found.x, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("loss", "gain"), [(est.Huber(), 3.0), (est.Tukey(), 5.0)])
def test_outliers_do_little(base, loss, gain):
    p = standard_parameters(base.model)
    truth = np.asarray(base.from_standard(p))
    o = observations(base.model, p, samples=1500, noise=NOISE)
    wild = np.random.default_rng(5).random(1500) < 0.05
    o = o.replace(
        forces=np.asarray(o.forces) + np.where(wild[:, None], [20.0, 4.0], 0.0)
    )
    plain = jid.identify(base, o, jid.WeightedLeastSquares(MEASURED))
    fit = jid.identify(base, o, est.IterativelyReweighted(loss, MEASURED))
    size = plain.naive_standard_deviations
    errors = [np.linalg.norm((f.parameters - truth) / size) for f in (fit, plain)]
    assert gain * errors[0] < errors[1]
    assert fit.notes == ()


def test_instruments_take_the_bias_of_noisy_columns_away(base):
    # Without tanh: what noise does to the mean of such a column, no instrument takes
    # away.
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.ConstantOffset())
    base = jid.base_parameters(jid.Model(base.model.robot, terms))
    p = standard_parameters(base.model)
    truth = np.asarray(base.from_standard(p))
    clean = observations(base.model, p, samples=3000, noise=0.1)
    estimators = (
        est.InstrumentalVariables((clean.motion,), MEASURED),
        jid.WeightedLeastSquares(MEASURED),
    )
    errors = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        noise = [s * random.standard_normal((3000, 2)) for s in (0.003, 0.1, 1.5)]
        m = clean.motion
        o = clean.replace(
            motion=jid.Motion(m.q + noise[0], m.qd + noise[1], m.qdd + noise[2])
        )
        errors.append([jid.identify(base, o, x).parameters - truth for x in estimators])
    # Means over the draws, in units of what chance lets them scatter.
    bias = np.mean(errors, axis=0) / (np.std(errors, axis=0, ddof=1) / np.sqrt(12))
    instruments, plain = np.sqrt(np.mean(bias**2, axis=1))
    assert instruments < 1.6
    assert plain > 6.0
