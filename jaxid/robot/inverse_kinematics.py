"""Inverse kinematics: joint coordinates along a path of the end-effector.

A robot with redundant joints takes, of all coordinates that reach the pose, those
nearest to a posture. That makes them a function of the pose alone: a closed path of the
end-effector is a closed path of the joints, as smooth as the pose. They are found by
Newton's method on the Lagrangian of this problem, for all poses of a path at once.
(A search by least squares, without the curvature of the placements, gains a digit in 30
steps where Newton's method doubles the digits.)
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Joints, Matrix3, Numbers, as_array
from jaxid.errors import InputError

from .forward_kinematics import TipJacobian, tip_curvature, tip_jacobian
from .limits_and_drives import complete_limits
from .robot import Robot
from .rotations import as_rotations

POSE_TOLERANCE = 1e-9
"""Distance at which a pose is reached [m, and rad]."""
RANGE_TOLERANCE = 1e-9
"""Excess over the end of a range that is rounding, relative to half the range."""
MAX_JUMP = 0.25
"""Largest motion of a joint between neighbouring poses, relative to half its range."""
MAX_STEP = 0.2
"""Largest step of the search, relative to half of a joint's range."""
STRIDE = 0.03
"""Distance of the poses that are solved one after the other [m]."""
APPROACH_STEPS = 60
"""Steps from the posture to the first pose, without curvature."""
STRIDE_STEPS = 4
"""Newton steps from a pose to the next one after a stride."""
FINAL_STEPS = 6
"""Newton steps of all poses at once, from interpolated coordinates."""


def inverse_kinematics_along(
    robot: Robot,
    positions: np.ndarray,
    rotation: Numbers,
    posture: Numbers | None = None,
) -> np.ndarray:
    """Return coordinates within the limits along a path of close positions [rad or m].

    Columns of the `rotation` are the end-effector's axes on the ground. The search
    begins at the preferred coordinates `posture`; the middle of the ranges if None.

    Raises:
        InputError: If the posture has another length, the rotation is no rotation, or
            the end-effector cannot follow the path: the message says where, and why.
    """
    task = _tip_task(robot, rotation, posture)
    q = _follow_path(task, positions)
    _require_followed(task, positions, q)
    return np.clip(q, task.low, task.high)


class _TipTask(NamedTuple):
    """Robot, attitude of its tip, preferred coordinates, half ranges and limits."""

    robot: Robot
    rotation: Matrix3
    posture: Joints
    half_range: Joints
    low: Joints
    high: Joints


Unknowns = np.ndarray
"""Coordinates of each pose, then the six multipliers of its placement."""


def _tip_task(robot: Robot, rotation: Numbers, posture: Numbers | None):
    """Return the checked task; joints without limits get half a turn, or a metre."""
    low = np.asarray(robot.limits.position_min)
    high = np.asarray(robot.limits.position_max)
    limits = complete_limits(robot)
    half_range = 0.5 * (limits.position_max - limits.position_min)
    middle_pose = 0.5 * (limits.position_max + limits.position_min)
    goal = middle_pose
    if posture is not None:
        goal = np.asarray(as_array("posture", posture))
    if goal.shape != middle_pose.shape:
        raise InputError(
            f"`posture` must hold {robot.joints} numbers, but has shape {goal.shape}."
        )
    R = as_rotations("`rotation`", rotation, (3, 3))
    return _TipTask(robot, np.asarray(R), goal, half_range, low, high)


def _follow_path(task: _TipTask, positions: np.ndarray):
    """Return coordinates at all poses: stride by stride, then all between at once."""
    joints = task.robot.joints
    unknowns = np.zeros((1, joints + 6))
    unknowns[:, :joints] = task.posture
    # Far from the pose the curvature misleads.
    for _ in range(APPROACH_STEPS):
        unknowns = _newton_step(task, positions[:1], unknowns, curved=False)

    nodes = _ends_of_strides(positions)
    solutions = []
    for k in nodes:
        unknowns = _newton_steps(task, positions[k : k + 1], unknowns, STRIDE_STEPS)
        solutions.append(unknowns[0])
    places = np.arange(len(positions))
    columns = [np.interp(places, nodes, column) for column in np.transpose(solutions)]
    guess = np.transpose(columns)
    unknowns = _newton_steps(task, positions, guess, FINAL_STEPS)
    return unknowns[:, :joints]


def _ends_of_strides(positions: np.ndarray):
    """Return the indices of poses about a `STRIDE` apart, with both ends."""
    steps = np.diff(positions, axis=0)
    distances = np.linalg.norm(steps, axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(distances)])
    strides = np.floor(lengths / STRIDE)
    _, starts = np.unique(strides, return_index=True)
    return np.unique(np.append(starts, len(positions) - 1))


def _newton_steps(
    task: _TipTask,
    positions: np.ndarray,
    unknowns: Unknowns,
    count: int,
):
    """Take some steps with the curvature of the placements."""
    for _ in range(count):
        unknowns = _newton_step(task, positions, unknowns)
    return unknowns


def _newton_step(
    task: _TipTask,
    positions: np.ndarray,
    unknowns: Unknowns,
    curved: bool = True,
):
    """Take a step towards the coordinates that reach the poses nearest to the posture.

    It solves the linearised conditions of an optimum, with the curvature of the
    placements if `curved`.
    """
    joints = task.robot.joints
    q, multipliers = np.split(unknowns, [joints], axis=1)
    # Coordinates count relative to half of their ranges.
    scale = task.half_range
    tip = tip_jacobian(task.robot, q)
    errors = pose_errors(tip, positions, task.rotation)
    jacobian = tip.slopes * scale[:, None]
    hessian = np.eye(joints)
    if curved:
        force, moment = np.split(multipliers, 2, axis=1)
        curvature = tip_curvature(tip, force, moment)
        hessian = hessian + np.outer(scale, scale) * curvature

    pull = np.einsum("pji,pi->pj", jacobian, multipliers)
    slope = (q - task.posture) / scale + pull
    right_side = np.concatenate([slope, errors], axis=1)
    matrix = _saddle_point_matrix(hessian, jacobian)
    step = np.linalg.solve(matrix, right_side[..., None])[..., 0]
    sizes = np.abs(step[:, :joints])
    excess = sizes.max(axis=1, keepdims=True) / MAX_STEP
    step /= np.maximum(1.0, excess)
    step[:, :joints] *= scale
    return unknowns - step


def _saddle_point_matrix(hessian: np.ndarray, jacobian: np.ndarray):
    """Return the matrices of the conditions of an optimum under linear constraints."""
    poses, joints, conditions = jacobian.shape
    curvature = np.broadcast_to(hessian, (poses, joints, joints))
    # Singular poses have a solution, too.
    ridge = -1e-11 * np.eye(conditions)
    ridge = np.broadcast_to(ridge, (poses, conditions, conditions))
    upper_rows = np.concatenate([curvature, jacobian], axis=2)
    lower_rows = np.concatenate([jacobian.swapaxes(1, 2), ridge], axis=2)
    return np.concatenate([upper_rows, lower_rows], axis=1)


def pose_errors(
    tip: TipJacobian, positions: np.ndarray, rotations: AnyArray
) -> np.ndarray:
    """Return the differences of positions [m] and of attitudes [rad] from poses."""
    turn = tip.rotation @ np.swapaxes(np.asarray(rotations), -1, -2)
    vector = scipy.spatial.transform.Rotation.from_matrix(turn).as_rotvec()
    return np.concatenate([tip.position - positions, vector], axis=1)


def _require_followed(task: _TipTask, positions: np.ndarray, q: np.ndarray):
    """Reject coordinates that miss a pose, leave their range or jump."""
    robot = task.robot
    errors = pose_errors(tip_jacobian(robot, q), positions, task.rotation)
    distances = np.linalg.norm(errors[:, :3], axis=1)
    angles = np.linalg.norm(errors[:, 3:], axis=1)
    excess = np.maximum(task.low - q, q - task.high) / task.half_range
    steps = np.diff(q, axis=0, prepend=q[:1])
    changes = np.abs(steps / task.half_range)

    is_reached = np.maximum(distances, angles) <= POSE_TOLERANCE
    is_in_range = excess.max(axis=1) <= RANGE_TOLERANCE
    is_continuous = changes.max(axis=1) <= MAX_JUMP
    failures = np.flatnonzero(~(is_reached & is_in_range & is_continuous))
    if not failures.size:
        return

    k = int(failures[0])
    if not is_reached[k]:
        reason = (
            f"it comes to within {distances[k]:.3g} m "
            f"and {angles[k]:.3g} rad of the pose"
        )
    elif not is_in_range[k]:
        joint = int(excess[k].argmax())
        reason = f"joint `{robot.joint_names[joint]}` leaves its range"
    else:
        reason = "the joints would have to jump: the pose is singular"
    place = ", ".join(f"{x:.3f}" for x in positions[k])
    raise InputError(
        f"`{robot.name}` cannot follow the path: "
        f"at pose {k + 1} of {len(q)}, ({place}) m, {reason}; "
        "choose another posture, or a path nearer to the middle of its reach."
    )
