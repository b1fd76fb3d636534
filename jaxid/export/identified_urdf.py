"""The URDF file of a robot with the identified model in it."""

from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]

from jaxid.arrays import AnyArray, Matrix, Texts, Vector
from jaxid.errors import InputError
from jaxid.identification.consistency import consistency_margin
from jaxid.identification.fit_result import Fit
from jaxid.io import FilePath, write_bytes
from jaxid.robot.description_files import is_xacro
from jaxid.robot.inertia import BodyParameters, Inertia
from jaxid.robot.mjcf import exact_text
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_angles
from jaxid.robot.urdf import load_urdf
from jaxid.robot.urdf_tree import UrdfTree, link_names
from jaxid.robot.virtual_joints import GROUP

from .bodies_and_joint_dynamics import (
    JointDynamics,
    feasible_bodies,
    joint_dynamics,
    origin_comment,
)

COMMENT_START = " Inertias and friction: model of "
"""Beginning of the comment in a URDF file that names the model."""

MAX_DEVIATION = 1e-3
"""Largest difference of frames in two descriptions of one robot [m, or of cosines]."""


def export_urdf(
    fit: Fit,
    source: FilePath,
    path: FilePath,
    *,
    tip: str | None = None,
    base: str | None = None,
) -> Path:
    """Write a robot's own URDF file with the identified model in it.

    Each link that a joint moves gets the inertial of its body, which contains all that
    is fixed to the link (fixed links then have none). Each joint gets its damping and
    dry friction, and its effort where a largest force is known. Joints beside the
    chain to `tip`, such as fingers, keep their type and their links, which are
    subtracted from the bodies that contain them. Where that leaves no possible body,
    and if joints of the chain mimic others, they become fixed where the robot holds
    them. A URDF describes no rotor inertias, no offsets and no width of a tanh: a
    comment names what is left out. Meshes, names and all else stay as they are.

    Args:
        fit: Physically consistent fit.
        source: URDF file of the robot; from a xacro or MJCF file, its expanded form is
            written.
        path: Path of the new file.
        tip: Last link, as in `load_urdf`; that of the fit's robot if None.
        base: First link, as in `load_urdf`; that of the fit's robot if None.

    Raises:
        FileNotFoundError: If the source does not exist.
        InputError: If the bodies of the fit cannot exist, or the file describes another
            robot.
    """
    robot = fit.base.model.robot
    tip = robot.source_tip if tip is None else tip
    base = robot.source_base if base is None else base
    bodies = feasible_bodies(fit, "a URDF file")
    arguments = dict(robot.source_arguments) if is_xacro(source) else {}
    place = {"tip": tip, "base": base, "xacro_arguments": arguments}
    place["floating"] = robot.floating
    file_robot = load_urdf(source, **place)
    # Joints of a sensor under the base are not in the file.
    first = GROUP if robot.has_base_sensor else 0
    if first:
        file_robot = file_robot.with_sensor(under_base=True)
    _require_same_robot(robot, file_robot, source)
    tree = UrdfTree(source, **place)
    dynamics = joint_dynamics(fit)
    _replace_comment(tree.root, fit, dynamics.missing_in_urdf)
    _replace_inertials(tree, bodies[first:])
    _write_joints(tree, robot, dynamics, first)
    document = tree.root.getroottree()
    text = etree.tostring(document, xml_declaration=True, encoding="utf-8")
    write_bytes(path, text + b"\n")
    return Path(path)


def _replace_comment(root: Any, fit: Fit, left_out: Texts) -> None:
    """Name the model in a comment, in place of the comment of an earlier export."""
    for comment in root.xpath("comment()"):
        if comment.text.startswith(COMMENT_START):
            root.remove(comment)
    root.insert(0, etree.Comment(COMMENT_START + origin_comment(fit, left_out)))


def _replace_inertials(tree: UrdfTree, bodies: BodyParameters) -> None:
    """Write the bodies into the links that joints move; no fixed link has one."""
    for joint in tree.mimics:
        _fix_joint(tree, joint)
    bodies, links = _without_side_branches(tree, bodies)
    links += [name for name, carrier in tree.carriers.items() if carrier.body >= 0]
    body_links = [link_names(joint)[1] for joint in tree.joints]
    inertials = dict(zip(body_links, bodies, strict=True))
    # Virtual joints, which the file does not have, move no mass.
    inertials = {link: body for link, body in inertials.items() if body[0]}
    for name in links:
        link = tree.links[name]
        for element in link.findall("inertial"):
            link.remove(element)
        if name in inertials:
            link.insert(0, _inertial(inertials[name]))


def _without_side_branches(
    tree: UrdfTree, bodies: BodyParameters
) -> tuple[Matrix, list[str]]:
    """Subtract from the bodies what joints beside the chain carry, such as fingers.

    Where that leaves no possible body, the joints become fixed. Return the bodies, and
    the links that remain parts of them.
    """
    remainders = np.array(bodies)
    # The poses are those before any joint becomes fixed.
    placements = tree.placed_links()
    contained_links = []
    for side_joint in tree.side_joints:
        branch = list(tree.branch(side_joint))
        links = [link_names(joint)[1] for joint in branch]
        load = np.zeros(10)
        for link in links:
            inertia_and_fault = tree.inertial(link)
            if link in placements and inertia_and_fault is not None:
                inertia, _ = inertia_and_fault
                _, rotation, position = placements[link]
                load += inertia.moved(rotation, position).parameters
        body = placements[link_names(side_joint)[0]].body
        remainder = remainders[body] - load
        # Simulators refuse joints that move no mass.
        if load[0] > 0.0 and consistency_margin(remainder) > 0.0:
            remainders[body] = remainder
            continue
        contained_links += links
        for joint in branch:
            _fix_joint(tree, joint)
    return remainders, contained_links


def _fix_joint(tree: UrdfTree, joint: Any) -> None:
    """Fix a joint where the robot holds it."""
    if joint.get("type") == "fixed":
        return
    rotation, position = tree.held_pose(joint)
    joint.set("type", "fixed")
    for mimic in joint.findall("mimic"):
        joint.remove(mimic)
    origin = child_element(joint, "origin")
    origin.set("xyz", exact_text(position))
    origin.set("rpy", exact_text(rpy_angles(rotation)))
    origin.attrib.pop("quat_xyzw", None)  # another form of the same


def _write_joints(
    tree: UrdfTree, robot: Robot, dynamics: JointDynamics, first: int
) -> None:
    """Write friction and largest forces of the robot's joints from the first one on."""
    # That of followers is part of their leaders'.
    zeros = np.zeros(len(robot.followers))
    damping = np.append(dynamics.values["damping"][first:], zeros)
    friction = np.append(dynamics.values["friction"][first:], zeros)
    efforts = np.append(robot.known_max_forces[first:], zeros + np.inf)
    for i, joint in enumerate(tree.joints):
        element = child_element(joint, "dynamics")
        # That of an MJCF file is no part of a URDF, and not the identified one.
        element.attrib.pop("armature", None)
        element.set("damping", exact_text(damping[i]))
        element.set("friction", exact_text(friction[i]))
        if np.isfinite(efforts[i]):
            limit = child_element(joint, "limit")
            limit.set("effort", exact_text(efforts[i]))
    # A URDF must have both; MJCF has no speeds.
    for limit in tree.root.iterfind("joint/limit"):
        for key in ("effort", "velocity"):
            limit.set(key, limit.get(key, "1e9"))


def _require_same_robot(robot: Robot, file_robot: Robot, source: FilePath) -> None:
    """Reject a file of another robot; how the robot is mounted is not in the file."""
    if robot.body_names != file_robot.body_names:
        raise InputError(
            f"`{source}` has the joints {', '.join(file_robot.body_names)}, "
            f"but the fit has {', '.join(robot.body_names)}: "
            "give the file of this robot, or its `tip`."
        )
    # How the robot is mounted on a sensor is not in the file, either.
    is_on_body = np.array(robot.parent) >= (GROUP if robot.has_base_sensor else 0)
    is_everywhere = np.ones_like(is_on_body)
    differences = {
        "relations between joints (`<mimic>`)": robot.followers != file_robot.followers,
        "kinds of joints": robot.revolute != file_robot.revolute,
        "axes": _differ(robot.axis, file_robot.axis, is_everywhere),
        "attitudes of joints": _differ(robot.rotation, file_robot.rotation, is_on_body),
        "places of joints": _differ(robot.offset, file_robot.offset, is_on_body),
    }
    for quantity, is_different in differences.items():
        if is_different:
            raise InputError(
                f"`{source}` has other {quantity} than the robot of the fit: "
                "give the file of that robot."
            )


def _differ(x: AnyArray, y: AnyArray, mask: np.ndarray) -> bool:
    """Return whether two arrays differ by more than rounding, where the mask says."""
    deviations = np.abs(np.asarray(x) - np.asarray(y))[mask]
    return bool(deviations.max(initial=0.0) > MAX_DEVIATION)


def _inertial(p: Vector) -> Any:
    """Return the element of a body, in the frame of its link."""
    inertia = Inertia.from_parameters(p)
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = zip(names, map(exact_text, inertia.moments), strict=True)
    return E.inertial(
        E.origin(xyz=exact_text(inertia.centre), rpy="0 0 0"),
        E.mass(value=exact_text(inertia.mass)),
        E.inertia(**dict(moments)),
    )


def child_element(element: Any, tag: str) -> Any:
    """Return the child of a tag, which is added if it is missing."""
    child = element.find(tag)
    return etree.SubElement(element, tag) if child is None else child
