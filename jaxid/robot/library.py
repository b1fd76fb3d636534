"""Robots from tables of Denavit-Hartenberg parameters, and the library `jid.robots`.

The numbers of the library are in `library.toml`. `source` holds their origin,
`limits.assumed` and `notes` those that nobody published. Limits that are not listed are
infinite, drives are direct.
"""

import functools
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import Numbers, Texts
from jaxid.errors import InputError

from .collision_model import CollisionModel
from .limits_and_drives import Drives, Limits
from .robot import Robot
from .rotations import axis_rotation, rpy_rotation
from .shapes import Capsule, HalfSpace

X, _, Z = np.eye(3)
"""Axes of a frame."""


def from_dh(
    rows: Numbers,
    *,
    convention: str,
    name: str = "robot",
    revolute: tuple[bool, ...] | None = None,
    joint_names: Texts | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = (0.0, 0.0, 0.0),
    tip_rotation: Numbers | None = None,
    tip_offset: Numbers = (0.0, 0.0, 0.0),
    notes: Texts = (),
    **fields: Any,
) -> Robot:
    r"""Build a serial robot from a row (alpha, a, d, theta) for each joint.

    In the **modified** convention (Craig, Khalil) row $i$ holds $\alpha_{i-1}, a_{i-1},
    d_i$ and $\theta_i$: $T_i = R_x(\alpha) D_x(a) R_z(\theta + q) D_z(d)$. Body $i$ has
    the frame $i$.

    In the **standard** (distal) convention row $i$ holds $\alpha_i, a_i, d_i$ and
    $\theta_i$: $T_i = R_z(\theta + q) D_z(d) D_x(a) R_x(\alpha)$. Frame $i$ then lies
    on the axis of joint $i + 1$, but a body's frame must lie on its own axis. So body
    $i$ has the frame $i - 1$, turned by $\theta + q$; the rest of $T_i$ goes into the
    placement of the next body, and that of the last row into the end-effector.

    In both, every joint's axis is the z axis of its body, and $q$ of a prismatic joint
    adds to $d$.

    Args:
        rows: Twist alpha [rad], length a [m], offset d [m], and the angle theta [rad]
            at q = 0.
        convention: `"modified"` or `"standard"`.
        name: Name of the robot.
        revolute: For each joint whether it turns or slides; all turn if None.
        joint_names: Names of the joints; `joint1`, `joint2`, … if None.
        base_rotation: Attitude of the table's base frame on the ground; upright if
            None.
        base_position: Origin of that frame on the ground [m].
        tip_rotation: Attitude of the end-effector in the last frame of the table.
        tip_offset: Origin of the end-effector in the last frame of the table [m].
        notes: Changes and assumptions that were made, one sentence each.
        fields: Further arguments of `Robot`: `gravity`, `limits`, `drives`, `tool`,
            `source`.

    Raises:
        InputError: If the convention has another name, or the table has the wrong
            shape.
    """
    if convention not in ("modified", "standard"):
        raise InputError(
            '`convention` must be "modified" (Craig) or "standard", '
            f'but is "{convention}".'
        )
    table = np.array(rows, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] not in (3, 4) or not np.isfinite(table).all():
        raise InputError(
            "`rows` must hold rows of finite (alpha, a, d, theta), "
            f"but has shape {table.shape}."
        )
    n = len(table)
    if table.shape[1] == 3:
        table = np.column_stack([table, np.zeros(n)])

    rotation = np.empty((n, 3, 3))
    offset = np.empty((n, 3))
    # Placement of the last frame of the table in the body of its row.
    R = np.eye(3)
    r = np.zeros(3)
    for i, (alpha, a, d, theta) in enumerate(table):
        twist = axis_rotation(X, alpha)
        turn = axis_rotation(Z, theta)
        if convention == "modified":
            rotation[i] = twist @ turn
            offset[i] = a * X + d * (twist @ Z)
        else:
            rotation[i] = R @ turn
            offset[i] = r
            R = twist
            r = d * Z + a * X

    tip_in_frame = np.eye(3) if tip_rotation is None else np.array(tip_rotation, float)
    robot = Robot(
        name,
        revolute=(True,) * n if revolute is None else revolute,
        axis=np.tile(Z, (n, 1)),
        rotation=rotation,
        offset=offset,
        joint_names=joint_names,
        tip_rotation=R @ tip_in_frame,
        tip_offset=r + R @ np.array(tip_offset, float),
        notes=notes,
        **fields,
    )
    return robot.mounted(base_rotation, base_position)


@functools.cache
def entries() -> dict[str, dict[str, Any]]:
    """Return the content of `library.toml`."""
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))


def _robot(key: str):
    """Return a robot of `library.toml`."""
    entry = dict(entries()[key])
    joints = len(entry.get("dh") or entry["offset"])
    revolute = tuple(entry.pop("revolute", (True,) * joints))
    entry["limits"] = _limits(entry.get("limits", {}), revolute)
    entry["drives"] = Drives(joints, **entry.get("drives", {}))
    for name in ("notes", "joint_names"):
        entry[name] = tuple(entry.get(name, ()))
    if "dh" in entry:
        units = (np.pi / 180, 1.0, 1.0, np.pi / 180)
        rows = np.array(entry.pop("dh")) * units
        base_angles = np.deg2rad(entry.pop("base_rpy", np.zeros(3)))
        return from_dh(
            rows,
            revolute=revolute,
            base_rotation=rpy_rotation(base_angles),
            **entry,
        )
    angles = np.deg2rad(entry.pop("rpy", np.zeros((joints, 3))))
    rotation = [rpy_rotation(rpy) for rpy in angles]
    return Robot(revolute=revolute, rotation=rotation, **entry)


def _limits(table: dict[str, Any], revolute: tuple[bool, ...]):
    """Return the limits of a robot of `library.toml`."""
    limits = dict(table)
    for name in limits.pop("degrees", ()):
        limits[name] = np.where(revolute, np.pi / 180, 1.0) * limits[name]
    assumptions = tuple(limits.pop("assumed", ()))
    return Limits(len(revolute), **limits, assumed=assumptions)


def tx90l_on_rail() -> Robot:
    """Return the seven-axis manipulator of the paper: a Stäubli TX90L on a rail.

    The rail is horizontal, along x. The bodies' frames are those in which the paper's
    base parameters come out (Eq. 24): the z axis of the bodies 3, 4 and 6 is turned
    onto their joints' axes, and body 5, the forearm, has its origin at the elbow.
    """
    return _robot("tx90l_on_rail")


def tx90l_on_rail_collision() -> CollisionModel:
    """Return capsules of the TX90L on its rail, and the ground; they are assumed.

    The shoulder's column moves with the rail; the wrist's capsule has a tool of 0.2 m
    beyond the flange's joint.
    """
    robot = tx90l_on_rail()
    entry = entries()["tx90l_on_rail_collision"]
    capsules = [Capsule(**capsule) for capsule in entry["capsules"]]
    return CollisionModel(robot, capsules, (HalfSpace("ground"),), entry["pairs"])


def tx40() -> Robot:
    """Return the Stäubli TX40, six axes, whose sixth motor turns with the fifth joint.

    Its drives take the encoders' angles and motors' torques as they were recorded.
    Coordinates are those of the published kinematic model, in which the arm lies flat
    at q = 0: joint 2 counts from -90 degrees, joint 3 from +90 degrees of the
    manufacturer's zero, where the arm stands upright.
    """
    return _robot("tx40")


def ur10() -> Robot:
    """Return the Universal Robots UR10, six axes."""
    return _robot("ur10")


def ur10e() -> Robot:
    """Return the Universal Robots UR10e, six axes."""
    return _robot("ur10e")


def panda() -> Robot:
    """Return the Franka Emika Panda, seven axes; the end-effector is the flange."""
    return _robot("panda")


def iiwa14() -> Robot:
    """Return the KUKA LBR iiwa 14 R820, seven axes, with the frames of its URDF."""
    return _robot("iiwa14")


def kr300() -> Robot:
    """Return the KUKA KR300 R2500 ultra, six axes.

    Coordinates are the link-side angles of the published recordings, as they stand in
    the files: the angles that its authors add for their kinematic model, (0, -90, 90,
    0, 0, 0) degrees, are in the geometry. The drives take motor torques to the joints.
    """
    return _robot("kr300")


def planar_arm(joints: int = 2, length: Numbers = 1.0) -> Robot:
    """Return a textbook arm in a vertical plane.

    Axes are along z, gravity along -y, and links along x at q = 0.

    Args:
        joints: Number of joints.
        length: Lengths of the links [m], one for all or one for each.

    Raises:
        InputError: If there is no joint, or the lengths do not fit.
    """
    if joints < 1 or np.shape(length) not in ((), (joints,)):
        raise InputError(
            "`joints` must be at least 1, and `length` one number, or one for each "
            "joint."
        )
    lengths = np.broadcast_to(np.array(length, dtype=np.float64), (joints,))
    ends = np.outer(lengths, X)
    return Robot(
        f"planar arm, {joints} joints",
        revolute=(True,) * joints,
        axis=np.tile(Z, (joints, 1)),
        rotation=np.tile(np.eye(3), (joints, 1, 1)),
        offset=np.vstack([np.zeros((1, 3)), ends[:-1]]),
        gravity=(0.0, -9.81, 0.0),
        tip_offset=ends[-1],
        source="textbook",
    )
