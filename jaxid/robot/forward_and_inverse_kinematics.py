"""Forward and inverse kinematics: placements of all frames, and coordinates along a path.

Placements are written on 3-vectors for one sample: batch with `jax.vmap`, differentiate
with `jax.grad`. Inverse kinematics is in NumPy: it evaluates few poses many times,
where compiling would take longer than computing.

A robot with redundant joints takes, of all coordinates that reach the pose, those
nearest to a posture. That makes them a function of the pose alone: a closed path of the
end-effector is a closed path of the joints, as smooth as the pose. All poses of a path
are solved at once.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float, Numbers, as_array
from jaxid.errors import InputError

from .robot import Robot
from .rotations import rotation_about

_REACHED = 1e-9
"""Distance at which a pose is reached [m, and rad], and slack of a range relative to its half."""


def placement_in_parent(
    robot: Robot, body: int, q: Float[AnyArray, ""]
) -> tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]:
    """Return attitude and origin [m] of a body in its parent, moved by its joint's coordinate."""
    R = robot.rotation[body]
    r = robot.offset[body]
    axis = robot.axis[body]
    if robot.revolute[body]:
        return R @ rotation_about(axis, q), r
    return R, r + R @ axis * q


def placements(
    robot: Robot, q: Float[AnyArray, " joints"]
) -> tuple[Float[AnyArray, "joints 3 3"], Float[AnyArray, "joints 3"]]:
    """Return attitudes and origins [m] of all bodies in the frame of the ground."""
    q = jnp.asarray(q)
    rotations, origins = [], []
    for i, parent in enumerate(robot.parent):
        R, r = placement_in_parent(robot, i, q[i])
        if parent >= 0:
            R = rotations[parent] @ R
            r = origins[parent] + rotations[parent] @ r
        rotations.append(R)
        origins.append(r)
    return jnp.stack(rotations), jnp.stack(origins)


def tip_placement(
    robot: Robot, q: Float[AnyArray, " joints"]
) -> tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]:
    """Return attitude and position [m] of the end-effector in the frame of the ground."""
    rotations, origins = placements(robot, q)
    R = rotations[robot.tip_body]
    return R @ robot.tip_rotation, origins[robot.tip_body] + R @ robot.tip_offset


def tip_jacobian(
    robot: Robot, q: Float[np.ndarray, "poses joints"]
) -> tuple[np.ndarray, ...]:
    """Return attitudes and positions [m] of the end-effector, and their derivatives, in NumPy.

    The derivatives are velocities of the origin and angular velocities by the rates of
    the joints.
    """
    poses, n = q.shape
    R = np.broadcast_to(np.eye(3), (poses, 3, 3))
    r = np.zeros((poses, 3))
    turn, slide, origin = (np.zeros((poses, n, 3)) for _ in range(3))
    offset, rotation, axes = (
        np.asarray(x) for x in (robot.offset, robot.rotation, robot.axis)
    )
    for i in robot.ancestors[robot.tip_body]:
        r = r + R @ offset[i]
        R = R @ rotation[i]
        along = R @ axes[i]
        origin[:, i] = r
        if robot.revolute[i]:
            turn[:, i] = along
            R = R @ rotation_about(axes[i], q[:, i])
        else:
            slide[:, i] = along
            r = r + along * q[:, i, None]
    tip = r + R @ np.asarray(robot.tip_offset)
    shift = slide + np.cross(turn, tip[:, None] - origin)
    return R @ np.asarray(robot.tip_rotation), tip, shift, turn


def tip_curvature(
    shift: Float[np.ndarray, "poses joints 3"],
    turn: Float[np.ndarray, "poses joints 3"],
    force: Float[np.ndarray, "poses 3"],
    moment: Float[np.ndarray, "poses 3"],
) -> Float[np.ndarray, "poses joints joints"]:
    """Return the second derivatives of the placement by the joints, times force and moment.

    Attitudes count as rotation vectors from the attitude of the end-effector.
    """
    # An earlier joint carries the later ones with it; of two turns, half of their
    # bracket.
    by_shift = np.einsum("pik,pjk->pij", np.cross(force[:, None], turn), shift)
    by_turn = np.einsum("pik,pjk->pij", np.cross(moment[:, None], turn), turn) / 2
    upper = np.triu(by_shift + by_turn)
    return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


def inverse_kinematics_along(
    robot: Robot,
    positions: Float[np.ndarray, "poses 3"],
    rotation: Numbers,
    posture: Numbers | None = None,
) -> Float[np.ndarray, "poses joints"]:
    """Return coordinates within the limits along a path of close positions [rad or m].

    Columns of the `rotation` are the end-effector's axes on the ground. The search
    begins at the preferred coordinates `posture`; the middle of the ranges if None.

    Raises:
        InputError: If the posture or the rotation is none, or the end-effector cannot
            follow the path: the message says where, and why.
    """
    task = _task(robot, rotation, posture)
    q = _follow(task, positions)
    missed = np.linalg.norm(
        _linearise(task, positions, q)[0].reshape(len(q), 2, 3), axis=2
    )
    beyond = np.maximum(task.low - q, q - task.high) / task.half
    jumps = np.abs(np.diff(q, axis=0, prepend=q[:1]) / task.half).max(axis=1) > 0.25
    reached = missed.max(axis=1) <= _REACHED
    outside = beyond.max(axis=1) > _REACHED
    failed = np.flatnonzero(~reached | jumps | outside)
    if not len(failed):
        return np.clip(q, task.low, task.high)
    k = int(failed[0])
    reason = "the joints would have to jump, for the pose is singular"
    if not reached[k]:
        reason = (
            f"it comes to within {missed[k, 0]:.3g} m and {missed[k, 1]:.3g} rad "
            "of the pose"
        )
    elif outside[k]:
        reason = (
            f"joint `{robot.joint_names[int(beyond[k].argmax())]}` leaves its range"
        )
    place = ", ".join(f"{x:.3f}" for x in positions[k])
    raise InputError(
        f"`{robot.name}` cannot follow the path: at pose {k + 1} of {len(q)}, "
        f"({place}) m, "
        f"{reason}; choose another posture, or a path nearer to the middle of its "
        "reach."
    )


class _Task(NamedTuple):
    """Robot, attitude of its end-effector, preferred coordinates, half of the ranges, limits."""

    robot: Robot
    rotation: Float[np.ndarray, "3 3"]
    posture: Float[np.ndarray, " joints"]
    half: Float[np.ndarray, " joints"]
    low: Float[np.ndarray, " joints"]
    high: Float[np.ndarray, " joints"]


def _task(robot: Robot, rotation: Numbers, posture: Numbers | None) -> _Task:
    """Return the checked task of a robot; joints without limits get a range of their own."""
    low = np.asarray(robot.limits.position_min)
    high = np.asarray(robot.limits.position_max)
    known = np.isfinite(low) & np.isfinite(high)
    with np.errstate(invalid="ignore"):
        half = np.where(known, (high - low) / 2, np.where(robot.revolute, np.pi, 1.0))
        middle = np.clip(np.where(known, (high + low) / 2, 0.0), low, high)
    near = np.asarray(as_array("posture", middle if posture is None else posture))
    if near.shape != middle.shape:
        raise InputError(
            f"`posture` must hold {robot.joints} numbers, but has shape {near.shape}."
        )
    R = np.asarray(as_array("rotation", rotation))
    proper = R.shape == (3, 3) and np.abs(R.T @ R - np.eye(3)).max() < 1e-9
    if not proper or np.linalg.det(R) < 0:
        raise InputError(
            "`rotation` must be an orthonormal, right-handed matrix of 3 rows."
        )
    return _Task(robot, R, near, half, low, high)


def _linearise(
    task: _Task, positions: np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return distances from poses [m, rad], their Jacobians by scaled joints, shift and turn."""
    R, r, shift, turn = tip_jacobian(task.robot, q)
    away = Rotation.from_matrix(R @ task.rotation.T).as_rotvec()
    e, J = (
        np.concatenate([r - positions, away], axis=1),
        np.concatenate([shift, turn], axis=2),
    )
    return e, np.swapaxes(J, 1, 2) * task.half, shift, turn


def _descend(
    task: _Task,
    positions: np.ndarray,
    q: np.ndarray,
    multipliers: np.ndarray,
    gauss: int,
    newton: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Go to the coordinates nearest to the posture, and to the multipliers of their poses.

    Steps solve the linearised conditions, the last `newton` of them with the poses'
    curvature.
    """
    n = q.shape[1]
    K = np.zeros((len(q), n + 6, n + 6))
    K[:, n:, n:] = -1e-11 * np.eye(6)
    for k in range(gauss + newton):
        e, J, shift, turn = _linearise(task, positions, q)
        K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = np.eye(n), np.swapaxes(J, 1, 2), J
        if k >= gauss:
            H = tip_curvature(shift, turn, multipliers[:, :3], multipliers[:, 3:])
            K[:, :n, :n] += H * (task.half[:, None] * task.half)
        slope = (q - task.posture) / task.half + np.einsum("pij,pi->pj", J, multipliers)
        step = np.linalg.solve(K, np.concatenate([slope, e], axis=1)[..., None])[..., 0]
        # At most a tenth of a joint's range.
        step /= np.maximum(1.0, np.abs(step[:, :n]).max(axis=1, keepdims=True) / 0.2)
        q = q - task.half * step[:, :n]
        multipliers = multipliers - step[:, n:]
    return q, multipliers


def _follow(task: _Task, positions: np.ndarray) -> np.ndarray:
    """Return coordinates at all poses: stride by stride, then all between at once."""
    # Strides of about 0.03 m, with both ends.
    way = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    stride = np.floor(np.concatenate([[0.0], np.cumsum(way)]) / 0.03)
    first = np.flatnonzero(np.diff(stride, prepend=-1.0) > 0)
    places = np.unique(np.append(first, len(positions) - 1))
    q, multipliers = _descend(
        task, positions[:1], task.posture[None], np.zeros((1, 6)), 60, 0
    )
    steps = []
    for k in places:
        q, multipliers = _descend(task, positions[k : k + 1], q, multipliers, 0, 4)
        steps.append(np.concatenate([q[0], multipliers[0]]))
    every = np.arange(len(positions))
    guess = np.stack([np.interp(every, places, x) for x in np.transpose(steps)], axis=1)
    return _descend(task, positions, guess[:, :-6], guess[:, -6:], 0, 6)[0]
