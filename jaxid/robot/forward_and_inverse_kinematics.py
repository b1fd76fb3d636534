"""Forward and inverse kinematics: placements of all frames, and coordinates of a pose.

Placements are written on 3-vectors for one sample: batch with `jax.vmap`, differentiate with
`jax.grad`. Inverse kinematics is in NumPy: it evaluates few poses many times, where compiling would
take longer than computing.

A robot with redundant joints takes, of all coordinates that reach the pose, those nearest to a
posture. That makes them a function of the pose alone: a closed path of the end-effector is a closed
path of the joints, as smooth as the pose. All starts, and all poses of a path, are solved at once.
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
_STARTS = 32
"""Number of random coordinates to start from."""
_LARGEST_STEP = 0.2
"""Largest step of a joint, relative to half its range."""
_SINGULAR = 1e-11
"""Regularisation of directions that no joint moves."""


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


def tip_jacobian(robot: Robot, q: Float[np.ndarray, "poses joints"]) -> tuple[np.ndarray, ...]:
    """Return attitudes and positions [m] of the end-effector, and their derivatives, in NumPy.

    The derivatives are velocities of the origin and angular velocities by the rates of the joints.
    """
    poses, n = q.shape
    R = np.broadcast_to(np.eye(3), (poses, 3, 3))
    r = np.zeros((poses, 3))
    turn, slide, origin = (np.zeros((poses, n, 3)) for _ in range(3))
    offset, rotation, axes = (np.asarray(x) for x in (robot.offset, robot.rotation, robot.axis))
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
    # An earlier joint carries the later ones with it; of two turns, half of their bracket.
    by_shift = np.einsum("pik,pjk->pij", np.cross(force[:, None], turn), shift)
    by_turn = np.einsum("pik,pjk->pij", np.cross(moment[:, None], turn), turn) / 2
    upper = np.triu(by_shift + by_turn)
    return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


def inverse_kinematics(
    robot: Robot,
    position: Numbers,
    rotation: Numbers | None = None,
    *,
    posture: Numbers | None = None,
) -> Float[np.ndarray, " joints"]:
    """Return joint coordinates within the limits that bring the end-effector to a pose [rad or m].

    Works for any chain, by damped least squares from many random starts. Of all solutions it
    returns the nearest to a posture, with joints measured by their ranges.

    Args:
        robot: Robot of the end-effector.
        position: Position of the end-effector on the ground [m].
        rotation: Attitude on the ground, whose columns are the end-effector's axes; any if None.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.

    Raises:
        InputError: If the pose cannot be reached: the message says how near the end-effector comes,
            or which limit prevents it.
    """
    goal = _goals(np.asarray(as_array("position", position))[None], rotation)
    return _candidates(_task(robot, posture), goal, "the pose")[0]


def inverse_kinematics_along(
    robot: Robot,
    positions: Float[np.ndarray, "poses 3"],
    rotation: Numbers,
    posture: Numbers | None = None,
) -> Float[np.ndarray, "poses joints"]:
    """Return coordinates along a path of close positions, without a jump [rad or m].

    Arguments as of `inverse_kinematics`, with one rotation for all poses.
    """
    task = _task(robot, posture)
    goals = _goals(positions, rotation)
    count, faults = len(goals), []
    for start in _candidates(task, goals[:1], f"pose 1 of {count}")[:8]:
        q = _follow(task, goals, start)
        missed = ~(_distances(task, goals, q).max(axis=1) <= _REACHED)
        beyond = _beyond(task, q)
        outside = beyond.max(axis=1) > _REACHED
        jumps = np.abs(np.diff(q, axis=0, prepend=q[:1]) / task.half).max(axis=1) > 0.25
        failed = np.flatnonzero(missed | jumps | outside)
        if not len(failed):
            return np.clip(q, task.low, task.high)
        k = int(failed[0])
        reason = "the joints would have to jump, for the pose is singular"
        if outside[k] and not missed[k]:
            reason = f"joint `{robot.joint_names[int(beyond[k].argmax())]}` leaves its range"
        faults.append((k, reason))
    k, reason = max(faults)
    name = f"pose {k + 1} of {count}"
    _candidates(task, goals[k : k + 1], name)
    raise InputError(
        f"`{robot.name}` cannot follow the path in one piece: at {name}, {_place(goals[k])}, "
        f"{reason}; choose another posture, or a path nearer to the middle of its reach."
    )


class _Task(NamedTuple):
    """Robot, preferred coordinates, half of the ranges, limits, and random starts."""

    robot: Robot
    posture: Float[np.ndarray, " joints"]
    half: Float[np.ndarray, " joints"]
    low: Float[np.ndarray, " joints"]
    high: Float[np.ndarray, " joints"]
    starts: Float[np.ndarray, "starts joints"]


def _task(robot: Robot, posture: Numbers | None) -> _Task:
    """Return the checked task of a robot; joints without limits get a range of their own."""
    low = np.asarray(robot.limits.position_min)
    high = np.asarray(robot.limits.position_max)
    known = np.isfinite(low) & np.isfinite(high)
    with np.errstate(invalid="ignore"):
        half = np.where(known, (high - low) / 2, np.where(robot.revolute, np.pi, 1.0))
        middle = np.clip(np.where(known, (high + low) / 2, 0.0), low, high)
    if posture is not None:
        middle = np.asarray(as_array("posture", posture))
        if middle.shape != (robot.joints,):
            raise InputError(
                f"`posture` must hold {robot.joints} numbers, but has shape {middle.shape}."
            )
    begin = np.random.default_rng(0).uniform(-1.0, 1.0, (_STARTS, robot.joints))
    begin[0] = 0.0
    return _Task(robot, middle, half, low, high, middle + half * begin)


def _goals(positions: np.ndarray, rotation: Numbers | None) -> np.ndarray:
    """Return checked poses: the position in the first column, and then the attitude if given."""
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise InputError(f"a position must hold three finite numbers [m], but is {positions}.")
    if rotation is None:
        return positions[:, :, None]
    R = np.asarray(as_array("rotation", rotation))
    proper = R.shape == (3, 3) and np.abs(R.T @ R - np.eye(3)).max() < 1e-9
    if not proper or np.linalg.det(R) < 0:
        raise InputError("`rotation` must be an orthonormal, right-handed matrix of 3 rows.")
    attitudes = np.broadcast_to(R, (len(positions), 3, 3))
    return np.concatenate([positions[:, :, None], attitudes], axis=2)


def _place(goal: np.ndarray) -> str:
    return f"({', '.join(f'{x:.3f}' for x in goal[:, 0])}) m"


def _linearise(task: _Task, goals: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return distances from poses [m, rad], their Jacobians by scaled joints, shift and turn."""
    R, r, shift, turn = tip_jacobian(task.robot, q)
    e, J = r - goals[:, :, 0], shift
    if goals.shape[2] > 1:
        away = Rotation.from_matrix(R @ np.swapaxes(goals[:, :, 1:], 1, 2)).as_rotvec()
        e = np.concatenate([e, away], axis=1)
        J = np.concatenate([J, turn], axis=2)
    return e, np.swapaxes(J, 1, 2) * task.half, shift, turn


def _distances(task: _Task, goals: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return distances [m] and angles [rad] of the end-effector from the poses."""
    return np.linalg.norm(_linearise(task, goals, q)[0].reshape(len(q), -1, 3), axis=2)


def _beyond(task: _Task, q: np.ndarray) -> np.ndarray:
    """Return how far coordinates lie outside of their ranges, relative to half of them."""
    return np.maximum(task.low - q, q - task.high) / task.half


def _descend(
    task: _Task,
    goals: np.ndarray,
    q: np.ndarray,
    multipliers: np.ndarray,
    gauss: int,
    newton: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Go to the coordinates nearest to the posture, and to the multipliers of their poses.

    Steps solve the linearised conditions, the last `newton` of them with the poses' curvature.
    """
    n, m = q.shape[1], multipliers.shape[1]
    K = np.zeros((len(q), n + m, n + m))
    K[:, n:, n:] = -_SINGULAR * np.eye(m)
    for k in range(gauss + newton):
        e, J, shift, turn = _linearise(task, goals, q)
        K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = np.eye(n), np.swapaxes(J, 1, 2), J
        if k >= gauss:
            force, moment = (
                np.pad(multipliers, ((0, 0), (0, 6 - m))).reshape(-1, 2, 3).swapaxes(0, 1)
            )
            H = tip_curvature(shift, turn, force, moment)
            K[:, :n, :n] += H * (task.half[:, None] * task.half)
        slope = (q - task.posture) / task.half + np.einsum("pij,pi->pj", J, multipliers)
        step = np.linalg.solve(K, np.concatenate([slope, e], axis=1)[..., None])[..., 0]
        step /= np.maximum(1.0, np.abs(step[:, :n]).max(axis=1, keepdims=True) / _LARGEST_STEP)
        q = q - task.half * step[:, :n]
        multipliers = multipliers - step[:, n:]
    return q, multipliers


def _try_starts(task: _Task, goal: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return solutions from all starts: nearest to the posture, and as the search found them."""
    # Steps of Levenberg and Marquardt within limits.
    q = np.clip(task.starts, low, high)
    eye = np.eye(task.robot.joints)
    damping = np.full(len(q), 1e-2)
    e, J, _, _ = _linearise(task, goal, q)
    for _ in range(80):
        H = np.swapaxes(J, 1, 2) @ J + damping[:, None, None] * eye
        slope = np.einsum("pij,pi->pj", J, e)[..., None]
        then = np.clip(q - task.half * np.linalg.solve(H, slope)[..., 0], low, high)
        e_then, J_then, _, _ = _linearise(task, goal, then)
        better = (e_then**2).sum(axis=1) < (e**2).sum(axis=1)
        damping = np.clip(damping * np.where(better, 0.2, 4.0), 1e-12, 1e3)
        q = np.where(better[:, None], then, q)
        e = np.where(better[:, None], e_then, e)
        J = np.where(better[:, None, None], J_then, J)
    none = np.zeros((len(q), 3 if goal.shape[2] == 1 else 6))
    return np.concatenate([_descend(task, goal, q, none, 60, 6)[0], q])


def _candidates(task: _Task, goal: np.ndarray, name: str) -> list[np.ndarray]:
    """Return coordinates that reach a pose within the limits, the nearest to the posture first."""
    q = _try_starts(task, goal, task.low, task.high)
    reached = _distances(task, goal, q).max(axis=1)
    good = q[(reached <= _REACHED) & (_beyond(task, q).max(axis=1) <= _REACHED)]
    away = np.sum(((good - task.posture) / task.half) ** 2, axis=1)
    kept: list[np.ndarray] = []
    for one in good[np.argsort(away)]:
        if all(np.abs((one - other) / task.half).max() > 1e-6 for other in kept):
            kept.append(np.clip(one, task.low, task.high))
    if kept:
        return kept
    robot = task.robot
    free = np.full(task.robot.joints, np.inf)
    q = _try_starts(task, goal, -free, free)
    distances = _distances(task, goal, q)
    reached = distances.max(axis=1) <= _REACHED
    if reached.any():
        beyond = _beyond(task, q[reached])
        j = int(beyond[beyond.max(axis=1).argmin()].argmax())
        raise InputError(
            f"{name}, {_place(goal[0])}, can be reached by `{robot.name}` only beyond the range of "
            f"joint `{robot.joint_names[j]}`: choose another pose."
        )
    nearest = distances[int(np.argmin(distances.sum(axis=1)))]
    angle = "" if len(nearest) == 1 else f" and {nearest[1]:.3g} rad"
    raise InputError(
        f"{name}, {_place(goal[0])}, is out of reach of `{robot.name}`: its end-effector comes to "
        f"within {nearest[0]:.3g} m{angle} of it."
    )


def _follow(task: _Task, goals: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return coordinates at all poses: stride by stride, then all between at once."""
    # Strides of about 0.03 m, with both ends.
    way = np.linalg.norm(np.diff(goals[:, :, 0], axis=0), axis=1)
    stride = np.floor(np.concatenate([[0.0], np.cumsum(way)]) / 0.03)
    first = np.flatnonzero(np.diff(stride, prepend=-1.0) > 0)
    places = np.unique(np.append(first, len(goals) - 1))
    q, multipliers = _descend(task, goals[:1], start[None], np.zeros((1, 6)), 60, 0)
    steps = []
    for k in places:
        q, multipliers = _descend(task, goals[k : k + 1], q, multipliers, 0, 4)
        steps.append(np.concatenate([q[0], multipliers[0]]))
    every = np.arange(len(goals))
    guess = np.stack([np.interp(every, places, x) for x in np.transpose(steps)], axis=1)
    return _descend(task, goals, guess[:, :-6], guess[:, -6:], 0, 6)[0]
