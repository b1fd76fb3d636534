"""Robots from tables of Denavit-Hartenberg parameters, modified or standard."""

import numpy as np

from jaxid.arrays import Numbers
from jaxid.errors import InputError
from jaxid.robot.drives import Drives
from jaxid.robot.kinematics import axis_rotation
from jaxid.robot.limits import Limits
from jaxid.robot.plausibility import SNAP_TOLERANCE, angle_notes, check_tolerance, snap_angles
from jaxid.robot.robot import GRAVITY, Robot, Tool

_X, _, _Z = np.eye(3)


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
    gravity: Numbers = GRAVITY,
    limits: Limits | None = None,
    drives: Drives | None = None,
    tool: Tool | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
    source: str = "",
    notes: tuple[str, ...] = (),
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
        gravity: Acceleration of gravity in the frame of the ground [m/s²].
        limits: Joint limits; infinite if None.
        drives: Motors and gears; direct drives if None.
        tool: Known load, in the frame of its body.
        snap_tolerance: Angles this close to a multiple of 90 degrees become exact [rad]; 0 is off.
        source: Origin of the numbers.
        notes: Changes and assumptions that were made, one sentence each.

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

    tolerance = check_tolerance(snap_tolerance)
    snapped = table.copy()
    snapped[:, [0, 3]] = snap_angles(table[:, [0, 3]], tolerance)
    labels = joint_names or tuple(f"joint{i + 1}" for i in range(n))
    for label, before, after in zip(labels, table, snapped, strict=False):
        notes += angle_notes(label, ("alpha", "theta"), before[[0, 3]], after[[0, 3]])

    rotation, offset = np.empty((n, 3, 3)), np.empty((n, 3))
    R, r = np.eye(3), np.zeros(3)
    for i, (alpha, a, d, theta) in enumerate(snapped):
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
        gravity=gravity,
        limits=limits,
        drives=drives,
        tool=tool,
        tip_rotation=R @ end,
        tip_offset=r + R @ np.asarray(tip_offset, dtype=np.float64),
        source=source,
        notes=notes,
    )
    return robot.mounted(base_rotation, base_position)
