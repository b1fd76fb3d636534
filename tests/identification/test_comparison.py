"""Comparisons: how often they err without a change, and that they see changes."""

import numpy as np
import pytest
from scipy import stats
from virtual import fit_of, planar_base, uncertainty

import jaxid as jid
from jaxid.identification.parameter_changes import Verdict, compare_some

BASE = planar_base()
SIZE, DRAWS = BASE.size, 1500


def fit(parameters, covariance, dof=np.inf):
    return fit_of(BASE, parameters, uncertainty=uncertainty(covariance, dof))


def covariances(seed):
    """Two different covariances with strong correlations and scales far apart."""
    random = np.random.default_rng(seed)
    scale = 10.0 ** random.uniform(-3, 2, SIZE)
    roots = random.normal(size=(2, SIZE, SIZE)) * scale[:, None]
    return [A @ A.T for A in roots], roots, random


def test_false_alarms_are_as_rare_as_promised():
    (a, b), roots, random = covariances(0)
    alone, family, joint, wrong = 0, 0, 0, 0
    for _ in range(DRAWS):
        p, q = (A @ random.normal(size=SIZE) for A in roots)
        found = jid.compare(fit(p, a), fit(q, b))
        alone += np.count_nonzero(found.p_values < 0.05)
        family += Verdict.CHANGED in found.verdicts
        joint += found.groups[0]["p_value"] < 0.05
        outside = np.abs(found.difference) > stats.norm.ppf(0.975) * np.sqrt(np.diag(a))
        wrong += np.count_nonzero(outside)
    # Binomial scatter: three standard deviations of a rate of 0.05 over 1500 draws are
    # 0.017.
    assert abs(alone / DRAWS / SIZE - 0.05) < 0.017
    assert abs(joint / DRAWS - 0.05) < 0.017
    assert 0.02 < family / DRAWS < 0.05 + 0.017
    assert wrong / DRAWS / SIZE > 0.1, "the other's interval is the wrong yardstick"


def test_a_difference_that_is_rounded_to_zero_has_no_sign():
    difference = np.zeros(SIZE)
    difference[:3] = -1e-6, 1e-6, 0.02
    first, second = (fit(p, 1e-4 * np.eye(SIZE)) for p in (0 * difference, difference))
    columns = {c.name: c.values for c in jid.compare(first, second).summary().columns}
    assert columns["difference"][:3] == ("0.000", "0.000", "+0.020")


def test_estimated_deviations_widen_intervals_and_joint_tests():
    """Covariances from few samples, where normal quantiles make tests err too often."""
    (a, _), roots, random = covariances(1)
    dof, A = 30, roots[0]
    rates, normal = np.zeros(2), np.zeros(2)
    for _ in range(1000):
        p = A @ random.normal(size=SIZE)
        scatter = A @ random.normal(size=(SIZE, dof))
        C = scatter @ scatter.T / dof
        zero = fit(np.zeros(SIZE), 1e-20 * a)
        for seen, n in ((rates, dof), (normal, np.inf)):
            found = jid.compare(zero, fit(p, C, n))
            seen += [np.mean(found.p_values < 0.05), found.groups[0]["p_value"] < 0.05]
    np.testing.assert_allclose(rates / 1000, 0.05, atol=0.02)
    assert normal[1] / 1000 > 0.12


def test_a_change_is_found_where_it_is():
    (a, b), _, _ = covariances(2)
    p, change = np.random.default_rng(0).normal(size=SIZE), np.zeros(SIZE)
    change[7] = 8.0 * np.sqrt(a[7, 7] + b[7, 7])
    found = jid.compare(fit(p, a), fit(p + change, b))
    assert [k for k, v in enumerate(found.verdicts) if v is Verdict.CHANGED] == [7]
    assert [g["name"] for g in found.groups if g["changed"]] == ["viscous friction"]
    small = jid.compare(fit(p, a), fit(p + 0.27 * change, b))
    assert small.verdicts[7] is Verdict.PERHAPS, (
        "2.2 deviations are no news among twelve"
    )


def test_undetermined_parameters_are_left_out():
    (a, b), _, _ = covariances(3)
    a[7, 7] = np.inf
    found = jid.compare(fit(np.zeros(SIZE), a), fit(1e9 * np.eye(SIZE)[7], b))
    assert found.verdicts[7] is Verdict.UNKNOWN
    assert [g["parameters"] for g in found.groups] == [6, 1, 2, 2]
    assert not any(g["changed"] for g in found.groups)
    assert np.isinf(found.half_widths[7])


def test_covariance_and_degrees_of_freedom_of_a_difference():
    a, p = np.eye(SIZE), np.zeros(SIZE)
    same = jid.compare(fit(p, a, 10), fit(p, a, 10))
    np.testing.assert_allclose(same.uncertainty.dof, 20.0)
    found = jid.compare(fit(p, a, 10), fit(p, 1e-6 * a, 40))
    np.testing.assert_allclose(found.uncertainty.dof, 10.0, rtol=1e-4)
    (a, _), _, _ = covariances(4)
    k = [6, 7]
    shared = compare_some(fit(p, a), fit(p, a), k, 0.75 * a[np.ix_(k, k)])
    np.testing.assert_allclose(shared.uncertainty.covariance, 0.5 * a[np.ix_(k, k)])
    assert shared.names == ("fv1", "fv2")


@pytest.mark.parametrize(("terms", "length"), [(3, 0.4), (4, 0.5)])
def test_refusals(terms, length):
    one, robot = fit(np.zeros(SIZE), np.eye(SIZE)), jid.robots.planar_arm(2, length)
    other = jid.base_parameters(jid.Model(robot, BASE.model.terms[:terms]))
    with pytest.raises(ValueError, match="have different base parameters"):
        jid.compare(one, fit_of(other, np.zeros(other.size)))
