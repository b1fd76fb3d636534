"""Commented experiment file for a robot: what `jaxid init` prints.

Keys, defaults and comments come from the functions and classes that take the keys. An example in a
description ("like `0.1`") becomes the value of a key that is commented out.
"""

import inspect
import json
import math
import os
import re
import textwrap
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxid.experiment.decoder import Key, choices, keys_of
from jaxid.experiment.estimator_table import KINDS, choose_uncertainty
from jaxid.experiment.excitation_tables import Collision, Excitation
from jaxid.experiment.method_tables import (
    CUTOFF,
    FILTERS,
    SIDES,
    DryFriction,
    Effects,
    Logs,
    build_rows,
)
from jaxid.experiment.robot_tables import Load, RobotSource, replace_drives, replace_limits
from jaxid.io import union_members
from jaxid.measurement.columns import Columns
from jaxid.measurement.units import Unit
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf

WIDTH, COLUMN = 100, 38
"""Largest length of a line, and column in which the comments behind keys begin."""
HEAD = """\
# Experiment file of {name}:
# what is known of the robot, what its logs hold, how it is identified.
# Lines that begin with `#` are comments; remove the `#` before a key to use it.
# Units: rad, m, s, N m (revolute joints) or N (prismatic joints), unless a key says otherwise.
#
#   jaxid inspect  experiment.toml                      what can be identified
#   jaxid inspect  experiment.toml log.csv              is this log sane?
#   jaxid excite   experiment.toml -o trajectory.csv    the motion to record
#   jaxid identify experiment.toml log.csv -o report/   parameters and torque errors
"""
EXAMPLES = {
    "angle_signs": "1",
    "force_signs": "1",
    "angle_offsets": "0.0",
    "velocities": '"dq{}"',
    "sample_time": "0.001",
    "velocity_unit": '"rad/s"',
    "force_cutoff": "inf",
    "margin": "0.1",
    "period": "10.0",
    "harmonics": "5",
    "force_harmonics": "50",
    "mass_min": "0.5",
    "mass_max": "50.0",
    "radius": "0.6",
    "centre_min": "[-0.2, -0.2, 0.0]",
    "centre_max": "[0.2, 0.2, 0.5]",
    "ellipsoid_centre": "[0.0, 0.0, 0.2]",
    "ellipsoid_axes": "[0.2, 0.2, 0.4]",
    "total_mass": "120.0",
}
"""Values of keys whose descriptions hold no example."""


def write_template(
    urdf: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    folder: str | Path | None = ".",
) -> str:
    """Return a complete commented experiment file for a robot; it loads as it is.

    Args:
        urdf: Path of the robot's URDF file.
        tip: Link of the end-effector; the end of the longest chain if None.
        base: Link that stands on the ground; the root if None.
        folder: Folder of the experiment file, to which the URDF's path is relative. If None, it is
            not known, and the path is absolute.

    Raises:
        FileNotFoundError: If the URDF file does not exist.
        InputError: If it cannot be loaded.
    """
    robot = load_urdf(urdf, tip=tip, base=base)
    path = Path(urdf).resolve()
    if folder is not None:
        path = Path(os.path.relpath(path, Path(folder).resolve()))
    return render(robot, path.as_posix(), tip, base)


def render(robot: Robot, urdf: str, tip: str | None = None, base: str | None = None) -> str:
    """Return the file for a robot that a URDF file describes.

    Args:
        robot: Robot of the URDF file.
        urdf: Path of the URDF file, as it is written into the file.
        tip: Link of the end-effector, if it was chosen.
        base: Link that stands on the ground, if it was chosen.
    """
    source = {"urdf": urdf, "tip": tip, "base": base}
    n = robot.joints
    sections = [
        HEAD.format(name=robot.name),
        _table("robot", [RobotSource], n, {k: v for k, v in source.items() if v}, ("tool",)),
        _table("robot.tool", [Load], n, active=False),
        _table("load", [Load], n, active=False, summary=_LOAD),
        _joints(robot) + _table("limits", [replace_limits], n, _limits(robot)),
        _table("drives", [replace_drives], n, {"gear_ratios": [1.0] * n}),
        _table("model", [Effects], n, {"offset": True}),
        _table("model.coulomb", [DryFriction], n),
        _table("recording", [Columns, Logs], n, _recording(robot), SIDES, _RECORDING),
        _table("filter", [FILTERS["butterworth"]], n, {"kind": "butterworth", "cutoff": CUTOFF})
        + _other_kinds("butterworth", {k: (_summary(f), (f,)) for k, f in FILTERS.items()}, n),
        _table("rows", [build_rows], n),
        _table(
            "estimator",
            [*KINDS["weighted"][1], choose_uncertainty],
            n,
            {"kind": "weighted"},
            (),
            _ESTIMATOR,
        )
        + _other_kinds("weighted", KINDS, n),
        _table("excitation", [Excitation], n),
        _table("collision", [Collision], n, active=False),
    ]
    return "\n".join(sections)


_LOAD = "Known load that is on the robot in some logs only: `jaxid gains` finds the true forces."
_ESTIMATOR = "Estimator of the parameters from the rows, and of their standard deviations."
_RECORDING = (
    'Columns of the logs: CSV (any separator), Parquet, NPZ or MAT files. A pattern ("{}" stands '
    "for the joint's number), a list of names, or positions from 0."
)


def _table(
    name: str,
    functions: Iterable[Callable],
    joints: int,
    values: Mapping[str, Any] | None = None,
    skip: Iterable[str] = (),
    summary: str = "",
    *,
    active: bool = True,
) -> str:
    """Return a table with all keys of some functions."""
    functions, values = list(functions), values or {}
    mark = "" if active else "# "
    lines = [*_comment(summary or _summary(functions[0])), f"{mark}[{name}]"]
    if "kind" in values:
        lines += _entry("kind", json.dumps(values["kind"]), "", active)
    for function in functions:
        for key in keys_of(function).values():
            if key.name not in skip:
                lines += _key(key, joints, values.get(key.name), active)
    return "\n".join(lines) + "\n"


def _other_kinds(
    default: str, kinds: Mapping[str, tuple[str, tuple[Callable, ...]]], joints: int
) -> str:
    """Return the keys of other kinds of a table, as comments."""
    lines, known = [], {name for f in kinds[default][1] for name in keys_of(f)}
    for kind, (text, functions) in kinds.items():
        if kind == default:
            continue
        lines += ["#", *_entry("kind", json.dumps(kind), text, False)]
        for key in (key for f in functions for key in keys_of(f).values()):
            if key.name not in known:
                known.add(key.name)
                lines += _key(key, joints, None, False)
    return "\n".join(lines) + "\n"


def _key(key: Key, joints: int, value: Any, active: bool) -> Iterator[str]:
    text, example = _split_example(key.text)
    example = example or EXAMPLES.get(key.name, "")
    if value is None and not (key.needed or key.tables or (example and not active)):
        value = key.default
    shown = _toml(value)
    if shown is None:
        active, shown = False, _example(key, joints, example)
    yield from _entry(key.name, shown, text, active)


def _split_example(text: str) -> tuple[str, str]:
    """Return a description as users of the file need it, and the example in it."""
    text = re.sub(r"[;,] (?:or )?None(?: if [^;.]*)?", "", text).replace(" if None", " by default")
    found = re.search(r",? like `([^`]+)`", text)
    if found is None:
        return text, ""
    return text.replace(found[0], "", 1), found[1]


def _example(key: Key, joints: int, example: str) -> str:
    """Return a value of the right type; one for each joint where a list is needed."""
    option = union_members(key.hint)[0]
    while typing.get_origin(option) is Annotated:
        option = typing.get_args(option)[0]
    if typing.get_origin(option) in (list, tuple):
        one = example or "1.0"
        return one if one.startswith("[") else f"[{', '.join([one] * joints)}]"
    return (
        example
        or {int: "1", float: "1.0"}.get(option)
        or str(_toml((choices(key.hint) or [True])[0]))
    )


def _toml(value: Any) -> str | None:
    """Return a value as TOML; None for what a file need not say."""
    if isinstance(value, list | tuple):
        shown = [_toml(x) if not isinstance(x, float) else _number(x) for x in value]
        return f"[{', '.join(map(str, shown))}]" if value else None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Unit):
        return json.dumps(value.symbol)
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, int | float) and math.isfinite(value):
        return _number(value)
    return None


def _number(value: float | int) -> str:
    return repr(value)


def _quoted(text: str) -> str:
    """Return a text of TOML that holds nothing that looks like a comment behind a key."""
    quoted = json.dumps(text, ensure_ascii=False).replace("  #", "  \\u0023")
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)


def _entry(name: str, value: str, text: str, active: bool) -> Iterator[str]:
    """Yield the lines of a key; its comment stands behind it, or before a long one."""
    mark = "" if active else "# "
    assignment = f"{mark}{name} = {value}"
    if len(assignment) >= COLUMN:
        yield from _comment(f"{text.rstrip('.')}:")
        yield from _broken(assignment, mark)
        return
    lines = textwrap.wrap(text.rstrip("."), WIDTH - COLUMN - 2) or [""]
    yield f"{assignment:<{COLUMN}}# {lines[0]}" if text else assignment
    for line in lines[1:]:
        yield f"#{'':<{COLUMN - 1}}# {line}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def _broken(assignment: str, mark: str) -> Iterator[str]:
    """Break a list that is too long for its line into several."""
    opening, bracket, content = assignment.partition(" = [")
    if len(assignment) <= WIDTH or not bracket:
        yield assignment
        return
    indent = f"{mark}  "
    yield opening + bracket
    yield from textwrap.wrap(
        f"{content[:-1]},", WIDTH, initial_indent=indent, subsequent_indent=indent
    )
    yield f"{mark}]"


def _summary(function: Callable) -> str:
    """Return the first sentence of a docstring, without formulas."""
    text = (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
    return re.sub(r" \$[^$]*\$", "", text)


def _limits(robot: Robot) -> dict[str, list[float]]:
    names = ("position_min", "position_max", "velocity", "acceleration", "jerk", "force")
    return {name: np.asarray(getattr(robot.limits, name)).tolist() for name in names}


def _recording(robot: Robot) -> dict[str, Any]:
    angles = ["rad" if turns else "m" for turns in robot.revolute]
    forces = ["N m" if turns else "N" for turns in robot.revolute]
    return {
        "angles": "q{}",
        "forces": "tau{}",
        "time": "time",
        "angle_unit": angles[0] if len(set(angles)) == 1 else angles,
        "force_unit": forces[0] if len(set(forces)) == 1 else forces,
    }


def _joints(robot: Robot) -> str:
    """Return a comment with numbers, names and kinds of the joints."""
    mixed = not all(robot.revolute)
    names = (
        f"{i + 1} {name}" + (f" ({'turns' if turns else 'slides'})" if mixed else "")
        for i, (name, turns) in enumerate(zip(robot.joint_names, robot.revolute, strict=True))
    )
    return "\n".join(_comment(f"The joints: {', '.join(names)}")) + "\n"
