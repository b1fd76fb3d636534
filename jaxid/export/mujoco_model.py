"""The identified model as an MJCF file for MuJoCo."""

from pathlib import Path
from typing import Any

import numpy as np
import scipy
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]

from jaxid.arrays import AnyArray, Vector
from jaxid.identification.fit_result import Fit
from jaxid.io import FilePath, import_extra, write_text
from jaxid.robot.contacts import Contact, Sphere
from jaxid.robot.follower_joints import Follower
from jaxid.robot.inertia import BodyParameters, Inertia
from jaxid.robot.joint_coordinates import with_leader
from jaxid.robot.mjcf import exact_text
from jaxid.robot.robot import GRAVITY, Robot
from jaxid.robot.virtual_joints import GROUP, frames_between

from .bodies_and_joint_dynamics import (
    Quantities,
    feasible_bodies,
    joint_dynamics,
    origin_comment,
)

POINT_RADIUS = 0.005
"""Radius of a foot that is a point [m]."""
SOLE_SIZE = (0.03, 0.005)
"""Radius and half the thickness of a sole, whose shape the robot does not hold [m]."""
ATTRIBUTES = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}
"""Attributes of MJCF for the quantities of `joint_dynamics`."""


def export_mjcf(fit: Fit, path: FilePath) -> Path:
    """Write the model for MuJoCo: geometry, bodies, rotors, friction, limits, motors.

    Feet of a robot on legs touch the ground: balls as they are, and of a sole the
    circle that a designed motion counts on. No other body has a shape.

    Rotor inertias are `armature`, viscous friction is `damping`, dry friction is
    `frictionloss` (without the width of a tanh: MuJoCo's own dry friction holds a joint
    at rest). A comment in the file names what MJCF cannot describe. A known tool is not
    included.

    Args:
        fit: Physically consistent fit.
        path: Path of the file; an existing file is replaced.

    Raises:
        InputError: If the bodies of the fit cannot exist.
    """
    write_text(path, _text_of(fit))
    return Path(path)


def as_mujoco(fit: Fit) -> Any:
    """Return the identified robot as a `mujoco.MjSpec`, which others can extend.

    It is what `export_mjcf` writes: attach it to a scene, add sensors, or `compile` it.

    Args:
        fit: Physically consistent fit.

    Raises:
        InputError: If the bodies of the fit cannot exist, or MuJoCo is not installed.
    """
    mujoco = import_extra("mujoco", "mujoco", "`as_mujoco` needs")
    return mujoco.MjSpec.from_string(_text_of(fit))


def _text_of(fit: Fit) -> str:
    """Return the MJCF of a fit, with a comment on what it cannot describe."""
    bodies = feasible_bodies(fit, "an MJCF file")
    dynamics = joint_dynamics(fit)
    comment = f" Model of {origin_comment(fit, dynamics.omissions)}"
    robot = fit.base.model.robot
    return mjcf_text(robot, bodies, dynamics.values, comment=comment)


def mjcf_text(
    robot: Robot,
    bodies: BodyParameters,
    dynamics: Quantities,
    timestep: float = 0.001,
    comment: str = "",
) -> str:
    """Return a robot, its bodies and the `joint_dynamics` as MJCF.

    Each body has ten parameters in the paper's order, and is named after its joint.
    Quantities that `dynamics` does not hold are zero.
    """
    root: Any = E.mujoco(model=robot.name)
    if comment:
        root.append(etree.Comment(comment))
    # A floating base has none: its accelerometer measures it.
    gravity = exact_text(GRAVITY if robot.floating else robot.gravity)
    root.append(E.compiler(angle="radian", autolimits="true"))
    root.append(E.option(gravity=gravity, timestep=exact_text(timestep)))
    world = etree.SubElement(root, "worldbody")
    actuators = etree.SubElement(root, "actuator")

    elements: dict[int, Any] = {-1: world}
    for i in robot.order:
        if i in frames_between(robot.virtual):
            elements[i] = elements[robot.parent[i]]
            continue
        # The first joint of a group holds its placement.
        placed = i - GROUP + 1 if i in robot.virtual else i
        is_solid = i in robot.solid_bodies
        body = E.body(
            *([_inertial(np.asarray(bodies)[i])] if is_solid else []),
            *_joints(robot, i, dynamics),
            name=f"{robot.body_names[i]}_body",
            **placement_attributes(robot.offset[placed], robot.rotation[placed]),
        )
        elements[robot.parent[i]].append(body)
        elements[i] = body
    for contact in robot.contacts:
        elements[contact.body].append(_foot(contact))
    actuators.extend(_motor(robot, joint) for joint in robot.driven)
    if robot.followers:
        led_followers = with_leader(robot.followers)
        root.append(E.equality(*(_equality(robot, f) for f in led_followers)))
    if robot.loops:
        _append_loops(root, robot, elements)
    tip = placement_attributes(robot.tip_offset, robot.tip_rotation)
    elements[robot.tip_body].append(E.site(name="tip", **tip))
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def _foot(contact: Contact) -> Any:
    """Return the shape of a foot, without mass."""
    kind = "cylinder"
    size = SOLE_SIZE
    if isinstance(contact.shape, Sphere):
        kind = "sphere"
        size = (contact.shape.radius or POINT_RADIUS,)
    place = exact_text(contact.position)
    return E.geom(name=contact.name, type=kind, size=exact_text(size), pos=place)


def _inertial(p: Vector) -> Any:
    """Return the element of a body's mass, centre of mass and moments of inertia."""
    inertia = Inertia.from_parameters(p)
    # In MuJoCo's order: xx, yy, zz, xy, xz, yz.
    moments = inertia.tensor[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    return E.inertial(
        pos=exact_text(inertia.centre),
        mass=exact_text(inertia.mass),
        fullinertia=exact_text(moments),
    )


def _joints(robot: Robot, i: int, dynamics: Quantities) -> list[Any]:
    """Return the joint of a body: a free one of a floating base, none of a sensor."""
    if i not in robot.virtual:
        return [_joint(robot, i, dynamics)]
    is_base = robot.floating and i not in robot.rigid
    return [E.freejoint()] if is_base else []


def _joint(robot: Robot, i: int, dynamics: Quantities) -> Any:
    """Return the element of a joint, with its range where both ends are known."""
    element: Any = E.joint(
        name=robot.body_names[i],
        type="hinge" if robot.turns[i] else "slide",
        axis=exact_text(robot.axis[i]),
    )
    # What belongs to a follower is part of what belongs to its leader.
    if i >= robot.joints:
        follower = robot.followers[i - robot.joints]
        ends = np.array([follower.position_min, follower.position_max])
        if np.isfinite(ends).all():
            element.set("range", exact_text(ends))
        return element
    for quantity, attribute in ATTRIBUTES.items():
        if quantity in dynamics and dynamics[quantity][i]:
            element.set(attribute, exact_text(dynamics[quantity][i]))
    ends = np.array([robot.limits.position_min[i], robot.limits.position_max[i]])
    if np.isfinite(ends).all():
        element.set("range", exact_text(ends))
    return element


def _equality(robot: Robot, follower: Follower) -> Any:
    """Return the element of the constraint that makes a joint follow another one."""
    return E.joint(
        joint1=follower.name,
        joint2=robot.joint_names[follower.leader],
        polycoef=exact_text((follower.offset, follower.factor, 0.0, 0.0, 0.0)),
    )


def _append_loops(root: Any, robot: Robot, elements: dict[int, Any]) -> None:
    """Write the points of the loops as sites, and the pose in which they close."""
    equality = root.find("equality")
    for loop in robot.loops:
        names = (f"{loop.name} first", f"{loop.name} second")
        for name, body, point in zip(names, loop.bodies, loop.points, strict=True):
            site = E.site(name=name, pos=exact_text(point))
            elements[body].append(site)
        first_name, second_name = names
        connect = E.connect(name=loop.name, site1=first_name, site2=second_name)
        equality.append(connect)
    # The joints in the order of the file.
    joints = root.find("worldbody").iter("joint")
    places = [robot.body_names.index(joint.get("name")) for joint in joints]
    pose = exact_text(np.asarray(robot.loop_pose)[places])
    root.append(E.keyframe(E.key(name="closed", qpos=pose)))


def _motor(robot: Robot, i: int) -> Any:
    """Return the element of a joint's motor, with its largest force if known."""
    name = robot.joint_names[i]
    element: Any = E.motor(name=f"{name}_motor", joint=name)
    force = np.asarray(robot.known_max_forces)[i]
    if np.isfinite(force):
        element.set("ctrlrange", exact_text((-force, force)))
    return element


def placement_attributes(offset: AnyArray, rotation: AnyArray) -> dict[str, str]:
    """Return the attributes of a placement; MuJoCo's quaternions are (w, x, y, z)."""
    quaternion = scipy.spatial.transform.Rotation.from_matrix(
        np.asarray(rotation)
    ).as_quat(canonical=True)
    return {"pos": exact_text(offset), "quat": exact_text(np.roll(quaternion, 1))}
