"""Robots from tables of Denavit-Hartenberg parameters, and the library `jid.robots`.

In the library `source` holds the origin of the numbers, `limits.assumed` and `notes` those that
nobody published. Limits that are not listed are infinite, drives are direct.
"""

from typing import Any

import numpy as np

from jaxid.arrays import Numbers
from jaxid.errors import InputError
from jaxid.robot.collision import GROUND, Capsule, CollisionModel, HalfSpace
from jaxid.robot.joints import Drives, Limits
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import SNAP_TOLERANCE, axis_rotation, snap_angles

_HALF = np.pi / 2
_X, _Y, _Z = np.eye(3)
_NO_ACCELERATIONS = "accelerations are not published: they are taken as unlimited."


def from_dh(
    rows: Numbers,
    *,
    convention: str,
    name: str = "robot",
    revolute: tuple[bool, ...] | None = None,
    joint_names: tuple[str, ...] | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = (0.0, 0.0, 0.0),
    tip_rotation: Numbers | None = None,
    tip_offset: Numbers = (0.0, 0.0, 0.0),
    snap_tolerance: float = SNAP_TOLERANCE,
    notes: tuple[str, ...] = (),
    **fields: Any,
) -> Robot:
    r"""Build a serial robot from one row (alpha, a, d) or (alpha, a, d, theta) for each joint.

    In the **modified** convention (Craig, Khalil) row $i$ holds $\alpha_{i-1}, a_{i-1}, d_i$ and
    $\theta_i$: $T_i = R_x(\alpha) D_x(a) R_z(\theta + q) D_z(d)$. Body $i$ has the frame $i$.

    In the **standard** (distal) convention row $i$ holds $\alpha_i, a_i, d_i$ and $\theta_i$:
    $T_i = R_z(\theta + q) D_z(d) D_x(a) R_x(\alpha)$. Frame $i$ then lies on the axis of joint
    $i + 1$, but a body's frame must lie on its own axis. So body $i$ has the frame $i - 1$,
    turned by $\theta + q$; the rest of $T_i$ goes into the placement of the next body, and that of
    the last row into the end-effector.

    In both, every joint's axis is the z axis of its body, and $q$ of a prismatic joint adds to $d$.

    Args:
        rows: Twist alpha [rad], length a [m], offset d [m], and the angle theta [rad] at q = 0.
        convention: `"modified"` or `"standard"`.
        name: Name of the robot.
        revolute: For each joint whether it turns or slides; all turn if None.
        joint_names: Names of the joints; `joint1`, `joint2`, … if None.
        base_rotation: Attitude of the table's base frame on the ground; upright if None.
        base_position: Origin of that frame on the ground [m].
        tip_rotation: Attitude of the end-effector in the last frame of the table.
        tip_offset: Origin of the end-effector in the last frame of the table [m].
        snap_tolerance: Angles this close to a multiple of 90 degrees become exact [rad]; 0 is off.
        notes: Changes and assumptions that were made, one sentence each.
        fields: Further arguments of `Robot`: `gravity`, `limits`, `drives`, `tool`, `source`.

    Raises:
        InputError: If the convention has another name, or the table has the wrong shape.
    """
    if convention not in ("modified", "standard"):
        raise InputError(
            f'`convention` must be "modified" or "standard", but is "{convention}": the modified '
            "one lists alpha and a of the link before the joint, the standard one of the link "
            "after it."
        )
    table = np.array(rows, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] not in (3, 4) or not np.isfinite(table).all():
        raise InputError(
            "`rows` must hold 3 or 4 finite numbers (alpha, a, d, theta) for each joint, "
            f"but has shape {table.shape}."
        )
    n = len(table)
    table = np.column_stack([table, np.zeros(n)])[:, :4]
    revolute = (True,) * n if revolute is None else revolute
    if len(revolute) != n:
        raise InputError(f"`revolute` must have one entry for each of the {n} rows.")

    labels = joint_names or tuple(f"joint{i + 1}" for i in range(n))
    rotation, offset = np.empty((n, 3, 3)), np.empty((n, 3))
    R, r = np.eye(3), np.zeros(3)
    for i, (label, (alpha, a, d, theta)) in enumerate(zip(labels, table, strict=False)):
        pair, snapped = snap_angles(label, ("alpha", "theta"), (alpha, theta), snap_tolerance)
        (alpha, theta), notes = pair, notes + snapped
        twist, turn = axis_rotation(_X, alpha), axis_rotation(_Z, theta)
        if convention == "modified":
            rotation[i], offset[i] = twist @ turn, a * _X + d * (twist @ _Z)
        else:
            rotation[i], offset[i] = R @ turn, r
            R, r = twist, d * _Z + a * _X
    end = np.eye(3) if tip_rotation is None else np.asarray(tip_rotation, dtype=np.float64)
    robot = Robot(
        name,
        revolute=revolute,
        axis=np.tile(_Z, (n, 1)),
        rotation=rotation,
        offset=offset,
        joint_names=joint_names,
        tip_rotation=R @ end,
        tip_offset=r + R @ np.asarray(tip_offset, dtype=np.float64),
        notes=notes,
        **fields,
    )
    return robot.mounted(base_rotation, base_position)


def tx90l_on_rail() -> Robot:
    """Return the seven-axis manipulator of the paper: a Stäubli TX90L on a horizontal rail along x.

    The bodies' frames are those in which the paper's base parameters come out (Eq. 24): the z axis
    of the bodies 3, 4 and 6 is turned onto their joints' axes, and body 5, the forearm, has its
    origin at the elbow.
    """
    upright, turned = np.eye(3), axis_rotation(_X, -_HALF)
    attitudes = np.array([upright, upright, turned, turned, upright, turned, upright])
    parents = np.concatenate([[upright], attitudes[:-1]])
    offset = np.zeros((7, 3))
    offset[1:4] = (0.0, 0.0, 0.478), (0.05, 0.0, 0.0), (0.0, 0.05, 0.5)
    offset[5:] = (0.0, 0.0, 0.55), (0.0, 0.0, 0.1)
    return Robot(
        "TX90L on rail",
        revolute=(False, *(True,) * 6),
        axis=[_X, *[_Z] * 6],
        rotation=np.einsum("iba,ibc->iac", parents, attitudes),
        offset=np.einsum("iba,ib->ia", parents, offset),
        joint_names=("rail", *(f"joint{i}" for i in range(1, 7))),
        limits=Limits(
            position_min=[-1.5, *np.deg2rad([-180.0, -130.0, -145.0, -270.0, -115.0, -270.0])],
            position_max=[1.5, *np.deg2rad([180.0, 147.5, 145.0, 270.0, 140.0, 270.0])],
            velocity=[1.5, *np.deg2rad([400.0, 390.0, 420.0, 540.0, 475.0, 760.0])],
            acceleration=[5.0, 8.0, 8.0, 10.0, 15.0, 15.0, 25.0],
            force=[3000.0, 318.0, 130.0, 65.0, 34.0, 29.0, 11.0],
            assumed=(
                "position_min of rail",
                "position_max of rail",
                "velocity of rail",
                "acceleration",
                "force of rail",
            ),
        ),
        source="ROS-Industrial staubli_experimental (geometry); manufacturer's manual (limits)",
        notes=(
            "assumed, for nobody published it: the rail's stroke (1.5 m to either side), speed "
            "(1.5 m/s), acceleration (5 m/s²) and force (3000 N).",
            "assumed, for nobody published it: the accelerations of the arm's joints.",
            "gear ratios are not published: the drives are direct, so forces are those of the "
            "joints; the paper states motor torques of 69 N m (rail) and 2.2 N m (last joint).",
        ),
    )


def tx90l_on_rail_collision() -> CollisionModel:
    """Return capsules of the TX90L on its rail, and the ground; they are assumed.

    The shoulder's column moves with the rail; the wrist's capsule has a tool of 0.2 m beyond the
    flange's joint.
    """
    capsules = (
        Capsule("column", 0, start=(0.0, 0.0, 0.05), end=(0.0, 0.0, 0.45), radius=0.19),
        Capsule("upper arm", 2, start=(0.0, 0.0, 0.05), end=(0.0, -0.5, 0.05), radius=0.13),
        Capsule("forearm", 4, start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.55), radius=0.12),
        Capsule("wrist", 6, start=(0.0, 0.0, -0.1), end=(0.0, 0.0, 0.2), radius=0.07),
        Capsule("rail", GROUND, start=(-2.5, 0.0, -0.15), end=(2.5, 0.0, -0.15), radius=0.25),
    )
    arm = [(a, b) for b in ("rail", "ground") for a in ("forearm", "wrist")]
    pairs = (("forearm", "column"), ("wrist", "column"), ("wrist", "upper arm"), *arm)
    return CollisionModel(tx90l_on_rail(), capsules, (HalfSpace("ground"),), pairs)


def tx40() -> Robot:
    """Return the Stäubli TX40, six axes, whose sixth motor turns with the fifth joint.

    Its drives take the encoders' angles and motors' torques as they were recorded. Coordinates are
    those of the published kinematic model, in which the arm lies flat at q = 0: joint 2 counts from
    -90 degrees, joint 3 from +90 degrees of the manufacturer's zero, where the arm stands upright.
    """
    zero = np.array([0.0, -_HALF, _HALF, 0.0, 0.0, 0.0])
    reduction = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    reduction[5, 4] = 32.0
    rows = np.zeros((6, 4))
    rows[:, 0] = 0.0, -_HALF, 0.0, _HALF, -_HALF, _HALF
    rows[2:4, 1:3] = (0.225, 0.035), (0.0, 0.225)
    rows[5, 3] = np.pi
    return from_dh(
        rows,
        convention="modified",
        name="TX40",
        base_position=(0.0, 0.0, 0.32),
        limits=Limits(
            position_min=np.deg2rad([-180.0, -125.0, -138.0, -270.0, -120.0, -270.0]) + zero,
            position_max=np.deg2rad([180.0, 125.0, 138.0, 270.0, 133.5, 270.0]) + zero,
            velocity=np.deg2rad([287.0, 287.0, 430.0, 410.0, 320.0, 700.0]),
            force=[131.84, 131.84, 103.49, 46.08, 43.19, 30.72],
        ),
        drives=Drives(reduction=reduction, zero=zero),
        source="figaroh-examples and BIRDy (geometry, gears, limits)",
        notes=(
            "the ranges of the joints 2 and 3 are the manufacturer's, moved by -90 and +90 degrees "
            "like the coordinates themselves.",
            "accelerations and motors' torques are not published: they are taken as unlimited.",
        ),
    )


def ur10() -> Robot:
    """Return the Universal Robots UR10, six axes."""
    return _universal_robot(
        "UR10",
        lengths=(-0.612, -0.5723),
        offsets=(0.1273, 0.163941, 0.1157, 0.0922),
        velocity=[2.16, 2.16, 3.15, 3.2, 3.2, 3.2],
        source="unisa-acg inverse-dynamics-solver; ROS-Industrial universal_robot (limits)",
    )


def ur10e() -> Robot:
    """Return the Universal Robots UR10e, six axes."""
    return _universal_robot(
        "UR10e",
        lengths=(-0.6127, -0.57155),
        offsets=(0.1807, 0.17415, 0.11985, 0.11655),
        velocity=np.deg2rad([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]),
        source="Universal_Robots_ROS2_Description",
    )


def _universal_robot(
    name: str, lengths: Numbers, offsets: Numbers, velocity: Numbers, source: str
) -> Robot:
    rows = np.zeros((6, 3))
    rows[[0, 3, 4], 0] = _HALF, _HALF, -_HALF
    rows[1:3, 1], rows[[0, 3, 4, 5], 2] = lengths, offsets
    reach = np.pi * np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0])
    return from_dh(
        rows,
        convention="standard",
        name=name,
        limits=Limits(
            position_min=-reach,
            position_max=reach,
            velocity=velocity,
            force=[330.0, 330.0, 150.0, 54.0, 54.0, 54.0],
        ),
        source=source,
        notes=(_NO_ACCELERATIONS,),
    )


def panda() -> Robot:
    """Return the Franka Emika Panda, seven axes; the end-effector is the flange."""
    rows = np.zeros((7, 3))
    rows[:, 0] = 0.0, -_HALF, _HALF, _HALF, -_HALF, _HALF, _HALF
    rows[[3, 4, 6], 1], rows[[0, 2, 4], 2] = (0.0825, -0.0825, 0.088), (0.333, 0.316, 0.384)
    return from_dh(
        rows,
        convention="modified",
        name="Panda",
        tip_offset=(0.0, 0.0, 0.107),
        limits=Limits(
            position_min=[-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
            position_max=[2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
            velocity=[2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
            acceleration=[15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
            jerk=[7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
            force=[87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0],
        ),
        source="franka_description; libfranka's rate limits (acceleration, jerk)",
    )


def iiwa14() -> Robot:
    """Return the KUKA LBR iiwa 14 R820, seven axes; frames as in its URDF, all upright at q = 0."""
    reach = np.array([2.9668, 2.0942, 2.9668, 2.0942, 2.9668, 2.0942, 3.0541])
    offset = np.zeros((7, 3))
    offset[[1, 3], 0], offset[[1, 3, 5], 2] = (-0.00043624, 0.00043624), (0.36, 0.42, 0.4)
    return Robot(
        "LBR iiwa 14",
        revolute=(True,) * 7,
        axis=[_Z, _Y, _Z, -_Y, _Z, _Y, _Z],
        rotation=np.tile(np.eye(3), (7, 1, 1)),
        offset=offset,
        tip_offset=(0.0, 0.0, 0.126),
        limits=Limits(
            position_min=-reach,
            position_max=reach,
            velocity=[1.4834, 1.4834, 1.7452, 1.3089, 2.2688, 2.356, 2.356],
            force=[320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0],
            assumed=("force",),
        ),
        source="ROS-Industrial kuka_experimental",
        notes=(
            "assumed, for the source does not state them: the largest torques of the joints.",
            _NO_ACCELERATIONS,
        ),
    )


def kr300() -> Robot:
    """Return the KUKA KR300 R2500 ultra, six axes.

    Coordinates are the link-side angles of the published recordings, as they stand in the files:
    the angles that its authors add for their kinematic model, (0, -90, 90, 0, 0, 0) degrees, are in
    the geometry. The drives take motor torques to the joints.
    """
    rows = [
        (_HALF, 0.35, -0.675, 0.0),
        (0.0, 1.15, -0.189, -_HALF),
        (-_HALF, 0.041, 0.189, np.pi),
        (_HALF, 0.0, -1.0, 0.0),
        (-_HALF, 0.0, 0.0, 0.0),
        (np.pi, 0.0, -0.24, 0.0),
    ]
    gears = [
        *(256.85714285714283, 267.42857142857144, 252.33333333333334),
        *(221.0, 239.61904761904762, 154.3231343283582),
    ]
    return from_dh(
        rows,
        convention="standard",
        name="KR300 R2500 ultra",
        base_rotation=axis_rotation(_X, np.pi),
        drives=Drives(reduction=gears),
        source="Robot_Identification (Weigand)",
        notes=(
            "q is what the recordings hold, without an offset: do not add one.",
            "limits are not published with the source: they are taken as infinite.",
            "a hydraulic counterbalance acts on joint 2, which rigid bodies and friction do not "
            "explain.",
        ),
    )


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
        raise InputError("`joints` must be at least 1, and `length` one number or one for each.")
    lengths = np.broadcast_to(np.array(length, dtype=np.float64), (joints,))
    ends = np.outer(lengths, _X)
    return Robot(
        f"planar arm, {joints} joints",
        revolute=(True,) * joints,
        axis=np.tile(_Z, (joints, 1)),
        rotation=np.tile(np.eye(3), (joints, 1, 1)),
        offset=np.vstack([np.zeros((1, 3)), ends[:-1]]),
        gravity=(0.0, -9.81, 0.0),
        tip_offset=ends[-1],
        source="textbook",
    )
