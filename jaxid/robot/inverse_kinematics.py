"""Inverse kinematics: joint coordinates of a pose of the end-effector, and along a path.

A robot with redundant joints takes, of all coordinates that reach the pose, those nearest to a
posture. That makes them a function of the pose alone: a closed path of the end-effector is a closed
path of the joints, as smooth as the pose. All starts, and all poses of a path, are solved at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.kinematics import rotation_vectors, tip_jacobian
from jaxid.robot.robot import Robot

_REACHED = 1e-9
"""Distance at which a pose is reached [m, and rad], and slack of a range relative to its half."""
_LARGEST_STEP = 0.2
"""Largest step of a joint, relative to half its range."""
_SINGULAR = 1e-11
"""Regularisation of directions that no joint moves."""


def inverse_kinematics(
    robot: Robot,
    position: Numbers,
    rotation: Numbers | None = None,
    *,
    posture: Numbers | None = None,
    starts: int = 32,
    seed: int = 0,
) -> Float[np.ndarray, " joints"]:
    """Return joint coordinates within the limits that bring the end-effector to a pose [rad or m].

    Works for any chain, by damped least squares from many random starts. Of all solutions it
    returns the nearest to a posture, with joints measured by their ranges.

    Args:
        robot: Robot of the end-effector.
        position: Position of the end-effector on the ground [m].
        rotation: Attitude on the ground, whose columns are the end-effector's axes; any if None.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.
        starts: Number of random coordinates to start from.
        seed: Seed of the starts.

    Raises:
        InputError: If the pose cannot be reached: the message says how near the end-effector comes,
            or which limit prevents it.
    """
    place = np.asarray(as_array("position", position))[None]
    attitude = None if rotation is None else np.asarray(as_array("rotation", rotation))[None]
    task, poses = _Task.of(robot, posture, starts, seed), _Poses.of(place, attitude)
    found = _candidates(task, poses)
    if not found:
        raise InputError(_explanation(task, poses, "the pose"))
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
    """Return joint coordinates along a path of the end-effector, without a jump [rad or m].

    Args:
        robot: Robot of the end-effector.
        positions: Positions of the end-effector, one row for each pose; neighbours are close [m].
        rotations: Attitudes of the end-effector, one for each pose, or one for all; any if None.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.
        starts: Number of random coordinates to start from at the first pose.
        seed: Seed of the starts.

    Raises:
        InputError: If a pose cannot be reached, or only with a jump or beyond the limits.
    """
    places = np.asarray(as_array("positions", positions))
    attitudes = None if rotations is None else np.asarray(as_array("rotations", rotations))
    if attitudes is not None and attitudes.ndim == 2:
        attitudes = np.broadcast_to(attitudes, (len(places), *attitudes.shape))
    task, poses = _Task.of(robot, posture, starts, seed), _Poses.of(places, attitudes)
    count = len(poses.position)
    candidates = _candidates(task, poses[:1])
    if not candidates:
        raise InputError(_explanation(task, poses[:1], f"pose 1 of {count}"))
    faults: list[tuple[int, str]] = []
    for q in _follow(task, poses, candidates[:8]):
        fault = _path_fault(task, poses, q)
        if fault is None:
            return np.clip(q, task.low, task.high)
        faults.append(fault)
    k, reason = max(faults)
    name = f"pose {k + 1} of {count}"
    if not _candidates(task, poses[k : k + 1]):
        raise InputError(_explanation(task, poses[k : k + 1], name))
    raise InputError(
        f"`{robot.name}` cannot follow the path in one piece: at {name}, {poses.place(k)}, "
        f"{reason}; choose another posture, or a path nearer to the middle of its reach."
    )


@dataclass(frozen=True)
class _Poses:
    """Positions [m] and, if they matter, attitudes of the end-effector."""

    position: Float[np.ndarray, "poses 3"]
    rotation: Float[np.ndarray, "poses 3 3"] | None

    @classmethod
    def of(cls, position: np.ndarray, rotation: np.ndarray | None) -> "_Poses":
        """Return checked poses."""
        shape = position.shape
        if position.ndim != 2 or shape[1] != 3 or not len(position):
            raise InputError(f"a position must hold three numbers [m], but has shape {shape[1:]}.")
        if not np.isfinite(position).all():
            raise InputError("a position must hold finite numbers [m].")
        if rotation is not None:
            if rotation.shape != (len(position), 3, 3):
                raise InputError(
                    f"a rotation must be a 3 x 3 matrix for each of the {len(position)} poses, but "
                    f"the shape is {rotation.shape}."
                )
            error = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max()
            if not error < 1e-9 or (np.linalg.det(rotation) < 0).any():
                raise InputError("a rotation must be orthonormal and right-handed.")
        return cls(position, rotation)

    def __getitem__(self, index) -> "_Poses":
        rotation = None if self.rotation is None else self.rotation[index]
        return _Poses(self.position[index], rotation)

    def repeated(self, count: int) -> "_Poses":
        """Return the first pose many times."""
        return self[np.zeros(count, int)]

    def place(self, k: int) -> str:
        """Return a position in words."""
        return f"({', '.join(f'{x:.3f}' for x in self.position[k])}) m"

    def strides(self) -> np.ndarray:
        """Return indices of poses about 0.03 m or 0.03 rad apart, with both ends."""
        way = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        if self.rotation is not None:
            between = np.swapaxes(self.rotation[:-1], 1, 2) @ self.rotation[1:]
            way = way + np.linalg.norm(rotation_vectors(between), axis=1)
        step = np.floor(np.concatenate([[0.0], np.cumsum(way)]) / 0.03)
        first = np.flatnonzero(np.diff(step, prepend=-1.0) > 0)
        return np.unique(np.append(first, len(self.position) - 1))


class _Task(NamedTuple):
    """Robot, preferred coordinates, half of the ranges, limits, and random starts."""

    robot: Robot
    posture: Float[np.ndarray, " joints"]
    half: Float[np.ndarray, " joints"]
    low: Float[np.ndarray, " joints"]
    high: Float[np.ndarray, " joints"]
    starts: Float[np.ndarray, "starts joints"]

    @classmethod
    def of(cls, robot: Robot, posture: Numbers | None, starts: int, seed: int) -> "_Task":
        """Return the checked task of a robot; joints without limits get a range of their own."""
        if starts < 1:
            raise InputError(f"`starts` must be at least 1, but is {starts}.")
        low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
        known = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            half = np.where(known, (high - low) / 2, np.where(robot.revolute, np.pi, 1.0))
            middle = np.clip(np.where(known, (high + low) / 2, 0.0), low, high)
        if posture is not None:
            middle = np.asarray(as_array("posture", posture))
            if middle.shape != (robot.joints,):
                raise InputError(
                    f"`posture` must hold one number for each joint ({robot.joints}), but has "
                    f"shape {middle.shape}."
                )
        random = np.random.default_rng(seed).uniform(-1.0, 1.0, (starts, robot.joints))
        begin = middle + half * random
        begin[0] = middle
        return cls(robot, middle, half, low, high, begin)

    def beyond(self, q: np.ndarray) -> np.ndarray:
        """Return how far coordinates lie outside of their ranges, relative to half of them."""
        return np.maximum(self.low - q, q - self.high) / self.half


def _linearise(task: _Task, poses: _Poses, q: np.ndarray):
    """Return the distance from the poses [m, rad], its Jacobian by scaled joints, and the tip."""
    tip = tip_jacobian(task.robot, q)
    e, J = tip.position - poses.position, tip.shift
    if poses.rotation is not None:
        turned = rotation_vectors(tip.rotation @ np.swapaxes(poses.rotation, 1, 2))
        e, J = np.concatenate([e, turned], axis=1), np.concatenate([J, tip.turn], axis=2)
    return e, np.swapaxes(J, 1, 2) * task.half, tip


def _distances(task: _Task, poses: _Poses, q: np.ndarray) -> np.ndarray:
    """Return distances [m] and angles [rad] of the end-effector from the poses."""
    return np.linalg.norm(_linearise(task, poses, q)[0].reshape(len(q), -1, 3), axis=2)


def _solve(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.solve(A, b[..., None])[..., 0]


def _search(task: _Task, poses: _Poses, q: np.ndarray, low, high) -> np.ndarray:
    """Go to the poses by steps of Levenberg and Marquardt within limits."""
    damping, eye = np.full(len(q), 1e-2), np.eye(q.shape[1])
    e, J, _ = _linearise(task, poses, q)
    for _ in range(80):
        H = np.swapaxes(J, 1, 2) @ J + damping[:, None, None] * eye
        slope = np.einsum("pij,pi->pj", J, e)
        then = np.clip(q - task.half * _solve(H, slope), low, high)
        e_then, J_then, _ = _linearise(task, poses, then)
        better = (e_then**2).sum(axis=1) < (e**2).sum(axis=1)
        damping = np.clip(damping * np.where(better, 0.2, 4.0), 1e-12, 1e3)
        q, e = np.where(better[:, None], then, q), np.where(better[:, None], e_then, e)
        J = np.where(better[:, None, None], J_then, J)
    return q


def _approach(task: _Task, poses: _Poses, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Go to the coordinates nearest to the posture; return them and the poses' multipliers."""
    multipliers = np.zeros((len(q), 3 if poses.rotation is None else 6))
    for _ in range(60):
        e, J, _ = _linearise(task, poses, q)
        away = (q - task.posture) / task.half
        G = J @ np.swapaxes(J, 1, 2) + _SINGULAR * np.eye(e.shape[1])
        multipliers = _solve(G, e - np.einsum("pij,pj->pi", J, away))
        move = -away - np.einsum("pij,pi->pj", J, multipliers)
        size = np.abs(move).max(axis=1, keepdims=True)
        q = q + task.half * move / np.maximum(1.0, size / _LARGEST_STEP)
    return q, multipliers


def _polish(
    task: _Task, poses: _Poses, q: np.ndarray, multipliers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the conditions of the nearest coordinates by Newton's method."""
    n, m = q.shape[1], multipliers.shape[1]
    for _ in range(6):
        e, J, tip = _linearise(task, poses, q)
        moment = multipliers[:, 3:] if m == 6 else np.zeros((len(q), 3))
        H = tip.curvature(multipliers[:, :3], moment) * (task.half[:, None] * task.half)
        K = np.zeros((len(q), n + m, n + m))
        K[:, :n, :n], K[:, n:, n:] = H + np.eye(n), -_SINGULAR * np.eye(m)
        K[:, :n, n:], K[:, n:, :n] = np.swapaxes(J, 1, 2), J
        slope = (q - task.posture) / task.half + np.einsum("pij,pi->pj", J, multipliers)
        step = _solve(K, np.concatenate([slope, e], axis=1))
        size = np.abs(step[:, :n]).max(axis=1, keepdims=True)
        step = step / np.maximum(1.0, size / _LARGEST_STEP)
        q, multipliers = q - task.half * step[:, :n], multipliers - step[:, n:]
    return q, multipliers


def _try_starts(task: _Task, pose: _Poses, low, high) -> np.ndarray:
    """Return solutions from all starts: nearest to the posture, and as the search found them."""
    poses = pose.repeated(len(task.starts))
    found = _search(task, poses, np.clip(task.starts, low, high), low, high)
    nearest, _ = _polish(task, poses, *_approach(task, poses, found))
    return np.concatenate([nearest, found])


def _candidates(task: _Task, pose: _Poses) -> list[np.ndarray]:
    """Return coordinates that reach a pose within the limits, the nearest to the posture first."""
    q = _try_starts(task, pose, task.low, task.high)
    reached = _distances(task, pose.repeated(len(q)), q).max(axis=1) <= _REACHED
    good = q[reached & (task.beyond(q).max(axis=1) <= _REACHED)]
    away = np.sum(((good - task.posture) / task.half) ** 2, axis=1)
    kept: list[np.ndarray] = []
    for one in good[np.argsort(away)]:
        if all(np.abs((one - other) / task.half).max() > 1e-6 for other in kept):
            kept.append(np.clip(one, task.low, task.high))
    return kept


def _follow(task: _Task, poses: _Poses, starts: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield coordinates at all poses for each start: stride by stride, then all between at once."""
    places = poses.strides()
    each = np.zeros(len(starts), int)
    state = _approach(task, poses[each], np.array(starts))
    steps = []
    for k in places:
        state = _polish(task, poses[each + k], *state)
        steps.append(state)
    every = np.arange(len(poses.position))
    for c in range(len(starts)):
        guess = []
        for part in (0, 1):
            values = np.array([step[part][c] for step in steps])
            guess.append(np.stack([np.interp(every, places, x) for x in values.T], axis=1))
        yield _polish(task, poses, *guess)[0]


def _path_fault(task: _Task, poses: _Poses, q: np.ndarray) -> tuple[int, str] | None:
    """Return the first pose of a path that fails, and the reason; None if none does."""
    missed = ~(_distances(task, poses, q).max(axis=1) <= _REACHED)
    beyond = task.beyond(q)
    jumps = np.abs(np.diff(q, axis=0, prepend=q[:1]) / task.half).max(axis=1) > 0.25
    outside = beyond.max(axis=1) > _REACHED
    failed = np.flatnonzero(missed | jumps | outside)
    if not len(failed):
        return None
    k = int(failed[0])
    if outside[k] and not missed[k]:
        return k, f"joint `{task.robot.joint_names[int(beyond[k].argmax())]}` leaves its range"
    return k, "the joints would have to jump, for the pose is singular"


def _explanation(task: _Task, pose: _Poses, name: str) -> str:
    """Return the reason why there are no coordinates for a pose."""
    robot, whole = task.robot, f"{name}, {pose.place(0)},"
    free = np.full(robot.joints, np.inf)
    q = np.concatenate(
        [_try_starts(task, pose, -free, free), _try_starts(task, pose, task.low, task.high)]
    )
    distances = _distances(task, pose.repeated(len(q)), q)
    reached = distances.max(axis=1) <= _REACHED
    if reached.any():
        beyond = task.beyond(q[reached])
        least = beyond[int(beyond.max(axis=1).argmin())]
        return (
            f"{whole} can be reached by `{robot.name}` only beyond the range of joint "
            f"`{robot.joint_names[int(least.argmax())]}`: choose another pose, or more `starts`."
        )
    nearest = distances[int(np.argmin(distances.sum(axis=1)))]
    angle = "" if pose.rotation is None else f" and {nearest[1]:.3g} rad"
    return (
        f"{whole} is out of reach of `{robot.name}`: its end-effector comes to within "
        f"{nearest[0]:.3g} m{angle} of it."
    )
