"""The family of estimators: laws for all members, and what each is for."""

import inspect

import numpy as np
import pytest
from scipy import optimize
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Factors
from jaxid.trajectory.trajectory import AbstractTrajectory

MEASURED = jid.estimators.ResidualVariances(0)


class Known(AbstractTrajectory):
    """A motion that is known at the samples of `virtual.motion`."""

    motion_: jid.Motion
    dt: float

    @property
    def duration(self):
        return self.dt * (len(self.motion_.q) - 1)

    def motion(self, t):
        places = np.round(np.asarray(t) / self.dt).astype(int)
        return self.motion_[places]


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.ConstantOffset())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


@pytest.fixture(scope="module")
def noisy(base):
    p = standard_parameters(base.model)
    return observations(base.model, p, noise=np.array([0.5, 0.1]))


def members(o, size=1.0):
    return (
        jid.estimators.LeastSquares(),
        jid.WeightedLeastSquares(MEASURED),
        jid.WeightedLeastSquares(jid.estimators.ResidualVariances()),
        jid.estimators.IterativelyReweighted(jid.estimators.Huber(), MEASURED),
        jid.estimators.IterativelyReweighted(jid.estimators.Tukey(), MEASURED),
        jid.estimators.GeneralisedLeastSquares(),
        jid.estimators.InstrumentalVariables((Known(o.motion, o.sample_time),), MEASURED),
        jid.estimators.RelativeTo(
            size * rough(o.joints),
            jid.estimators.IterativelyReweighted(jid.estimators.Tukey(), MEASURED),
        ),
        jid.estimators.RelativeTo(size * rough(o.joints), jid.WeightedLeastSquares(MEASURED)),
    )


def rough(joints):
    """Standard parameters of a bad CAD model; without a ridge they do nothing."""
    return np.linspace(-1.0, 1.0, 13 * joints)


def with_forces(o, change):
    forces = np.array(o.forces)
    change(forces)
    return o.replace(forces=forces)


@pytest.fixture(scope="module", params=range(9))
def member(request, base, noisy):
    """Number of an estimator, and its fit."""
    return request.param, jid.identify(base, noisy, members(noisy)[request.param])


def test_every_estimator_finds_the_truth_without_noise(base, member):
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=100)
    fit = jid.identify(base, o, members(o)[member[0]])
    np.testing.assert_allclose(fit.parameters, base.from_standard(p), rtol=1e-7, atol=1e-7)


def test_every_estimator_follows_its_forces_and_judges_itself(base, noisy, member):
    """Forces in other units, parameters and deviations in other units; the same undetermined."""
    (k, fit), c = member, 2.0**-13
    other = jid.identify(base, noisy.replace(forces=c * noisy.forces), members(noisy, c)[k])
    size = c * np.abs(fit.parameters).max()
    np.testing.assert_allclose(other.parameters, c * np.asarray(fit.parameters), 1e-9, 1e-9 * size)
    np.testing.assert_allclose(other.standard_deviations, c * fit.standard_deviations, rtol=1e-8)
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
    np.testing.assert_allclose(parts.standard_deviations, whole.standard_deviations, rtol=1e-6)


def alone(base, noisy, k):
    """Estimate with a member from factors alone."""
    blocks = jid.RegressionProblem(base, [noisy]).blocks
    problem = jid.RegressionProblem(base, blocks=blocks)
    return jid.identification.identify.fit_problem(problem, members(noisy)[k])


def weighted(weights):
    return jid.WeightedLeastSquares(jid.estimators.GivenWeights(weights))


GIVEN = np.array([0.025, 0.2])
LINEAR = [
    jid.estimators.LeastSquares(),
    weighted(GIVEN),
    jid.estimators.LeastSquares(jid.estimators.Truncated(1e-6)),
    jid.WeightedLeastSquares(jid.estimators.GivenWeights(GIVEN), jid.estimators.Ridge(0.1)),
]


@pytest.mark.parametrize("estimator", LINEAR)
def test_forces_that_add_up_give_parameters_that_do(base, noisy, estimator):
    first = np.asarray(noisy.forces)
    second = np.random.default_rng(4).normal(size=first.shape)
    logs = [noisy.replace(forces=x) for x in (first, second, first - 1.7 * second)]
    p, q, total = (np.asarray(jid.identify(base, o, estimator).parameters) for o in logs)
    np.testing.assert_allclose(total, p - 1.7 * q, rtol=1e-8, atol=1e-8 * np.abs(p).max())


@pytest.mark.parametrize("power", [-40, 33])
def test_only_the_ratio_of_weights_counts(base, noisy, power):
    one, other = (jid.identify(base, noisy, weighted(c * GIVEN)) for c in (1.0, 2.0**power))
    np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-9)
    np.testing.assert_allclose(other.standard_deviations, one.standard_deviations, rtol=1e-9)


def test_order_division_and_rows_that_do_not_count_change_nothing(base, noisy):
    """Rows are samples, since nothing is filtered; masked rows may hold anything."""
    random = np.random.default_rng(1)
    m, forces, order = noisy.motion, np.asarray(noisy.forces), random.permutation(noisy.samples)
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
    (lambda base, o: jid.identify(base, o, weighted(np.zeros(2))), "`weights`"),
    (lambda base, o: jid.identify(base, o, weighted([1.0, -1.0])), "`weights`"),
    (lambda base, o: jid.identify(base, o, weighted([np.nan, 1.0])), "`weights`"),
    (lambda base, o: jid.identify(base, o, weighted(np.ones(3))), "`weights`.*2 joints"),
    (lambda base, o: jid.estimators.Truncated(2.0), "`rcond`"),
    (lambda base, o: jid.estimators.Ridge(-1.0), "`strength`"),
    (lambda base, o: jid.estimators.Ridge(np.nan), "`strength`"),
    (lambda base, o: jid.estimators.Huber(np.nan), "`limit`"),
    (lambda base, o: jid.estimators.Tukey(0.0), "`limit`"),
    (lambda base, o: jid.identify(base, o, jid.estimators.RelativeTo(np.ones(5))), "`parameters`"),
    (
        lambda base, o: jid.identify(
            base, o, jid.estimators.InstrumentalVariables((Known(o.motion, 0.1),) * 2, MEASURED)
        ),
        "`references`",
    ),
    (lambda base, o: identify(base, o.motion), "`observations`"),
    (lambda base, o: identify(base.model, o), "`base`"),
    (lambda base, o: jid.identify(base, o, LINEAR[0]).predict(jid.Motion(*ONES)), "`motion`"),
    (lambda base, o: jid.Recording.of(1j * ONES[0], ONES[0], sample_time=0.1), "complex"),
    (
        lambda base, o: jid.Recording.of(*ONES[:2], sample_time=0.1, largest_gap=-1),
        "`largest_gap`",
    ),
    *[(lambda base, o, k=k: alone(base, o, k), "only their factors") for k in range(3, 8)],
]


@pytest.mark.parametrize(("make", "named"), REFUSALS)
def test_what_cannot_be_is_rejected(base, noisy, make, named):
    with pytest.raises((TypeError, ValueError), match=named):
        make(base, noisy)


@pytest.mark.parametrize("loss", [jid.estimators.Huber(), jid.estimators.Tukey()])
def test_a_loss_is_consistent_with_itself(loss):
    x = np.linspace(-8, 8, 4001)
    felt = x * loss.weight(x)
    np.testing.assert_allclose(np.gradient(felt, x)[1:-1], loss.slope(x)[1:-1], atol=0.6)
    smooth = np.abs(np.abs(x) - loss.limit) > 0.01
    np.testing.assert_allclose(np.gradient(felt, x)[smooth], loss.slope(x)[smooth], atol=5e-3)
    # 95 % of the precision of least squares where the noise is normal.
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    slope, square = (np.trapezoid(y * density, x) for y in (loss.slope(x), felt**2))
    assert slope**2 / square == pytest.approx(0.95, abs=0.002)


def test_huber_minimises_its_loss(base, noisy):
    """scipy's least squares with the same scales as an oracle."""
    o = with_forces(noisy, lambda f: np.add(f[::17], 5.0, out=f[::17]))
    estimator = jid.estimators.IterativelyReweighted(
        jid.estimators.Huber(), MEASURED, tolerance=1e-9
    )
    fit = jid.identify(base, o, estimator)
    theta, forces, joint = dense(base, o)
    r = forces - theta @ fit.parameters
    scale = np.array([1.4826 * np.median(np.abs(r[joint == j])) for j in range(2)])[joint]
    size = np.asarray(fit.weights)[joint] * scale
    c = jid.estimators.Huber().limit

    def residuals(p):
        x = np.abs((forces - theta @ p) / scale)
        return size * np.sqrt(np.where(x <= c, x**2, 2 * c * x - c**2))

    start = np.linalg.lstsq(theta, forces, rcond=None)[0]
    found = optimize.least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    np.testing.assert_allclose(fit.parameters, found.x, rtol=1e-4, atol=1e-4)


def test_a_ridge_towards_a_prior_is_solved_as_numpy_does(base, noisy):
    share, prior = 0.3, 1.1 * standard_parameters(base.model)
    ridge = jid.WeightedLeastSquares(MEASURED, jid.estimators.Ridge(share))
    fit = jid.identify(base, noisy, jid.estimators.RelativeTo(prior, ridge))
    theta, forces, joint = dense(base, noisy)
    w = np.asarray(fit.weights)[joint]
    A, b = theta * w[:, None], forces * w
    norms = np.linalg.norm(A, axis=0)
    pull = share * np.linalg.norm(A / norms, 2) * np.diag(norms)
    p0 = np.asarray(base.from_standard(prior))
    both, right = np.vstack([A, pull]), np.concatenate([b, pull @ p0])
    expected = np.linalg.lstsq(both, right, rcond=None)[0]
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-8)
    plain = jid.identify(base, noisy, ridge)
    truth = np.asarray(base.from_standard(standard_parameters(base.model)))
    assert np.linalg.norm(fit.parameters - truth) < np.linalg.norm(plain.parameters - truth)


@pytest.mark.parametrize(
    ("loss", "gain"), [(jid.estimators.Huber(), 3.0), (jid.estimators.Tukey(), 5.0)]
)
def test_outliers_do_little(base, loss, gain):
    p = standard_parameters(base.model)
    truth = np.asarray(base.from_standard(p))
    o = observations(base.model, p, samples=1500, noise=np.array([0.5, 0.1]))
    wild = np.random.default_rng(5).random(1500) < 0.05
    o = with_forces(o, lambda f: np.add(f, np.where(wild[:, None], [20.0, 4.0], 0.0), out=f))
    plain = jid.identify(base, o, jid.WeightedLeastSquares(MEASURED))
    fit = jid.identify(base, o, jid.estimators.IterativelyReweighted(loss, MEASURED))
    size = plain.naive_standard_deviations
    errors = [np.linalg.norm((f.parameters - truth) / size) for f in (fit, plain)]
    assert gain * errors[0] < errors[1]
    assert fit.notes == ()


def test_correlated_joints_are_solved_as_numpy_does(base):
    p = standard_parameters(base.model)
    mask = np.random.default_rng(2).random((400, 2)) < 0.8
    o = observations(base.model, p, mask=mask)
    S = np.array([[1.0, 0.9 * 0.3], [0.9 * 0.3, 0.09]])
    noise = np.random.default_rng(3).standard_normal((400, 2)) @ np.linalg.cholesky(S).T
    o = with_forces(o, lambda f: np.add(f, noise, out=f))
    fit = jid.identify(base, o, jid.estimators.GeneralisedLeastSquares(iterations=4))
    theta, forces, joint = dense(base, o)
    r = np.full((400, 2), np.nan)
    r[mask] = forces - theta @ fit.parameters
    both = mask.all(axis=1)
    pair = np.mean(r[both, 0] * r[both, 1])
    found = np.array([[np.nanmean(r[:, 0] ** 2), pair], [pair, np.nanmean(r[:, 1] ** 2)]])
    np.testing.assert_allclose(found, S, rtol=0.15)
    time = np.broadcast_to(np.arange(400)[:, None], (400, 2))[mask]
    V = np.where(time[:, None] == time, found[joint[:, None], joint], 0.0)
    expected = np.linalg.solve(
        theta.T @ np.linalg.solve(V, theta), theta.T @ np.linalg.solve(V, forces)
    )
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-4, atol=1e-4)
    plain = jid.identify(base, o, jid.WeightedLeastSquares(jid.estimators.ResidualVariances()))
    assert np.median(fit.standard_deviations / plain.standard_deviations) < 0.9


def test_instruments_take_the_bias_of_noisy_columns_away(base):
    # Without tanh: what noise does to the mean of such a column, no instrument takes away.
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.ConstantOffset())
    base = jid.base_parameters(jid.Model(base.model.robot, terms))
    p = standard_parameters(base.model)
    truth = np.asarray(base.from_standard(p))
    clean = observations(base.model, p, samples=3000, noise=0.1)
    errors = {"plain": [], "instruments": []}
    reference = Known(clean.motion, clean.sample_time)
    for seed in range(12):
        random = np.random.default_rng(seed)
        noise = [s * random.standard_normal((3000, 2)) for s in (0.003, 0.1, 1.5)]
        m = clean.motion
        o = clean.replace(motion=jid.Motion(m.q + noise[0], m.qd + noise[1], m.qdd + noise[2]))
        plain = jid.identify(base, o, jid.WeightedLeastSquares(MEASURED))
        fit = jid.identify(base, o, jid.estimators.InstrumentalVariables((reference,), MEASURED))
        errors["plain"].append(plain.parameters - truth)
        errors["instruments"].append(fit.parameters - truth)
    # Means over the draws, in units of what chance lets them scatter.
    bias = {
        k: np.mean(e, axis=0) / (np.std(e, axis=0, ddof=1) / np.sqrt(12)) for k, e in errors.items()
    }
    assert np.sqrt(np.mean(bias["instruments"] ** 2)) < 1.6
    assert np.sqrt(np.mean(bias["plain"] ** 2)) > 6.0
