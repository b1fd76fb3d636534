"""Filters chosen by held-out errors in one band."""

from typing import Any

import numpy as np
import pytest
import virtual

import jaxid as jid

BASE = virtual.planar_base(3)
MODEL = BASE.model
P = virtual.standard_parameters(MODEL, seed=1)
WLS = jid.estimators.LeastSquares()


def log(step, pace=1.0, noise=0.0, seed=11):
    """20 s at 250 Hz: noise of torques and angles, motion up to 2 Hz."""
    t = np.arange(0.0, 20.0, 0.004)[:, None, None]
    w = 2 * np.pi * pace * np.array([0.3, 0.9, 2.0])[:, None]
    rng = np.random.default_rng(seed)
    phase, a = rng.uniform(0, 6, (3, 3)), np.array([0.7, 0.3, 0.12])[:, None]
    z = a * np.exp(1j * (w * t + phase))
    q, qd, qdd = (np.sum((1j * w) ** k * z, axis=1).imag for k in range(3))
    forces = np.asarray(MODEL.inverse_dynamics(P, jid.Motion(q, qd, qdd)))
    torque_noise = rng.normal(0.0, 0.5, forces.shape)
    angles = q + rng.normal(0.0, noise, q.shape)
    return jid.Recording.of(
        step * np.round(angles / step), forces + torque_noise, time=t.ravel()
    )


def chosen(recordings, *candidates, told=None) -> Any:
    progress = None if told is None else told.append
    filters = tuple(map(jid.ZeroPhaseButterworth, candidates))
    return jid.choose_filter(
        BASE,
        recordings,
        *([filters] if filters else []),
        estimator=WLS,
        progress=progress,
    )


def test_a_filter_is_chosen_between_too_low_and_too_high():
    told = []
    cutoffs = (1.6, 8.0, 16.0, 100.0)
    found = chosen(log(2 * np.pi / 2**16), *cutoffs, told=told)
    assert 4.0 <= found.filter.cutoff <= 32.0
    # Twice the highest frequency of the motion.
    assert found.band == pytest.approx(4.0, rel=0.1)
    np.testing.assert_allclose(found.cutoffs, cutoffs)
    assert found.curve[0] > 1.5 * found.curve.min()
    assert found.curve[-1] > 1.1 * found.curve.min()
    assert told[-1] == 1.0
    assert f"filtered at {found.filter.cutoff:.3g} Hz" in str(found)
    assert f"band of {found.band:.3g} Hz" in str(found)


def test_ten_hertz_stay_where_nothing_is_gained():
    found = chosen(log(2 * np.pi / 2**20, pace=0.5))
    assert found.filter == jid.ZeroPhaseButterworth(10.0)
    assert {2.0, 3.5, 5.0} <= set(found.cutoffs.tolist())


def test_noisy_angles_take_a_lower_cutoff_and_fast_motion_a_higher_one():
    noisy = chosen(log(1e-9, pace=0.5, noise=0.01))
    assert noisy.filter.cutoff < 6.0
    fast = chosen(log(1e-9, pace=4.0))
    # Twice or five times 8 Hz.
    assert fast.filter.cutoff in (16.0, 40.0)


def test_filters_that_take_much_of_a_log_are_left_out():
    first, _ = log(1e-6).split(0.2)
    found = chosen(first)
    assert found.cutoffs.min() > 3.5
    assert found.band > 3.5
    shortest, _ = first.split(0.2)
    alone = chosen(shortest, 2.0, 10.0)
    assert alone.filter == jid.ZeroPhaseButterworth(10.0)
    assert "too short for a choice" in str(alone)


def test_invalid_choices_are_rejected():
    with pytest.raises(ValueError, match="`candidates`"):
        jid.choose_filter(BASE, (), [])
