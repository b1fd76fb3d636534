"""Bounded least squares against scipy, alone and in batches."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import optimize

from jaxid.least_squares import BoundedLevenbergMarquardt, Minimum, search_squares

FREE = (-np.inf, np.inf)


def last_step(residuals, start, bounds=FREE, data=None, rtol=1e-8) -> Minimum:
    """Return the end of a search, or its hundredth step."""
    search = search_squares(residuals, start, bounds, data, rtol)
    *_, last = itertools.islice(search, 100)
    return last


def rosenbrock(x, scale):
    return jnp.stack([scale * (x[1] - x[0] ** 2), 1.0 - x[0]])


def decay(x, data):
    time, values = data
    return x[0] * jnp.exp(-x[1] * time) + x[2] - values


@pytest.fixture(scope="module")
def measured():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 4.0, 60)
    return time, 3.0 * np.exp(-0.8 * time) + 0.5 + 0.02 * rng.standard_normal(60)


def test_a_curved_valley_is_followed_to_its_end():
    minimum = last_step(rosenbrock, np.array([-1.2, 1.0]), data=10.0)
    assert minimum.converged
    np.testing.assert_allclose(minimum.x, [1.0, 1.0], atol=1e-8)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        (-np.inf, np.inf),
        ([0.0, 0.0, 0.6], [np.inf, np.inf, np.inf]),
        ([0.0, 0.0, 0.0], [2.0, 5.0, 1.0]),
        ([0.0, 1.5, 0.7], [2.5, 5.0, 1.0]),
    ],
)
def test_a_fit_within_bounds_is_that_of_scipy(measured, lower, upper):
    start = np.array([1.0, 2.0, 0.9])
    bounds = (np.array(lower), np.array(upper))
    minimum = last_step(decay, start, bounds, measured, rtol=1e-14)
    peer = optimize.least_squares(
        lambda x: np.asarray(decay(x, measured)),
        np.clip(start, lower, upper),
        bounds=(lower, upper),
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert minimum.converged
    np.testing.assert_allclose(minimum.x, peer.x, rtol=1e-6)
    assert (minimum.x >= np.asarray(lower)).all()
    assert (minimum.x <= np.asarray(upper)).all()


def test_a_batch_holds_the_results_of_its_members(measured):
    time, values = measured
    many_values = values + np.linspace(0.0, 1.0, 5)[:, None]
    start = jnp.array([1.0, 1.0, 0.0])

    def fit(values):
        solution = optx.least_squares(
            decay,
            BoundedLevenbergMarquardt(),
            start,
            args=(jnp.asarray(time), values),
            options={"lower": jnp.zeros(3), "upper": jnp.full(3, np.inf)},
            throw=False,
        )
        return solution.value, solution.result == optx.RESULTS.successful

    batch, converged = jax.vmap(fit)(jnp.asarray(many_values))
    assert converged.all()
    bounds = (np.zeros(3), np.full(3, np.inf))
    for k, values in enumerate(many_values):
        alone = last_step(decay, start, bounds, (time, values))
        np.testing.assert_allclose(batch[k], alone.x, rtol=1e-7)


def test_unknowns_without_effect_stay():
    def residuals(x, _):
        return x[:1] - 3.0

    minimum = last_step(residuals, np.array([0.0, 7.0]))
    np.testing.assert_allclose(minimum.x, [3.0, 7.0], atol=1e-6)


def test_a_search_without_end_says_so():
    search = search_squares(rosenbrock, np.array([-1.2, 1.0]), FREE, 10.0, 1e-8)
    first_step = next(search)
    second_step = next(search)
    assert not first_step.converged
    assert not second_step.converged
