"""Files of trajectories: exact JSON for this package, CSV tables and ROS messages for others."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars as pl

from jaxid.dynamics.motion import Motion
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

FORMAT, VERSION = "jaxid trajectory", 2
MESSAGE = "trajectory_msgs/msg/JointTrajectory"
"""Type of the message for ROS 2."""
TOPIC = "/joint_trajectory_controller/joint_trajectory"
"""Topic of the controller that plays it."""


def save_trajectory(trajectory: AbstractTrajectory, path: str | Path) -> None:
    """Write a trajectory so that `load_trajectory` returns the same numbers, bit by bit.

    Args:
        trajectory: Any trajectory.
        path: Path of the JSON file.

    Raises:
        InputError: If a number is not finite, or the path is a folder.
    """
    if not all(
        np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(trajectory)
    ):
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
                "version "
                f"{VERSION}: load it with the package that wrote it"
            )
        return from_json(content.get("trajectory"), AbstractTrajectory, "trajectory")
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = " ".join(map(str, error.args))
        raise InputError(f"`{path}` is no trajectory file: {reason}.") from error


def write_csv(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: str | Path,
    *,
    sample_time: float,
) -> None:
    """Write a table of samples: time, positions, velocities and accelerations of all joints.

    The header names joint and unit: `time [s],q_joint1 [rad],...,qdd_joint1
    [rad/s^2],...`.

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
        for j, name in enumerate(robot.joint_names):
            header = f"{symbol}_{name} [{robot.joint_unit(j)}{rate}]"
            columns[header] = np.asarray(getattr(motion, symbol))[:, j]
    write_text(path, pl.DataFrame(columns).write_csv())


def write_ros(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: str | Path,
    *,
    sample_time: float,
) -> None:
    """Write the ROS 2 message `trajectory_msgs/JointTrajectory` as YAML, or as a bag (`.mcap`).

    The bag holds the message on the topic of a `joint_trajectory_controller`, and needs
    the extra `logs`. YAML begins with comments that say units and cycle, and how to
    bring the robot to the start and publish the file. Arguments are those of
    `write_csv`, and so are the errors.
    """
    times, motion = _sample(trajectory, robot, sample_time)
    rows = (np.asarray(x).tolist() for x in (motion.q, motion.qd, motion.qdd))
    names = list(robot.joint_names)
    message = {
        "header": {"stamp": _ros_time(0.0), "frame_id": ""},
        "joint_names": names,
    }
    keys = ("positions", "velocities", "accelerations", "effort", "time_from_start")
    points = [
        dict(zip(keys, (*row, [], _ros_time(t)), strict=True))
        for t, *row in zip(times.tolist(), *rows, strict=True)
    ]
    if Path(path).suffix == ".mcap":
        _write_bag({**message, "points": points}, Path(path))
        return
    lines = [
        f"# {MESSAGE} of `{robot.name}`: rad (revolute joints) or m (prismatic "
        "joints), and s;",
        f"# at most {sample_time:.6g} s from one point to the next.",
        "# Move the robot slowly to the first point, then:",
        f"#   ros2 topic pub --once {TOPIC} \\",
        f'#     {MESSAGE} "$(cat FILE)"',
        *(f"{key}: {json.dumps(value)}" for key, value in message.items()),
    ]
    # JSON's values are YAML's values, but YAML 1.1 reads `1e-05`, without a point, as
    # text.
    texts = (f"- {json.dumps(point, allow_nan=False)}" for point in points)
    lines += ["points:", *(re.sub(r"(?<![.\d])(\d+)e", r"\1.0e", x) for x in texts)]
    write_text(path, "\n".join(lines) + "\n")


def _write_bag(message: dict[str, Any], path: Path) -> None:
    """Write a message as a bag of ROS 2 in one file (MCAP)."""
    typesys, rosbag2 = (
        import_extra(f"rosbags.{name}", "logs", f"`{path.name}` is written by")
        for name in ("typesys", "rosbag2")
    )
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def typed(name: str, **values: Any) -> Any:
        return store.types[name](**values)

    header = typed(
        "std_msgs/msg/Header",
        stamp=typed("builtin_interfaces/msg/Time", **message["header"]["stamp"]),
        frame_id=message["header"]["frame_id"],
    )
    points = []
    for point in message["points"]:
        time = typed("builtin_interfaces/msg/Duration", **point["time_from_start"])
        arrays = {
            k: np.array(x, np.float64)
            for k, x in point.items()
            if k != "time_from_start"
        }
        name = "trajectory_msgs/msg/JointTrajectoryPoint"
        points.append(typed(name, **arrays, time_from_start=time))
    trajectory_message = typed(
        MESSAGE, header=header, joint_names=message["joint_names"], points=points
    )
    with atomic_folder(path.parent) as folder:
        bag, plugin = folder / "bag", rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(bag, version=9, storage_plugin=plugin) as writer:
            connection = writer.add_connection(TOPIC, MESSAGE, typestore=store)
            writer.write(
                connection, 0, store.serialize_cdr(trajectory_message, MESSAGE)
            )
        next(bag.glob("*.mcap")).rename(folder / path.name)
        shutil.rmtree(bag)


def _ros_time(time: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round(time * 1_000_000_000), 1_000_000_000)
    return {"sec": seconds, "nanosec": nanoseconds}


def _sample(
    trajectory: AbstractTrajectory, robot: Robot, sample_time: float
) -> tuple[np.ndarray, Motion]:
    if trajectory.joints != robot.joints:
        raise InputError(
            f"`trajectory` must move the {robot.joints} joints of `{robot.name}`, but "
            "moves "
            f"{trajectory.joints}."
        )
    return trajectory.sample(sample_time)
