"""Filters chosen by held-out errors."""

import numpy as np
import pytest
import virtual

import jaxid as jid

BASE = virtual.planar_base(3)
MODEL = BASE.model
P = virtual.standard_parameters(MODEL, seed=1)
WLS = jid.estimators.LeastSquares()


@pytest.fixture(scope="module")
def noisy_log():
    """20 s at 250 Hz: encoders of 16 bits, torque noise, motion up to 2 Hz."""
    t = np.arange(0.0, 20.0, 0.004)[:, None, None]
    w = 2 * np.pi * np.array([0.3, 0.9, 2.0])[:, None]
    rng = np.random.default_rng(11)
    phase, a = rng.uniform(0, 6, (3, 3)), np.array([0.7, 0.3, 0.12])[:, None]
    z = a * np.exp(1j * (w * t + phase))
    q, qd, qdd = (np.sum((1j * w) ** k * z, axis=1).imag for k in range(3))
    forces = np.asarray(MODEL.inverse_dynamics(P, jid.Motion(q, qd, qdd)))
    bits = 2 * np.pi / 2**16
    noise = rng.normal(0.0, 0.5, forces.shape)
    return jid.Recording.of(bits * np.round(q / bits), forces + noise, time=t.ravel())


CUTOFFS = (0.5, 8.0, 16.0, 100.0)


def test_a_filter_is_chosen_between_too_low_and_too_high(noisy_log):
    candidates = [
        (
            jid.ZeroPhaseButterworth(f),
            jid.Subsample(max(1, int(1.0 / (5.0 * f * 0.004)))),
        )
        for f in CUTOFFS
    ]
    told = []
    found = jid.choose_filter(
        BASE, noisy_log, candidates, estimator=WLS, progress=told.append
    )
    best = CUTOFFS[found.best]
    assert 4.0 <= best <= 32.0
    assert found.filter.cutoff == best
    assert found.curve[0] > 1.5 * found.curve.min()
    assert found.curve[-1] > 1.1 * found.curve.min()
    assert told[-1] == 1.0


def test_invalid_choices_are_rejected():
    with pytest.raises(ValueError, match="`candidates`"):
        jid.choose_filter(BASE, (), [])
