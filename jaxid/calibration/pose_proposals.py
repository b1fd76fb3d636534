"""Sessions to record next: places and postures that narrow the intervals most."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Vector, double_precision
from jaxid.errors import InputError
from jaxid.robot.collision import CollisionModel
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import complete_limits

from .adjustment import session_equations
from .corrections import common_corrections
from .frames import Frame, stacked
from .geometry_fit import GeometryFit
from .observations import AbstractObservation
from .problem import CalibrationProblem, build_problem

POSTURE_SPREAD = 0.25
"""Deviation of proposed poses from the posture of their session, in half ranges."""
MIN_SHARE = 0.5
"""Share of the asked poses that a place must allow."""
MAX_ERROR = 1e-6
"""Largest error of a pose that reaches its place [m]."""


class ProposedSession(NamedTuple):
    """Poses to record in one session, and how much they narrow the intervals."""

    q: np.ndarray  # joint coordinates [rad or m]
    position: Vector  # mean position of the end-effector [m]
    narrowing: float  # mean decrease of the deviations by this session (0 to 1)


def propose_sessions(
    fit: GeometryFit,
    kind: type[AbstractObservation],
    *,
    sessions: int = 4,
    poses: int = 20,
    candidates: int = 60,
    collision: CollisionModel | None = None,
    distance: float = 0.03,
    seed: int = 0,
) -> list[ProposedSession]:
    """Return sessions that determine best what the present ones leave open.

    Places are drawn at random within the limits of the joints; at each, the robot takes
    poses in which the tool stays in place. Greedily, the session is taken that
    decreases the deviations of all combinations most. When the next one decreases them
    little, more sessions do not pay.

    Args:
        fit: Calibration so far.
        kind: Kind of the observations, like `jid.calibration.PointContact`; only those
            without measured numbers.
        sessions: Number of sessions to propose.
        poses: Number of poses in each.
        candidates: Number of random places.
        collision: Shapes that must keep a distance; None without.
        distance: That distance [m].
        seed: Seed of the random places.

    Raises:
        InputError: If no place can be reached in different postures.
    """
    rng = np.random.default_rng(seed)
    proposals = []
    matrices = []
    for _ in range(candidates):
        q = _reachable_poses(fit, kind, poses, rng, collision, distance)
        if len(q) >= MIN_SHARE * poses:
            proposals.append(q)
            matrices.append(_information(fit, kind, q))
    if not proposals:
        raise InputError(
            "no place was found that the tool can reach in different postures: raise "
            "`candidates`, or make room for the robot (`collision`)."
        )
    return _best_sessions(fit, proposals, np.stack(matrices), sessions)


def _best_sessions(
    fit: GeometryFit, proposals: list[np.ndarray], matrices: np.ndarray, count: int
) -> list[ProposedSession]:
    """Return the sessions that narrow the intervals most, one after the other."""
    scales = fit.solution.scales[fit.problem.common_columns]
    equations = fit.solution.adjustment.equations
    matrix = np.sum([x.matrix for x in equations], axis=0)

    def log_deviations(matrix: Matrix) -> Vector:
        system = np.eye(len(scales)) + scales[:, None] * matrix * scales
        covariance = scales[:, None] * np.linalg.inv(system) * scales
        return 0.5 * np.log(np.diag(fit.combinations.covariance(covariance)))

    best_sessions = []
    for _ in range(min(count, len(matrices))):
        before = log_deviations(matrix)
        gains = [float(np.mean(before - log_deviations(matrix + x))) for x in matrices]
        best = int(np.argmax(gains))
        matrix = matrix + matrices[best]
        matrices = np.delete(matrices, best, axis=0)
        q = proposals.pop(best)
        position = tip_jacobian(fit.robot, q).position.mean(axis=0)
        best_sessions.append(ProposedSession(q, position, 1.0 - np.exp(-gains[best])))
    return best_sessions


def _reachable_poses(
    fit: GeometryFit,
    kind: type[AbstractObservation],
    poses: int,
    rng: np.random.Generator,
    collision: CollisionModel | None,
    distance: float,
) -> np.ndarray:
    """Return poses around a random posture that the robot can take at one place."""
    robot = fit.robot
    limits = complete_limits(robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    middle = 0.5 * (high + low)
    half_range = 0.5 * (high - low)
    posture = middle + 0.8 * half_range * rng.uniform(-1.0, 1.0, robot.joints)
    spread = POSTURE_SPREAD * half_range * rng.normal(size=(poses, robot.joints))
    problem = _problem_at(fit, kind, posture, posture + spread)
    nominal = problem.nominal.vector
    exact = problem.without_errors(nominal)
    errors = problem.error_sizes(exact.linearise(nominal).errors)
    q = exact.groups[kind].q
    is_possible = errors.lengths < MAX_ERROR
    is_possible &= np.all(np.abs(q - middle) <= half_range, axis=1)
    if collision is not None:
        with double_precision():
            gaps = np.asarray(collision.clearance(robot, q))
        is_possible &= gaps.reshape(len(q), -1).min(axis=1) >= distance
    return np.asarray(q)[is_possible]


def _problem_at(
    fit: GeometryFit, kind: type[AbstractObservation], posture: Vector, q: np.ndarray
) -> CalibrationProblem:
    """Return a problem whose place is where the tool is in a posture."""
    tools = [frame for (session, _), frame in fit.frames.items() if not session]
    tool = tools[0]
    name = next(name for session, name in fit.frames if not session)
    tip = tip_jacobian(fit.robot, posture[None])
    place = Frame(tip.rotation[0], tip.position[0]) @ tool
    problem = build_problem(
        fit.robot, [kind("proposed", q, tool=name)], fit.problem.bodies
    )
    level_place = Frame(np.eye(3), place.position)
    starts = [tool if not session else level_place for session, _ in problem.frame_keys]
    return dataclasses.replace(problem, starts=stacked(starts))


def _information(
    fit: GeometryFit, kind: type[AbstractObservation], q: np.ndarray
) -> Matrix:
    """Return second derivatives by the common unknowns of the fit from some poses."""
    problem = _problem_at(fit, kind, q[0], q)
    nominal = problem.nominal.vector
    scales = problem.nominal._replace(frames=problem.freedoms.astype(float)).vector
    weights = np.ones(len(problem.pose_sessions))
    (equations,) = session_equations(
        problem, problem.linearise(nominal), nominal, scales, weights
    )
    numbers = {x: k for k, x in enumerate(fit.corrections)}
    places = [numbers[x] for x in common_corrections(problem)]
    matrix = np.zeros((len(numbers), len(numbers)))
    matrix[np.ix_(places, places)] = equations.matrix
    return matrix
