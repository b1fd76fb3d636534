"""Several runs together: against dense least squares, known truths, and files."""

import dataclasses

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification.runs.states import stores_energy
from jaxid.identification.runs.tied import tied

NOISE = np.array([0.5, 0.1])


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.ConstantOffset())
    robot = jid.robots.planar_arm(2, 0.4).replace(limits=jid.Limits(2, force=[40.0, 5.0]))
    return jid.base_parameters(jid.Model(robot, terms))


@pytest.fixture(scope="module")
def truths(base):
    """Standard parameters of a cold and a warm robot: friction and offsets differ."""
    cold = standard_parameters(base.model)
    warm = cold.copy()
    warm[20:] *= np.linspace(0.4, 0.9, len(warm) - 20)
    return cold, warm


def observed(base, truths, seed=0, **options):
    names = ("cold", "warm")
    return [
        dataclasses.replace(
            observations(
                base.model, p, noise=NOISE, seed=k + 1, noise_seed=10 * seed + k, **options
            ),
            name=name,
        )
        for k, (name, p) in enumerate(zip(names, truths, strict=True))
    ]


def test_shared_and_own_parameters_equal_dense_least_squares(base, truths):
    two = observed(base, truths)
    found = jid.identify_states([jid.identify(base, o) for o in two])
    assert found.states == ("cold", "warm")
    assert {base.names[k] for k in found.varying} == {"fv1", "fv2", "fc1", "fc2", "fo1", "fo2"}
    rows, forces = [], []
    for k, o in enumerate(two):
        theta, Q, joint = dense(base, o)
        w = np.array([1 / 40.0, 1 / 5.0])[joint]
        own = np.zeros((len(Q), 2 * len(found.varying)))
        own[:, k * len(found.varying) :][:, : len(found.varying)] = theta[:, list(found.varying)]
        rows.append(w[:, None] * np.hstack([theta[:, list(found.shared)], own]))
        forces.append(w * Q)
    expected, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(forces), rcond=None)
    np.testing.assert_allclose(found.found.parameters, expected, rtol=1e-9)
    cold = found.of("cold")
    assert cold.names == base.names
    n = len(found.shared)
    np.testing.assert_allclose(
        cold.parameters[list(found.varying)], expected[n : n + len(found.varying)], rtol=1e-9
    )
    assert found.names[n] == "fv1 (cold)"
    assert found.estimates.units[n] == "N m s"
    errors = jid.validate(found.fit("warm"), two[1]).errors[0]
    assert (
        errors.relative < 1.02 * jid.validate(jid.identify(base, two[1]), two[1]).errors[0].relative
    )


def test_covariance_is_that_of_many_noise_draws(base, truths):
    draws, variances = [], []
    for seed in range(40):
        runs = [jid.identify(base, o) for o in observed(base, truths, seed, samples=200)]
        found = jid.identify_states(runs)
        draws.append(found.found.parameters)
        variances.append(np.diag(found.found.covariance))
    scatter = np.var(draws, axis=0, ddof=1)
    ratio = np.mean(variances, axis=0) / scatter
    # A variance from 40 draws scatters by sqrt(2 / 40) = 0.22.
    assert abs(np.mean(ratio) - 1.0) < 0.15
    np.testing.assert_allclose(ratio, 1.0, atol=0.7)


def test_what_changed_is_found_and_what_is_shared_is_tested(base, truths):
    found = jid.identify_states([jid.identify(base, o) for o in observed(base, truths)])
    verdicts = dict(
        zip(*(lambda c: (c.first.names, c.verdicts))(found.compare("cold", "warm")), strict=True)
    )
    assert set(verdicts) == {base.names[k] for k in found.varying}
    assert verdicts["fv1"] is jid.identification.runs.comparison.Verdict.CHANGED
    assert found.sharing[1] > 1e-3
    cold, _ = truths
    heavier = cold.copy()
    heavier[11] += 1.0
    other = jid.identify_states([jid.identify(base, o) for o in observed(base, (cold, heavier))])
    assert other.sharing[1] < 1e-6


def test_a_difference_between_states_knows_that_they_share(base, truths):
    """Between states of one fit it is more precise than between two fits."""
    runs = [jid.identify(base, o) for o in observed(base, truths)]
    found = jid.identify_states(runs)
    together = found.compare("cold", "warm").standard_deviations
    apart = jid.compare(*runs).standard_deviations[list(found.varying)]
    assert (together <= 1.05 * apart).all()
    assert (together < 0.9 * apart).any()


def test_what_stores_energy_is_told_by_physics_not_by_names(base):
    stored = dict(zip(base.names, stores_energy(base), strict=True))
    assert stored["C1"]
    assert not stored["fv1"]
    terms = (jid.RigidBodies(), jid.terms.LinearSpring(), jid.RotorInertia(), jid.CoulombFriction())
    other = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))
    stored = dict(zip(other.names, stores_energy(other), strict=True))
    assert stored["ks1"]
    assert stored["Ia2"]
    assert not stored["fc1"]


def test_an_update_equals_the_joint_fit(base, truths):
    cold, _ = truths
    two = [observations(base.model, cold, noise=NOISE, seed=s, noise_seed=s) for s in (1, 2)]
    together = jid.identify(base, two)
    one, other = (jid.identify(base, o) for o in two)
    updated = jid.update(one, other)
    np.testing.assert_allclose(updated.parameters, together.parameters, rtol=1e-11)
    np.testing.assert_allclose(
        np.sqrt(np.diag(updated.covariance)), together.standard_deviations, rtol=0.2
    )
    assert updated.rows == together.rows
    np.testing.assert_allclose(updated.residual_rms, together.residual_rms, rtol=1e-9)
    third = observations(base.model, cold, noise=NOISE, seed=3, noise_seed=3)
    again = jid.update(updated, jid.identify(base, third))
    np.testing.assert_allclose(
        again.parameters, jid.identify(base, [*two, third]).parameters, rtol=1e-11
    )


def test_runs_with_weights_of_their_own_keep_them(base, truths):
    two = observed(base, truths)
    weights = jid.estimators.ResidualVariances()
    one, other = (jid.identify(base, o, estimator=jid.WeightedLeastSquares(weights)) for o in two)
    assert np.abs(one.weights / other.weights - 1).max() > 1e-6
    E = np.eye(base.size)
    updated = jid.update(one, other)
    np.testing.assert_allclose(updated.parameters, tied((one, other), (E, E)).parameters)
    np.testing.assert_allclose(updated.parameters, updated.parameters, rtol=1e-9)
    third = observations(base.model, truths[0], noise=NOISE, seed=3, noise_seed=3)
    again = jid.update(
        updated, jid.identify(base, third, estimator=jid.WeightedLeastSquares(weights))
    )
    with pytest.raises(ValueError, match="have seen the same data, which would count twice"):
        jid.update(again, one)
    with pytest.raises(ValueError, match=r"the two runs `.*` have seen the same data"):
        jid.identify_payload(one, one)
    R, z = again.factor
    np.testing.assert_allclose(np.linalg.lstsq(R, z, rcond=None)[0], again.parameters, rtol=1e-9)


def test_a_run_that_leaves_something_open_still_helps(base, truths):
    cold, _ = truths
    full = observations(base.model, cold, noise=NOISE, seed=1, noise_seed=1)
    still = observations(base.model, cold, noise=NOISE, seed=2, noise_seed=2, still=(1,))
    one, poor = jid.identify(base, full), jid.identify(base, still)
    assert np.isinf(np.diag(poor.covariance)).any()
    updated = jid.update(one, poor)
    together = jid.identify(base, [full, still])
    np.testing.assert_allclose(updated.parameters, together.parameters, rtol=1e-8)
    assert np.isfinite(updated.covariance).all()
    before, after = (np.sqrt(np.diag(r.covariance)) for r in (one, updated))
    k = base.names.index("fv1")
    assert after[k] < 0.95 * before[k]
    # Both are estimates from the residuals' spectra, and scatter by a tenth and more.
    assert np.median(after / before) < 1.25


def test_a_fit_from_a_file_goes_on_exactly(base, truths, tmp_path):
    one, other = (jid.identify(base, o) for o in observed(base, truths))
    again = jid.load(one.save(tmp_path / "cold.json"))
    for a, b in zip(again.factor, one.factor, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(
        jid.update(again, other).parameters, jid.update(one, other).parameters
    )


def test_other_estimates_are_solved_anew_from_their_factors(base, truths):
    one, other = observed(base, truths)
    robust = jid.identify(base, one, jid.estimators.IterativelyReweighted())
    assert not robust.is_least_squares
    np.testing.assert_allclose(
        jid.update(robust, jid.identify(base, other)).parameters,
        jid.update(jid.identify(base, one), jid.identify(base, other)).parameters,
        rtol=1e-9,
    )


def test_refusals(base, truths):
    one, other = (jid.identify(base, o) for o in observed(base, truths))
    with pytest.raises(ValueError, match="two or more with different names, but are cold, cold"):
        jid.identify_states([one, one])
    with pytest.raises(ValueError, match="`fv9` is no base parameter"):
        jid.identify_states([one, other], varying=["fv9"])
    with pytest.raises(ValueError, match="either `varying` or `shared`"):
        jid.identify_states([one, other], varying=["fv1"], shared=["fv2"])
    with pytest.raises(ValueError, match="must be one of cold, warm, but is `hot`"):
        jid.identify_states([one, other], shared=["fv2"]).of("hot")
    bare = jid.base_parameters(jid.Model(base.model.robot, base.model.terms[:3]))
    with pytest.raises(ValueError, match="`cold` and `bare` have different base parameters"):
        jid.update(one, jid.identify(bare, observed(base, truths)[0], name="bare"))
