"""Trajectories as files: exact and versioned for this package, a table of samples for others."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.io import atomic_folder, read_json
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import FourierSeries
from jaxid.trajectory.held import Held
from jaxid.trajectory.joint_path import JointPath
from jaxid.trajectory.leads import WithLeads
from jaxid.trajectory.rest import RestToRest
from jaxid.trajectory.segments import Segments
from jaxid.trajectory.spline import Spline
from jaxid.trajectory.trajectory import AbstractTrajectory

FORMAT = "jaxid trajectory"
VERSION = 1
MEMBERS = (FourierSeries, RestToRest, WithLeads, Spline, Segments, JointPath, Held)
"""What a file may hold, each by the name of its class."""


def save_trajectory(trajectory: AbstractTrajectory, path: str | Path) -> None:
    """Writes a trajectory so that `load_trajectory` gives back the same numbers, bit by bit.

    Args:
        trajectory: A member of the family.
        path: Of the JSON file.

    Raises:
        InputError: If a number is not finite, or the path is a folder.
    """
    content = {"format": FORMAT, "version": VERSION, **_record(trajectory)}
    try:
        text = json.dumps(content, indent=1, allow_nan=False)
    except ValueError as error:
        raise InputError(
            "a trajectory with numbers that are not finite cannot be saved."
        ) from error
    write_text(path, text + "\n")


def load_trajectory(
    path: str | Path, members: tuple[type[AbstractTrajectory], ...] = MEMBERS
) -> AbstractTrajectory:
    """Reads a trajectory that `save_trajectory` has written.

    Args:
        path: Of the JSON file.
        members: What the file may hold; add your own.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it holds no trajectory, or one of a later version or unknown kind.
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
            f"{VERSION}: load it with the package that wrote it, or a newer one."
        )
    try:
        return _restore(content, {member.__name__: member for member in members})
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"`{path}` is damaged: {' '.join(map(str, error.args))}.") from error


def write_csv(
    trajectory: AbstractTrajectory, robot: Robot, path: str | Path, *, sample_time: float
) -> None:
    """Writes a table of samples: time, positions, velocities and accelerations of all joints.

    The header names joint and unit: `time [s],q_joint1 [rad],...,qdd_joint1 [rad/s^2],...`.

    Args:
        trajectory: Sampled from its start to its end.
        robot: Whose joints move.
        path: Of the CSV file.
        sample_time: Largest time between two samples [s].

    Raises:
        InputError: If the trajectory has not the robot's joints, or `sample_time` is not positive.
    """
    require_joints(trajectory, robot)
    times, motion = trajectory.sample(sample_time)
    header = ["time [s]"]
    for symbol, rate in (("q", ""), ("qd", "/s"), ("qdd", "/s^2")):
        header += [
            f"{symbol}_{name} [{robot.joint_unit(j)}{rate}]"
            for j, name in enumerate(robot.joint_names)
        ]
    rows = np.column_stack([times, motion.q, motion.qd, motion.qdd]).tolist()
    lines = [",".join(map(_quoted, header)), *(",".join(map(repr, row)) for row in rows)]
    write_text(path, "\n".join(lines) + "\n")


def _quoted(field: str) -> str:
    """A field of a CSV file: names may hold what separates fields."""
    return '"' + field.replace('"', '""') + '"' if {",", '"'} & set(field) else field


def require_joints(trajectory: AbstractTrajectory, robot: Robot) -> None:
    """Refuses a trajectory of another robot.

    Raises:
        InputError: If it moves more or fewer joints.
    """
    if trajectory.joints != robot.joints:
        raise InputError(
            f"the trajectory must move the {robot.joints} joints of `{robot.name}`, but moves "
            f"{trajectory.joints}."
        )


def write_text(path: str | Path, text: str) -> None:
    """Writes one file whole or not at all."""
    path = Path(path)
    with atomic_folder(path.parent) as folder:
        (folder / path.name).write_text(text, encoding="utf-8")


def _record(trajectory: AbstractTrajectory) -> dict[str, Any]:
    fields = {f.name: _plain(getattr(trajectory, f.name)) for f in dataclasses.fields(trajectory)}
    return {"kind": type(trajectory).__name__, **fields}


def _plain(value: Any) -> Any:
    if isinstance(value, AbstractTrajectory):
        return _record(value)
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if isinstance(value, int):
        return value
    return np.asarray(value, np.float64).tolist()


def _restore(content: dict[str, Any], members: dict[str, type]) -> AbstractTrajectory:
    kind = content["kind"]
    if kind not in members:
        raise InputError(f"it holds a `{kind}`, which is none of {', '.join(members)}")
    values = {}
    for field in dataclasses.fields(members[kind]):
        if field.name not in content:
            raise InputError(f"`{kind}` has no `{field.name}`")
        values[field.name] = _value(content[field.name], members)
    return members[kind](**values)


def _value(value: Any, members: dict[str, type]) -> Any:
    if isinstance(value, dict):
        return _restore(value, members)
    if isinstance(value, list):
        if value and isinstance(value[0], dict):
            return tuple(_restore(one, members) for one in value)
        return np.array(value, np.float64)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{value!r} is no number")
    return value
