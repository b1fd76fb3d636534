"""Commented experiment file for a robot: what `jaxid init` prints.

`templates/experiment.toml.jinja` is its text: all keys with their defaults, and what
they mean. A default or an example stands there as in the function or class that takes
the key.
"""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.io import FilePath, fill_template
from jaxid.measurement.log_files import READERS
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.urdf import joint_parameters, load_urdf

TEMPLATE = Path(__file__).parent / "templates" / "experiment.toml.jinja"
"""Text of the file, in which the robot's names and numbers are filled in."""
LIMITS = (
    "position_min",
    "position_max",
    "velocity",
    "acceleration",
    "jerk",
    "force",
)


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
    joints = range(robot.joints)
    limits = {x: np.asarray(getattr(robot.limits, x)).tolist() for x in LIMITS}
    stated_ratios = None
    if robot.drives.lack_stated_ratios:
        stated_ratios = robot.drives.stated_ratios.tolist()
    path = os.path.relpath(Path(urdf).resolve(), Path(folder).resolve())
    return fill_template(
        TEMPLATE,
        **chain,
        robot=robot,
        robot_path=Path(path).as_posix(),
        is_mjcf=is_mjcf(urdf),
        limits=limits,
        ones=[1.0] * robot.joints,
        zeros=[0.0] * robot.joints,
        stated_ratios=stated_ratios,
        springs=bool(joint_parameters(urdf, **chain)["stiffness"].any()),
        suffixes=list(READERS),
        angle_unit=_one_or_each(map(robot.joint_unit, joints)),
        force_unit=_one_or_each(map(robot.force_unit, joints)),
        toml=toml_text,
    )


def _one_or_each(units: Iterable[str]) -> str | list[str]:
    """Return the unit that all joints have, or those of all joints."""
    units = list(units)
    return units if len(set(units)) > 1 else units[0]


def toml_text(value: Any) -> str:
    """Return a number, a text, or a list or table of them as TOML."""
    if isinstance(value, list):
        return f"[{', '.join(map(toml_text, value))}]"
    if isinstance(value, dict):
        entries = [f"{json.dumps(k)} = {toml_text(x)}" for k, x in value.items()]
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, str):
        # Nothing in a text may look like a comment behind a key.
        text = json.dumps(value, ensure_ascii=False).replace("  #", "  \\u0023")
        return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)
    return repr(value)
