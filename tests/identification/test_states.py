"""Several fits together: against dense least squares, known truths, and files."""

import dataclasses

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification.combination import combine
from jaxid.identification.operating_states import stores_energy
from jaxid.identification.parameter_changes import Verdict

NOISE = np.array([0.5, 0.1])


def observe(base, truths, seed=0, **options):
    return [
        dataclasses.replace(
            observations(
                base.model,
                p,
                noise=NOISE,
                seed=k + 1,
                noise_seed=10 * seed + k,
                **options,
            ),
            name=name,
        )
        for k, (name, p) in enumerate(zip(("cold", "warm"), truths, strict=True))
    ]


@pytest.fixture(scope="module")
def truths(base):
    """Standard parameters of a cold and a warm robot: friction and offsets differ."""
    cold = standard_parameters(base.model)
    warm = cold.copy()
    warm[20:] *= np.linspace(0.4, 0.9, len(warm) - 20)
    return cold, warm


@pytest.fixture(scope="module")
def logs(base, truths):
    return observe(base, truths)


@pytest.fixture(scope="module")
def fits(base, logs):
    return [jid.identify(base, o) for o in logs]


@pytest.fixture(scope="module")
def found(fits):
    return jid.identify_states(fits)


def test_shared_and_own_parameters_equal_dense_least_squares(base, logs, fits, found):
    assert found.states == ("cold", "warm")
    assert {base.names[k] for k in found.varying} == {
        "fv1",
        "fv2",
        "fc1",
        "fc2",
        "fo1",
        "fo2",
    }
    rows, forces, varying = [], [], list(found.varying)
    for k, o in enumerate(logs):
        theta, Q, joint = dense(base, o)
        w = np.array([1 / 40.0, 1 / 5.0])[joint]
        own = np.zeros((len(Q), 2 * len(varying)))
        own[:, k * len(varying) :][:, : len(varying)] = theta[:, varying]
        rows.append(w[:, None] * np.hstack([theta[:, list(found.shared)], own]))
        forces.append(w * Q)
    expected, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(forces), rcond=None)
    np.testing.assert_allclose(found.parameters, expected, rtol=1e-9)
    n = len(found.shared)
    cold = found.fit("cold").parameters[varying]
    np.testing.assert_allclose(cold, expected[n : n + len(varying)], rtol=1e-9)
    assert (found.names[n], found.units[n]) == ("fv1 (cold)", "N m s")
    errors = [
        jid.validate(f, logs[1]).errors[0].relative
        for f in (found.fit("warm"), fits[1])
    ]
    assert errors[0] < 1.02 * errors[1]


def test_covariance_is_that_of_many_noise_draws(base, truths):
    draws, variances = [], []
    for seed in range(40):
        runs = [jid.identify(base, o) for o in observe(base, truths, seed, samples=200)]
        found = jid.identify_states(runs)
        draws.append(found.parameters)
        variances.append(np.diag(found.uncertainty.covariance))
    ratio = np.mean(variances, axis=0) / np.var(draws, axis=0, ddof=1)
    # A variance from 40 draws scatters by sqrt(2 / 40) = 0.22.
    assert abs(np.mean(ratio) - 1.0) < 0.15
    np.testing.assert_allclose(ratio, 1.0, atol=0.7)


def test_changes_are_found_and_sharing_is_tested(base, truths, fits, found):
    comparison = found.compare("cold", "warm")
    verdicts = dict(zip(comparison.names, comparison.verdicts, strict=True))
    assert set(verdicts) == {base.names[k] for k in found.varying}
    assert verdicts["fv1"] is Verdict.CHANGED
    assert found.sharing[1] > 1e-3
    # Between states of one fit a difference is more precise than between two fits.
    together = comparison.standard_deviations
    apart = jid.compare(*fits).standard_deviations[list(found.varying)]
    assert (together <= 1.05 * apart).all()
    assert (together < 0.9 * apart).any()
    heavier = truths[0].copy()
    heavier[11] += 1.0
    warm = jid.identify(base, observe(base, (truths[0], heavier))[1])
    assert jid.identify_states([fits[0], warm]).sharing[1] < 1e-6


def test_energy_is_a_matter_of_physics_not_of_names(base):
    terms = (
        jid.RigidBodies(),
        jid.terms.LinearSpring(),
        jid.RotorInertia(),
        jid.CoulombFriction(),
    )
    other = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))
    for one, storing, others in (
        (base, {"C1"}, {"fv1"}),
        (other, {"ks1", "Ia2"}, {"fc1"}),
    ):
        stored = dict(zip(one.names, stores_energy(one), strict=True))
        assert all(stored[name] for name in storing)
        assert not any(stored[name] for name in others)


def test_an_update_equals_the_joint_fit(base, truths):
    logs = [
        observations(base.model, truths[0], noise=NOISE, seed=s, noise_seed=s)
        for s in range(3)
    ]
    one, two, three = (jid.identify(base, o) for o in logs)
    together, updated = jid.identify(base, logs[:2]), jid.combine_fits(one, two)
    np.testing.assert_allclose(updated.parameters, together.parameters, rtol=1e-11)
    # By chance slow rows may disagree with the others in one log, not in both together.
    deviations = updated.standard_deviations
    np.testing.assert_allclose(deviations, together.standard_deviations, rtol=0.3)
    assert updated.rows == together.rows
    np.testing.assert_allclose(updated.residual_rms, together.residual_rms, rtol=1e-9)
    all_three = jid.identify(base, logs).parameters
    np.testing.assert_allclose(
        jid.combine_fits(updated, three).parameters, all_three, rtol=1e-11
    )


def test_fits_with_weights_of_their_own_keep_them(base, truths, logs):
    estimator = jid.WeightedLeastSquares(jid.estimators.ResidualVariances())
    third = observations(base.model, truths[0], noise=NOISE, seed=3, noise_seed=3)
    one, two, three = (jid.identify(base, o, estimator) for o in (*logs, third))
    assert np.abs(one.weights / two.weights - 1).max() > 1e-6
    updated, E = jid.combine_fits(one, two), np.eye(base.size)
    np.testing.assert_allclose(updated.parameters, combine((one, two), (E, E))[0])
    again = jid.combine_fits(updated, three)
    R, z = again.factor
    np.testing.assert_allclose(
        np.linalg.lstsq(R, z, rcond=None)[0], again.parameters, rtol=1e-9
    )
    for twice in (
        lambda: jid.combine_fits(again, one),
        lambda: jid.identify_payload(one, one),
    ):
        with pytest.raises(
            ValueError,
            match="contain the same data, which would count twice",
        ):
            twice()


def test_a_fit_that_leaves_something_open_still_helps(base, truths):
    full = observations(base.model, truths[0], noise=NOISE, seed=1, noise_seed=1)
    still = observations(
        base.model, truths[0], noise=NOISE, seed=2, noise_seed=2, still=(1,)
    )
    one, poor = jid.identify(base, full), jid.identify(base, still)
    assert np.isinf(np.diag(poor.covariance)).any()
    updated = jid.combine_fits(one, poor)
    together = jid.identify(base, [full, still])
    np.testing.assert_allclose(updated.parameters, together.parameters, rtol=1e-8)
    assert np.isfinite(updated.covariance).all()
    ratio = updated.standard_deviations / one.standard_deviations
    assert ratio[base.names.index("fv1")] < 0.95
    # Both are estimates from the residuals' spectra, and scatter by a tenth and more.
    assert np.median(ratio) < 1.25
    named = [dataclasses.replace(f, name=name) for f, name in ((one, "a"), (poor, "b"))]
    assert 0.0 < jid.identify_states(named).sharing[1] <= 1.0


def test_other_estimates_are_solved_again_from_their_factors(base, logs, fits):
    robust = jid.identify(base, logs[0], jid.estimators.IterativelyReweighted())
    assert not robust.is_least_squares
    updated = [jid.combine_fits(one, fits[1]).parameters for one in (robust, fits[0])]
    np.testing.assert_allclose(*updated, rtol=1e-9)


def test_refusals(fits, found):
    with pytest.raises(ValueError, match="different names"):
        jid.identify_states([fits[0], fits[0]])
    with pytest.raises(ValueError, match="`state`"):
        found.fit("hot")
