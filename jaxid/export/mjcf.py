"""MJCF: the model for MuJoCo."""

from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import AnyArray, Float
from jaxid.export.physical import Inertial, Joints, known_efforts, possible_bodies
from jaxid.identification.fit import Fit
from jaxid.io import write_text
from jaxid.robot.robot import Robot


def export_mjcf(fit: Fit, path: str | Path) -> Path:
    """Writes the model for MuJoCo: geometry, bodies, rotors, friction, limits, motors.

    Rotor inertias are `armature`, viscous friction is `damping`, dry friction is `frictionloss`
    (without the width of a tanh: MuJoCo's own dry friction holds a joint still). What MJCF cannot
    hold is named in a comment of the file. A known tool is not in it.

    Args:
        fit: A physically consistent fit.
        path: Of the file; one that is there already is replaced.

    Raises:
        InputError: If the bodies of the fit could not exist.
    """
    path = Path(path)
    bodies = possible_bodies(fit, "an MJCF file")
    joints = Joints.of(fit)
    said = [f"Model of {fit.date or 'an unknown day'}, {fit.checksum}."]
    if joints.left:
        said.append(f"Not in this file: {', '.join(joints.left)}.")
    text = mjcf_text(
        fit.base.model.robot,
        bodies,
        armature=joints.armature,
        damping=joints.damping,
        friction=joints.friction,
        comment=" ".join(said),
    )
    write_text(path, text)
    return path


def mjcf_text(
    robot: Robot,
    bodies: Float[AnyArray, "joints 10"],
    *,
    armature: Float[AnyArray, " joints"] | float = 0.0,
    damping: Float[AnyArray, " joints"] | float = 0.0,
    friction: Float[AnyArray, " joints"] | float = 0.0,
    timestep: float = 0.001,
    comment: str = "",
) -> str:
    """A robot with given bodies as MJCF; joints keep their names, bodies are named after them.

    Args:
        robot: Geometry, limits and gravity.
        bodies: Ten parameters for each in the paper's order.
        armature: Inertia of the rotors [kg m² or kg].
        damping: Viscous friction [N m s/rad or N s/m].
        friction: Dry friction [N m or N].
        timestep: Of the simulation [s].
        comment: That stands at the top.
    """
    root = etree.Element("mujoco", model=robot.name)
    if comment:
        root.append(etree.Comment(f" {comment.replace('--', '- -')} "))
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = _numbers(robot.gravity)
    etree.SubElement(root, "option", gravity=gravity, timestep=_number(timestep))
    world = etree.SubElement(root, "worldbody")
    actuators = etree.SubElement(root, "actuator")
    at_joints = {
        "armature": np.broadcast_to(armature, robot.joints),
        "damping": np.broadcast_to(damping, robot.joints),
        "frictionloss": np.broadcast_to(friction, robot.joints),
    }
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    efforts = known_efforts(robot)
    elements: list[etree._Element] = []
    for i, (parent, name) in enumerate(zip(robot.parent, robot.joint_names, strict=True)):
        body = etree.SubElement(
            elements[parent] if parent >= 0 else world,
            "body",
            name=f"{name}_body",
            pos=_numbers(robot.offset[i]),
            quat=_numbers(quaternion(np.asarray(robot.rotation[i]))),
        )
        elements.append(body)
        m, c, J = Inertial.of(np.asarray(bodies)[i])
        tensor = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
        etree.SubElement(
            body, "inertial", pos=_numbers(c), mass=_number(m), fullinertia=_numbers(tensor)
        )
        joint = etree.SubElement(
            body,
            "joint",
            name=name,
            type="hinge" if robot.revolute[i] else "slide",
            axis=_numbers(robot.axis[i]),
            **{key: _number(values[i]) for key, values in at_joints.items() if values[i]},
        )
        if np.isfinite(low[i]) and np.isfinite(high[i]):
            joint.set("range", _numbers((low[i], high[i])))
        motor = etree.SubElement(actuators, "motor", name=f"{name}_motor", joint=name)
        if np.isfinite(efforts[i]):
            motor.set("ctrlrange", _numbers((-efforts[i], efforts[i])))
    etree.SubElement(
        elements[robot.tip_body],
        "site",
        name="tip",
        pos=_numbers(robot.tip_offset),
        quat=_numbers(quaternion(np.asarray(robot.tip_rotation))),
    )
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def quaternion(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """The rotation as (w, x, y, z), by its best determined component."""
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], 0, 0, 0],
            [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], 0, 0],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], 0],
            [
                R[1, 0] - R[0, 1],
                R[0, 2] + R[2, 0],
                R[1, 2] + R[2, 1],
                R[2, 2] - R[0, 0] - R[1, 1],
            ],
        ]
    )
    _, vectors = np.linalg.eigh(K / 3.0)
    q = vectors[:, -1]
    return q if q[0] >= 0 else -q


def _number(x: float) -> str:
    return repr(float(x))


def _numbers(values) -> str:
    return " ".join(_number(x) for x in np.asarray(values, np.float64))
