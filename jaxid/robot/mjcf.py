"""The kinematic tree of an MJCF file, which MuJoCo compiles, written as a URDF."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import scipy
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]

from jaxid.arrays import Matrix3, Numbers, Vector, Vector3
from jaxid.errors import InputError
from jaxid.io import import_extra

from .contacts import AbstractContactShape, Sole, Sphere
from .mjcf_flags import switch_off
from .rotations import axis_rotation, rpy_angles

JOINT_TYPES = ("floating", "ball", "prismatic", "revolute")
"""Types of joints in MuJoCo's order."""
PARSER_CODES = re.compile(r"\nError=\w+ ErrorID=\d+ \(\w+\)")
"""Codes of MuJoCo's XML parser in its errors, which say nothing to a user."""
EFFECTS = {
    "jnt_stiffness": ("joint", "a spring (`springs = true` in `[model]` describes it)"),
    "jnt_stiffnesspoly": ("joint", "a stiffness that depends on the deflection"),
    "jnt_springyield": ("joint", "a spring that yields"),
    "dof_dampingpoly": ("joint", "a damping that depends on the speed"),
    "tendon_stiffness": ("tendon", "stiffness"),
    "tendon_stiffnesspoly": ("tendon", "a stiffness that depends on the deflection"),
    "tendon_damping": ("tendon", "damping"),
    "tendon_dampingpoly": ("tendon", "a damping that depends on the speed"),
    "tendon_frictionloss": ("tendon", "dry friction"),
    "tendon_armature": ("tendon", "inertia"),
    "actuator_damping": ("actuator", "damping of several joints at once"),
    "actuator_dampingpoly": ("actuator", "a damping that depends on the speed"),
    "actuator_armature": ("actuator", "inertia of several joints at once"),
    "body_plugin": ("link", "a plugin"),
    "body_gravcomp": (
        "link",
        "`gravcomp` (if all bodies have 1, a log of this simulation holds no gravity: "
        "`gravity = [0.0, 0.0, 0.0]` in `[robot]`)",
    ),
}
"""Arrays of effects beside the default model: kind of the elements, and words."""

WELD_CORNERS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
"""Points of a frame that coincide if the frames of two bodies do [m]."""


class Effect(NamedTuple):
    """An effect on forces that the default model leaves out.

    Attributes:
        kind: Kind of the element, like "joint".
        name: Name of the element.
        words: What it does.
        link: Name of the link on which it acts; "" for all.
    """

    kind: str
    name: str
    words: str
    link: str


class LinkLoop(NamedTuple):
    """A constraint that closes a loop.

    Attributes:
        name: Name of the constraint.
        links: The two links that it connects.
        points: Points of both that coincide [2 points 3]: one, or three if the
            constraint holds their attitude too.
    """

    name: str
    links: tuple[str, str]
    points: np.ndarray


class Description(NamedTuple):
    """Contents of a robot's file.

    Attributes:
        root: Element of the robot in a URDF.
        gravity: Acceleration of gravity [m/s²].
        loops: Constraints that close loops.
        effects: Effects on forces that the default model leaves out.
        motors: Names of the joints that have an actuator.
        poses: Coordinates of joints by their names, in the poses that the file states.
        contacts: Shapes of feet, by the names of their links.
    """

    root: Any
    gravity: Numbers
    loops: Sequence[LinkLoop] = ()
    effects: Sequence[Effect] = ()
    motors: Sequence[str] = ()
    poses: Sequence[dict[str, float]] = ()
    contacts: Mapping[str, AbstractContactShape] = MappingProxyType({})


def import_mujoco() -> Any:
    """Return the module `mujoco`; say how to install it if it is missing."""
    return import_extra("mujoco", "mujoco", "MJCF files and simulations need")


def mjcf_as_urdf(path: str | Path) -> Description:
    """Return the contents of an MJCF file, whose robot is written as a URDF.

    Each body is a link of its name, fixed to the frame of its last joint; each named
    site is a link that is fixed to its body. A joint that an equality constraint
    couples to another mimics it. Shapes are left out.
    """
    mujoco = import_mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = PARSER_CODES.sub("", str(error))
        lines = [" ".join(line.split()) for line in text.splitlines()]
        reason = "; ".join(line.rstrip(".") for line in lines if line)
        raise InputError(
            f"`{path}`: MuJoCo cannot compile this file: {reason}."
        ) from error
    switch_off(mujoco, model)
    _carry_to_joints(mujoco, model)
    tree = _Writer(mujoco, model)
    for body in range(1, model.nbody):
        tree.add_body(body)
    for site in range(model.nsite):
        tree.add_site(site)
    for constraint in np.flatnonzero(model.eq_active0):
        tree.add_constraint(int(constraint))

    gravity = np.array(model.opt.gravity)
    # Motors that compensate gravity themselves feel the whole weight.
    if model.jnt_actgravcomp.all() or not gravity.any():
        model.body_gravcomp[:] = 0.0
    tree.add_effects()
    return Description(
        tree.root,
        gravity,
        tree.loops,
        tree.effects,
        tree.motors(),
        tree.poses(),
        tree.add_feet(),
    )


def body_name(model: Any, body: int) -> str:
    """Return the name of a body of a compiled model, or its number if it has none."""
    return model.body(body).name or f"body{body}"


def rotation_of_quaternion(quaternion: Vector) -> Matrix3:
    """Return the rotation of MuJoCo's quaternion (w, x, y, z)."""
    turn = scipy.spatial.transform.Rotation.from_quat(np.roll(quaternion, -1))
    return turn.as_matrix()


def exact_text(values: Numbers | float) -> str:
    """Write numbers with all their digits."""
    numbers = np.ravel(np.asarray(values, np.float64)).tolist()
    return " ".join(repr(number) for number in numbers)


class _Writer:
    """Writer of the links and joints of a compiled model.

    Attributes:
        root: Element of the robot.
        loops: Constraints that close loops.
        effects: Effects that the default model leaves out.
    """

    def __init__(self, mujoco: Any, model: Any):
        self._mujoco = mujoco
        self._model = model
        self._links = ["world"]  # of the bodies, in MuJoCo's order
        self._joints: dict[int, Any] = {}
        self._efforts = _largest_forces(mujoco, model)
        self.loops: list[LinkLoop] = []
        self.effects: list[Effect] = []
        name = model.names.split(b"\0")[0].decode()
        self.root: Any = E.robot(E.link(name="world"), name=name)

    def _name(self, kind: str, index: int):
        """Return the name of an element, or its number if it has none."""
        return getattr(self._model, kind)(index).name or f"{kind}{index}"

    def _connect(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        origin: Any,
    ) -> Any:
        """Write a joint between two links."""
        ends = E.parent(link=parent), E.child(link=child)
        element = E.joint(*ends, origin, name=name, type=kind)
        self.root.append(element)
        return element

    def add_body(self, body: int):
        """Write the joints of a body, one by one, and its link with the inertia."""
        model = self._model
        name = body_name(model, body)
        parent = self._links[model.body_parentid[body]]
        R = rotation_of_quaternion(model.body_quat[body])
        r = model.body_pos[body]
        # The link of the body itself follows its last joint.
        mount = f"{name} mount"
        mount_type = "fixed"
        first_joint = model.body_jntadr[body]
        for joint in range(first_joint, first_joint + model.body_jntnum[body]):
            if JOINT_TYPES[model.jnt_type[joint]] == "floating":
                mount = self._name("joint", joint)
                mount_type = "floating"
                continue
            R, r = self._joint_placement(joint, R, r)
            parent = self._add_joint(joint, parent, _origin(R, r))
            # The frame of the joint is that of the body, at the joint's place.
            R = np.eye(3)
            r = -model.jnt_pos[joint]

        link: Any = E.link(name=name)
        if model.body_mass[body] or model.body_inertia[body].any():
            link.append(self._inertial(body))
        self.root.append(link)
        self._links.append(name)
        self._connect(mount, mount_type, parent, name, _origin(R, r))

    def _joint_placement(
        self,
        joint: int,
        rotation: Matrix3,
        position: Vector3,
    ):
        """Return attitude and origin of a joint's frame from the placement of its body.

        An MJCF file describes the pose at the coordinate `ref`, a URDF file that at
        zero.
        """
        model = self._model
        axis = model.jnt_axis[joint]
        ref = model.qpos0[model.jnt_qposadr[joint]]
        position = position + rotation @ model.jnt_pos[joint]
        kind = JOINT_TYPES[model.jnt_type[joint]]
        if kind == "prismatic":
            position = position - rotation @ axis * ref
        elif ref:
            rotation = rotation @ axis_rotation(axis, -ref)
        return rotation, position

    def _add_joint(self, joint: int, parent: str, origin: Any):
        """Write a joint and an empty link that it moves; return the link's name."""
        kind = JOINT_TYPES[self._model.jnt_type[joint]]
        # A URDF's revolute joint must have a range.
        if kind == "revolute" and not self._model.jnt_limited[joint]:
            kind = "continuous"
        name = self._name("joint", joint)
        link = f"{name} frame"
        self.root.append(E.link(name=link))
        element = self._connect(name, kind, parent, link, origin)
        element.extend(self._properties(joint))
        self._joints[joint] = element
        return link

    def _inertial(self, body: int):
        """Return mass, centre of mass and principal moments of a body."""
        model = self._model
        R = rotation_of_quaternion(model.body_iquat[body])
        xx, yy, zz = model.body_inertia[body]
        return E.inertial(
            _origin(R, model.body_ipos[body]),
            E.mass(value=exact_text(model.body_mass[body])),
            E.inertia(
                ixx=exact_text(xx),
                iyy=exact_text(yy),
                izz=exact_text(zz),
                **dict.fromkeys(("ixy", "ixz", "iyz"), "0"),
            ),
        )

    def _properties(self, joint: int):
        """Return a joint's axis, range, largest force, friction and rotor inertia."""
        model = self._model
        limit: dict[str, str] = {}
        if model.jnt_limited[joint]:
            lower, upper = model.jnt_range[joint]
            limit["lower"] = exact_text(lower)
            limit["upper"] = exact_text(upper)
        if np.isfinite(self._efforts[joint]):
            limit["effort"] = exact_text(self._efforts[joint])
        dof = model.jnt_dofadr[joint]
        dynamics = E.dynamics(
            damping=exact_text(model.dof_damping[dof]),
            friction=exact_text(model.dof_frictionloss[dof]),
            armature=exact_text(model.dof_armature[dof]),
            stiffness=exact_text(model.jnt_stiffness[joint]),
            springref=exact_text(model.qpos_spring[model.jnt_qposadr[joint]]),
        )
        axis = E.axis(xyz=exact_text(model.jnt_axis[joint]))
        return [axis, E.limit(**limit), dynamics]

    def add_site(self, site: int):
        """Write a site as a link, if its name is not empty and not that of a body."""
        model = self._model
        name = model.site(site).name
        if not name or name in self._links:
            return
        self.root.append(E.link(name=name))
        R = rotation_of_quaternion(model.site_quat[site])
        origin = _origin(R, model.site_pos[site])
        body_link = self._links[model.site_bodyid[site]]
        self._connect(f"{name} site", "fixed", body_link, name, origin)

    def add_feet(self) -> dict[str, AbstractContactShape]:
        """Write links at bodies that end the tree and collide; return their shapes."""
        model = self._model
        spheres = self._mujoco.mjtGeom.mjGEOM_SPHERE
        contacts = {}
        for body in range(1, model.nbody):
            first = model.body_geomadr[body]
            geoms = np.arange(first, first + model.body_geomnum[body])
            geoms = geoms[
                (model.geom_contype[geoms] | model.geom_conaffinity[geoms]) > 0
            ]
            if body in model.body_parentid or not len(geoms):
                continue
            name = f"{self._links[body]} foot"
            is_ball = len(geoms) == 1 and model.geom_type[geoms[0]] == spheres
            radius = model.geom_size[geoms[0], 0]
            contacts[name] = Sphere(radius) if is_ball else Sole()
            self.root.append(E.link(name=name))
            origin = _origin(np.eye(3), model.geom_pos[geoms].mean(axis=0))
            self._connect(f"{name} mount", "fixed", self._links[body], name, origin)
        return contacts

    def add_constraint(self, constraint: int):
        """Write a constraint between joints as a mimic; note one that closes a loop."""
        model = self._model
        kinds = self._mujoco.mjtEq
        kind = int(model.eq_type[constraint])
        first_object = int(model.eq_obj1id[constraint])
        second_object = int(model.eq_obj2id[constraint])
        if kind == kinds.mjEQ_JOINT:
            self._add_mimic(first_object, second_object, model.eq_data[constraint, :5])
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            is_weld = kind == kinds.mjEQ_WELD
            bodies = np.array([first_object, second_object])
            data = model.eq_data[constraint]
            points = data[:6].reshape(2, 3)
            quaternions = np.eye(4)[[0, 0]]
            if model.eq_objtype[constraint] == self._mujoco.mjtObj.mjOBJ_SITE:
                points = model.site_pos[bodies]
                quaternions = model.site_quat[bodies]
                bodies = model.site_bodyid[bodies]
            elif is_weld:
                # MuJoCo stores the point of the second body first.
                points = points[::-1]
                quaternions[0] = data[6:10]
            # A mocap body is moved by a program: it is no part of the robot.
            if (model.body_mocapid[bodies] < 0).all():
                name = self._name("equality", constraint)
                links = (self._links[bodies[0]], self._links[bodies[1]])
                corners = WELD_CORNERS[: 3 if is_weld else 1]
                ends = [
                    point + corners @ rotation_of_quaternion(quaternion).T
                    for point, quaternion in zip(points, quaternions, strict=True)
                ]
                self.loops.append(LinkLoop(name, links, np.array(ends)))
        elif kind == kinds.mjEQ_TENDON:
            name = self._name("equality", constraint)
            self.effects.append(Effect("constraint", name, "a relation of tendons", ""))

    def motors(self) -> list[str]:
        """Return the names of the joints that an actuator drives."""
        model = self._model
        actuators = range(model.nu)
        return [
            self._name("joint", model.actuator_trnid[actuator, 0])
            for actuator in actuators
            if _acts_on_joint(self._mujoco, model, actuator)
        ]

    def poses(self) -> list[dict[str, float]]:
        """Return the coordinates of the joints in the keyframes, then in the pose."""
        model = self._model
        names = [element.get("name") for element in self._joints.values()]
        places = model.jnt_qposadr[list(self._joints)]
        return [
            dict(zip(names, positions[places].tolist(), strict=True))
            for positions in (*model.key_qpos, model.qpos0)
        ]

    def add_effects(self):
        """Enter the effects of joints, tendons, bodies and the medium around them."""
        model = self._model
        for array, (kind, words) in EFFECTS.items():
            # Earlier versions of MuJoCo lack some arrays.
            values = np.asarray(getattr(model, array, []))
            if array == "body_plugin":
                values = values + 1  # they are indices, -1 for none
            for row in np.unique(np.argwhere(values)[:, 0]):
                element = model.dof_jntid[row] if array.startswith("dof") else row
                name = self._links[row] if kind == "link" else self._name(kind, element)
                links = {"joint": f"{name} frame", "link": name}
                self.effects.append(Effect(kind, name, words, links.get(kind, "")))
        if model.opt.density or model.opt.viscosity:
            words = "the resistance of a medium such as air or water"
            self.effects.append(Effect("option", "density", words, ""))

    def _add_mimic(self, joint: int, master: int, polynomial: Vector):
        """Write a constraint of a joint; it is exact where the mimicked joint is held.

        The polynomial gives the joint's coordinate, as the difference from its `ref`,
        of that of the mimicked one.
        """
        model = self._model
        attributes = {}
        slope = 0.0
        change = polynomial[0]
        if master >= 0:
            coordinate = 0.0
            if model.jnt_limited[master]:
                coordinate = np.clip(0.0, *model.jnt_range[master])
            master_ref = model.qpos0[model.jnt_qposadr[master]]
            slope = polynomial[1]
            value = np.polyval(polynomial[::-1], coordinate - master_ref)
            change = value - slope * coordinate
            attributes["joint"] = self._joints[master].get("name")
        ref = model.qpos0[model.jnt_qposadr[joint]]
        if polynomial[2:].any():
            attributes["nonlinear"] = "true"
        attributes["multiplier"] = exact_text(slope)
        attributes["offset"] = exact_text(ref + change)
        self._joints[joint].append(E.mimic(**attributes))


def _carry_to_joints(mujoco: Any, model: Any):
    """Give inertia and damping of actuators on one joint to the joint, by gear²."""
    for actuator in range(model.nu):
        if not _acts_on_joint(mujoco, model, actuator):
            continue
        dof = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
        factor = model.actuator_gear[actuator, 0] ** 2
        for quantity in ("armature", "damping", "dampingpoly"):
            # Earlier versions of MuJoCo lack some arrays.
            values = getattr(model, f"actuator_{quantity}", None)
            if values is not None:
                joint_values = getattr(model, f"dof_{quantity}")
                joint_values[dof] += factor * values[actuator]
                values[actuator] = 0.0


def _acts_on_joint(mujoco: Any, model: Any, actuator: int):
    """Return whether an actuator drives a single joint."""
    transmissions = mujoco.mjtTrn
    joint_kinds = (transmissions.mjTRN_JOINT, transmissions.mjTRN_JOINTINPARENT)
    return int(model.actuator_trntype[actuator]) in joint_kinds


def _largest_forces(mujoco: Any, model: Any):
    """Return the largest force of actuators on each joint; infinite if unknown."""
    total = np.zeros(model.njnt)
    for actuator in range(model.nu):
        if _acts_on_joint(mujoco, model, actuator):
            joint = model.actuator_trnid[actuator, 0]
            gear = np.abs(model.actuator_gear[actuator, 0])
            force = _largest_input(mujoco, model, actuator)
            total[joint] += force * gear
    total = np.where(total > 0.0, total, np.inf)
    joint_limits = np.abs(model.jnt_actfrcrange).max(axis=1)
    smaller_limits = np.minimum(total, joint_limits)
    return np.where(model.jnt_actfrclimited, smaller_limits, total)


def _largest_input(mujoco: Any, model: Any, actuator: int):
    """Return the largest force of an actuator before its gear; infinite if unknown."""
    if model.actuator_forcelimited[actuator]:
        return np.abs(model.actuator_forcerange[actuator]).max()
    # Other actuators have a bias, such as that of a position servo.
    is_motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    if is_motor and model.actuator_ctrllimited[actuator]:
        gain = model.actuator_gainprm[actuator, 0]
        return np.abs(model.actuator_ctrlrange[actuator] * gain).max()
    return np.inf


def _origin(R: Matrix3, r: Vector3):
    """Return the element of a placement."""
    return E.origin(xyz=exact_text(r), rpy=exact_text(rpy_angles(R)))
