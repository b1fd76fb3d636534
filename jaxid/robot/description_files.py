"""Files that describe robots: URDF, xacro, and MJCF as the URDF of the same tree."""

from collections.abc import Mapping
from pathlib import Path

from jaxid.errors import InputError

from .mjcf import Description, mjcf_as_urdf
from .robot import GRAVITY
from .xacro import expand_xacro
from .xml_files import has_xacro, parse_xml, read_xml, require_urdf


def read_description(
    path: str | Path, xacro_arguments: Mapping[str, str] | None = None
) -> Description:
    """Return the URDF element of a robot's file, and what else the file states."""
    robot = read_xml(path)
    if xacro_arguments and not has_xacro(robot):
        raise InputError(
            f"`{path}` is not a xacro file, but only these have arguments: "
            "remove `xacro_arguments` (`--xacro`)."
        )
    if robot.tag == "mujoco":
        return mjcf_as_urdf(path)
    if has_xacro(robot):
        robot = parse_xml(path, expand_xacro(Path(path), xacro_arguments or {}))
    require_urdf(path, robot)
    return Description(robot, GRAVITY)


def is_mjcf(path: str | Path) -> bool:
    """Return whether a file describes its robot as MJCF."""
    return parse_xml(path).tag == "mujoco"


def is_xacro(path: str | Path) -> bool:
    """Return whether a file must be expanded by the program `xacro`."""
    return has_xacro(parse_xml(path))
