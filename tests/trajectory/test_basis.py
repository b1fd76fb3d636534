"""Contract of every basis: linear, derivatives that belong together, envelopes that hold."""

import numpy as np
import pytest

from jaxid.trajectory.basis import SHIFTS, FourierBasis
from jaxid.trajectory.leads_basis import LeadsBasis
from jaxid.trajectory.rest import RestToRestBasis
from jaxid.trajectory.spline import RestToRestSplineBasis

BASES = [FourierBasis(5, 0.8), FourierBasis(1, 3.0)]


@pytest.fixture(params=BASES, ids=lambda basis: type(basis).__name__)
def basis(request):
    return request.param


def numbers(basis, joints=3, seed=0):
    return np.random.default_rng(seed).standard_normal((joints, basis.variables))


def test_rows_are_the_trajectorys_motion(basis):
    x, t = numbers(basis), np.linspace(0.0, basis.duration, 17)
    motion, rows = basis.trajectory(x).motion(t), basis.rows(t)
    for k, exact in enumerate((motion.q, motion.qd, motion.qdd)):
        np.testing.assert_allclose(rows[k] @ x.T, exact, atol=1e-12)


def test_each_order_is_the_derivative_of_the_one_before(basis):
    t, h = np.linspace(0.1, 0.9, 9) * basis.duration, 1e-5 * basis.duration
    before, rows, after = (basis.rows(x) for x in (t - h, t, t + h))
    for k in range(3):
        slope = (after[k] - before[k]) / (2 * h)
        np.testing.assert_allclose(rows[k + 1], slope, atol=1e-6 * np.abs(rows[k + 1]).max())


@pytest.mark.parametrize("points", [12, 64, 512])
def test_envelopes_bound_the_motion_at_all_times(basis, points):
    envelope = basis.envelope(points)
    fine = basis.rows(np.linspace(0.0, basis.duration, 4001))
    for seed in range(5):
        x = numbers(basis, 1, seed)[0]
        for k in range(4):
            for centre in (0.0, 0.7):
                bound = envelope.factor * np.abs(envelope.rows[k] @ x - centre).max()
                assert np.abs(fine[k] @ x - centre).max() <= bound * (1 + 1e-12)


def test_envelopes_get_tight(basis):
    assert 1.0 <= basis.envelope(512).factor < 1.001 < basis.envelope(24).factor


def test_refuses_what_is_no_frequency():
    with pytest.raises(ValueError, match="`omega` must be a positive"):
        FourierBasis(5, 0.0)
    with pytest.raises(ValueError, match="`harmonics` must be at least 1"):
        FourierBasis(0, 0.8)


def test_a_periodic_motion_begins_later_or_runs_backwards(basis):
    retimings, x = basis.retimings, numbers(basis)
    t, step = basis.times(23), basis.duration / SHIFTS
    assert len(retimings) == 2 * SHIFTS
    np.testing.assert_allclose(retimings[0], np.eye(basis.variables), atol=1e-12)
    for k in (1, 7, SHIFTS - 1):
        later, backwards = (
            basis.rows(t) @ (x @ T.T).T for T in (retimings[k], retimings[SHIFTS + k])
        )
        np.testing.assert_allclose(later, basis.rows(t - k * step) @ x.T, atol=1e-9)
        turned = basis.rows(k * step - t) @ x.T
        turned[1::2] *= -1
        np.testing.assert_allclose(backwards, turned, atol=1e-9)


@pytest.mark.parametrize(
    "basis",
    [RestToRestBasis(4, 0.9), RestToRestSplineBasis(9, 5.0), LeadsBasis(3, 1.1, lead=0.4)],
    ids=lambda basis: type(basis).__name__,
)
def test_a_motion_between_standstills_only_runs_backwards(basis):
    retimings, x = basis.retimings, numbers(basis)
    t = np.linspace(0.0, basis.duration, 41)
    assert len(retimings) == 2
    np.testing.assert_allclose(retimings[0], np.eye(basis.variables), atol=1e-8)
    own, turned = basis.rows(t) @ x.T, basis.rows(basis.duration - t) @ (x @ retimings[1].T).T
    for order, sign in enumerate((1.0, -1.0, 1.0)):
        scale = np.abs(own[order]).max()
        np.testing.assert_allclose(turned[order], sign * own[order], atol=1e-7 * scale)
