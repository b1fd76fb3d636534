"""The kinematic tree of an MJCF file, as MuJoCo compiles it (extra `mujoco`), written as a URDF."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError

from .rotations import axis_rotation, rpy_angles

Loop = tuple[str, str, str]
"""Name of a constraint that closes a loop, and the two bodies that it connects."""
_KINDS = ("floating", "ball", "prismatic", "revolute")
"""Types of joints in MuJoCo's order."""
Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


def import_mujoco() -> Any:
    """Return the module `mujoco`.

    Raises:
        ModuleNotFoundError: If it is not installed.
    """
    try:
        return importlib.import_module("mujoco")
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "MuJoCo is not installed: `pip install 'jaxid-robotics[mujoco]'`."
        ) from missing


def mjcf_as_urdf(path: str | Path) -> tuple[Any, Float[np.ndarray, "3"], list[Loop]]:
    """Return the URDF element of an MJCF file, its gravity [m/s²], and its closed loops.

    Each body is a link of its name, fixed to the frame of its last joint; each named site is a link
    that is fixed to its body. A joint that an equality constraint couples to another mimics it.
    Shapes are left out.

    Raises:
        InputError: If MuJoCo cannot compile the file.
        ModuleNotFoundError: If MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        said = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"`{path}`: MuJoCo cannot compile this file: {said}.") from error
    tree = _Writer(mujoco, model)
    for body in range(1, model.nbody):
        tree.add_body(body)
    for site in range(model.nsite):
        tree.add_site(site)
    tree.add_constraints()
    weightless = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return tree.root, np.zeros(3) if weightless else np.array(model.opt.gravity), tree.loops


class _Writer:
    """Writer of the links and joints of a compiled model."""

    def __init__(self, mujoco: Any, model: Any):
        self._mujoco = mujoco
        self._model = model
        name = bytes(model.names).split(b"\0")[0].decode()
        self.root = etree.Element("robot", name=name)
        self.loops: list[Loop] = []
        self._links = ["world"]
        self._joints: dict[int, Any] = {}
        self._efforts = _largest_forces(mujoco, model)
        etree.SubElement(self.root, "link", name="world")

    def _name(self, kind: str, index: int) -> str:
        """Return the name of a body, a joint or a constraint, or its number if it has none."""
        return getattr(self._model, kind)(index).name or f"{kind}{index}"

    def add_body(self, body: int) -> None:
        """Write the joints of a body, one after the other, and its link with the inertia."""
        model, name = self._model, self._name("body", body)
        link = self._links[model.body_parentid[body]]
        R, r = _matrix(model.body_quat[body]), model.body_pos[body]
        mount, kind = f"{name} mount", "fixed"
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if _KINDS[model.jnt_type[joint]] == "floating":
                mount, kind = self._name("joint", joint), "floating"
                continue
            anchor, axis = model.jnt_pos[joint], model.jnt_axis[joint]
            r = r + R @ anchor
            moved = f"{self._name('joint', joint)} frame"
            self._add_joint(joint, link, moved, self._at_zero(joint, R, r, axis))
            link, R, r = moved, np.eye(3), -anchor
        element = etree.SubElement(self.root, "link", name=name)
        if model.body_mass[body] or model.body_inertia[body].any():
            inertial = etree.SubElement(element, "inertial")
            _add_origin(inertial, _matrix(model.body_iquat[body]), model.body_ipos[body])
            etree.SubElement(inertial, "mass", value=_text(model.body_mass[body]))
            moments = zip(("ixx", "iyy", "izz"), map(_text, model.body_inertia[body]), strict=True)
            products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
            etree.SubElement(inertial, "inertia", {**dict(moments), **products})
        self._links.append(name)
        self._connect(mount, kind, link, name, (R, r))

    def add_site(self, site: int) -> None:
        """Write a site as a link; one without a name, or with that of a body, is left out."""
        model, name = self._model, self._name("site", site)
        if name == f"site{site}" or name in self._links:
            return
        etree.SubElement(self.root, "link", name=name)
        body = self._links[model.site_bodyid[site]]
        pose = _matrix(model.site_quat[site]), model.site_pos[site]
        self._connect(f"{name} site", "fixed", body, name, pose)

    def _at_zero(self, joint: int, R: np.ndarray, r: np.ndarray, axis: np.ndarray) -> Pose:
        """Return the pose at coordinate zero; the file describes the one at `ref`."""
        ref = self._model.qpos0[self._model.jnt_qposadr[joint]]
        kind = _KINDS[self._model.jnt_type[joint]]
        if kind == "revolute" and ref:
            R = R @ axis_rotation(axis, -ref)
        if kind == "prismatic":
            r = r - R @ axis * ref
        return R, r

    def _add_joint(self, joint: int, link: str, moved: str, pose: Pose) -> None:
        """Write a joint with its range, largest force, friction and rotor inertia."""
        model = self._model
        kind = _KINDS[model.jnt_type[joint]]
        etree.SubElement(self.root, "link", name=moved)
        element = self._connect(self._name("joint", joint), kind, link, moved, pose)
        self._joints[joint] = element
        etree.SubElement(element, "axis", xyz=_text(model.jnt_axis[joint]))
        limit = etree.SubElement(element, "limit")
        if model.jnt_limited[joint]:
            for key, end in zip(("lower", "upper"), model.jnt_range[joint], strict=True):
                limit.set(key, _text(end))
        if np.isfinite(self._efforts[joint]):
            limit.set("effort", _text(self._efforts[joint]))
        dof = model.jnt_dofadr[joint]
        values = {
            "damping": model.dof_damping[dof],
            "friction": model.dof_frictionloss[dof],
            "armature": model.dof_armature[dof],
        }
        numbers = {key: _text(value) for key, value in values.items()}
        etree.SubElement(element, "dynamics", numbers)

    def _connect(self, name: str, kind: str, parent: str, child: str, pose: Pose) -> Any:
        joint = etree.SubElement(self.root, "joint", name=name, type=kind)
        etree.SubElement(joint, "parent", link=parent)
        etree.SubElement(joint, "child", link=child)
        _add_origin(joint, *pose)
        return joint

    def add_constraints(self) -> None:
        """Write active constraints between joints as mimics, and list those that close loops."""
        model, kind = self._model, self._mujoco.mjtEq
        bodies = (int(kind.mjEQ_CONNECT), int(kind.mjEQ_WELD))
        for i in range(model.neq):
            pair = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
            if not model.eq_active0[i]:
                continue
            if int(model.eq_type[i]) == int(kind.mjEQ_JOINT):
                self._add_mimic(*pair, model.eq_data[i, :5])
            elif int(model.eq_type[i]) in bodies:
                if int(model.eq_objtype[i]) == int(self._mujoco.mjtObj.mjOBJ_SITE):
                    pair = [int(model.site_bodyid[site]) for site in pair]
                # A mocap body is moved by a program: it is no part of the robot.
                if (model.body_mocapid[pair] < 0).all():
                    ends = [self._links[body] for body in pair]
                    self.loops.append((self._name("equality", i), ends[0], ends[1]))

    def _add_mimic(self, joint: int, other: int, polynomial: np.ndarray) -> None:
        """Write a joint's constraint; the polynomial is exact where the other joint is held."""
        model, start = self._model, self._model.qpos0
        mimic = etree.SubElement(self._joints[joint], "mimic")
        zero = start[model.jnt_qposadr[joint]]
        if other < 0:
            mimic.set("offset", _text(zero + polynomial[0]))
            return
        low, high = model.jnt_range[other] if model.jnt_limited[other] else (-np.inf, np.inf)
        held = min(max(0.0, low), high)
        value = zero + np.polyval(polynomial[::-1], held - start[model.jnt_qposadr[other]])
        mimic.set("joint", self._joints[other].get("name"))
        mimic.set("multiplier", _text(polynomial[1]))
        mimic.set("offset", _text(value - polynomial[1] * held))


def _largest_forces(mujoco: Any, model: Any) -> Float[np.ndarray, " joints"]:
    """Return the largest forces of the actuators on each joint; infinite where unknown."""
    total = np.zeros(model.njnt)
    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    for i in range(model.nu):
        if int(model.actuator_trntype[i]) not in joints:
            continue
        most = np.inf
        plain = int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_NONE)
        if model.actuator_forcelimited[i]:
            most = np.abs(model.actuator_forcerange[i]).max()
        elif model.actuator_ctrllimited[i] and plain:
            most = np.abs(model.actuator_ctrlrange[i] * model.actuator_gainprm[i, 0]).max()
        total[model.actuator_trnid[i, 0]] += most * np.abs(model.actuator_gear[i, 0])
    total = np.where(total > 0.0, total, np.inf)
    ranges = np.abs(model.jnt_actfrcrange).max(axis=1)
    return np.where(model.jnt_actfrclimited, np.minimum(total, ranges), total)


def _matrix(quaternion: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of MuJoCo's quaternion (w, x, y, z)."""
    return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()


def _add_origin(element: Any, R: AnyArray, r: Numbers) -> None:
    etree.SubElement(element, "origin", xyz=_text(r), rpy=_text(rpy_angles(R)))


def _text(values: Numbers | float) -> str:
    """Write numbers with all their digits."""
    return " ".join(map(repr, np.ravel(np.asarray(values, np.float64)).tolist()))
