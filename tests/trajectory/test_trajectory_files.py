"""Files of trajectories: what is read back is what was written, and errors name the file."""

import csv
import json

import jax
import numpy as np
import polars as pl
import pytest
from test_family import FAMILY, PANDA, series

from jaxid.robot import library
from jaxid.trajectory.files import load_trajectory, save_trajectory, write_csv
from jaxid.trajectory.fourier import FourierSeries, random_fourier_series
from jaxid.trajectory.ros import joint_trajectory, write_ros_json, write_ros_yaml


@pytest.mark.parametrize("name", FAMILY)
def test_a_trajectory_comes_back_bit_by_bit(name, tmp_path):
    trajectory = FAMILY[name]
    save_trajectory(trajectory, tmp_path / "t.json")
    loaded = load_trajectory(tmp_path / "t.json")
    assert jax.tree.structure(loaded) == jax.tree.structure(trajectory)
    for x, y in zip(jax.tree.leaves(loaded), jax.tree.leaves(trajectory), strict=True):
        np.testing.assert_array_equal(x, y)
    t = np.linspace(0.0, float(trajectory.duration), 17)
    np.testing.assert_array_equal(loaded.motion(t).qdd, trajectory.motion(t).qdd)


def test_files_that_are_no_trajectories_are_refused(tmp_path):
    path = tmp_path / "t.json"
    with pytest.raises(FileNotFoundError, match=r"t\.json"):
        load_trajectory(path)
    save_trajectory(series(), path)
    good = json.loads(path.read_text())
    for change, message in (
        ({"format": "other"}, "no trajectory file"),
        ({"version": 2}, "version 2"),
        ({"kind": "Waltz"}, "`Waltz`"),
        ({"omega": "fast"}, "no number"),
    ):
        path.write_text(json.dumps({**good, **change}))
        with pytest.raises(ValueError, match=message):
            load_trajectory(path)
    del good["offset"]
    path.write_text(json.dumps(good))
    with pytest.raises(ValueError, match="`offset`"):
        load_trajectory(path)
    path.write_text("{")
    with pytest.raises(ValueError, match=r"t\.json` is no trajectory file"):
        load_trajectory(path)


def test_numbers_that_are_not_finite_are_not_saved(tmp_path):
    s = series()
    with pytest.raises(ValueError, match="not finite"):
        save_trajectory(FourierSeries(s.offset * np.nan, s.a, s.b, 0.8), tmp_path / "t.json")
    assert not list(tmp_path.iterdir())


def test_a_table_has_units_and_exact_numbers(tmp_path):
    robot = library.tx90l_on_rail()
    trajectory = random_fourier_series(robot, omega=0.8, seed=0)
    write_csv(trajectory, robot, tmp_path / "t.csv", sample_time=0.01)
    table = pl.read_csv(tmp_path / "t.csv")
    assert table.columns[:3] == ["time [s]", "q_rail [m]", "q_joint1 [rad]"]
    assert table.columns[8] == "qd_rail [m/s]"
    assert table.columns[-1] == "qdd_joint6 [rad/s^2]"
    times, motion = trajectory.sample(0.01)
    expected = np.column_stack([times, motion.q, motion.qd, motion.qdd])
    np.testing.assert_array_equal(table.to_numpy(), expected)
    assert np.diff(times).max() <= 0.01 + 1e-15
    assert times[-1] == trajectory.period


def test_ros_messages_parse_back(tmp_path):
    yaml = pytest.importorskip("yaml")
    trajectory = FAMILY["rest to rest"]
    message = joint_trajectory(trajectory, PANDA, sample_time=0.05)
    write_ros_json(trajectory, PANDA, tmp_path / "t.json", sample_time=0.05)
    write_ros_yaml(trajectory, PANDA, tmp_path / "t.yaml", sample_time=0.05)
    assert json.loads((tmp_path / "t.json").read_text()) == message
    assert yaml.safe_load((tmp_path / "t.yaml").read_text()) == message
    assert set(message) == {"header", "joint_names", "points"}
    times, motion = trajectory.sample(0.05)
    point, t = message["points"][7], message["points"][-1]["time_from_start"]
    np.testing.assert_array_equal(point["positions"], motion.q[7])
    np.testing.assert_array_equal(point["velocities"], motion.qd[7])
    np.testing.assert_array_equal(point["accelerations"], motion.qdd[7])
    assert t["sec"] + 1e-9 * t["nanosec"] == pytest.approx(times[-1], abs=1e-9)


def test_tiny_numbers_stay_numbers_in_yaml(tmp_path):
    yaml = pytest.importorskip("yaml")
    still = FourierSeries(np.full(7, 1e-7), np.full((7, 2), 1e-12), np.full((7, 2), 3.0), 0.8)
    write_ros_yaml(still, PANDA, tmp_path / "t.yaml", sample_time=1.0)
    points = yaml.safe_load((tmp_path / "t.yaml").read_text())["points"]
    assert all(isinstance(x, float) for p in points for x in p["positions"] + p["velocities"])


def test_another_robots_trajectory_is_refused(tmp_path):
    with pytest.raises(ValueError, match="6 joints of `UR10`, but moves 7"):
        write_csv(series(), library.ur10(), tmp_path / "t.csv", sample_time=0.1)


def test_names_of_joints_may_hold_what_separates_fields(tmp_path):
    yaml = pytest.importorskip("yaml")
    names = ('rail, "x"', "a: b # c", "- d", "e", "null", "g", "h")
    robot = PANDA.replace(joint_names=names)
    write_csv(series(), robot, tmp_path / "t.csv", sample_time=1.0)
    header = next(csv.reader((tmp_path / "t.csv").read_text().splitlines()))
    assert header[1:8] == [f"q_{name} [rad]" for name in names]
    write_ros_yaml(series(), robot, tmp_path / "t.yaml", sample_time=1.0)
    assert yaml.safe_load((tmp_path / "t.yaml").read_text())["joint_names"] == list(names)
