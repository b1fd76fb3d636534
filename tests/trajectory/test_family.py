"""The contract of every trajectory and basis, limits of leads, and the members' own laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.robot import library
from jaxid.robot.limits import Limits
from jaxid.trajectory.basis import FourierBasis
from jaxid.trajectory.fourier import FourierSeries, random_fourier_series
from jaxid.trajectory.held import Held
from jaxid.trajectory.iso9283 import iso9283_path
from jaxid.trajectory.joint_path import joint_path
from jaxid.trajectory.leads import WithLeads, with_leads
from jaxid.trajectory.leads_basis import LeadsBasis
from jaxid.trajectory.rest import RestToRest, RestToRestBasis, rest_basis
from jaxid.trajectory.segments import Segments
from jaxid.trajectory.spline import RestToRestSplineBasis, Spline

PANDA = library.panda()
POINTS = np.random.default_rng(4).standard_normal((6, 7))


def series(seed=0, reach=1.0) -> FourierSeries:
    return random_fourier_series(PANDA, omega=0.8, reach=reach, seed=seed)


def chain() -> Segments:
    first, last = Spline.through(POINTS, 3.0), Spline.through(POINTS[::-1], 2.0)
    middle = RestToRest.of(series(1))
    start = middle.motion(0.0).q
    return Segments.of(
        first,
        Spline.through([POINTS[-1], start], 1.5),
        middle,
        Spline.through([start, POINTS[-1]], 1.0),
        last,
    )


FAMILY = {
    "series": series(),
    "rest to rest": RestToRest.of(series(), periods=2),
    "with leads": with_leads(series(), PANDA, periods=2),
    "spline": Spline(POINTS, 2.5),
    "spline at rest": Spline.at_rest(POINTS, 2.5),
    "spline through points": Spline.through(POINTS, 4.0),
    "held": Held(Spline.through(POINTS, 4.0), 0.03),
    "segments": chain(),
    "path of the end-effector": joint_path(
        library.tx90l_on_rail(),
        iso9283_path([0.0, 0.65, 0.65], 0.5, np.diag([1.0, -1.0, -1.0]), acceleration=3.0),
        posture=[0.0, 1.57, 0.3, 1.6, 0.0, 0.5, 0.0],
        spacing=0.05,
    ),
}
AT_REST = (
    "rest to rest",
    "with leads",
    "spline at rest",
    "spline through points",
    "held",
    "segments",
    "path of the end-effector",
)
BASES = (
    FourierBasis(5, 0.8),
    RestToRestBasis(5, 0.8),
    RestToRestSplineBasis(9, 6.0),
    LeadsBasis(5, 0.8, lead=0.4, periods=2),
)


@pytest.mark.parametrize("name", FAMILY)
def test_derivatives_are_those_of_the_position(name):
    trajectory = FAMILY[name]
    duration = float(trajectory.duration)
    t = np.random.default_rng(0).uniform(0.01 * duration, 0.99 * duration, 400)
    h = 1e-5
    ahead, behind, now = trajectory.motion(t + h), trajectory.motion(t - h), trajectory.motion(t)
    for x, derivative in (("q", now.qd), ("qd", now.qdd), ("qdd", trajectory.jerk(t))):
        quotient = (getattr(ahead, x) - getattr(behind, x)) / (2 * h)
        near = np.abs(quotient - derivative) <= 1e-5 * (1 + np.abs(derivative).max())
        # The jerk of leads and segments jumps where they meet.
        assert near.mean() > (0.999 if x != "qdd" else 0.98), (x, near.mean())


@pytest.mark.parametrize("name", FAMILY)
def test_nothing_jumps(name):
    trajectory = FAMILY[name]
    times, m = trajectory.sample(2e-3)
    assert times[0] == 0.0
    assert times[-1] == float(trajectory.duration)
    for x, rate in ((m.q, m.qd), (m.qd, m.qdd), (m.qdd, trajectory.jerk(times))):
        step = np.abs(np.diff(x, axis=0)).max()
        assert step <= 1.5 * np.diff(times).max() * np.abs(rate).max() + 1e-12


@pytest.mark.parametrize("name", FAMILY)
def test_any_shape_of_times_and_jit(name):
    trajectory = FAMILY[name]
    t = np.linspace(0.0, float(trajectory.duration), 6)
    flat = trajectory.motion(t)
    assert trajectory.motion(0.5).q.shape == (trajectory.joints,)
    folded = jax.jit(lambda x: trajectory.motion(x))(t.reshape(2, 3))
    np.testing.assert_allclose(folded.qdd.reshape(6, 7), flat.qdd, atol=1e-9)
    mapped = jax.vmap(trajectory.jerk)(jnp.asarray(t))
    np.testing.assert_allclose(mapped, trajectory.jerk(t), atol=1e-9)


@pytest.mark.parametrize("name", AT_REST)
def test_stands_still_at_both_ends(name):
    trajectory = FAMILY[name]
    for t in (0.0, float(trajectory.duration)):
        m = trajectory.motion(t)
        np.testing.assert_allclose(m.qd, 0.0, atol=1e-12)
        np.testing.assert_allclose(m.qdd, 0.0, atol=1e-11)


def test_a_series_at_rest_is_the_nearest_one_and_stays_so():
    once = RestToRest.of(series())
    again = RestToRest.of(once.series)
    np.testing.assert_allclose(again.series.a, once.series.a, atol=1e-15)
    np.testing.assert_allclose(again.series.b, once.series.b, atol=1e-15)
    x = np.concatenate([np.zeros((7, 1)), series().a, series().b], axis=1)
    Z = rest_basis(5)
    nearest = x @ Z @ Z.T
    np.testing.assert_allclose(nearest[:, 1:6], once.series.a, atol=1e-14)
    np.testing.assert_allclose(nearest[:, 6:], once.series.b, atol=1e-14)
    assert Z.shape == (11, 9)
    # Not at rest by itself: the conditions do something.
    assert np.abs(series().motion(0.0).qd).max() > 0.1


@pytest.mark.parametrize("basis", BASES, ids=lambda b: type(b).__name__)
def test_a_basis_gives_the_motion_of_its_trajectory(basis):
    x = np.random.default_rng(1).standard_normal((3, basis.variables))
    trajectory = basis.trajectory(x)
    assert float(trajectory.duration) == pytest.approx(basis.duration)
    t = basis.instants(50)[1:-1]
    motion = trajectory.motion(t)
    expected = (motion.q, motion.qd, motion.qdd, trajectory.jerk(t))
    for rows, values in zip(basis.rows(t), expected, strict=True):
        np.testing.assert_allclose(rows @ x.T, values, atol=1e-10 * np.abs(values).max())


@pytest.mark.parametrize("basis", BASES, ids=lambda b: type(b).__name__)
@pytest.mark.parametrize("points", [16, 64, 512])
def test_the_envelope_bounds_a_finer_grid_and_grows_tight(basis, points):
    rows, factor = basis.envelope(points)
    t = basis.instants(20_000)
    fine = basis.rows(t)
    for seed in range(5):
        x = np.random.default_rng(seed).standard_normal(basis.variables)
        for order in range(4):
            bound = factor * np.abs(rows[order] @ x).max()
            peak = np.abs(fine[order] @ x).max()
            assert peak <= bound * (1 + 1e-9)
            if points == 512:
                assert bound <= 1.02 * peak


def test_a_spline_goes_through_its_points():
    trajectory = Spline.through(POINTS, 5.0)
    np.testing.assert_allclose(trajectory.motion(np.arange(6.0)).q, POINTS, atol=1e-12)


def test_a_spline_keeps_to_the_range_of_its_points():
    q = Spline.at_rest(POINTS, 5.0).motion(np.linspace(0, 5, 1000)).q
    assert (np.asarray(q) <= POINTS.max(axis=0) + 1e-12).all()
    assert (np.asarray(q) >= POINTS.min(axis=0) - 1e-12).all()


@pytest.mark.parametrize("robot", [PANDA, library.tx90l_on_rail()], ids=lambda r: r.name)
def test_leads_keep_the_limits_and_follow_the_series_between(robot):
    for seed in range(4):
        inner = random_fourier_series(robot, omega=0.8, reach=1.0, seed=seed)
        led = with_leads(inner, robot, periods=2)
        times = np.linspace(0.0, float(led.duration), 40_000)
        m, lim = jax.tree.map(np.asarray, led.motion(times)), robot.limits
        assert np.max([m.q - lim.position_max, lim.position_min - m.q]) <= 1e-8
        assert (np.abs(m.qd) / lim.velocity).max() <= 1 + 1e-8
        assert (np.abs(m.qdd) / lim.acceleration).max() <= 1 + 1e-8
        assert (np.abs(np.asarray(led.jerk(times))) / lim.jerk).max() <= 1 + 1e-6
        begin, end = (float(x) for x in led.window)
        assert end - begin == pytest.approx(2 * inner.period)
        t = np.linspace(begin, end, 300)
        np.testing.assert_allclose(
            led.motion(t).q, inner.motion(t - begin + led.start).q, atol=1e-9
        )
        assert begin < 1.0


def test_leads_that_no_limit_allows_name_the_joint():
    robot = PANDA.replace(
        limits=Limits(7, velocity=PANDA.limits.velocity, acceleration=[*[10.0] * 6, 1e-3])
    )
    with pytest.raises(ValueError, match="joint `joint7` exceeds"):
        with_leads(series(), robot)


def test_segments_that_do_not_meet_are_refused():
    first, second = Spline.through(POINTS, 1.0), Spline.through(POINTS, 1.0)
    with pytest.raises(ValueError, match=r"the coordinate of joint \d jumps by"):
        Segments.of(first, second)
    with pytest.raises(ValueError, match="velocity of joint"):
        Segments.of(
            first,
            FourierSeries(
                POINTS[-1] + series().b @ (1 / np.arange(1, 6)) / 0.8, series().a, series().b, 0.8
            ),
        )
    with pytest.raises(ValueError, match="same joints"):
        Segments.of(first, Spline.through(POINTS[:, :3], 1.0))
    with pytest.raises(ValueError, match="at least one"):
        Segments.of()


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: RestToRest.of(series(), periods=0), "periods"),
        (lambda: RestToRestBasis(1, 0.8), "harmonics"),
        (lambda: with_leads(series(), PANDA, periods=0), "periods"),
        (lambda: with_leads(series(), library.ur10()), "series"),
        (lambda: Spline.through(POINTS[:1], 1.0), "points"),
        (lambda: Spline.at_rest(POINTS, 0.0), "duration"),
        (lambda: RestToRestSplineBasis(1, 1.0), "points"),
        (lambda: RestToRestSplineBasis(5, -1.0), "duration"),
        (lambda: series().sample(0.0), "sample_time"),
    ],
)
def test_refuses(make, named):
    with pytest.raises(ValueError, match=f"`{named}` must"):
        make()


def test_leads_are_differentiable_in_their_series():
    led = with_leads(series(), PANDA)

    def end(a):
        inner = FourierSeries(led.inner.offset, a, led.inner.b, 0.8)
        return jnp.sum(
            WithLeads(inner, led.start, led.length, led.lead_in, led.lead_out)
            .motion(np.linspace(0.0, 9.0, 40))
            .q
            ** 2
        )

    a, h = jnp.asarray(led.inner.a), 1e-6
    direction = np.random.default_rng(0).standard_normal(a.shape)
    quotient = (end(a + h * direction) - end(a - h * direction)) / (2 * h)
    assert float(jnp.sum(jax.grad(end)(a) * direction)) == pytest.approx(float(quotient), rel=1e-7)
