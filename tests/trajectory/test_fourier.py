"""Fourier series: Eq. 34 as printed, exact derivatives, limits that hold between samples."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.robot import library
from jaxid.robot.limits import Limits
from jaxid.trajectory.fourier import FourierSeries, random_fourier_series


def series(seed=0, joints=3, harmonics=4, omega=0.8) -> FourierSeries:
    random = np.random.default_rng(seed)
    a, b = random.standard_normal((2, joints, harmonics))
    return FourierSeries(random.standard_normal(joints), a, b, omega)


def test_is_the_papers_sum():
    s, t = series(), 1.37
    for i in range(3):
        q = s.offset[i]
        for k in range(1, 5):
            q += s.a[i, k - 1] / (0.8 * k) * math.sin(0.8 * k * t)
            q -= s.b[i, k - 1] / (0.8 * k) * math.cos(0.8 * k * t)
        assert float(s.motion(t).q[i]) == pytest.approx(q, abs=1e-14)


def test_derivatives_are_those_of_the_position():
    s = series(1)
    for t in (0.0, 0.4, 12.3):
        m = s.motion(t)
        one = jnp.ones(())
        qd = jax.jvp(lambda x: s.motion(x).q, (jnp.asarray(t),), (one,))[1]
        qdd = jax.jvp(lambda x: s.motion(x).qd, (jnp.asarray(t),), (one,))[1]
        np.testing.assert_allclose(m.qd, qd, atol=1e-12)
        np.testing.assert_allclose(m.qdd, qdd, atol=1e-12)
        h = 1e-4
        after, before = s.motion(t + h), s.motion(t - h)
        np.testing.assert_allclose(m.qd, (after.q - before.q) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(m.qdd, (after.qd - before.qd) / (2 * h), atol=1e-5)


def test_repeats_after_its_period_about_its_offset():
    s = series(2)
    t = np.arange(64) * s.period / 64
    once, again = s.motion(t), s.motion(t + s.period)
    np.testing.assert_allclose(once.q, again.q, atol=1e-12)
    np.testing.assert_allclose(np.mean(once.q, axis=0), s.offset, atol=1e-13)


def test_takes_any_shape_of_times():
    s = series()
    t = np.linspace(0.0, 3.0, 6)
    flat = s.motion(t)
    assert s.motion(0.5).q.shape == (3,)
    np.testing.assert_array_equal(s.motion(t.reshape(2, 3)).qdd.reshape(6, 3), flat.qdd)
    mapped = jax.jit(jax.vmap(lambda x: s.motion(x).qd))(jnp.asarray(t))
    np.testing.assert_allclose(mapped, flat.qd, atol=1e-14)


def test_is_differentiable_in_coefficients_and_frequency():
    s, t = series(3), 2.1
    gradient = jax.grad(lambda x: jnp.sum(x.motion(t).q))(jax.tree.map(jnp.asarray, s))
    w = 0.8 * np.arange(1, 5)
    np.testing.assert_allclose(gradient.a, np.tile(np.sin(w * t) / w, (3, 1)), atol=1e-14)
    np.testing.assert_allclose(gradient.b, np.tile(-np.cos(w * t) / w, (3, 1)), atol=1e-14)
    np.testing.assert_array_equal(gradient.offset, np.ones(3))
    h = 1e-6
    up, down = (FourierSeries(s.offset, s.a, s.b, 0.8 + x).motion(t).q.sum() for x in (h, -h))
    assert float(gradient.omega) == pytest.approx(float(up - down) / (2 * h), rel=1e-6)


@pytest.mark.parametrize("robot", [library.panda(), library.tx90l_on_rail()], ids=lambda r: r.name)
@pytest.mark.parametrize(("harmonics", "seed"), [(1, 0), (5, 1), (20, 2)])
def test_random_series_keeps_and_uses_limits_on_a_finer_grid(robot, harmonics, seed):
    s = random_fourier_series(robot, omega=0.8, harmonics=harmonics, reach=1.0, seed=seed)
    m = s.motion(np.arange(20_000) * s.period / 20_000)
    lim = robot.limits
    slack = 1e-9
    assert (np.asarray(m.q) >= lim.position_min - slack).all()
    assert (np.asarray(m.q) <= lim.position_max + slack).all()
    use = [
        np.ptp(m.q, axis=0) / (lim.position_max - lim.position_min),
        np.abs(m.qd).max(0) / lim.velocity,
        np.abs(m.qdd).max(0) / lim.acceleration,
    ]
    assert np.max(use) <= 1 + slack
    # Every joint meets its tightest limit, up to the bound for what lies between grid points.
    assert np.max(use, axis=0).min() > math.cos(math.pi * harmonics / 512) - 1e-3


def test_reach_leaves_room():
    robot = library.panda()
    s = random_fourier_series(robot, omega=0.8, reach=0.5, seed=3)
    m = s.motion(np.linspace(0.0, s.period, 5000))
    centre = 0.5 * (robot.limits.position_min + robot.limits.position_max)
    half = 0.25 * (robot.limits.position_max - robot.limits.position_min)
    assert (np.abs(np.asarray(m.q) - centre) <= half).all()
    assert (np.abs(m.qd).max(0) <= 0.5 * robot.limits.velocity).all()
    assert (np.abs(m.qdd).max(0) <= 0.5 * robot.limits.acceleration).all()


def test_unknown_limits_are_assumed_as_documented():
    robot = library.tx90l_on_rail()
    robot = robot.replace(limits=Limits(7, position_min=[0.2, *[-np.inf] * 6]))
    s = random_fourier_series(robot, omega=0.8, seed=4)
    m = s.motion(np.linspace(0.0, s.period, 5000))
    assert np.min(m.q[:, 0]) >= 0.2
    assert np.max(m.q[:, 0]) <= 2.2
    assert np.abs(m.q[:, 1:]).max() <= np.pi
    assert np.abs(m.qd[:, 0]).max() <= 0.5
    assert np.abs(m.qd[:, 1:]).max() <= np.pi / 2
    assert np.abs(m.qdd[:, 1:]).max() <= 2 * np.pi


def test_seed_decides():
    robot = library.panda()
    first, again, other = (random_fourier_series(robot, omega=1.0, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(first.a, again.a)
    assert not np.array_equal(first.a, other.a)


@pytest.mark.parametrize(
    "settings", [{"omega": 0.0}, {"omega": 1.0, "harmonics": 0}, {"omega": 1.0, "reach": 1.5}]
)
def test_refuses_what_is_no_series(settings):
    with pytest.raises(ValueError, match=r"`(omega|harmonics|reach)` must be"):
        random_fourier_series(library.panda(), **settings)
