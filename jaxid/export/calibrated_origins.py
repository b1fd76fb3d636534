"""The robot's own URDF or MJCF file with the origins of its joints calibrated."""

from pathlib import Path
from typing import Any

import numpy as np
import scipy
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.calibration.frames import ORIGIN, Frame
from jaxid.calibration.geometry_fit import GeometryFit
from jaxid.errors import InputError
from jaxid.io import FilePath, write_bytes
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.mjcf import exact_text, import_mujoco, rotation_of_quaternion
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_angles
from jaxid.robot.urdf_tree import UrdfTree

from .identified_urdf import child_element


def export_origins(
    fit: GeometryFit, path: FilePath, *, source: FilePath | None = None
) -> Path:
    """Write a robot's own file with calibrated origins of its joints.

    All else stays as it is, also inertias, meshes and limits. A URDF has no
    compliances: `fit.deflections` has the angles that they add.

    Args:
        fit: Calibrated geometry.
        path: Path of the new file.
        source: URDF or MJCF file of the robot; that from which it was loaded if None.
            From a xacro file, its expanded form is written.

    Raises:
        InputError: If the robot comes from no file, or the file has other joints.
    """
    robot = fit.problem.robot
    source = robot.source if source is None else source
    if not Path(source).is_file():
        raise InputError(
            f"`{robot.name}` comes from no file: give `source`, its URDF or MJCF file."
        )
    write = _mjcf if is_mjcf(source) else _urdf
    write_bytes(path, write(fit, robot, source))
    return Path(path)


def _corrections(fit: GeometryFit) -> list[Frame]:
    """Return the correction of each body's frame in its nominal frame."""
    nominal = fit.problem.robot
    rotations = np.asarray(nominal.rotation)
    attitudes = np.swapaxes(rotations, -1, -2) @ np.asarray(fit.robot.rotation)
    shifts = fit.origins[:, :3]
    return [Frame(*pair) for pair in zip(attitudes, shifts, strict=True)]


def _urdf(fit: GeometryFit, robot: Robot, source: FilePath) -> bytes:
    """Return the text of a URDF file with calibrated origins."""
    tree = UrdfTree(
        source,
        tip=robot.source_tip,
        base=robot.source_base,
        xacro_arguments=dict(robot.source_arguments) or None,
    )
    _require_joints(robot, [joint.get("name") for joint in tree.joints], source)
    for joint, correction in zip(tree.joints, _corrections(fit), strict=True):
        origin = child_element(joint, "origin")
        position = tree.numbers(origin, "xyz", (0.0, 0.0, 0.0))
        frame = Frame(tree.attitude(origin), position) @ correction
        origin.set("xyz", exact_text(frame.position))
        origin.set("rpy", exact_text(rpy_angles(frame.rotation)))
        origin.attrib.pop("quat_xyzw", None)  # another form of the same
    document = tree.root.getroottree()
    return etree.tostring(document, xml_declaration=True, encoding="utf-8") + b"\n"


def _mjcf(fit: GeometryFit, robot: Robot, source: FilePath) -> bytes:
    """Return the text of an MJCF file with calibrated bodies."""
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_path(str(source))
    spec = mujoco.MjSpec.from_file(str(source))
    spec.compile()
    root = etree.fromstring(spec.to_xml().encode())
    names = [joint.name for joint in spec.joints]
    _require_joints(robot, names, source)
    corrections = dict(zip(robot.body_names, _corrections(fit), strict=True))
    for body in root.find("worldbody").iter("body"):
        joints = [x for x in body.iterchildren("joint") if x.get("name") in corrections]
        if joints:
            _correct_body(model, body, joints, corrections)
    return etree.tostring(root, encoding="utf-8") + b"\n"


def _correct_body(
    model: Any, body: Any, joints: list[Any], corrections: dict[str, Frame]
) -> None:
    """Place a body and its joints, each of which moves all after it.

    Args:
        model: Model of the file before.
        body: Element of the body.
        joints: Elements of its joints.
        corrections: Corrections at the joints, by their names.
    """
    models = [model.joint(joint.get("name")) for joint in joints]
    number = int(models[0].bodyid[0])
    rotation = rotation_of_quaternion(model.body_quat[number])
    start = Frame(rotation, model.body_pos[number])
    motion = ORIGIN
    places = []
    for joint in models:
        # The frame of a jaxid body has its origin at the joint.
        at_joint = start @ Frame(np.eye(3), joint.pos)
        motion = motion @ at_joint @ corrections[joint.name] @ at_joint.inverse
        places.append(motion @ at_joint)
    frame = motion @ start
    quaternion = scipy.spatial.transform.Rotation.from_matrix(frame.rotation)
    body.set("pos", exact_text(frame.position))
    body.set("quat", exact_text(np.roll(quaternion.as_quat(), 1)))
    for element, joint, place in zip(joints, models, places, strict=True):
        at_joint = frame.inverse @ place
        element.set("pos", exact_text(at_joint.position))
        element.set("axis", exact_text(at_joint.rotation @ joint.axis))


def _require_joints(robot: Robot, names: list[Any], source: FilePath) -> None:
    """Reject a file without the joints of the robot."""
    missing_names = [name for name in robot.body_names if name not in names]
    if missing_names:
        raise InputError(
            f"`{source}` has no joint `{missing_names[0]}`: give the file of "
            f"`{robot.name}`."
        )
