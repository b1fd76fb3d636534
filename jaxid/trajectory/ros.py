"""Trajectories for ROS: the fields of `trajectory_msgs/JointTrajectory` as JSON or YAML."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.robot.robot import Robot
from jaxid.trajectory.files import require_joints, write_text
from jaxid.trajectory.trajectory import AbstractTrajectory

NANOSECONDS = 1_000_000_000


def joint_trajectory(
    trajectory: AbstractTrajectory, robot: Robot, *, sample_time: float
) -> dict[str, Any]:
    """The message `trajectory_msgs/JointTrajectory` (ROS 2) as plain dictionaries and lists.

    ROS 1 calls the parts of a time `secs` and `nsecs`.

    Args:
        trajectory: Sampled from its start to its end.
        robot: Whose joint names it carries.
        sample_time: Largest time between two points [s].

    Raises:
        InputError: If the trajectory has not the robot's joints, or `sample_time` is not positive.
    """
    require_joints(trajectory, robot)
    times, motion = trajectory.sample(sample_time)
    rows = (x.tolist() for x in (np.asarray(motion.q), motion.qd, motion.qdd))
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(robot.joint_names),
        "points": [
            {
                "positions": q,
                "velocities": qd,
                "accelerations": qdd,
                "effort": [],
                "time_from_start": {"sec": t // NANOSECONDS, "nanosec": t % NANOSECONDS},
            }
            for t, q, qd, qdd in zip((round(t * NANOSECONDS) for t in times), *rows, strict=True)
        ],
    }


def write_ros_json(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Writes a `JointTrajectory` as JSON; see `joint_trajectory`.

    Args:
        trajectory: Sampled from its start to its end.
        robot: Whose joint names it carries.
        path: Of the file.
        sample_time: Largest time between two points [s].

    Raises:
        InputError: If the trajectory has not the robot's joints, or `sample_time` is not positive.
    """
    message = joint_trajectory(trajectory, robot, sample_time=sample_time)
    write_text(path, json.dumps(message, allow_nan=False) + "\n")


def write_ros_yaml(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Writes a `JointTrajectory` as YAML; see `joint_trajectory`.

    `ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory "$(cat FILE)"` takes it.

    Args:
        trajectory: Sampled from its start to its end.
        robot: Whose joint names it carries.
        path: Of the file.
        sample_time: Largest time between two points [s].

    Raises:
        InputError: If the trajectory has not the robot's joints, or `sample_time` is not positive.
    """
    message = joint_trajectory(trajectory, robot, sample_time=sample_time)
    write_text(path, "\n".join(_yaml_lines(message)) + "\n")


def _yaml_lines(message: dict[str, Any]) -> Iterator[str]:
    stamp = message["header"]["stamp"]
    yield "header:"
    yield f"  stamp: {_yaml_time(stamp)}"
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


def _yaml_time(time: dict[str, int]) -> str:
    return f"{{sec: {time['sec']}, nanosec: {time['nanosec']}}}"


def _yaml_number(x: float) -> str:
    """A number that YAML 1.1 reads as one: `1e-05` without a point would be a text."""
    digits, exponent, power = repr(x).partition("e")
    return digits + ("" if "." in digits else ".0") + exponent + power
