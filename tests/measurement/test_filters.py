"""Filters: the laws that every member obeys, and each against its formula or scipy."""

import inspect
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from jaxid.measurement import filters
from jaxid.measurement.filters import (
    AbstractFilter,
    PaperFilter,
    PeriodicFourier,
    Subsample,
    ZeroPhaseButterworth,
)
from jaxid.measurement.filters.low_pass import butterworth

DT = 0.001
OMEGA = 0.8
PERIOD = 2 * np.pi / OMEGA
FILTERS = [
    ZeroPhaseButterworth(15),
    ZeroPhaseButterworth(100, force_cutoff=20.0, margin=0.02),
    ZeroPhaseButterworth(30, order=3, force_cutoff=np.inf),
    PaperFilter(),
    PeriodicFourier(PERIOD, 5),
]
every = pytest.mark.parametrize("filter", FILTERS, ids=lambda f: type(f).__name__)


def fourier(t, seed=1, joints=3, harmonics=5):
    """A Fourier motion and its exact derivatives, without the package (Eq. 34)."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-0.4, 0.4, (2, joints, harmonics))
    wl = OMEGA * np.arange(1, harmonics + 1)
    s, c = np.sin(t[:, None] * wl), np.cos(t[:, None] * wl)
    q = (s @ (a / wl).T) - c @ (b / wl).T + rng.uniform(-1, 1, joints)
    return q, c @ a.T + s @ b.T, -s @ (a * wl).T + c @ (b * wl).T


def test_the_laws_cover_every_filter_and_each_has_a_name():
    members = {
        c
        for _, c in inspect.getmembers(filters, inspect.isclass)
        if issubclass(c, AbstractFilter) and not inspect.isabstract(c)
    }
    assert members == {type(f) for f in FILTERS}, (
        "add it to the list `FILTERS` of this file"
    )
    assert members == {*filters.FILTERS.values()}, "add the filter to `FILTERS`"
    data = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    for name in filters.FILTERS:
        assert f'`"{name}"`' in data, (
            "add a row to the table of filters in docs/data.md"
        )


@every
def test_smoothing_is_linear_and_acts_on_each_column_alone(filter):
    x, y = np.random.default_rng(5).normal(size=(2, 600, 2, 3))
    apart = filter.smooth(x, DT) + 7.0 * filter.smooth(y, DT)
    np.testing.assert_allclose(filter.smooth(x + 7.0 * y, DT), apart, atol=1e-11)
    alone = filter.smooth(x[:, 1, 2], DT)
    np.testing.assert_allclose(filter.smooth(x, DT)[:, 1, 2], alone, atol=1e-13)


@every
def test_constants_pass_unchanged_and_ramps_without_phase(filter):
    t = DT * np.arange(4000)
    np.testing.assert_allclose(
        filter.smooth(np.full((4000, 1), 3.7), DT), 3.7, rtol=1e-10
    )
    edge = max(filter.edge(DT), 1)
    inner = slice(edge, -edge)
    # What is left of the start after the edge is a part of the step that a ramp's end
    # makes.
    np.testing.assert_allclose(filter.smooth(5 * t, DT)[inner], 5 * t[inner], atol=1e-2)


@every
@pytest.mark.parametrize("frequency", [0.5, 3.0, 12.0, 40.0])
def test_sinusoids_pass_with_the_gain_of_the_formula_and_without_phase(
    filter, frequency
):
    low = filter.low_pass(DT)
    n, k = 20000, 2 * np.pi * frequency
    t = DT * np.arange(n)
    gain = low.gain(np.array([frequency]), DT)[0]
    out = filter.smooth(np.stack([np.sin(k * t), np.cos(k * t)], 1), DT)
    middle = slice(8000, 12000)
    for j, wave in enumerate((np.sin, np.cos)):
        expected = gain * wave(k * t[middle])
        np.testing.assert_allclose(out[middle, j], expected, atol=1e-9)


def test_gains_are_the_formulas():
    f = np.array([0.1, 3.0, 15.0, 40.0])
    warped = np.tan(np.pi * f * DT) / np.tan(np.pi * 15 * DT)
    np.testing.assert_allclose(
        ZeroPhaseButterworth(15).low_pass(DT).gain(f, DT),
        1 / (1 + warped**8),
        rtol=1e-9,
    )
    warped = 2 / DT * np.tan(np.pi * f * DT) / 100
    np.testing.assert_allclose(
        PaperFilter().low_pass(DT).gain(f, DT), 1 / (1 + warped**2), rtol=1e-12
    )
    np.testing.assert_array_equal(FILTERS[2].low_pass(DT).gain(f, DT), 1.0)


def test_butterworth_is_scipys():
    x = np.random.default_rng(0).normal(size=(500, 4))
    sos = signal.butter(4, 15, output="sos", fs=1 / DT)
    expected = signal.sosfiltfilt(sos, x, axis=0)
    filter = ZeroPhaseButterworth(15)
    np.testing.assert_allclose(filter.smooth(x, DT), expected, atol=1e-13)
    np.testing.assert_allclose(filter.motion(x, None, DT).q, expected, atol=1e-13)


@every
@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-14])
def test_memory_is_where_the_impulse_response_ends(filter, tolerance):
    low = filter.low_pass(DT)
    n = low.memory(tolerance)
    impulse = np.zeros(4 * n + 401)
    middle = len(impulse) // 2
    impulse[middle] = 1.0
    response = np.abs(low(impulse))
    rounding = 1e-15 * response.max()
    assert response[middle + n + 1 :].max() <= tolerance * response[middle] + rounding
    if n and tolerance > 1e-10:
        assert (
            response[middle + n - 30 : middle + n + 1].max()
            > 0.1 * tolerance * response[middle]
        )


@every
def test_motions_follow_the_desired_ones(filter):
    """The comparison of Fig. 5, with a motion whose derivatives are known."""
    t = DT * np.arange(round(2 * PERIOD / DT))
    q, qd, qdd = fourier(t)
    motion = filter.motion(q, None, DT)
    edge = filter.edge(DT)
    inner = slice(edge, -edge if edge else None)
    for j in range(3):
        for got, true in ((motion.q, q), (motion.qd, qd), (motion.qdd, qdd)):
            assert np.corrcoef(got[inner, j], true[inner, j])[0, 1] > 0.999
        assert np.polyfit(qdd[inner, j], motion.qdd[inner, j], 1)[0] == pytest.approx(
            1, abs=5e-3
        )


@every
@pytest.mark.parametrize("angle", [0.3, 123.456])
def test_a_joint_that_stands_has_no_speed_at_all(filter, angle):
    """Rounding would be a column to least squares, with parameters of 1e15."""
    q = fourier(DT * np.arange(round(PERIOD / DT) + 1))[0]
    q[:, 1] = angle
    speed = np.zeros_like(q)
    for velocities in (None, speed):
        motion = filter.motion(q, velocities, DT)
        assert (motion.q[:, 1] == angle).all()
        assert not motion.qd[:, 1].any()
        assert not motion.qdd[:, 1].any()


def test_butterworth_derivatives_are_of_fourth_order():
    """Difference stencils of second order would lose 6e-3 of a velocity here."""
    dt, k = 0.008, 2 * np.pi * 4
    t = dt * np.arange(1000)
    q = np.sin(k * t)[:, None]
    filter = ZeroPhaseButterworth(30)
    gain = butterworth(30.0, 4, dt).gain(np.array([4.0]), dt)[0]
    motion = filter.motion(q, None, dt)
    inner = slice(100, -100)
    bound = (k * dt) ** 4 / 30 * 1.05
    assert np.abs(motion.qd[inner, 0] / k - gain * np.cos(k * t[inner])).max() < bound
    assert (
        np.abs(motion.qdd[inner, 0] / k**2 + gain * np.sin(k * t[inner])).max() < bound
    )
    measured = filter.motion(q, 2 * k * np.cos(k * t)[:, None], dt)
    assert (
        np.abs(measured.qd[inner, 0] / k - 2 * gain * np.cos(k * t[inner])).max() < 1e-9
    )
    assert (
        np.abs(measured.qdd[inner, 0] / k**2 + 2 * gain * np.sin(k * t[inner])).max()
        < 2 * bound
    )


def test_the_cutoff_is_where_the_gain_is_one_half():
    for filter in FILTERS:
        low = filter.low_pass(DT)
        if np.isfinite(low.cutoff):
            gain = low.gain(np.array([low.cutoff]), DT)
            np.testing.assert_allclose(gain, 0.5, atol=1e-3)


def test_paper_filter_lags_and_attenuates_as_its_formula_says():
    """Forward and backward, G(s) G(-s) gives minus the acceleration: turned sign."""
    t, k = DT * np.arange(16000), 20.0
    motion = PaperFilter(velocity=200.0).motion(np.sin(k * t)[:, None], None, DT)
    w = 2 / DT * math.tan(k * DT / 2)
    lag, gain, t = math.atan(w / 200), w / math.hypot(1, w / 200), t[4000:8000]
    np.testing.assert_allclose(
        motion.qd[4000:8000, 0], gain * np.cos(k * t - lag), atol=1e-8 * k
    )
    assert lag / k == pytest.approx(1 / 200, rel=0.02)
    expected = -(w**2) / (1 + (w / 100) ** 2) * np.sin(k * t)
    np.testing.assert_allclose(motion.qdd[4000:8000, 0], expected, atol=1e-8 * k**2)


def test_periodic_fourier_is_exact_and_rejects_noise():
    t = DT * np.arange(round(3.3 * PERIOD / DT))
    q, qd, qdd = fourier(t)
    filter = PeriodicFourier(PERIOD, 5)
    motion = filter.motion(q, None, DT)
    for got, true in ((motion.q, q), (motion.qd, qd), (motion.qdd, qdd)):
        np.testing.assert_allclose(got, true, atol=1e-11)
    noise = 1e-3 * np.random.default_rng(4).normal(size=q.shape)
    noisy = filter.motion(q + noise, None, DT)
    # Least squares leave sqrt(11 / samples) of white noise.
    assert np.sqrt(np.mean((noisy.q - q) ** 2)) < 2e-3 * math.sqrt(11 / len(t))
    assert np.sqrt(np.mean((noisy.qdd - qdd) ** 2)) < 1e-3


def periodic(periods, harmonics):
    q, _, _ = fourier(DT * np.arange(round(2 * PERIOD / DT)))
    return PeriodicFourier(periods * PERIOD, harmonics).motion(q, None, DT)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: ZeroPhaseButterworth(0.0), "`cutoff` of `ZeroPhaseButterworth`"),
        (lambda: ZeroPhaseButterworth(5.0, margin=-1.0), "`margin`"),
        (lambda: PaperFilter(velocity=-1), "`velocity` of `PaperFilter`"),
        (lambda: PeriodicFourier(0, 5), "`period`"),
        (lambda: periodic(0.9, 5), "joint 1 deviate from a Fourier series .* `period`"),
        (lambda: periodic(2.1, 5), "record whole periods"),
        (lambda: PaperFilter().edge(1 / 380), r"`velocity` .* faster than 381\.972 Hz"),
        (lambda: PaperFilter().motion(np.zeros((99, 1)), None, 1 / 380), "`velocity`"),
        (
            lambda: ZeroPhaseButterworth(70).smooth(np.zeros((99, 1)), 0.008),
            "faster than 140 Hz",
        ),
        (lambda: ZeroPhaseButterworth(5.0, 21), "`order`"),
        (lambda: ZeroPhaseButterworth(5.0, 2.5), "`order`"),
        (lambda: ZeroPhaseButterworth(1e-12).edge(DT), "`cutoff`"),
        (lambda: PaperFilter(10.0, 400.0).edge(0.01), "`acceleration`"),
        (lambda: PeriodicFourier(np.inf, 5).edge(DT), "`10 harmonics / period`"),
        (lambda: PeriodicFourier(1.0, 2.5), "`harmonics`"),
        (lambda: Subsample(0), "`step`"),
    ],
)
def test_refusals(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()
