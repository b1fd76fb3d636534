"""URDF files: the robot's own file with the inertias, friction and efforts of a fit."""

from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.export.inertials import feasible_bodies, joint_dynamics
from jaxid.identification.fit import Fit
from jaxid.io import write_bytes
from jaxid.robot.inertia import Inertia
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import SNAP_TOLERANCE
from jaxid.robot.urdf import UrdfTree, load_urdf

_COMMENT = " Inertias and friction: model of "
"""Beginning of the comment that names the model; one of an earlier model is removed."""


def export_urdf(
    fit: Fit,
    source: str | Path,
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> Path:
    """Write a robot's own URDF file with the identified model in it.

    Replaced are the inertial of each link that a joint moves, with all that is fixed to it (fixed
    links then have none), the damping and the dry friction of each joint, and its effort where a
    largest force is known. A URDF describes no rotor inertias, no offsets and no width of a tanh: a
    comment names what is left out. Meshes, names and all else stay as they are.

    Args:
        fit: Physically consistent fit.
        source: URDF file of the robot.
        path: Path of the new file.
        tip: Last link, as in `load_urdf`.
        base: First link, as in `load_urdf`.
        snap_tolerance: Tolerance of angles, as in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the source does not exist.
        InputError: If the bodies of the fit cannot exist, or the file describes another robot.
    """
    robot, bodies = fit.base.model.robot, feasible_bodies(fit, "a URDF file")
    described = load_urdf(source, tip=tip, base=base, snap_tolerance=snap_tolerance)
    _require_same(robot, described, source)
    carriers = UrdfTree(source, tip=tip, base=base, snap_tolerance=snap_tolerance).carriers
    dynamics, efforts = joint_dynamics(fit), np.asarray(robot.known_max_forces)
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    document = etree.parse(str(source), parser)
    root = document.getroot()
    for comment in root.xpath("comment()"):
        if comment.text.startswith(_COMMENT):
            root.remove(comment)
    root.insert(0, etree.Comment(_comment(fit, (*dynamics.rotors, *dynamics.left_out))))
    joints = {e.get("name"): e for e in root.iterfind("joint")}
    moved = {joints[name].find("child").get("link"): i for i, name in enumerate(robot.joint_names)}
    for link in root.iterfind("link"):
        name = link.get("name")
        if name not in carriers or carriers[name][0] < 0:
            continue
        for old in link.findall("inertial"):
            link.remove(old)
        if name in moved:
            link.insert(0, _inertial(bodies[moved[name]]))
    for i, name in enumerate(robot.joint_names):
        element = _child(joints[name], "dynamics")
        element.set("damping", repr(float(dynamics.damping[i])))
        element.set("friction", repr(float(dynamics.friction[i])))
        if np.isfinite(efforts[i]):
            _child(joints[name], "limit").set("effort", repr(float(efforts[i])))
    write_bytes(path, etree.tostring(document, xml_declaration=True, encoding="utf-8") + b"\n")
    return Path(path)


def _comment(fit: Fit, left_out: tuple[str, ...]) -> str:
    text = f"{_COMMENT}{fit.date or 'an unknown day'}, {fit.checksum}. "
    if left_out:
        text += f"Not in this file: {', '.join(left_out)}. "
    return text.replace("--", "- -")


def _require_same(robot: Robot, described: Robot, source: str | Path) -> None:
    if robot.joint_names != described.joint_names:
        raise InputError(
            f"`{source}` has the joints {', '.join(described.joint_names)}, but the fit of "
            f"`{robot.name}` has {', '.join(robot.joint_names)}: give the file of this robot, or "
            "its `tip`."
        )
    # The file does not say how the robot is mounted on the ground.
    inner = [i for i, parent in enumerate(robot.parent) if parent >= 0]
    for quantity in ("axis", "rotation", "offset"):
        rows = range(robot.joints) if quantity == "axis" else inner
        one, other = (np.asarray(getattr(r, quantity))[list(rows)] for r in (robot, described))
        if not np.allclose(one, other, rtol=0.0, atol=1e-3):
            raise InputError(
                f"`{source}` has another geometry than the robot `{robot.name}` of the fit "
                f"(`{quantity}` differs): give the file with which the model was identified."
            )


def _inertial(p: Float[np.ndarray, "10"]) -> etree._Element:
    inertia, element = Inertia.from_parameters(p), etree.Element("inertial")
    centre = " ".join(map(repr, np.asarray(inertia.centre).tolist()))
    etree.SubElement(element, "origin", xyz=centre, rpy="0 0 0")
    etree.SubElement(element, "mass", value=repr(float(inertia.mass)))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = zip(names, np.asarray(inertia.moments).tolist(), strict=True)
    etree.SubElement(element, "inertia", {name: repr(value) for name, value in moments})
    return element


def _child(element: etree._Element, tag: str) -> etree._Element:
    child = element.find(tag)
    return etree.SubElement(element, tag) if child is None else child
