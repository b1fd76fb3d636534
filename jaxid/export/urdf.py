"""URDF: an original file with the inertias, friction and efforts of a fit, and nothing else new."""

from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.export.physical import Inertial, Joints, known_efforts, possible_bodies
from jaxid.identification.fit import Fit
from jaxid.io import write_bytes
from jaxid.robot.plausibility import SNAP_TOLERANCE
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf, merged_links

SAME = 1e-3
"""Difference of lengths [m] and directions up to which two robots are the same."""

SAID = " Inertias and friction: model of "
"""How the comment begins; that of an earlier model goes."""


def export_urdf(
    fit: Fit,
    source: str | Path,
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> Path:
    """Writes a robot's own URDF file with the model in the place of what it claimed.

    Replaced are the inertial of each link that a joint moves, with all that is fixed to it (fixed
    links then have none), the damping and the dry friction of each joint, and its effort where a
    largest force is known. A URDF holds no rotor inertias, no offsets and no width of a tanh; a
    comment names what is left out. Meshes, names and all the rest stay as they are.

    Args:
        fit: A physically consistent fit.
        source: The robot's URDF file.
        path: Of the new file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        snap_tolerance: As in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the source does not exist.
        InputError: If the bodies of the fit could not exist, or the file is of another robot.
    """
    path, robot = Path(path), fit.base.model.robot
    bodies = possible_bodies(fit, "a URDF file")
    described = load_urdf(source, tip=tip, base=base, snap_tolerance=snap_tolerance)
    _require_same(robot, described, source)
    links = merged_links(source, tip=tip, base=base, snap_tolerance=snap_tolerance)
    joints, efforts = Joints.of(fit), known_efforts(robot)
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    document = etree.parse(str(source), parser)
    root = document.getroot()
    left = [x for x in robot_names(joints) if x]
    for comment in root.xpath("comment()"):
        if comment.text.startswith(SAID):
            root.remove(comment)
    root.insert(0, etree.Comment(_comment(fit, left)))
    elements = {e.get("name"): e for e in root.iterfind("joint")}
    moved = {
        elements[name].find("child").get("link"): i for i, name in enumerate(robot.joint_names)
    }
    for link in root.iterfind("link"):
        body, _, _ = links.get(link.get("name"), (-1, None, None))
        if body < 0:
            continue
        for old in link.findall("inertial"):
            link.remove(old)
        if link.get("name") in moved:
            link.insert(0, _inertial(bodies[moved[link.get("name")]]))
    for i, name in enumerate(robot.joint_names):
        dynamics = _child(elements[name], "dynamics")
        dynamics.set("damping", repr(float(joints.damping[i])))
        dynamics.set("friction", repr(float(joints.friction[i])))
        if np.isfinite(efforts[i]):
            _child(elements[name], "limit").set("effort", repr(float(efforts[i])))
    text = etree.tostring(document, xml_declaration=True, encoding="utf-8")
    write_bytes(path, text + b"\n")
    return path


def robot_names(joints: Joints) -> tuple[str, ...]:
    """Names of the parameters that a URDF cannot hold."""
    rotors = tuple(f"Ia{j + 1}" for j in np.flatnonzero(joints.armature))
    return (*rotors, *joints.left)


def _comment(fit: Fit, left: list[str]) -> str:
    said = f"{SAID}{fit.date or 'an unknown day'}, {fit.checksum}. "
    if left:
        said += f"Not in this file: {', '.join(left)}. "
    return said.replace("--", "- -")


def _require_same(robot: Robot, described: Robot, source: str | Path) -> None:
    if robot.joint_names != described.joint_names:
        raise InputError(
            f"`{source}` has the joints {', '.join(described.joint_names)}, but the fit of "
            f"`{robot.name}` has {', '.join(robot.joint_names)}: give the file of this robot, or "
            "its `tip`."
        )
    # How the robot is mounted on the ground is not the file's business.
    inner = [i for i, parent in enumerate(robot.parent) if parent >= 0]
    for what in ("axis", "rotation", "offset"):
        rows = range(robot.joints) if what == "axis" else inner
        one, other = (np.asarray(getattr(r, what))[list(rows)] for r in (robot, described))
        if one.size and np.abs(one - other).max() > SAME:
            raise InputError(
                f"`{source}` has another geometry than the robot `{robot.name}` of the fit ({what} "
                "differs): give the file with which the model was identified."
            )


def _inertial(p: Float[np.ndarray, "10"]) -> etree._Element:
    m, c, J = Inertial.of(p)
    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=" ".join(map(repr, c.tolist())), rpy="0 0 0")
    etree.SubElement(element, "mass", value=repr(m))
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2)}
    entries["izz"] = (2, 2)
    etree.SubElement(element, "inertia", {k: repr(float(J[at])) for k, at in entries.items()})
    return element


def _child(element: etree._Element, tag: str) -> etree._Element:
    found = element.find(tag)
    return etree.SubElement(element, tag) if found is None else found
