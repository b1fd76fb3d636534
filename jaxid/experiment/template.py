"""Commented experiment file for a robot: what `jaxid init` prints.

Keys, defaults and comments come from the functions and classes that take the keys. An
example in a description ("like `0.1`") becomes the value of a key that is commented
out.
"""

import inspect
import itertools
import json
import math
import os
import re
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxid.io import union_members
from jaxid.measurement.filters import FILTERS
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf
from jaxid.units import Unit

from .decoder import Key, keys_of
from .estimator_table import KINDS
from .experiment import TABLES
from .model_and_log_tables import CUTOFF, SIDES, DryFriction
from .robot_tables import known_load

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
    "load": "Known load that is on the robot in some logs only: `jaxid gains` finds "
    "the true "
    "forces.",
    "recording": "Columns of the logs: CSV (any separator), Parquet, NPZ, MAT, HDF5 "
    "or ROS bags. "
    'A pattern ("{}" stands for the joint\'s number, "{name}" for its name), a list '
    "of names, or "
    "positions from 0.",
}
"""Descriptions of tables where the docstring of their function says something else."""
INNER = {"robot": ("robot.tool", known_load), "model": ("model.coulomb", DryFriction)}
"""Tables within others, and their functions."""
OF_KINDS = {*itertools.chain(*KINDS.values())} - set.intersection(
    *map(set, KINDS.values())
)
"""Keys that not all kinds of estimators take, which are commented out."""


def write_template(
    urdf: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    folder: str | Path = ".",
) -> str:
    """Return a complete commented experiment file for a robot; it loads as it is."""
    robot = load_urdf(urdf, tip=tip, base=base)
    path = Path(os.path.relpath(Path(urdf).resolve(), Path(folder).resolve()))
    limits = (
        "position_min",
        "position_max",
        "velocity",
        "acceleration",
        "jerk",
        "force",
    )
    joints = range(robot.joints)
    angles, forces = [*map(robot.joint_unit, joints)], [*map(robot.force_unit, joints)]
    values = {
        "robot": {
            "mjcf" if is_mjcf(urdf) else "urdf": path.as_posix(),
            "tip": tip,
            "base": base,
        },
        "limits": {
            name: np.asarray(getattr(robot.limits, name)).tolist() for name in limits
        },
        "drives": {"gear_ratios": [1.0] * robot.joints},
        "model": {"offset": True},
        "recording": {
            "angles": "q{}",
            "forces": "tau{}",
            "time": "time",
            "angle_unit": angles if len({*angles}) > 1 else angles[0],
            "force_unit": forces if len({*angles}) > 1 else forces[0],
        },
        "filter": {"kind": "butterworth", "cutoff": CUTOFF},
        "estimator": {"kind": "consistent"},
    }
    sections = [HEAD.format(name=robot.name)]
    for name, functions in TABLES.items():
        table = _table(name, functions, robot.joints, values.get(name, {}))
        sections.append(_joints(robot) + table if name == "limits" else table)
        if name in INNER:
            inner, function = INNER[name]
            sections.append(_table(inner, (function,), robot.joints, {}))
    return "\n".join(sections)


def _table(
    name: str, functions: tuple[Callable, ...], joints: int, values: Mapping[str, Any]
) -> str:
    """Return a table with all keys of some functions; some or all of them are commented out."""
    active = name not in ("load", "collision", "robot.tool")
    lines = _comment(SUMMARIES.get(name) or _summary(functions[0]))
    lines.append(f"{'' if active else '# '}[{name}]")
    if name == "filter":
        lines += _entry("kind", json.dumps(values["kind"]), "", True)
    known = {*SIDES, "tool"}
    kinds = {filter: kind for kind, filter in FILTERS.items()}
    for function in functions:
        kind = kinds.get(function)
        is_active = active and kind in (None, values.get("kind"))
        if kind is not None and not is_active:
            # Keys of the other kinds of filters are comments.
            lines += ["#", *_entry("kind", json.dumps(kind), _summary(function), False)]
        for key in keys_of(function).values():
            if key.name not in known:
                shown = is_active and key.name not in OF_KINDS
                lines += _key(key, joints, values.get(key.name), shown)
        known |= {*keys_of(function)}
    return "\n".join(lines) + "\n"


def _key(key: Key, joints: int, value: Any, active: bool) -> Iterator[str]:
    # The description as users of the file need it, and the example in it.
    text = re.sub(r"[;,] (?:or )?None(?: if [^;.]*)?", "", key.text)
    text = text.replace(" if None", " by default")
    found = re.search(r",? like `([^`]+)`", text)
    text, example = (text.replace(found[0], "", 1), found[1]) if found else (text, "")
    needed = key.default is inspect.Parameter.empty
    if value is None and not (needed or (example and not active) or "=" in example):
        value = key.default
    shown = toml_text(value)
    if shown is None:
        # An example of the right type: a value for each joint where a list is needed.
        active, option = False, union_members(key.hint)[0]
        while typing.get_origin(option) is Annotated:
            option = typing.get_args(option)[0]
        kind, words = typing.get_origin(option), {int: "1", float: "1.0"}
        if kind in (list, tuple) and not example.startswith("["):
            example = f"[{', '.join([example or '1.0'] * joints)}]"
        if kind is Literal:
            words[option] = json.dumps(typing.get_args(option)[0])
        shown = example or words.get(option, "true")
    yield from _entry(key.name, shown, text, active)


def toml_text(value: Any) -> str | None:
    """Return a value as TOML; None for what a file need not say."""
    if isinstance(value, list | tuple):
        shown = [repr(x) if isinstance(x, float) else toml_text(x) for x in value]
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


def _joints(robot: Robot) -> str:
    """Return a comment with numbers, names and kinds of the joints."""
    names = (
        f"{i} {name} ({'turns' if turns else 'slides'})"
        for i, (name, turns) in enumerate(
            zip(robot.joint_names, robot.revolute, strict=True), 1
        )
    )
    return "\n".join(_comment(f"The joints: {', '.join(names)}")) + "\n"
