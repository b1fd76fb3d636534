"""Files of trajectories: exact JSON for this package, CSV tables and ROS messages for others."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxid.errors import InputError
from jaxid.io import from_json, json_text, read_json, to_json, write_text
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory

FORMAT, VERSION = "jaxid trajectory", 2


def save_trajectory(trajectory: AbstractTrajectory, path: str | Path) -> None:
    """Write a trajectory so that `load_trajectory` returns the same numbers, bit by bit.

    Args:
        trajectory: Any trajectory.
        path: Path of the JSON file.

    Raises:
        InputError: If a number is not finite, or the path is a folder.
    """
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(trajectory)):
        raise InputError("a `trajectory` with numbers that are not finite cannot be saved.")
    content = {"format": FORMAT, "version": VERSION, "trajectory": to_json(trajectory)}
    write_text(path, json_text(content))


def load_trajectory(path: str | Path) -> AbstractTrajectory:
    """Read a trajectory that `save_trajectory` has written.

    Args:
        path: Path of the JSON file. Import the modules of your own trajectories before.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it holds no trajectory, or one of another version or an unknown kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"the trajectory file `{path}` does not exist.")
    try:
        content = read_json(path)
    except ValueError as error:
        raise InputError(f"`{path}` is no trajectory file: {error}.") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'`{path}` is no trajectory file: its `format` is not "{FORMAT}".')
    if content.get("version") != VERSION:
        raise InputError(
            f"`{path}` has version {content.get('version')}, but this package reads version "
            f"{VERSION}: load it with the package that wrote it."
        )
    try:
        return from_json(content.get("trajectory"), AbstractTrajectory, "trajectory")
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"`{path}` is damaged: {' '.join(map(str, error.args))}.") from error


def write_csv(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Write a table of samples: time, positions, velocities and accelerations of all joints.

    The header names joint and unit: `time [s],q_joint1 [rad],...,qdd_joint1 [rad/s^2],...`.

    Args:
        trajectory: Trajectory, sampled from its start to its end.
        robot: Robot whose joints move.
        path: Path of the CSV file.
        sample_time: Largest time between two samples [s].

    Raises:
        InputError: If the trajectory does not move the robot's joints, or `sample_time` is not
            positive.
    """
    _check_joints(trajectory, robot)
    times, motion = trajectory.sample(sample_time)
    header = ["time [s]"]
    for symbol, rate in (("q", ""), ("qd", "/s"), ("qdd", "/s^2")):
        header += [
            f"{symbol}_{name} [{robot.joint_unit(j)}{rate}]"
            for j, name in enumerate(robot.joint_names)
        ]
    rows = np.column_stack([times, motion.q, motion.qd, motion.qdd]).tolist()
    lines = [",".join(map(_quote, header)), *(",".join(map(repr, row)) for row in rows)]
    write_text(path, "\n".join(lines) + "\n")


def joint_trajectory(
    trajectory: AbstractTrajectory, robot: Robot, *, sample_time: float
) -> dict[str, Any]:
    """Return the ROS 2 message `trajectory_msgs/JointTrajectory` as dictionaries and lists.

    ROS 1 calls the parts of a time `secs` and `nsecs`.

    Args:
        trajectory: Trajectory, sampled from its start to its end.
        robot: Robot whose joint names the message carries.
        sample_time: Largest time between two points [s].

    Raises:
        InputError: If the trajectory does not move the robot's joints, or `sample_time` is not
            positive.
    """
    _check_joints(trajectory, robot)
    times, motion = trajectory.sample(sample_time)
    nanoseconds = [round(t * 1_000_000_000) for t in times]
    rows = (np.asarray(x).tolist() for x in (motion.q, motion.qd, motion.qdd))
    return {
        "header": {"stamp": _ros_time(0), "frame_id": ""},
        "joint_names": list(robot.joint_names),
        "points": [
            {
                "positions": q,
                "velocities": qd,
                "accelerations": qdd,
                "effort": [],
                "time_from_start": _ros_time(t),
            }
            for t, q, qd, qdd in zip(nanoseconds, *rows, strict=True)
        ],
    }


def write_ros_json(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Write a `JointTrajectory` as JSON; arguments as of `joint_trajectory` and the file's path."""
    message = joint_trajectory(trajectory, robot, sample_time=sample_time)
    write_text(path, json.dumps(message, allow_nan=False) + "\n")


def write_ros_yaml(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Write a `JointTrajectory` as YAML; arguments as of `joint_trajectory` and the file's path.

    `ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory "$(cat FILE)"` publishes it.
    """
    message = joint_trajectory(trajectory, robot, sample_time=sample_time)
    write_text(path, "\n".join(_yaml_lines(message)) + "\n")


def _yaml_lines(message: dict[str, Any]) -> Iterator[str]:
    yield "header:"
    yield f"  stamp: {_yaml_time(message['header']['stamp'])}"
    yield '  frame_id: ""'
    # JSON's strings are YAML's strings in double quotes.
    yield f"joint_names: {json.dumps(message['joint_names'])}"
    yield "points:"
    for point in message["points"]:
        lead = "- "
        for key in ("positions", "velocities", "accelerations", "effort"):
            yield f"{lead}{key}: [{', '.join(map(_yaml_number, point[key]))}]"
            lead = "  "
        yield f"  time_from_start: {_yaml_time(point['time_from_start'])}"


def _ros_time(nanoseconds: int) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}


def _yaml_time(time: dict[str, int]) -> str:
    return f"{{sec: {time['sec']}, nanosec: {time['nanosec']}}}"


def _yaml_number(x: float) -> str:
    """Return a number of YAML 1.1, which would read `1e-05` without a point as text."""
    digits, exponent, power = repr(x).partition("e")
    return digits + ("" if "." in digits else ".0") + exponent + power


def _quote(field: str) -> str:
    """Return a field of a CSV file, in quotes if it holds a separator."""
    return '"' + field.replace('"', '""') + '"' if {",", '"'} & set(field) else field


def _check_joints(trajectory: AbstractTrajectory, robot: Robot) -> None:
    if trajectory.joints != robot.joints:
        raise InputError(
            f"`trajectory` must move the {robot.joints} joints of `{robot.name}`, but moves "
            f"{trajectory.joints}."
        )
