"""Comparisons: how often they err where nothing has changed, and that they see what has."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import jaxid as jid
from jaxid.identification.runs.comparison import Comparison, Verdict
from jaxid.identification.runs.estimates import groups

SIZE, DRAWS = 12, 1500
NAMES = tuple(f"p{k}" for k in range(SIZE))
KINDS = ("bodies",) * 8 + ("friction",) * 4


def estimates(parameters, covariance, freedom=np.inf, label="run"):
    return jid.identification.runs.estimates.Estimates(
        label=label,
        names=NAMES,
        expressions=NAMES,
        units=("kg",) * SIZE,
        groups=KINDS,
        parameters=parameters,
        covariance=covariance,
        freedom=np.full(SIZE, float(freedom)),
    )


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
        found = Comparison.of(estimates(p, a), estimates(q, b))
        alone += np.count_nonzero(found.p_values < 0.05)
        family += Verdict.CHANGED in found.verdicts
        joint += found.groups[0].p_value < 0.05
        outside = np.abs(found.difference) > stats.norm.ppf(0.975) * np.sqrt(np.diag(a))
        wrong += np.count_nonzero(outside)
    # Binomial scatter: three standard deviations of a rate of 0.05 over 1500 draws are 0.017.
    assert abs(alone / DRAWS / SIZE - 0.05) < 0.017
    assert abs(joint / DRAWS - 0.05) < 0.017
    assert family / DRAWS < 0.05 + 0.017
    assert family / DRAWS > 0.02, "the correction must not throw everything away"
    assert wrong / DRAWS / SIZE > 0.1, "the other's interval is the wrong yardstick"


def test_estimated_deviations_widen_intervals_and_joint_tests():
    """Covariances from few samples: with quantiles of the normal law tests err far too often."""
    (a, _), roots, random = covariances(1)
    freedom, A = 30, roots[0]
    rates, normal = np.zeros(2), np.zeros(2)
    for _ in range(1000):
        p = A @ random.normal(size=SIZE)
        scatter = A @ random.normal(size=(SIZE, freedom))
        C = scatter @ scatter.T / freedom
        zero = estimates(np.zeros(SIZE), 1e-20 * a)
        for seen, f in ((rates, freedom), (normal, np.inf)):
            found = Comparison.of(zero, estimates(p, C, f))
            seen += [np.mean(found.p_values < 0.05), found.groups[0].p_value < 0.05]
    np.testing.assert_allclose(rates / 1000, 0.05, atol=0.02)
    assert normal[1] / 1000 > 0.12


def test_a_change_is_found_where_it_is():
    (a, b), _, _ = covariances(2)
    p = np.random.default_rng(0).normal(size=SIZE)
    change = np.zeros(SIZE)
    change[10] = 8.0 * np.sqrt(a[10, 10] + b[10, 10])
    found = Comparison.of(estimates(p, a), estimates(p + change, b))
    assert [k for k, v in enumerate(found.verdicts) if v is Verdict.CHANGED] == [10]
    assert [g.changed for g in found.groups] == [False, True]
    small = Comparison.of(estimates(p, a), estimates(p + 0.27 * change, b))
    assert small.verdicts[10] is Verdict.PERHAPS, "2.2 deviations are no news among twelve"


def test_what_one_run_does_not_determine_is_left_out():
    (a, b), _, _ = covariances(3)
    a = a.copy()
    a[10, 10] = np.inf
    p = np.zeros(SIZE)
    q = p.copy()
    q[10] = 1e9
    found = Comparison.of(estimates(p, a), estimates(q, b))
    assert found.verdicts[10] is Verdict.UNKNOWN
    assert [g.size for g in found.groups] == [8, 3]
    assert not any(g.changed for g in found.groups)
    assert np.isinf(found.half_widths[10])


def test_estimates_of_one_fit_share_their_errors():
    (a, _), _, _ = covariances(4)
    p = np.zeros(SIZE)
    found = Comparison.of(estimates(p, a), estimates(p, a), cross=0.75 * a)
    np.testing.assert_allclose(found.covariance, 0.5 * a)


def test_freedom_of_a_difference_is_that_of_its_larger_part():
    a = np.eye(SIZE)
    p = np.zeros(SIZE)
    found = Comparison.of(estimates(p, a, 10), estimates(p, 1e-6 * a, 40))
    np.testing.assert_allclose(found.freedom, 10.0, rtol=1e-4)
    same = Comparison.of(estimates(p, a, 10), estimates(p, a, 10))
    np.testing.assert_allclose(same.freedom, 20.0)


def test_kinds_are_the_terms_in_words():
    base = jid.base_parameters(jid.Model(jid.robots.tx90l_on_rail()))
    of = dict(zip(base.names, groups(base), strict=True))
    assert of["m1"] == "rigid bodies"
    assert of["fv1"] == "viscous friction"
    assert of["fc7"] == "coulomb friction"
    assert of["Ia7"] == "rotor inertia"


def test_refusals():
    (a, b), _, _ = covariances(5)
    one = estimates(np.zeros(SIZE), a, label="cold")
    other = dataclasses.replace(one, label="warm", names=("x", *NAMES[1:]))
    with pytest.raises(ValueError, match="`cold` has `p0` where `warm` has `x`"):
        Comparison.of(one, other)
    with pytest.raises(ValueError, match=r"`level` must lie between 0 and 1, like 0.95, but is 95"):
        Comparison.of(one, estimates(np.zeros(SIZE), b), 95.0)
