"""Files for simulators and tools: URDF, MJCF, and the parameters that Pinocchio takes."""

import itertools
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float, Joints, double_precision
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import consistency_margin
from jaxid.identification.fit_result import Fit
from jaxid.io import json_text, write_bytes, write_text
from jaxid.result_table import printable
from jaxid.robot.inertia import Inertia
from jaxid.robot.mjcf import exact_text
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_angles
from jaxid.robot.urdf import load_urdf
from jaxid.robot.urdf_tree import UrdfTree

from .torque_program import body_parameters

_COMMENT = " Inertias and friction: model of "
"""Beginning of the comment in a URDF file that names the model."""


def joint_dynamics(
    fit: Fit,
) -> tuple[dict[str, Float[np.ndarray, " joints"]], tuple[str, ...], tuple[str, ...]]:
    r"""Return inertia and friction at the joints, as far as simulators can describe them.

    They follow from the columns of the terms: a parameter belongs to a joint if its
    forces, as the mean of both directions, are $a \ddot q_j + b \dot q_j + c\,
    \mathrm{sign}(\dot q_j)$ at all speeds beyond the transition of dry friction.

    Returns:
        The `armature` [kg m² or kg], `damping` [N m s/rad or N s/m] and dry `friction`
        [N m or N]; the names of the parameters in `armature`; and the names of those in
        none of the three.
    """
    model = fit.base.model
    robot, total, rotors = model.robot, np.zeros((3, model.robot.joints)), []
    left_out = [] if model.memory is None else ["the memory of dry friction"]
    for term, p in model.split(fit.standard_parameters):
        if term.body_parameters:
            continue
        coefficients = _joint_coefficients(term, robot)
        total += coefficients @ np.asarray(p)
        for k, (name, _) in enumerate(term.parameters(robot)):
            if coefficients[0, :, k].any():
                rotors.append(name)
            if not coefficients[:, :, k].any():
                left_out.append(name)
    values = {"armature": total[0], "damping": total[1], "friction": total[2]}
    return values, tuple(rotors), tuple(left_out)


def _joint_coefficients(
    term: AbstractTerm, robot: Robot
) -> Float[np.ndarray, "3 joints columns"]:
    """Return inertia, viscous and dry friction of unit parameters; zeros if they are neither."""
    random, n, probes = np.random.default_rng(0), robot.joints, 6
    q, qdd = random.uniform(-1.0, 1.0, (2, probes, n))
    qd = random.uniform(20.0, 80.0, (probes, n)) * random.choice(
        [-1.0, 1.0], (probes, n)
    )
    with double_precision():
        columns = 0.5 * np.array(
            [
                np.asarray(term.columns(robot, x, v, a))
                - term.columns(robot, x, -v, -a)
                for x, v, a in zip(q, qd, qdd, strict=True)
            ]
        )
    coefficients = np.zeros((3, n, columns.shape[2]))
    for j, k in zip(*np.nonzero(columns.any(axis=0)), strict=True):
        basis = np.stack([qdd[:, j], qd[:, j], np.sign(qd[:, j])], axis=1)
        x = np.linalg.lstsq(basis, columns[:, j, k])[0]
        alone = np.count_nonzero(columns[:, :, k].any(axis=0)) == 1
        if alone and np.abs(basis @ x - columns[:, j, k]).max() < 1e-9:
            coefficients[:, j, k] = x.round(12)
    return coefficients


def _feasible_bodies(fit: Fit, target: str) -> Float[np.ndarray, "joints 10"]:
    """Return ten parameters of each body; reject bodies and friction that cannot exist."""
    cure = (
        "identify with `jid.PhysicallyConsistent()` (in the experiment file: "
        "`[estimator]` "
        '`kind = "consistent"`)'
    )
    if fit.full_parameters is None:
        raise InputError(
            f"{target} needs all parameters, but the fit knows only base parameters: "
            f"{cure}."
        )
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    # Rounding may reach slightly below zero.
    feasible = (np.asarray(consistency_margin(bodies)) >= -1e-9) & (bodies[:, 0] > 0)
    if not feasible.all():
        body = int(np.argmin(feasible)) + 1
        raise InputError(
            f"{target} needs bodies that can exist, but body {body} cannot: {cure}."
        )
    for quantity, values in joint_dynamics(fit)[0].items():
        if (values < 0).any():
            joint = fit.base.model.robot.joint_names[int(np.argmin(values))]
            raise InputError(
                f"{target} needs `{quantity}` >= 0, but `{joint}` has "
                f"{values.min():g}: {cure}."
            )
    return bodies


def _origin(fit: Fit, left_out: tuple[str, ...]) -> str:
    """Return what the comment of a file says about the model."""
    text = f"{fit.date or 'an unknown day'}, {fit.checksum}. "
    if left_out:
        text += f"Not in this file: {', '.join(left_out)}. "
    return re.sub("-(?=-)", "- ", printable(text))


def export_urdf(
    fit: Fit,
    source: str | Path,
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
) -> Path:
    """Write a robot's own URDF file with the identified model in it.

    Replaced are the inertial of each link that a joint moves, with all that is fixed to
    it (fixed links then have none), the damping and the dry friction of each joint, and
    its effort where a largest force is known. Joints on identified bodies that the
    robot does not have, such as fingers, become fixed where the robot holds them,
    because the bodies contain their links. A URDF describes no rotor inertias, no
    offsets and no width of a tanh: a comment names what is left out. Meshes, names and
    all else stay as they are.

    Args:
        fit: Physically consistent fit.
        source: URDF file of the robot; from a xacro or MJCF file, its expanded form is
            written.
        path: Path of the new file.
        tip: Last link, as in `load_urdf`.
        base: First link, as in `load_urdf`.

    Raises:
        FileNotFoundError: If the source does not exist.
        InputError: If the bodies of the fit cannot exist, or the file describes another
            robot.
    """
    robot, bodies = fit.base.model.robot, _feasible_bodies(fit, "a URDF file")
    _require_same(robot, load_urdf(source, tip=tip, base=base), source)
    tree = UrdfTree(source, tip=tip, base=base)
    dynamics, rotors, left_out = joint_dynamics(fit)
    efforts = np.asarray(robot.known_max_forces)
    root, links = tree.root, _hold_joints(tree)
    for comment in root.xpath("comment()"):
        if comment.text.startswith(_COMMENT):
            root.remove(comment)
    root.insert(0, etree.Comment(_COMMENT + _origin(fit, (*rotors, *left_out))))
    joints = {e.get("name"): e for e in root.iterfind("joint")}
    moved = {
        joints[name].find("child").get("link"): i
        for i, name in enumerate(robot.joint_names)
    }
    links += [name for name, (body, _, _) in tree.carriers.items() if body >= 0]
    for name in links:
        link = tree.links[name]
        for old in link.findall("inertial"):
            link.remove(old)
        if name in moved:
            link.insert(0, _inertial(bodies[moved[name]]))
    for i, name in enumerate(robot.joint_names):
        element = _child(joints[name], "dynamics")
        for quantity in ("damping", "friction"):
            element.set(quantity, exact_text(dynamics[quantity][i]))
        if np.isfinite(efforts[i]):
            _child(joints[name], "limit").set("effort", exact_text(efforts[i]))
    for limit, key in itertools.product(
        root.iterfind("joint/limit"), ("effort", "velocity")
    ):
        # A URDF must have both; MJCF has no speeds.
        limit.set(key, limit.get(key, "1e9"))
    write_bytes(
        path,
        etree.tostring(root.getroottree(), xml_declaration=True, encoding="utf-8")
        + b"\n",
    )
    return Path(path)


def _hold_joints(tree: UrdfTree) -> list[str]:
    """Fix the joints on identified bodies that the robot does not have; return links below them."""
    branches = [joint for first in tree.left_out for joint in tree.branch(first)]
    for joint in (*tree.held, *branches):
        if joint.get("type") == "fixed":
            continue
        R, r = tree.held_pose(joint)
        joint.set("type", "fixed")
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
        origin = _child(joint, "origin")
        origin.set("xyz", exact_text(r))
        origin.set("rpy", exact_text(rpy_angles(R)))
    return [joint.find("child").get("link") for joint in branches]


def _require_same(robot: Robot, described: Robot, source: str | Path) -> None:
    if robot.joint_names != described.joint_names:
        raise InputError(
            f"`{source}` has the joints {', '.join(described.joint_names)}, but the "
            "fit has "
            f"{', '.join(robot.joint_names)}: give the file of this robot, or its "
            "`tip`."
        )
    for name, ours, theirs in zip(
        robot.joint_names, robot.revolute, described.revolute, strict=True
    ):
        if ours != theirs:
            kinds = ("slides", "turns")
            raise InputError(
                f"joint `{name}` {kinds[theirs]} in `{source}`, but {kinds[ours]} in "
                "the robot of "
                "the fit: give its own file."
            )
    # The file does not say how the robot is mounted on the ground.
    inner = [i for i, parent in enumerate(robot.parent) if parent >= 0]
    for quantity, rows in (
        ("axis", slice(None)),
        ("rotation", inner),
        ("offset", inner),
    ):
        one, other = (
            np.asarray(getattr(r, quantity))[rows] for r in (robot, described)
        )
        if not np.allclose(one, other, rtol=0.0, atol=1e-3):
            raise InputError(
                f"`{source}` has another `{quantity}` than the robot of the fit: give "
                "its own file."
            )


def _inertial(p: Float[np.ndarray, "10"]) -> etree._Element:
    inertia, element = Inertia.from_parameters(p), etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=exact_text(inertia.centre), rpy="0 0 0")
    etree.SubElement(element, "mass", value=exact_text(inertia.mass))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = zip(names, map(exact_text, inertia.moments), strict=True)
    etree.SubElement(element, "inertia", dict(moments))
    return element


def _child(element: etree._Element, tag: str) -> etree._Element:
    child = element.find(tag)
    return etree.SubElement(element, tag) if child is None else child


def export_mjcf(fit: Fit, path: str | Path) -> Path:
    """Write the model for MuJoCo: geometry, bodies, rotors, friction, limits, motors.

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
    bodies = _feasible_bodies(fit, "an MJCF file")
    values, _, left_out = joint_dynamics(fit)
    comment = f" Model of {_origin(fit, left_out)}"
    write_text(path, mjcf_text(fit.base.model.robot, bodies, values, comment=comment))
    return Path(path)


def mjcf_text(
    robot: Robot,
    bodies: Float[AnyArray, "joints 10"],
    dynamics: Mapping[str, Joints],
    timestep: float = 0.001,
    comment: str = "",
) -> str:
    """Return a robot, its bodies and the `joint_dynamics` as MJCF.

    Each body has ten parameters in the paper's order, and is named after its joint.
    Quantities that `dynamics` does not hold are zero.
    """
    root = etree.Element("mujoco", model=robot.name)
    if comment:
        root.append(etree.Comment(comment))
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    etree.SubElement(
        root, "option", gravity=exact_text(robot.gravity), timestep=exact_text(timestep)
    )
    world = etree.SubElement(root, "worldbody")
    actuators = etree.SubElement(root, "actuator")
    attributes = {
        "armature": "armature",
        "damping": "damping",
        "frictionloss": "friction",
    }
    at_joints = {
        key: dynamics[name] for key, name in attributes.items() if name in dynamics
    }
    ranges = np.stack([robot.limits.position_min, robot.limits.position_max], axis=1)
    efforts = np.asarray(robot.known_max_forces)
    elements: list[etree._Element] = []
    for i, (parent, name) in enumerate(
        zip(robot.parent, robot.joint_names, strict=True)
    ):
        body = etree.SubElement(
            elements[parent] if parent >= 0 else world,
            "body",
            name=f"{name}_body",
            **placement_attributes(robot.offset[i], robot.rotation[i]),
        )
        elements.append(body)
        inertia = Inertia.from_parameters(np.asarray(bodies)[i])
        etree.SubElement(
            body,
            "inertial",
            pos=exact_text(inertia.centre),
            mass=exact_text(inertia.mass),
            fullinertia=exact_text(
                inertia.tensor[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
            ),
        )
        joint = etree.SubElement(
            body,
            "joint",
            name=name,
            type="hinge" if robot.revolute[i] else "slide",
            axis=exact_text(robot.axis[i]),
            **{
                key: exact_text(values[i])
                for key, values in at_joints.items()
                if values[i]
            },
        )
        if np.isfinite(ranges[i]).all():
            joint.set("range", exact_text(ranges[i]))
        motor = etree.SubElement(actuators, "motor", name=f"{name}_motor", joint=name)
        if np.isfinite(efforts[i]):
            motor.set("ctrlrange", exact_text((-efforts[i], efforts[i])))
    tip = placement_attributes(robot.tip_offset, robot.tip_rotation)
    etree.SubElement(elements[robot.tip_body], "site", name="tip", **tip)
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def placement_attributes(offset: AnyArray, rotation: AnyArray) -> dict[str, str]:
    """Return the attributes of a placement; MuJoCo's quaternions are (w, x, y, z)."""
    quaternion = Rotation.from_matrix(np.asarray(rotation)).as_quat(canonical=True)
    return {"pos": exact_text(offset), "quat": exact_text(np.roll(quaternion, 1))}


def pinocchio_parameters(fit: Fit) -> Float[np.ndarray, "joints 10"]:
    r"""Return the bodies' parameters in Pinocchio's order, about the origins of the joint frames.

    Each row is an argument of `pinocchio.Inertia.FromDynamicParameters` and fits the
    columns of Pinocchio's `computeJointTorqueRegressor`:
    $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$. The rows stand in the
    order of the robot's joints. The forces are those of the fit even if the bodies
    cannot exist.

    Args:
        fit: Identified model.
    """
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    return np.asarray(Inertia.from_parameters(bodies).pinocchio)


def export_pinocchio(fit: Fit, path: str | Path) -> Path:
    """Write the bodies in Pinocchio's order, and inertia and friction at the joints, as JSON.

    Args:
        fit: Identified model.
        path: Path of the file; an existing file is replaced.
    """
    values, _, left_out = joint_dynamics(fit)
    columns = {
        "name": fit.base.model.robot.joint_names,
        "parameters": pinocchio_parameters(fit).tolist(),
        **{quantity: x.tolist() for quantity, x in values.items()},
    }
    content = {
        "model": fit.checksum,
        "date": fit.date,
        "names": ["m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"],
        "joints": [
            dict(zip(columns, row, strict=True))
            for row in zip(*columns.values(), strict=True)
        ],
        "left_out": list(left_out),
    }
    write_text(path, json_text(content))
    return Path(path)
