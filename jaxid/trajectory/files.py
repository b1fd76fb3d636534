"""Files of trajectories: exact JSON, CSV tables, ROS messages."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import (
    atomic_folder,
    from_json,
    import_extra,
    json_text,
    read_json,
    to_json,
    write_text,
)
from jaxid.robot.robot import Robot

from .trajectory import AbstractTrajectory

FORMAT = "jaxid trajectory"
VERSION = 2
MESSAGE = "trajectory_msgs/msg/JointTrajectory"
"""Type of the message for ROS 2."""
TOPIC = "/joint_trajectory_controller/joint_trajectory"
"""Topic of the controller that plays it."""


ARRAYS = ("positions", "velocities", "accelerations", "effort")
"""Fields of a point of the message that hold one number for each joint, or none."""


def save_trajectory(trajectory: AbstractTrajectory, path: str | Path) -> None:
    """Write a trajectory so that `load_trajectory` returns the same bits.

    Args:
        trajectory: Any trajectory.
        path: Path of the JSON file.

    Raises:
        InputError: If a number is not finite, or the path is a folder.
    """
    leaves = jax.tree.leaves(trajectory)
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in leaves):
        raise InputError(
            "a `trajectory` with numbers that are not finite cannot be saved."
        )
    content = {"format": FORMAT, "version": VERSION, "trajectory": to_json(trajectory)}
    write_text(path, json_text(content))


def load_trajectory(path: str | Path) -> AbstractTrajectory:
    """Read a trajectory that `save_trajectory` has written.

    Args:
        path: Path of the JSON file. Import the modules of your own trajectories before.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it holds no trajectory, or one of another version or an unknown
            kind.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"the trajectory file `{path}` does not exist.")
    try:
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise InputError(f'its `format` is not "{FORMAT}"')
        if content.get("version") != VERSION:
            raise InputError(
                f"it has version {content.get('version')}, but this package reads "
                f"version {VERSION}: load it with the package that wrote it"
            )
        return from_json(content.get("trajectory"), AbstractTrajectory, "trajectory")
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = " ".join(map(str, error.args))
        raise InputError(f"`{path}` is not a trajectory file: {reason}.") from error


def write_csv(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: str | Path,
    *,
    sample_time: float,
) -> None:
    """Write a table of times, positions, velocities and accelerations.

    The header names joint and unit: `time [s],q_joint1 [rad],...,qdd_joint1
    [rad/s^2],...`. Of a robot on its feet, `tau_JOINT` is the force by nominal
    parameters, and `contact_FOOT` is 1 where the foot is to stand.

    Args:
        trajectory: Trajectory, sampled from its start to its end.
        robot: Robot whose joints move.
        path: Path of the CSV file.
        sample_time: Largest time between two samples [s].

    Raises:
        InputError: If the trajectory does not move the robot's joints, or `sample_time`
            is not positive.
    """
    times, motion = _sample(trajectory, robot, sample_time)
    columns = {"time [s]": times}
    for symbol, rate in (("q", ""), ("qd", "/s"), ("qdd", "/s^2")):
        values = np.asarray(getattr(motion, symbol))
        for j, name in enumerate(robot.joint_names):
            unit = f"{robot.joint_unit(j)}{rate}"
            columns[f"{symbol}_{name} [{unit}]"] = values[:, j]
    forces = trajectory.feed_forward(times)
    if forces is not None:
        for j, name in enumerate(robot.joint_names):
            columns[f"tau_{name} [{robot.force_unit(j)}]"] = np.asarray(forces)[:, j]
    columns |= trajectory.columns(times)
    write_text(path, pl.DataFrame(columns).write_csv())


def write_ros(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: str | Path,
    *,
    sample_time: float,
) -> None:
    """Write a ROS 2 `trajectory_msgs/JointTrajectory` as YAML or bag (`.mcap`).

    The bag holds the message on the topic of a `joint_trajectory_controller`, and needs
    the extra `logs`. YAML begins with comments that say units and cycle, and how to
    bring the robot to the start and publish the file. Arguments are those of
    `write_csv`, and so are the errors.
    """
    times, motion = _sample(trajectory, robot, sample_time)
    forces = trajectory.feed_forward(times)
    efforts = [[]] * len(times) if forces is None else forces.tolist()
    points = []
    for k, time in enumerate(times.tolist()):
        point = {
            "positions": motion.q[k].tolist(),
            "velocities": motion.qd[k].tolist(),
            "accelerations": motion.qdd[k].tolist(),
            "effort": efforts[k],
            "time_from_start": _ros_time(time),
        }
        points.append(point)
    names = list(robot.joint_names)
    if Path(path).suffix == ".mcap":
        _write_bag(names, points, Path(path))
        return
    header = {"stamp": _ros_time(0.0), "frame_id": ""}
    lines = [
        f"# {MESSAGE} of `{robot.name}`: "
        "rad (revolute joints) or m (prismatic joints), and s;",
        f"# at most {sample_time:.6g} s from one point to the next.",
        "# Move the robot slowly to the first point, then:",
        f"#   ros2 topic pub --once {TOPIC} \\",
        f'#     {MESSAGE} "$(cat FILE)"',
        f"header: {json.dumps(header)}",
        f"joint_names: {json.dumps(names)}",
        "points:",
    ]
    for point in points:
        # JSON's values are YAML's values, but YAML 1.1 reads `1e-05`, without a point,
        # as text.
        text = json.dumps(point, allow_nan=False)
        lines.append("- " + re.sub(r"(?<![.\d])(\d+)e", r"\1.0e", text))
    write_text(path, "\n".join(lines) + "\n")


def _write_bag(
    joint_names: list[str],
    points: list[dict[str, Any]],
    path: Path,
):
    """Write the message as a bag of ROS 2 in one file (MCAP)."""
    purpose = f"`{path.name}` is written by"
    typesys = import_extra("rosbags.typesys", "logs", purpose)
    rosbag2 = import_extra("rosbags.rosbag2", "logs", purpose)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    make_time = store.types["builtin_interfaces/msg/Time"]
    make_duration = store.types["builtin_interfaces/msg/Duration"]
    make_header = store.types["std_msgs/msg/Header"]
    make_point = store.types["trajectory_msgs/msg/JointTrajectoryPoint"]

    messages = []
    for point in points:
        duration = make_duration(**point["time_from_start"])
        arrays = [np.array(point[name], np.float64) for name in ARRAYS]
        messages.append(make_point(*arrays, duration))
    header = make_header(stamp=make_time(**_ros_time(0.0)), frame_id="")
    message = store.types[MESSAGE](header, joint_names, messages)
    with atomic_folder(path.parent) as folder:
        bag = folder / "bag"
        plugin = rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(bag, version=9, storage_plugin=plugin) as writer:
            connection = writer.add_connection(TOPIC, MESSAGE, typestore=store)
            writer.write(connection, 0, store.serialize_cdr(message, MESSAGE))
        next(bag.glob("*.mcap")).rename(folder / path.name)
        shutil.rmtree(bag)


def _ros_time(time: float):
    seconds, nanoseconds = divmod(round(time * 1_000_000_000), 1_000_000_000)
    return {"sec": seconds, "nanosec": nanoseconds}


def _sample(
    trajectory: AbstractTrajectory,
    robot: Robot,
    sample_time: float,
):
    """Return times and motion of a trajectory that moves the robot's joints."""
    if trajectory.joints != robot.joints:
        raise InputError(
            f"`trajectory` must move the {robot.joints} joints "
            f"of `{robot.name}`, but moves {trajectory.joints}."
        )
    return trajectory.sample(sample_time)
