"""Commented experiment file for a robot: what `jaxid init` prints.

Keys, defaults and comments come from the functions and classes that take the keys. An
example in a description ("like `0.1`") becomes the value of a key that is commented
out.
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
from typing import Annotated, Any, Literal

import numpy as np

from jaxid.io import FilePath, union_members
from jaxid.measurement.filters import FILTERS
from jaxid.measurement.log_files import READERS
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import joint_parameters, load_urdf
from jaxid.units import Unit

from .decoder import Key, keys_of
from .experiment import TABLES
from .robot_tables import known_load
from .setup_tables import KINDS, SIDES, DryFriction

WIDTH = 100
"""Largest length of a line."""
COLUMN = 38
"""Column in which the comments behind keys begin."""
HEAD = """\
# Experiment file of {name}:
# what is known of the robot, what its logs contain, and how it is identified.
# Lines that begin with `#` are comments; remove the `#` before a key to use it.
# Units: rad, m, s, N m (revolute joints) or N (prismatic joints), unless a key says \
otherwise.
#
#   jaxid inspect  experiment.toml                      what can be identified
#   jaxid inspect  experiment.toml log.csv              does this log have mistakes?
#   jaxid excite   experiment.toml -o trajectory.csv    the motion to record
#   jaxid identify experiment.toml log.csv -o report/   parameters and torque errors
"""
SUMMARIES = {
    "filter": "Filter of the logs. Without `cutoff`, the best of 2, 3.5, 5 and 10 Hz "
    "and of values that suit the motion is chosen by errors on parts of the "
    "logs; with a list like `[5.0, 20.0]`, the best of the list.",
    "load": "Known load that the robot carries in some logs only: `jaxid gains` finds "
    "the true forces.",
    "recording": f"Columns of the logs ({', '.join(READERS)}). "
    'A pattern ("{}" is the number of the joint, "{name}" its name), '
    "a list of names, or positions from 0.",
}
"""Descriptions of tables where the docstring of their function says something else."""
INNER_TABLES = {
    "robot": ("robot.tool", known_load),
    "model": ("model.coulomb", DryFriction),
}
"""Tables within others, and their functions."""
INACTIVE_TABLES = ("load", "sensor", "collision", "robot.tool")
"""Tables that are commented out as a whole."""
LIMITS = (
    "position_min",
    "position_max",
    "velocity",
    "acceleration",
    "jerk",
    "force",
)
KEYS_OF_SOME_KINDS = set().union(*KINDS.values()) - set.intersection(
    *map(set, KINDS.values())
)
"""Keys that not all kinds of estimators take, which are commented out."""


def write_template(
    urdf: FilePath,
    *,
    tip: str | None = None,
    base: str | None = None,
    xacro_arguments: Mapping[str, str] | None = None,
    folder: FilePath = ".",
) -> str:
    """Return a complete commented experiment file for a robot; it loads as it is."""
    chain: Any = {"tip": tip, "base": base, "xacro_arguments": xacro_arguments}
    robot = load_urdf(urdf, **chain)
    stiffness = joint_parameters(urdf, **chain)["stiffness"]
    path = os.path.relpath(Path(urdf).resolve(), Path(folder).resolve())
    key = "mjcf" if is_mjcf(urdf) else "urdf"
    values = {
        "robot": {key: Path(path).as_posix(), **chain},
        "limits": {
            name: np.asarray(getattr(robot.limits, name)).tolist() for name in LIMITS
        },
        "drives": {"gear_ratios": [1.0] * robot.joints},
        "model": {"offset": True, "springs": bool(stiffness.any())},
        "recording": {
            "angles": "q{}",
            "forces": "tau{}",
            "time": "time",
            "angle_unit": _one_or_each(map(robot.joint_unit, range(robot.joints))),
            "force_unit": _one_or_each(map(robot.force_unit, range(robot.joints))),
        },
        "filter": {"kind": "butterworth"},
        "estimator": {"kind": "consistent"},
    }
    sections = [HEAD.format(name=robot.name)]
    for name, functions in TABLES.items():
        table = _table(name, functions, robot.joints, values.get(name, {}))
        if name == "drives" and robot.drives.lack_stated_ratios:
            table += _stated_ratios(robot)
        sections.append(_joints(robot) + table if name == "limits" else table)
        if name in INNER_TABLES:
            inner_name, function = INNER_TABLES[name]
            sections.append(_table(inner_name, (function,), robot.joints, {}))
    return "\n".join(sections)


def _one_or_each(units: Iterable[str]) -> str | list[str]:
    """Return the unit that all joints have, or those of all joints."""
    units = list(units)
    return units if len(set(units)) > 1 else units[0]


def _table(
    name: str, functions: tuple[Callable, ...], joints: int, values: Mapping[str, Any]
) -> str:
    """Return a table with all keys of some functions, some or all commented out."""
    is_active_table = name not in INACTIVE_TABLES
    lines = _comment(SUMMARIES.get(name) or _summary(functions[0]))
    lines.append(f"{'' if is_active_table else '# '}[{name}]")
    if name == "filter":
        lines += _entry("kind", json.dumps(values["kind"]), "", True)
    written_names = {*SIDES, "tool"}
    kinds: dict[Any, str] = {filter: kind for kind, filter in FILTERS.items()}
    for function in functions:
        kind = kinds.get(function)
        is_active = is_active_table and kind in (None, values.get("kind"))
        if kind is not None and not is_active:
            # Keys of the other kinds of filters are comments.
            lines += ["#", *_entry("kind", json.dumps(kind), _summary(function), False)]
        for key in keys_of(function).values():
            # Each kind of filter has keys of its own, which may have equal names.
            if kind is not None or key.name not in written_names:
                is_common = key.name not in KEYS_OF_SOME_KINDS
                value = values.get(key.name)
                lines += _key(key, joints, value, is_active and is_common)
        written_names |= {*keys_of(function)}
    return "\n".join(lines) + "\n"


def _key(key: Key, joints: int, value: Any, is_active: bool) -> Iterator[str]:
    """Yield the lines of a key: its value, default or example, and description."""
    # The description as users of the file need it, and the example in it.
    text = re.sub(r"[;,] (?:or )?None(?: if [^;.]*)?", "", key.text)
    text = text.replace(" if None", " by default")
    example = ""
    example_match = re.search(r",? like `([^`]+)`", text)
    if example_match is not None:
        text = text.replace(example_match[0], "", 1)
        example = example_match[1]
    has_default = key.default is not inspect.Parameter.empty
    shows_example = (example and not is_active) or "=" in example
    if value is None and has_default and not shows_example:
        value = key.default
    assigned_text = toml_text(value)
    if assigned_text is None:
        is_active = False
        assigned_text = _example(union_members(key.hint)[0], example, joints)
    yield from _entry(key.name, assigned_text, text, is_active)


def _example(hint: Any, example: str, joints: int) -> str:
    """Return an example of the right type, for each joint where lists are needed."""
    while typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    kind = typing.get_origin(hint)
    if kind in (list, tuple) and not example.startswith("["):
        numbers = [example or "1.0"] * joints
        return f"[{', '.join(numbers)}]"
    if example:
        return example
    if kind is Literal:
        return json.dumps(typing.get_args(hint)[0])
    return {int: "1", float: "1.0"}.get(hint, "true")


def toml_text(value: Any) -> str | None:
    """Return a value as TOML; None for what a file need not say."""
    if isinstance(value, list | tuple):
        # In a list, infinity is written, too.
        texts = [repr(x) if isinstance(x, float) else str(toml_text(x)) for x in value]
        return f"[{', '.join(texts)}]" if value else None
    if isinstance(value, dict):
        entries = [f"{json.dumps(k)} = {toml_text(x)}" for k, x in value.items()]
        return f"{{ {', '.join(entries)} }}" if value else None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Unit):
        return json.dumps(value.symbol)
    if isinstance(value, str):
        # Nothing in a text may look like a comment behind a key.
        text = json.dumps(value, ensure_ascii=False).replace("  #", "  \\u0023")
        return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)
    if isinstance(value, int | float) and math.isfinite(value):
        return repr(value)
    return None


def _entry(name: str, value: str, text: str, is_active: bool) -> Iterator[str]:
    """Yield the lines of a key; its comment stands behind it, or before a long one."""
    mark = "" if is_active else "# "
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


def _stated_ratios(robot: Robot) -> str:
    """Return a comment with the gear ratios that the robot's file states."""
    value = toml_text(np.asarray(robot.drives.stated_ratios).tolist()) or ""
    text = (
        "These ratios are in the robot's file (`<transmission>`). Use them instead of "
        'those above if the logs were recorded on the motor side (`side = "motor"`)'
    )
    return "\n".join([*_comment(f"{text}:"), f"# gear_ratios = {value}"]) + "\n"


def _joints(robot: Robot) -> str:
    """Return a comment with numbers, names and kinds of the joints."""
    texts = []
    for j, name in enumerate(robot.joint_names):
        motion = "turns" if robot.revolute[j] else "slides"
        texts.append(f"{j + 1} {name} ({motion})")
    return "\n".join(_comment(f"The joints: {', '.join(texts)}")) + "\n"
