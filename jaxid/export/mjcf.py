"""MJCF files: a robot for MuJoCo."""

from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float
from jaxid.export.inertials import feasible_bodies, joint_dynamics
from jaxid.identification.fit import Fit
from jaxid.io import write_text
from jaxid.robot.inertia import Inertia
from jaxid.robot.robot import Robot


def export_mjcf(fit: Fit, path: str | Path) -> Path:
    """Write the model for MuJoCo: geometry, bodies, rotors, friction, limits, motors.

    Rotor inertias are `armature`, viscous friction is `damping`, dry friction is `frictionloss`
    (without the width of a tanh: MuJoCo's own dry friction holds a joint at rest). A comment in the
    file names what MJCF cannot describe. A known tool is not included.

    Args:
        fit: Physically consistent fit.
        path: Path of the file; an existing file is replaced.

    Raises:
        InputError: If the bodies of the fit cannot exist.
    """
    bodies, joints = feasible_bodies(fit, "an MJCF file"), joint_dynamics(fit)
    comment = f"Model of {fit.date or 'an unknown day'}, {fit.checksum}."
    if joints.left_out:
        comment += f" Not in this file: {', '.join(joints.left_out)}."
    text = mjcf_text(
        fit.base.model.robot,
        bodies,
        armature=joints.armature,
        damping=joints.damping,
        friction=joints.friction,
        comment=comment,
    )
    write_text(path, text)
    return Path(path)


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
    """Return a robot with given bodies as MJCF; bodies are named after their joints.

    Args:
        robot: Geometry, limits and gravity.
        bodies: Ten parameters of each body in the paper's order.
        armature: Inertia of the rotors [kg m² or kg].
        damping: Viscous friction [N m s/rad or N s/m].
        friction: Dry friction [N m or N].
        timestep: Time step of the simulation [s].
        comment: Comment at the top.
    """
    root = etree.Element("mujoco", model=robot.name)
    if comment:
        root.append(etree.Comment(f" {comment.replace('--', '- -')} "))
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    etree.SubElement(root, "option", gravity=_text(robot.gravity), timestep=_text(timestep))
    world = etree.SubElement(root, "worldbody")
    actuators = etree.SubElement(root, "actuator")
    at_joints = {
        "armature": np.broadcast_to(armature, robot.joints),
        "damping": np.broadcast_to(damping, robot.joints),
        "frictionloss": np.broadcast_to(friction, robot.joints),
    }
    ranges = np.stack([robot.limits.position_min, robot.limits.position_max], axis=1)
    efforts = np.asarray(robot.known_max_forces)
    elements: list[etree._Element] = []
    for i, (parent, name) in enumerate(zip(robot.parent, robot.joint_names, strict=True)):
        body = etree.SubElement(
            elements[parent] if parent >= 0 else world,
            "body",
            name=f"{name}_body",
            **_placement(robot.offset[i], robot.rotation[i]),
        )
        elements.append(body)
        inertia = Inertia.from_parameters(np.asarray(bodies)[i])
        etree.SubElement(
            body,
            "inertial",
            pos=_text(inertia.centre),
            mass=_text(inertia.mass),
            fullinertia=_text(inertia.tensor[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]),
        )
        joint = etree.SubElement(
            body,
            "joint",
            name=name,
            type="hinge" if robot.revolute[i] else "slide",
            axis=_text(robot.axis[i]),
            **{key: _text(values[i]) for key, values in at_joints.items() if values[i]},
        )
        if np.isfinite(ranges[i]).all():
            joint.set("range", _text(ranges[i]))
        motor = etree.SubElement(actuators, "motor", name=f"{name}_motor", joint=name)
        if np.isfinite(efforts[i]):
            motor.set("ctrlrange", _text((-efforts[i], efforts[i])))
    tip = _placement(robot.tip_offset, robot.tip_rotation)
    etree.SubElement(elements[robot.tip_body], "site", name="tip", **tip)
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def _placement(offset: AnyArray, rotation: AnyArray) -> dict[str, str]:
    """Return the attributes of a placement; MuJoCo's quaternions are (w, x, y, z)."""
    quaternion = Rotation.from_matrix(np.asarray(rotation)).as_quat(canonical=True)
    return {"pos": _text(offset), "quat": _text(np.roll(quaternion, 1))}


def _text(values: AnyArray | tuple | float) -> str:
    """Write numbers with all their digits."""
    return " ".join(map(repr, np.ravel(np.asarray(values, np.float64)).tolist()))
