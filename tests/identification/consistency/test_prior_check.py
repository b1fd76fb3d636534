"""Bodies of a file as a prior: wrong ones are dropped or bounded, good ones help."""

import arms
import numpy as np
import pytest
from virtual import observations

import jaxid as jid
from jaxid.identification.consistency import prior_check
from jaxid.identification.problem import RegressionProblem
from jaxid.result_table import Status


@pytest.fixture(scope="module")
def case():
    """Base parameters, true parameters and noisy observations of an arm."""
    base = jid.base_parameters(jid.Model(jid.robots.panda(), arms.TERMS))
    p = arms.truth(base.model, 1)
    return base, p, observations(base.model, p, samples=400, noise=0.5, seed=1)


def true_bodies(p):
    return p[:70].reshape(7, 10)


def ball(mass, moment):
    body = np.zeros(10)
    body[0], body[4:7] = mass, moment
    return body


def fit(case, bodies):
    base, _, o = case
    pull = jid.consistency.EntropicPull(bodies)
    return jid.identify(base, o, jid.PhysicallyConsistent(pull=pull))


def covered(case, fit):
    """Return the share of determined parameters whose interval holds the truth."""
    base, p, _ = case
    low, high = fit.intervals().T
    truth = np.asarray(base.from_standard(p))
    determined = np.array([x is not Status.BAD for x in fit.trust])
    return np.mean((low <= truth) & (truth <= high), where=determined)


@pytest.mark.parametrize(("mass", "moment"), [(1e-3, 1e-6), (1.0, 1.0)])
def test_placeholders_do_no_harm(case, mass, moment):
    result = fit(case, np.tile(ball(mass, moment), (7, 1)))
    assert result.consistency.residual_increase < 0.02
    assert covered(case, result) > 0.9


def test_bodies_that_predict_worse_are_dropped_with_a_line(case, monkeypatch):
    monkeypatch.setattr(prior_check, "MAX_GROWTH", 0.0)
    result = fit(case, true_bodies(case[1]))
    assert result.consistency.pull.bodies is None
    assert any("not used as a prior" in note for note in result.notes)
    np.testing.assert_array_equal(result.parameters, fit(case, None).parameters)


def test_placeholders_between_good_bodies_do_no_harm(case):
    bodies = true_bodies(case[1]).copy()
    bodies[1::2] = ball(1e-3, 1e-6)
    result = fit(case, bodies)
    # A prior as it is, by contrast, ruins the estimate.
    base, _, o = case
    pull = jid.consistency.EntropicPull(bodies, result.consistency.pull.strength)
    ruined = jid.identify(base, o, jid.PhysicallyConsistent(pull=pull))
    assert ruined.consistency.residual_increase > 1.0
    assert result.consistency.residual_increase < 0.02
    assert covered(case, result) > 0.9


def test_bodies_that_are_about_right_predict_other_motions_better(case):
    base, p, _ = case
    factors = np.random.default_rng(0).uniform(0.7, 1.3, (7, 1))
    result = fit(case, factors * true_bodies(p))
    assert result.consistency.pull.strength in prior_check.STRENGTHS
    assert covered(case, result) > 0.9
    o = observations(base.model, p, samples=400, seed=2)
    errors = [
        np.sum(
            RegressionProblem(base, o).factors.residual_squares(
                np.asarray(x.parameters)
            )
        )
        for x in (result, fit(case, None))
    ]
    assert errors[0] < errors[1]


def test_intervals_hold_those_without_bounds(case):
    base, _, o = case
    result = fit(case, true_bodies(case[1]))
    inner = jid.identify(base, o, jid.WeightedLeastSquares()).intervals()
    outer = result.intervals()
    assert (outer[:, 0] <= inner[:, 0] + 1e-9).all()
    assert (outer[:, 1] >= inner[:, 1] - 1e-9).all()
