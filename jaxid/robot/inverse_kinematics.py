"""Which joint coordinates bring the end-effector to a pose; one posture along a whole path.

A robot with joints to spare takes, of all coordinates that reach the pose, those nearest to a
posture. That makes them a function of the pose alone: a closed path of the end-effector is a closed
path of the joints, as smooth as the pose.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.kinematics import rotation_vectors, tip_jacobian
from jaxid.robot.robot import Robot

REACHED = 1e-9
"""Distance from a pose that counts as reached [m, and rad]."""
FREE_TURN, FREE_STROKE = np.pi, 1.0
"""Half of the range of a joint without limits [rad, m]."""
SLACK = 1e-9
"""Share of half the range that rounding may lie outside of it."""
SEARCH, APPROACH, NEWTON = 80, 60, 6
"""Steps to a pose, to the posture on it, and of Newton's method in the end."""
LARGEST_STEP = 0.2
"""Of a joint on the way to the posture, as a share of half its range."""
LARGEST_JUMP = 0.25
"""Of a joint between two poses of a path, as a share of half its range."""
TRIED = 8
"""Coordinates of the first pose from which a path is tried, the nearest to the posture first."""
STRIDE = 0.03
"""Way of the end-effector from which a path is followed step by step [m, or rad]."""
SINGULAR = 1e-11
"""Regularises directions that no joint moves."""


def inverse_kinematics(
    robot: Robot,
    position: Numbers,
    rotation: Numbers | None = None,
    *,
    posture: Numbers | None = None,
    starts: int = 32,
    seed: int = 0,
) -> Float[np.ndarray, " joints"]:
    """Joint coordinates within the limits that bring the end-effector to a pose [rad or m].

    Works for any chain, by damped least squares from many random starts. Of what is found, it is
    the nearest to a posture, joints measured by their ranges.

    Args:
        robot: Whose end-effector it is.
        position: Of the end-effector on the ground [m].
        rotation: Its attitude on the ground: columns are its axes; any attitude if None.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.
        starts: Random coordinates to start from.
        seed: Of the starts.

    Raises:
        InputError: If the pose cannot be reached: the message says how near the end-effector comes,
            or which limits are in the way.
    """
    place = np.asarray(as_array("position", position))[None]
    attitude = None if rotation is None else np.asarray(as_array("rotation", rotation))[None]
    task, poses = _Task.of(robot, posture, starts, seed), _poses(place, attitude)
    found = _candidates(task, poses)
    if not len(found):
        raise InputError(_refusal(task, poses, "the pose"))
    return found[0]


def inverse_kinematics_along(
    robot: Robot,
    positions: Numbers,
    rotations: Numbers | None = None,
    *,
    posture: Numbers | None = None,
    starts: int = 32,
    seed: int = 0,
) -> Float[np.ndarray, "poses joints"]:
    """Joint coordinates along a path of the end-effector, without a jump [rad or m].

    Args:
        robot: Whose end-effector it is.
        positions: Of the end-effector, one row for each pose; neighbours lie close together [m].
        rotations: Its attitudes, one for each pose, or one for all; any if None.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.
        starts: Random coordinates to start from at the first pose.
        seed: Of the starts.

    Raises:
        InputError: If a pose cannot be reached, or only with a jump or beyond the limits.
    """
    places = np.asarray(as_array("positions", positions))
    attitudes = None if rotations is None else np.asarray(as_array("rotations", rotations))
    if attitudes is not None and attitudes.ndim == 2:
        attitudes = np.broadcast_to(attitudes, (len(places), *attitudes.shape))
    task, poses = _Task.of(robot, posture, starts, seed), _poses(places, attitudes)
    count = len(poses.position)
    candidates = _candidates(task, poses[:1])
    if not len(candidates):
        raise InputError(_refusal(task, poses[:1], f"pose 1 of {count}"))
    faults: list[tuple[int, str]] = []
    for q in _followed(task, poses, candidates[:TRIED]):
        fault = _fault(task, poses, q)
        if fault is None:
            return np.clip(q, task.low, task.high)
        faults.append(fault)
    k, why = max(faults)
    name = f"pose {k + 1} of {count}"
    if not len(_candidates(task, poses[k : k + 1])):
        raise InputError(_refusal(task, poses[k : k + 1], name))
    raise InputError(
        f"`{robot.name}` cannot follow the path in one piece: at {name}, {poses.where(k)}, {why}; "
        "choose another posture, or a path nearer to the middle of its reach."
    )


class _Poses:
    """Positions and attitudes of the end-effector."""

    def __init__(self, position: np.ndarray, rotation: np.ndarray | None):
        self.position, self.rotation = position, rotation

    def __getitem__(self, chosen) -> "_Poses":
        rotation = None if self.rotation is None else self.rotation[chosen]
        return _Poses(self.position[chosen], rotation)

    def where(self, k: int) -> str:
        """A position in words."""
        return f"({', '.join(f'{x:.3f}' for x in self.position[k])}) m"

    def strides(self) -> np.ndarray:
        """Numbers of poses about `STRIDE` apart, with both ends."""
        way = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        if self.rotation is not None:
            between = np.swapaxes(self.rotation[:-1], 1, 2) @ self.rotation[1:]
            way = way + np.linalg.norm(rotation_vectors(between), axis=1)
        step = np.floor(np.concatenate([[0.0], np.cumsum(way)]) / STRIDE)
        first = np.flatnonzero(np.diff(step, prepend=-1.0) > 0)
        return np.unique(np.append(first, len(self.position) - 1))


def _poses(position: np.ndarray, rotation: np.ndarray | None) -> _Poses:
    shape = position.shape
    if position.ndim != 2 or shape[1] != 3 or not len(position) or not np.isfinite(position).all():
        raise InputError(
            f"a position must hold three finite numbers [m], but the shape is {shape[-1:]}."
        )
    if rotation is not None:
        if rotation.shape != (len(position), 3, 3):
            raise InputError(
                f"`rotations` must hold a 3 x 3 matrix for each of the {len(position)} poses, but "
                f"have shape {rotation.shape}."
            )
        products = np.swapaxes(rotation, 1, 2) @ rotation
        if not np.abs(products - np.eye(3)).max() < 1e-9 or (np.linalg.det(rotation) < 0).any():
            raise InputError("attitudes must be rotation matrices: orthonormal and right-handed.")
    return _Poses(position, rotation)


class _Task(NamedTuple):
    """A robot, the coordinates that are wanted, half of the ranges, limits, and the starts."""

    robot: Robot
    posture: Float[np.ndarray, " joints"]
    half: Float[np.ndarray, " joints"]
    low: Float[np.ndarray, " joints"]
    high: Float[np.ndarray, " joints"]
    starts: int
    seed: int

    @classmethod
    def of(cls, robot: Robot, posture: Numbers | None, starts: int, seed: int) -> "_Task":
        """The task of a robot, checked."""
        if starts < 1:
            raise InputError(f"`starts` must be at least 1, but is {starts}.")
        low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
        known = np.isfinite(low) & np.isfinite(high)
        free = np.where(robot.revolute, FREE_TURN, FREE_STROKE)
        with np.errstate(invalid="ignore"):
            half = np.where(known, (high - low) / 2, free)
            middle = np.clip(np.where(known, (high + low) / 2, 0.0), low, high)
        if posture is not None:
            middle = as_array("posture", posture)
            if middle.shape != (robot.joints,):
                raise InputError(
                    f"`posture` must hold one number for each joint ({robot.joints}), but has "
                    f"shape {middle.shape}."
                )
        return cls(robot, np.asarray(middle), half, low, high, starts, seed)

    def beyond(self, q: np.ndarray) -> np.ndarray:
        """How far coordinates lie outside of their ranges, as shares of half of them."""
        return np.maximum(self.low - q, q - self.high) / self.half


def _linearised(task: _Task, poses: _Poses, q: np.ndarray):
    """Distance from the poses [m, rad], its Jacobian by scaled joints, and the tip."""
    tip = tip_jacobian(task.robot, q)
    e, J = tip.position - poses.position, tip.shift
    if poses.rotation is not None:
        turned = rotation_vectors(tip.rotation @ np.swapaxes(poses.rotation, 1, 2))
        e, J = np.concatenate([e, turned], axis=1), np.concatenate([J, tip.turn], axis=2)
    return e, np.swapaxes(J, 1, 2) * task.half, tip


def _miss(task: _Task, poses: _Poses, q: np.ndarray) -> np.ndarray:
    """Distances [m] and angles [rad] of the end-effector from the poses."""
    e = _linearised(task, poses, q)[0].reshape(len(q), -1, 3)
    return np.linalg.norm(e, axis=2)


def _solve(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.solve(A, b[..., None])[..., 0]


def _search(task: _Task, poses: _Poses, q: np.ndarray, low, high) -> np.ndarray:
    """Levenberg and Marquardt's steps towards the poses, kept within limits."""
    damping, eye = np.full(len(q), 1e-2), np.eye(q.shape[1])
    e, J, _ = _linearised(task, poses, q)
    for _ in range(SEARCH):
        H = np.swapaxes(J, 1, 2) @ J + damping[:, None, None] * eye
        slope = np.einsum("pij,pi->pj", J, e)
        then = np.clip(q - task.half * _solve(H, slope), low, high)
        e_then, J_then, _ = _linearised(task, poses, then)
        better = (e_then**2).sum(axis=1) < (e**2).sum(axis=1)
        damping = np.clip(damping * np.where(better, 0.2, 4.0), 1e-12, 1e3)
        q, e = np.where(better[:, None], then, q), np.where(better[:, None], e_then, e)
        J = np.where(better[:, None, None], J_then, J)
    return q


def _approach(task: _Task, poses: _Poses, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Goes on to the coordinates nearest to the posture; with the multipliers of the poses."""
    multipliers = np.zeros((len(q), 3 if poses.rotation is None else 6))
    for _ in range(APPROACH):
        e, J, _ = _linearised(task, poses, q)
        away = (q - task.posture) / task.half
        G = J @ np.swapaxes(J, 1, 2) + SINGULAR * np.eye(e.shape[1])
        multipliers = _solve(G, e - np.einsum("pij,pj->pi", J, away))
        move = -away - np.einsum("pij,pi->pj", J, multipliers)
        size = np.abs(move).max(axis=1, keepdims=True)
        q = q + task.half * move / np.maximum(1.0, size / LARGEST_STEP)
    return q, multipliers


def _polish(
    task: _Task, poses: _Poses, q: np.ndarray, multipliers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Newton's method on the conditions of the nearest coordinates on the poses."""
    n, m = q.shape[1], multipliers.shape[1]
    still = np.zeros((len(q), 3))
    for _ in range(NEWTON):
        e, J, tip = _linearised(task, poses, q)
        moment = multipliers[:, 3:] if m == 6 else still
        H = tip.curvature(multipliers[:, :3], moment) * (task.half[:, None] * task.half)
        K = np.zeros((len(q), n + m, n + m))
        K[:, :n, :n], K[:, n:, n:] = H + np.eye(n), -SINGULAR * np.eye(m)
        K[:, :n, n:], K[:, n:, :n] = np.swapaxes(J, 1, 2), J
        slope = (q - task.posture) / task.half + np.einsum("pij,pi->pj", J, multipliers)
        step = _solve(K, np.concatenate([slope, e], axis=1))
        size = np.abs(step[:, :n]).max(axis=1, keepdims=True)
        step = step / np.maximum(1.0, size / LARGEST_STEP)
        q, multipliers = q - task.half * step[:, :n], multipliers - step[:, n:]
    return q, multipliers


def _tried(task: _Task, pose: _Poses, low, high) -> np.ndarray:
    """What is found from all starts: the nearest to the posture, and the first that reaches."""
    random = np.random.default_rng(task.seed)
    begin = task.posture + task.half * random.uniform(-1.0, 1.0, (task.starts, len(task.half)))
    begin[0] = task.posture
    poses = pose[np.zeros(task.starts, int)]
    found = _search(task, poses, np.clip(begin, low, high), low, high)
    nearest, _ = _polish(task, poses, *_approach(task, poses, found))
    return np.concatenate([nearest, found])


def _candidates(task: _Task, pose: _Poses) -> list[np.ndarray]:
    """Coordinates that reach a pose within the limits, the nearest to the posture first."""
    q = _tried(task, pose, task.low, task.high)
    reached = _miss(task, pose[np.zeros(len(q), int)], q).max(axis=1) <= REACHED
    good = q[reached & (task.beyond(q).max(axis=1) <= SLACK)]
    away = np.sum(((good - task.posture) / task.half) ** 2, axis=1)
    kept: list[np.ndarray] = []
    for one in good[np.argsort(away)]:
        if all(np.abs((one - other) / task.half).max() > 1e-6 for other in kept):
            kept.append(np.clip(one, task.low, task.high))
    return kept


def _followed(task: _Task, poses: _Poses, starts: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Coordinates at all poses for each start: step by step, then all poses between at once."""
    places = poses.strides()
    each = np.zeros(len(starts), int)
    state = _approach(task, poses[each], np.array(starts))
    steps = []
    for k in places:
        state = _polish(task, poses[each + k], *state)
        steps.append(state)
    for c in range(len(starts)):
        q, multipliers = (np.array([step[part][c] for step in steps]) for part in (0, 1))
        guess = (_between(places, len(poses.position), x) for x in (q, multipliers))
        yield _polish(task, poses, *guess)[0]


def _between(places: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(np.arange(count), places, x) for x in values.T], axis=1)


def _fault(task: _Task, poses: _Poses, q: np.ndarray) -> tuple[int, str] | None:
    """The first pose of a path that fails, and why; None if none does."""
    bad = ~(_miss(task, poses, q).max(axis=1) <= REACHED)
    beyond = task.beyond(q)
    jumps = np.abs(np.diff(q, axis=0, prepend=q[:1]) / task.half).max(axis=1) > LARGEST_JUMP
    outside = beyond.max(axis=1) > SLACK
    failed = np.flatnonzero(bad | jumps | outside)
    if not len(failed):
        return None
    k = int(failed[0])
    if outside[k] and not bad[k]:
        return k, f"joint `{task.robot.joint_names[int(beyond[k].argmax())]}` leaves its range"
    return k, "the joints would have to jump, for the pose is singular"


def _refusal(task: _Task, pose: _Poses, name: str) -> str:
    """Why there are no coordinates for a pose."""
    robot, whole = task.robot, f"{name}, {pose.where(0)},"
    free = np.full(robot.joints, np.inf)
    q = np.concatenate([_tried(task, pose, -free, free), _tried(task, pose, task.low, task.high)])
    miss = _miss(task, pose[np.zeros(len(q), int)], q)
    reached = miss.max(axis=1) <= REACHED
    if reached.any():
        beyond = task.beyond(q[reached])
        least = beyond[int(beyond.max(axis=1).argmin())]
        return (
            f"{whole} can be reached by `{robot.name}` only beyond the range of joint "
            f"`{robot.joint_names[int(least.argmax())]}`: choose another pose, or more `starts`."
        )
    nearest = miss[int(np.argmin(miss.sum(axis=1)))]
    angle = "" if pose.rotation is None else f" and {nearest[1]:.3g} rad"
    return (
        f"{whole} is out of reach of `{robot.name}`: its end-effector comes to within "
        f"{nearest[0]:.3g} m{angle} of it."
    )
