"""The kinematic tree of an MJCF file, as MuJoCo compiles it (extra `mujoco`), written as a URDF."""

from pathlib import Path
from typing import Any

import numpy as np
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]
from scipy.spatial.transform import Rotation

from jaxid.arrays import Float, Numbers
from jaxid.errors import InputError
from jaxid.io import import_extra

from .rotations import axis_rotation, rpy_angles

Loop = tuple[str, str, str]
"""Name of a constraint that closes a loop, and the two bodies that it connects."""
_KINDS = ("floating", "ball", "prismatic", "revolute")
"""Types of joints in MuJoCo's order."""


def import_mujoco() -> Any:
    """Return the module `mujoco`; say how to install it if it is missing."""
    return import_extra("mujoco", "mujoco", "MJCF files and simulations need")


def mjcf_as_urdf(path: str | Path) -> tuple[Any, Float[np.ndarray, "3"], list[Loop]]:
    """Return the URDF element of an MJCF file, its gravity [m/s²], and its closed loops.

    Each body is a link of its name, fixed to the frame of its last joint; each named
    site is a link that is fixed to its body. A joint that an equality constraint
    couples to another mimics it. Shapes are left out.
    """
    mujoco = import_mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        said = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"`{path}`: MuJoCo cannot compile this file: {said}."
        ) from error
    tree = _Writer(mujoco, model)
    for body in range(1, model.nbody):
        tree.add_body(body)
    for site in range(model.nsite):
        tree.add_site(site)
    for constraint in np.flatnonzero(model.eq_active0):
        tree.add_constraint(int(constraint))
    weightless = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return (
        tree.root,
        np.zeros(3) if weightless else np.array(model.opt.gravity),
        tree.loops,
    )


def mjcf_shapes(
    path: str | Path,
) -> dict[str, list[tuple[Float[np.ndarray, "points 3"], float]]]:
    """Return points and radii [m] of the shapes of all bodies, as `mjcf_as_urdf` names them.

    Shapes that cannot collide count only where a body has no others.
    """
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_path(str(path))
    kinds, found = mujoco.mjtGeom, {}
    colliding = (model.geom_contype | model.geom_conaffinity) != 0
    for geom in range(model.ngeom):
        body, kind = int(model.geom_bodyid[geom]), int(model.geom_type[geom])
        own = model.geom_bodyid == body
        if kind in (kinds.mjGEOM_PLANE, kinds.mjGEOM_HFIELD, kinds.mjGEOM_SDF) or (
            not colliding[geom] and colliding[own].any()
        ):
            continue
        size, radius = model.geom_size[geom], 0.0
        points = size * np.array(
            [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        )
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            half = 0.0 if kind == kinds.mjGEOM_SPHERE else size[1]
            points, radius = (
                np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]),
                float(size[0]),
            )
        elif kind == kinds.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(
                float
            )
        name = "world" if body == 0 else model.body(body).name or f"body{body}"
        placed = model.geom_pos[geom] + points @ _matrix(model.geom_quat[geom]).T
        found.setdefault(name, []).append((placed, radius))
    return found


class _Writer:
    """Writer of the links and joints of a compiled model."""

    def __init__(self, mujoco: Any, model: Any):
        self._mujoco = mujoco
        self._model = model
        self._links = ["world"]
        self._joints: dict[int, Any] = {}
        self._efforts = _largest_forces(mujoco, model)
        self.loops: list[Loop] = []
        self.root: Any = E.robot(
            E.link(name="world"), name=model.names.split(b"\0")[0].decode()
        )

    def _name(self, kind: str, index: int) -> str:
        """Return the name of a body, a joint or a constraint, or its number if it has none."""
        return getattr(self._model, kind)(index).name or f"{kind}{index}"

    def _connect(
        self, joint: str, kind: str, ends: tuple[str, str], origin: Any
    ) -> Any:
        parent, child = ends
        element = E.joint(
            E.parent(link=parent), E.child(link=child), origin, name=joint, type=kind
        )
        self.root.append(element)
        return element

    def add_body(self, body: int) -> None:
        """Write the joints of a body, one after the other, and its link with the inertia."""
        model, name = self._model, self._name("body", body)
        link = self._links[model.body_parentid[body]]
        R, r = _matrix(model.body_quat[body]), model.body_pos[body]
        mount, mount_kind = f"{name} mount", "fixed"
        first = int(model.body_jntadr[body])
        for i in range(first, first + int(model.body_jntnum[body])):
            joint, kind = self._name("joint", i), _KINDS[model.jnt_type[i]]
            if kind == "floating":
                mount, mount_kind = joint, kind
                continue
            if kind == "revolute" and not model.jnt_limited[i]:
                kind = "continuous"
            r = r + R @ model.jnt_pos[i]
            # The file describes the pose at `ref`, a URDF the one at zero.
            ref = model.qpos0[model.jnt_qposadr[i]]
            if kind == "prismatic":
                r = r - R @ model.jnt_axis[i] * ref
            elif ref:
                R = R @ axis_rotation(model.jnt_axis[i], -ref)
            moved = f"{joint} frame"
            self.root.append(E.link(name=moved))
            self._joints[i] = self._connect(joint, kind, (link, moved), _origin(R, r))
            self._joints[i].extend(self._properties(i))
            link, R, r = moved, np.eye(3), -model.jnt_pos[i]
        element: Any = E.link(name=name)
        if model.body_mass[body] or model.body_inertia[body].any():
            xx, yy, zz = map(exact_text, model.body_inertia[body])
            place = _origin(_matrix(model.body_iquat[body]), model.body_ipos[body])
            mass = E.mass(value=exact_text(model.body_mass[body]))
            products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
            moments = E.inertia(ixx=xx, iyy=yy, izz=zz, **products)
            element.append(E.inertial(place, mass, moments))
        self.root.append(element)
        self._links.append(name)
        self._connect(mount, mount_kind, (link, name), _origin(R, r))

    def _properties(self, joint: int) -> list[Any]:
        """Return a joint's axis, range, largest force, friction and rotor inertia."""
        model = self._model
        limit: dict[str, str] = {}
        if model.jnt_limited[joint]:
            limit["lower"], limit["upper"] = map(exact_text, model.jnt_range[joint])
        if np.isfinite(self._efforts[joint]):
            limit["effort"] = exact_text(self._efforts[joint])
        dof = model.jnt_dofadr[joint]
        dynamics = E.dynamics(
            damping=exact_text(model.dof_damping[dof]),
            friction=exact_text(model.dof_frictionloss[dof]),
            armature=exact_text(model.dof_armature[dof]),
        )
        return [
            E.axis(xyz=exact_text(model.jnt_axis[joint])),
            E.limit(**limit),
            dynamics,
        ]

    def add_site(self, site: int) -> None:
        """Write a site as a link; one without a name, or with that of a body, is left out."""
        model, name = self._model, self._model.site(site).name
        if name and name not in self._links:
            self.root.append(E.link(name=name))
            origin = _origin(_matrix(model.site_quat[site]), model.site_pos[site])
            ends = (self._links[model.site_bodyid[site]], name)
            self._connect(f"{name} site", "fixed", ends, origin)

    def add_constraint(self, i: int) -> None:
        """Write a constraint between joints as a mimic; note one that closes a loop."""
        model, kinds, kind = (
            self._model,
            self._mujoco.mjtEq,
            int(self._model.eq_type[i]),
        )
        pair = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
        if kind == int(kinds.mjEQ_JOINT):
            self._add_mimic(pair[0], pair[1], model.eq_data[i, :5])
        elif kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
            if int(model.eq_objtype[i]) == int(self._mujoco.mjtObj.mjOBJ_SITE):
                pair = [int(model.site_bodyid[site]) for site in pair]
            # A mocap body is moved by a program: it is no part of the robot.
            if (model.body_mocapid[pair] < 0).all():
                first, second = (self._links[body] for body in pair)
                self.loops.append((self._name("equality", i), first, second))

    def _add_mimic(self, joint: int, other: int, polynomial: np.ndarray) -> None:
        """Write a joint's constraint; the polynomial is exact where the other joint is held."""
        model, start = self._model, self._model.qpos0
        value, slope, mimicked = (
            start[model.jnt_qposadr[joint]] + polynomial[0],
            0.0,
            {},
        )
        if other >= 0:
            low, high = (
                model.jnt_range[other]
                if model.jnt_limited[other]
                else (-np.inf, np.inf)
            )
            held = min(max(0.0, low), high)
            shift = held - start[model.jnt_qposadr[other]]
            slope = polynomial[1]
            value += np.polyval(polynomial[::-1], shift) - polynomial[0] - slope * held
            mimicked = {"joint": self._joints[other].get("name")}
        mimic = E.mimic(
            **mimicked, multiplier=exact_text(slope), offset=exact_text(value)
        )
        self._joints[joint].append(mimic)


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
            most = np.abs(
                model.actuator_ctrlrange[i] * model.actuator_gainprm[i, 0]
            ).max()
        total[model.actuator_trnid[i, 0]] += most * np.abs(model.actuator_gear[i, 0])
    total = np.where(total > 0.0, total, np.inf)
    ranges = np.abs(model.jnt_actfrcrange).max(axis=1)
    return np.where(model.jnt_actfrclimited, np.minimum(total, ranges), total)


def _matrix(quaternion: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of MuJoCo's quaternion (w, x, y, z)."""
    return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()


def _origin(R: Float[np.ndarray, "3 3"], r: Float[np.ndarray, "3"]) -> Any:
    return E.origin(xyz=exact_text(r), rpy=exact_text(rpy_angles(R)))


def exact_text(values: Numbers | float) -> str:
    """Write numbers with all their digits."""
    return " ".join(map(repr, np.ravel(np.asarray(values, np.float64)).tolist()))
