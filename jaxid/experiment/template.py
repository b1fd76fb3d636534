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
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxid.experiment.decoder import Key, keys_of, table_of
from jaxid.experiment.estimator_table import KINDS
from jaxid.experiment.experiment import TABLES
from jaxid.experiment.method_tables import CUTOFF, FILTERS, SIDES, DryFriction
from jaxid.experiment.robot_tables import known_load
from jaxid.io import union_members
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
SUMMARIES = {
    "load": "Known load that is on the robot in some logs only: `jaxid gains` finds the true "
    "forces.",
    "recording": "Columns of the logs: CSV (any separator), Parquet, NPZ or MAT files. A pattern "
    '("{}" stands for the joint\'s number), a list of names, or positions from 0.',
}
"""Descriptions of tables where the docstring of their function says something else."""


def write_template(
    urdf: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    folder: str | Path = ".",
) -> str:
    """Return a complete commented experiment file for a robot; it loads as it is.

    Args:
        urdf: Path of the robot's URDF file.
        tip: Link of the end-effector; the end of the longest chain if None.
        base: Link that stands on the ground; the root if None.
        folder: Folder of the experiment file, to which the URDF's path is relative.

    Raises:
        FileNotFoundError: If the URDF file does not exist.
        InputError: If it cannot be loaded.
    """
    robot = load_urdf(urdf, tip=tip, base=base)
    path = Path(os.path.relpath(Path(urdf).resolve(), Path(folder).resolve()))
    source = {"urdf": path.as_posix(), "tip": tip, "base": base}
    limits = ("position_min", "position_max", "velocity", "acceleration", "jerk", "force")
    values = {
        "robot": {key: value for key, value in source.items() if value},
        "limits": {name: np.asarray(getattr(robot.limits, name)).tolist() for name in limits},
        "drives": {"gear_ratios": [1.0] * robot.joints},
        "model": {"offset": True},
        "recording": _recording(robot),
        "filter": {"kind": "butterworth", "cutoff": CUTOFF},
        "estimator": {"kind": "weighted"},
    }
    commented = {name for keys in KINDS.values() for name in keys} - {*KINDS["weighted"]}
    sections = [HEAD.format(name=robot.name)]
    for name, functions in TABLES.items():
        functions = functions[:1] if name == "filter" else functions
        table = _table(
            name,
            functions,
            robot.joints,
            values.get(name, {}),
            commented if name == "estimator" else (),
            active=name not in ("load", "collision"),
        )
        if name == "robot":
            table += "\n" + _table("robot.tool", (known_load,), robot.joints, active=False)
        if name == "limits":
            table = _joints(robot) + table
        if name == "model":
            table += "\n" + _table("model.coulomb", (DryFriction,), robot.joints)
        sections.append(table + (_other_filters(robot.joints) if name == "filter" else ""))
    return "\n".join(sections)


def _table(
    name: str,
    functions: tuple[Callable, ...],
    joints: int,
    values: Mapping[str, Any] | None = None,
    commented: Collection[str] = (),
    *,
    active: bool = True,
) -> str:
    """Return a table with all keys of some functions; some or all of them are commented out."""
    values = values or {}
    lines = _comment(SUMMARIES.get(name) or _summary(functions[0]))
    lines.append(f"{'' if active else '# '}[{name}]")
    if name == "filter":
        lines += _entry("kind", json.dumps(values["kind"]), "", True)
    for key in (key for function in functions for key in keys_of(function).values()):
        if key.name not in (*SIDES, "tool"):
            shown = active and key.name not in commented
            lines += _key(key, joints, values.get(key.name), shown)
    return "\n".join(lines) + "\n"


def _other_filters(joints: int) -> str:
    """Return the keys of the other kinds of filters, as comments."""
    lines, known = [], {*keys_of(FILTERS["butterworth"])}
    for kind, function in list(FILTERS.items())[1:]:
        lines += ["#", *_entry("kind", json.dumps(kind), _summary(function), False)]
        for key in keys_of(function).values():
            if key.name not in known:
                lines += _key(key, joints, None, False)
        known |= {*keys_of(function)}
    return "\n".join(lines) + "\n"


def _key(key: Key, joints: int, value: Any, active: bool) -> Iterator[str]:
    text, example = _split_example(key.text)
    needed = key.default is inspect.Parameter.empty
    if value is None and not (needed or _holds_table(key.hint) or (example and not active)):
        value = key.default
    shown = _toml(value)
    if shown is None:
        active, shown = False, _example(key, joints, example)
    yield from _entry(key.name, shown, text, active)


def _holds_table(hint: Any) -> bool:
    """Whether a value may hold tables."""
    options = union_members(hint)
    inner = [
        x for o in options if typing.get_origin(o) in (list, tuple) for x in typing.get_args(o)
    ]
    return any(table_of(o) for o in options) or any(x is not ... and _holds_table(x) for x in inner)


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
    if typing.get_origin(option) is Literal:
        example = example or json.dumps(typing.get_args(option)[0])
    return example or {int: "1", float: "1.0"}.get(option, "true")


def _toml(value: Any) -> str | None:
    """Return a value as TOML; None for what a file need not say."""
    if isinstance(value, list | tuple):
        shown = [repr(x) if isinstance(x, float) else _toml(x) for x in value]
        return f"[{', '.join(map(str, shown))}]" if value else None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Unit):
        return json.dumps(value.symbol)
    if isinstance(value, str):
        # Nothing in a text may look like a comment behind a key.
        quoted = json.dumps(value, ensure_ascii=False).replace("  #", "  \\u0023")
        return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)
    if isinstance(value, int | float) and math.isfinite(value):
        return repr(value)
    return None


def _entry(name: str, value: str, text: str, active: bool) -> Iterator[str]:
    """Yield the lines of a key; its comment stands behind it, or before a long one."""
    mark = "" if active else "# "
    assignment = f"{mark}{name} = {value}"
    if len(assignment) >= COLUMN:
        yield from _comment(f"{text.rstrip('.')}:")
        # A list may go on in the next line.
        lines = textwrap.wrap(assignment, WIDTH, subsequent_indent=f"{mark}  ")
        yield from lines if " = [" in assignment else [assignment]
        return
    lines = textwrap.wrap(text.rstrip("."), WIDTH - COLUMN - 2) or [""]
    yield f"{assignment:<{COLUMN}}# {lines[0]}" if text else assignment
    for line in lines[1:]:
        yield f"#{'':<{COLUMN - 1}}# {line}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def _summary(function: Callable) -> str:
    """Return the first sentence of a docstring, without formulas."""
    text = (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
    return re.sub(r" \$[^$]*\$", "", text)


def _recording(robot: Robot) -> dict[str, Any]:
    joints = range(robot.joints)
    angles, forces = [*map(robot.joint_unit, joints)], [*map(robot.force_unit, joints)]
    return {
        "angles": "q{}",
        "forces": "tau{}",
        "time": "time",
        "angle_unit": angles[0] if len(set(angles)) == 1 else angles,
        "force_unit": forces[0] if len(set(angles)) == 1 else forces,
    }


def _joints(robot: Robot) -> str:
    """Return a comment with numbers, names and kinds of the joints."""
    names = (
        f"{i} {name} ({'turns' if turns else 'slides'})"
        for i, (name, turns) in enumerate(zip(robot.joint_names, robot.revolute, strict=True), 1)
    )
    return "\n".join(_comment(f"The joints: {', '.join(names)}")) + "\n"
