"""Contract of every trajectory, limits of random series and leads, and files."""

import csv
import json
import math
import re

import jax
import numpy as np
import polars as pl
import pytest

from jaxid.errors import InputError
from jaxid.robot import library
from jaxid.robot.limits_and_drives import Limits
from jaxid.trajectory import (
    FourierBasis,
    LeadsBasis,
    LinearTrajectory,
    PaddedToCycle,
    RestToRestBasis,
    RestToRestSplineBasis,
    TipPath,
    iso9283_path,
    joint_path,
    line,
    load_trajectory,
    random_fourier_series,
    save_trajectory,
    with_leads,
    write_csv,
    write_ros,
    write_rsi,
    write_urscript,
)
from jaxid.trajectory.controllers import CONTROLLERS

PANDA = library.panda()
ARM = library.planar_arm(2)
DOWN = np.diag([1.0, -1.0, -1.0])
REST = RestToRestBasis(5, 0.8, periods=2)
POINTS = np.random.default_rng(4).standard_normal((6, 2))


def series(robot=ARM, seed=0, reach=1.0) -> LinearTrajectory:
    return random_fourier_series(robot, omega=0.8, reach=reach, seed=seed)


def jerk(trajectory, times):
    """Derivatives of the accelerations."""
    ones = np.ones_like(times)
    return jax.jvp(lambda t: trajectory.motion(t).qdd, (times,), (ones,))[1]


FAMILY = {
    "series": series(),
    "with leads": with_leads(series(), ARM, periods=2),
    "leads of a basis": LeadsBasis(5, 0.8).trajectory(
        np.asarray(series().coefficients)
    ),
    "spline by handles": RestToRestSplineBasis(6, 2.5).trajectory(POINTS.T),
    "padded": PaddedToCycle(RestToRestSplineBasis(6, 4.0).trajectory(POINTS.T), 0.03),
    "path of the end-effector": joint_path(
        library.tx90l_on_rail(),
        TipPath(
            (line(np.array([0.2, 0.45, 0.65]), np.array([0.0, 0.65, 0.65])),), DOWN
        ),
        posture=[0.0, 1.57, 0.3, 1.6, 0.0, 0.5, 0.0],
    ),
}


@pytest.mark.parametrize("name", FAMILY)
def test_derivatives_belong_together_nothing_jumps_and_ends_are_at_rest(name):
    trajectory, h = FAMILY[name], 1e-5
    times, now = trajectory.sample(2e-3)
    assert times[0] == 0.0
    assert times[-1] == float(trajectory.duration)
    ahead, behind = trajectory.motion(times + h), trajectory.motion(times - h)
    for x, rate in (("q", now.qd), ("qd", now.qdd), ("qdd", jerk(trajectory, times))):
        quotient = (getattr(ahead, x) - getattr(behind, x)) / (2 * h)
        near = np.abs(quotient - rate)[5:-5] <= 1e-5 * (1 + np.abs(rate).max())
        # The jerk of leads jumps where they meet the series.
        assert near.mean() > (0.999 if x != "qdd" else 0.98), (x, near.mean())
        step = np.abs(np.diff(getattr(now, x), axis=0)).max()
        assert step <= 1.5 * np.diff(times).max() * np.abs(rate).max() + 1e-12
    if name != "series":
        np.testing.assert_allclose(now.qd[[0, -1]], 0.0, atol=1e-9)
        np.testing.assert_allclose(now.qdd[[0, -1]], 0.0, atol=1e-7)


def test_any_shape_of_times_and_jit():
    trajectory, t = FAMILY["with leads"], np.linspace(0.0, 3.0, 6)
    assert trajectory.motion(0.5).q.shape == (trajectory.joints,)
    folded = jax.jit(lambda x: trajectory.motion(x).qdd)(t.reshape(2, 3))
    np.testing.assert_allclose(
        folded.reshape(6, -1), trajectory.motion(t).qdd, atol=1e-9
    )


@pytest.mark.parametrize("name", FAMILY)
def test_files_keep_every_bit(name, tmp_path):
    trajectory = FAMILY[name]
    save_trajectory(trajectory, tmp_path / "t.json")
    loaded = load_trajectory(tmp_path / "t.json")
    assert jax.tree.structure(loaded) == jax.tree.structure(trajectory)
    for x, y in zip(jax.tree.leaves(loaded), jax.tree.leaves(trajectory), strict=True):
        np.testing.assert_array_equal(x, y)


def test_splines_start_and_end_at_their_handles_and_keep_to_the_range_of_all():
    ends = FAMILY["spline by handles"].motion(np.array([0.0, 2.5])).q
    np.testing.assert_allclose(ends, POINTS[[0, -1]], atol=1e-12)
    q = np.asarray(FAMILY["spline by handles"].motion(np.linspace(0, 2.5, 1000)).q)
    assert (q <= POINTS.max(axis=0) + 1e-12).all()
    assert (q >= POINTS.min(axis=0) - 1e-12).all()


@pytest.mark.parametrize(
    ("harmonics", "seed", "reach"), [(1, 0, 1.0), (5, 1, 0.5), (20, 2, 1.0)]
)
def test_random_series_keep_and_use_limits_on_a_finer_grid(harmonics, seed, reach):
    robot = library.tx90l_on_rail()
    s = random_fourier_series(
        robot, omega=0.8, harmonics=harmonics, reach=reach, seed=seed
    )
    m = jax.tree.map(np.asarray, s.motion(np.arange(5_000) * s.duration / 5_000))
    lim = robot.limits
    middle = 0.5 * (lim.position_min + lim.position_max)
    half = lim.position_max - middle
    assert np.max(np.abs(m.q - middle) / half) <= reach + 1e-9
    use = [
        np.ptp(m.q, axis=0) / (2 * half),
        np.abs(m.qd).max(0) / lim.velocity,
        np.abs(m.qdd).max(0) / lim.acceleration,
    ]
    assert np.max(use) <= reach + 1e-9
    # Every joint meets its tightest limit, up to the bound for what lies between grid
    # points.
    assert np.max(use, axis=0).min() > reach * (
        math.cos(math.pi * harmonics / 512) - 1e-3
    )


def test_unknown_limits_are_assumed_as_documented():
    robot = library.tx90l_on_rail()
    robot = robot.replace(limits=Limits(7, position_min=[0.2, *[-np.inf] * 6]))
    s = random_fourier_series(robot, omega=0.8, seed=4)
    m = s.motion(np.linspace(0.0, s.duration, 5000))
    assert 0.2 <= np.min(m.q[:, 0]) <= np.max(m.q[:, 0]) <= 2.2
    assert np.abs(m.qd[:, 0]).max() <= 0.5
    for x, limit in ((m.q, np.pi), (m.qd, np.pi / 2), (m.qdd, 2 * np.pi)):
        assert np.abs(x[:, 1:]).max() <= limit


def test_leads_keep_the_limits_and_follow_the_series_between():
    robot = PANDA
    for seed in range(2):
        inner = series(robot, seed)
        led = with_leads(inner, robot, periods=2)
        times = np.linspace(0.0, float(led.duration), 5_000)
        m, lim = jax.tree.map(np.asarray, led.motion(times)), robot.limits
        assert np.max([m.q - lim.position_max, lim.position_min - m.q]) <= 1e-8
        assert (
            np.max(np.abs([m.qd / lim.velocity, m.qdd / lim.acceleration])) <= 1 + 1e-8
        )
        assert (np.abs(np.asarray(jerk(led, times))) / lim.jerk).max() <= 1 + 1e-6
        begin, end = (float(x) for x in led.window)
        assert end - begin == pytest.approx(2 * inner.duration)
        t = np.linspace(begin, end, 300)
        expected = inner.motion(t - begin + led.start).q
        np.testing.assert_allclose(led.motion(t).q, expected, atol=1e-9)
        assert begin < 1.0


LAZY = PANDA.replace(limits=Limits(7, acceleration=[*[10.0] * 6, 1e-3]))
SIDE = line(np.zeros(3), np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: RestToRestBasis(5, 0.8, periods=0), "`periods`"),
        (lambda: RestToRestBasis(1, 0.8), "`harmonics`"),
        (lambda: FourierBasis(5, 0.0), "`omega`"),
        (lambda: LeadsBasis(3, 1.1, lead=0.0), "`lead`"),
        (lambda: random_fourier_series(ARM, omega=1.0, harmonics=0), "`harmonics`"),
        (lambda: random_fourier_series(ARM, omega=1.0, reach=1.5), "`reach`"),
        (lambda: with_leads(series(), ARM, periods=0), "`periods`"),
        (lambda: with_leads(series(), PANDA), "`series`"),
        (lambda: with_leads(series(PANDA), LAZY), "`joint7`"),
        (lambda: RestToRestSplineBasis(1, 1.0), "`points`"),
        (lambda: RestToRestSplineBasis(5, -1.0), "`duration`"),
        (lambda: series().sample(0.0), "`sample_time`"),
        (lambda: iso9283_path([0.0, 0.0], 1.0, DOWN), "centre"),
        (lambda: TipPath((SIDE,), DOWN, speed=0.0), "speed"),
        (lambda: TipPath((), DOWN), "pieces"),
        (lambda: TipPath((SIDE, SIDE), DOWN), "piece 2 of `pieces`"),
        (lambda: TipPath((line(np.zeros(3), np.zeros(3)),), DOWN), "finite length"),
    ],
)
def test_refuses(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_files_that_hold_no_trajectory_are_refused(tmp_path):
    path = tmp_path / "t.json"
    with pytest.raises(FileNotFoundError, match=r"t\.json"):
        load_trajectory(path)
    s = series()
    with pytest.raises(ValueError, match="`trajectory`"):
        save_trajectory(s.basis.trajectory(s.coefficients * np.nan), path)
    assert not path.exists()
    save_trajectory(s, path)
    good = json.loads(path.read_text())
    inner = good["trajectory"]
    for change, name in (
        ({"format": "other"}, "`format`"),
        ({"trajectory": {**inner, "kind": "Waltz"}}, "`Waltz`"),
        (
            {"trajectory": {**inner, "coefficients": "fast"}},
            r"`trajectory\.coefficients`",
        ),
    ):
        path.write_text(json.dumps({**good, **change}))
        with pytest.raises(ValueError, match=name):
            load_trajectory(path)


def test_a_table_has_units_and_exact_numbers(tmp_path):
    robot = library.tx90l_on_rail()
    trajectory = random_fourier_series(robot, omega=0.8, seed=0)
    write_csv(trajectory, robot, tmp_path / "t.csv", sample_time=0.01)
    table = pl.read_csv(tmp_path / "t.csv")
    names = [table.columns[k] for k in (0, 1, 8, -1)]
    assert names == ["time [s]", "q_rail [m]", "qd_rail [m/s]", "qdd_joint6 [rad/s^2]"]
    times, motion = trajectory.sample(0.01)
    expected = np.column_stack([times, motion.q, motion.qd, motion.qdd])
    np.testing.assert_array_equal(table.to_numpy(), expected)
    with pytest.raises(
        ValueError, match="`trajectory` must move the 6 joints of `UR10`"
    ):
        write_csv(series(), library.ur10(), tmp_path / "t.csv", sample_time=0.1)


def test_a_bag_of_ros_2_holds_the_motion_bit_by_bit(tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel")
    robot = library.panda()
    motion = random_fourier_series(robot, omega=0.8, seed=0)
    write_ros(motion, robot, tmp_path / "motion.ros.mcap", sample_time=0.01)
    assert [path.name for path in tmp_path.iterdir()] == ["motion.ros.mcap"]
    with rosbags.AnyReader([tmp_path / "motion.ros.mcap"]) as bag:
        ((connection, _, data),) = bag.messages()
        message = bag.deserialize(data, connection.msgtype)
    assert connection.topic == "/joint_trajectory_controller/joint_trajectory"
    assert connection.msgtype == "trajectory_msgs/msg/JointTrajectory"
    assert tuple(message.joint_names) == robot.joint_names
    times, expected = motion.sample(0.01)
    for name, short in (
        ("positions", "q"),
        ("velocities", "qd"),
        ("accelerations", "qdd"),
    ):
        found = [getattr(point, name) for point in message.points]
        np.testing.assert_array_equal(found, getattr(expected, short))
    found = [
        p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points
    ]
    np.testing.assert_allclose(found, times, rtol=0, atol=1e-9)
    # The independent reader of MCAP finds the same bytes.
    reader = pytest.importorskip("mcap.reader")
    with (tmp_path / "motion.ros.mcap").open("rb") as file:
        ((schema, channel, single),) = reader.make_reader(file).iter_messages()
    assert (schema.name, channel.message_encoding) == (connection.msgtype, "cdr")
    assert single.data == bytes(data)


def test_universal_robots_play_every_position_in_turn(tmp_path):
    robot = library.ur10()
    motion = random_fourier_series(robot, omega=0.8, seed=0)
    write_urscript(motion, robot, tmp_path / "motion.script", 0.008)
    head, *lines = (tmp_path / "motion.script").read_text().splitlines()
    first, start, *played, stop, end = lines
    assert head.startswith("# Motion of `UR10`: 983 positions [rad], one in 0.008 s")
    assert (first, stop, end) == ("def play_motion():", "  stopj(2.0)", "end")
    pattern = re.compile(r"  servoj\(\[(.*)\], 0, 0, 0\.008, 0\.1, 300\)")
    rows = [
        [float(x) for x in pattern.fullmatch(line)[1].split(", ")] for line in played
    ]
    np.testing.assert_allclose(rows, motion.sample(0.008)[1].q, rtol=0, atol=5.1e-10)
    assert (
        start
        == f"  movej({played[0].partition('(')[2].partition(', 0, 0')[0]}, a=0.5, "
        "v=0.3)"
    )
    assert "e-" not in "".join(played)


def test_rsi_gets_degrees_from_the_start(tmp_path):
    robot = library.ur10()
    motion = random_fourier_series(robot, omega=0.8, seed=0)
    write_rsi(motion, robot, tmp_path / "motion.rsi.csv", 0.004)
    table = pl.read_csv(tmp_path / "motion.rsi.csv")
    assert table.columns == [f"AK.A{k} [deg]" for k in range(1, 7)]
    q = motion.sample(0.004)[1].q
    np.testing.assert_allclose(
        table.to_numpy() * np.pi / 180, q - q[0], rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("robot", [library.tx90l_on_rail(), library.panda()])
def test_a_controller_refuses_another_robot(robot):
    with pytest.raises(
        InputError, match="`controller` moves robots of 6 revolute joints, but `"
    ):
        CONTROLLERS["universal_robots"].require(robot)


def test_ros_messages_parse_back(tmp_path):
    yaml = pytest.importorskip("yaml")
    # Tiny numbers and separators in names survive.
    coefficients = np.tile([1e-7, 1e-12, 1e-12, 3.0, 3.0], (2, 1))
    tiny = FourierBasis(2, 0.8).trajectory(coefficients)
    names = ('rail, "x"', "1e-5: b # c")
    robot = ARM.replace(joint_names=names)
    write_ros(tiny, robot, tmp_path / "t.yaml", sample_time=0.5)
    message = yaml.safe_load((tmp_path / "t.yaml").read_text())
    assert message["joint_names"] == list(names)
    times, motion = tiny.sample(0.5)
    point, t = message["points"][7], message["points"][-1]["time_from_start"]
    rows = [point[key] for key in ("positions", "velocities", "accelerations")]
    np.testing.assert_array_equal(rows, [motion.q[7], motion.qd[7], motion.qdd[7]])
    assert t["sec"] + 1e-9 * t["nanosec"] == pytest.approx(times[-1], abs=1e-9)
    write_csv(tiny, robot, tmp_path / "t.csv", sample_time=1.0)
    with (tmp_path / "t.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert header[1:3] == [f"q_{name} [rad]" for name in names]
