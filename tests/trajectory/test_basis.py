"""Contract of every basis: matching derivatives, envelopes that hold, retimings."""

import jax
import numpy as np
import pytest

from jaxid.trajectory.fourier import FourierBasis, RestToRestBasis
from jaxid.trajectory.lead_in_and_out import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis

PERIODIC = FourierBasis(5, 0.8)
LEADS = LeadsBasis(3, 0.8, lead=0.4, periods=2)
BASES = {
    "fourier": PERIODIC,
    "rest to rest": RestToRestBasis(4, 0.9),
    "spline": RestToRestSplineBasis(9, 5.0),
    "leads": LEADS,
}
BETWEEN_RESTS = ("rest to rest", "spline", "leads")


@pytest.fixture(params=BASES)
def basis(request):
    return BASES[request.param]


def coefficients(basis, joints=3, seed=0):
    return np.random.default_rng(seed).standard_normal((joints, basis.variables))


def test_each_order_is_the_derivative_of_the_one_before(basis):
    h = 1e-5 * basis.duration
    t = basis.instants(40)[1:-1] + 0.01
    before, rows, after = (basis.rows(x) for x in (t - h, t, t + h))
    for k in range(3):
        slope = (after[k] - before[k]) / (2 * h)
        np.testing.assert_allclose(
            rows[k + 1], slope, atol=1e-6 * np.abs(rows[k + 1]).max()
        )


def test_a_basis_holds_a_constant(basis):
    """So that a robot can stand still at any position."""
    rows = basis.rows(basis.instants(50))
    constant = np.linalg.lstsq(rows[0], np.ones(50), rcond=None)[0]
    np.testing.assert_allclose(rows[0] @ constant, 1.0, atol=1e-9)
    np.testing.assert_allclose(rows[1] @ constant, 0.0, atol=1e-9)


def test_the_trajectory_is_the_rows_times_the_coefficients(basis):
    x = coefficients(basis)
    trajectory, t = basis.trajectory(x), basis.instants(50)[1:-1]
    assert float(trajectory.duration) == pytest.approx(basis.duration)
    motion = trajectory.motion(t)
    _, jerk = jax.jvp(lambda t: trajectory.motion(t).qdd, (t,), (np.ones_like(t),))
    expected = (motion.q, motion.qd, motion.qdd, jerk)
    for rows, values in zip(basis.rows(t), expected, strict=True):
        np.testing.assert_allclose(
            rows @ x.T, values, atol=1e-10 * np.abs(values).max()
        )


@pytest.mark.parametrize("points", [16, 512])
def test_envelopes_bound_the_motion_at_all_times_and_get_tight(basis, points):
    rows, factor = basis.envelope(points)
    fine = basis.rows(basis.instants(5_000))
    for seed in range(5):
        x = coefficients(basis, 1, seed)[0]
        for k in range(4):
            for centre in (0.0, 0.7):
                bound = factor * np.abs(rows[k] @ x - centre).max()
                peak = np.abs(fine[k] @ x - centre).max()
                assert peak <= bound * (1 + 1e-9)
                assert points < 512 or bound <= 1.02 * peak


@pytest.mark.parametrize("name", BETWEEN_RESTS)
def test_stands_still_at_the_ends_and_beyond(name):
    basis = BASES[name]
    x, end = coefficients(basis), float(basis.duration)
    q, *rates = basis.rows(np.array([0.0, end])) @ x.T
    np.testing.assert_allclose(rates[:2], 0.0, atol=1e-11)
    q_beyond, *rates = basis.rows(np.array([-0.1, end + 0.1])) @ x.T
    np.testing.assert_allclose(q_beyond, q, atol=1e-12)
    np.testing.assert_array_equal(rates, 0.0)


def test_a_periodic_motion_begins_later_or_runs_backwards():
    maps, x = PERIODIC.retimings(), coefficients(PERIODIC)
    t, step = PERIODIC.times(23), PERIODIC.duration / 40
    assert len(maps) == 80
    np.testing.assert_allclose(maps[0], np.eye(PERIODIC.variables), atol=1e-12)
    for k in (1, 7, 39):
        later, backwards = (
            PERIODIC.rows(t) @ (x @ T.T).T for T in (maps[k], maps[40 + k])
        )
        np.testing.assert_allclose(later, PERIODIC.rows(t - k * step) @ x.T, atol=1e-9)
        turned = PERIODIC.rows(k * step - t) @ x.T
        turned[1::2] *= -1
        np.testing.assert_allclose(backwards, turned, atol=1e-9)


@pytest.mark.parametrize("name", ["rest to rest", "spline"])
def test_a_motion_between_standstills_only_runs_backwards(name):
    basis = BASES[name]
    maps, x = basis.retimings(), coefficients(basis)
    t = np.linspace(0.0, basis.duration, 41)
    assert len(maps) == 2
    np.testing.assert_allclose(maps[0], np.eye(basis.variables), atol=1e-8)
    ahead, turned = (
        basis.rows(t) @ x.T,
        basis.rows(basis.duration - t) @ (x @ maps[1].T).T,
    )
    for order, sign in enumerate((1.0, -1.0, 1.0)):
        scale = np.abs(ahead[order]).max()
        np.testing.assert_allclose(
            turned[order], sign * ahead[order], atol=1e-7 * scale
        )


def test_a_fourier_series_is_the_papers_sum():
    random, t = np.random.default_rng(0), 1.37
    a, b = random.standard_normal((2, 3, 4))
    offset, k = random.standard_normal(3), np.arange(1, 5)
    expected = (
        offset
        + a @ (np.sin(0.8 * k * t) / (0.8 * k))
        - b @ (np.cos(0.8 * k * t) / (0.8 * k))
    )
    series = FourierBasis(4, 0.8).trajectory(np.column_stack([offset, a, b]))
    np.testing.assert_allclose(series.motion(t).q, expected, atol=1e-14)


def test_leads_are_checked_and_one_period_between_them_is_measured():
    basis = LEADS
    times, instants = basis.times(50), basis.instants(200)
    assert times[0] == pytest.approx(0.4)
    assert times[-1] < 0.4 + basis.series.duration
    np.testing.assert_allclose(instants[[0, -1]], [0.0, basis.duration], atol=1e-12)
    assert (np.diff(instants) > 0).all()
