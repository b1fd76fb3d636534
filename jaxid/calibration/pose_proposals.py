"""Sessions to record next: places and postures that narrow the intervals most."""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Matrix, Vector, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import complete_limits

from .adjustment import normal_matrices, session_equations
from .frames import Frame
from .geometry_fit import GeometryFit
from .problem import CalibrationProblem, gravity_torques

POSTURE_SPREAD = 0.25
"""Deviation of proposed poses from the posture of their session, in half ranges."""
MAX_ERROR = 1e-6
"""Largest error of a pose that reaches its place [m]."""
SPARE_POSES = 2
"""Random poses for each that is asked; not all can be taken."""


class ProposedSession(NamedTuple):
    """Poses to record in one session, and how much they narrow the intervals."""

    q: np.ndarray  # joint coordinates [rad or m]
    position: Vector  # mean position of the end-effector [m]
    narrowing: float  # mean decrease of the intervals by this session (0 to 1)


def propose_sessions(
    fit: GeometryFit,
    *,
    sessions: int = 3,
    poses: int = 20,
    candidates: int = 40,
    clearance: Clearance | None = None,
    seed: int = 0,
) -> list[ProposedSession]:
    """Return sessions that determine best what the present ones leave open.

    They measure what the first session measures. Places are drawn at random within the
    limits of the joints; where the tool is in contact, it stays in its place in all
    poses. Greedily, the session is taken that narrows the intervals of all combinations
    most. When the next one narrows them little, more sessions do not pay.

    Args:
        fit: Calibration so far.
        sessions: Number of sessions to propose.
        poses: Number of poses in each.
        candidates: Number of random places.
        clearance: Distance that shapes must keep; None without.
        seed: Seed of the random places.

    Raises:
        InputError: If no place can be reached in so many postures.
    """
    rng = np.random.default_rng(seed)
    drafts = []
    for _ in range(candidates):
        problem = _reachable_session(fit, poses, rng, clearance)
        if len(problem.poses.q) == poses:
            drafts.append(problem)
    if not drafts:
        raise InputError(
            f"no place was found that the tool can reach in {poses} postures: ask for "
            "fewer `poses`, or make room for the robot (`clearance`)."
        )
    return _best_sessions(fit, drafts, sessions)


def _best_sessions(
    fit: GeometryFit, drafts: list[CalibrationProblem], count: int
) -> list[ProposedSession]:
    """Return the sessions that narrow the intervals most, one after the other."""
    scales = fit.solution.scales[fit.problem.common_columns]
    matrix = normal_matrices(fit.solution.adjustment.equations).sum(axis=0)
    matrices = [_information(problem) for problem in drafts]

    def log_deviations(matrix: Matrix) -> Vector:
        system = np.eye(len(scales)) + scales[:, None] * matrix * scales
        covariance = scales[:, None] * np.linalg.inv(system) * scales
        return 0.5 * np.log(np.diag(fit.combinations.covariance(covariance)))

    best_sessions = []
    for number in range(min(count, len(drafts))):
        before = log_deviations(matrix)
        gains = [np.mean(before - log_deviations(matrix + x)) for x in matrices]
        best = int(np.argmax(gains))
        matrix = matrix + matrices.pop(best)
        q = drafts.pop(best).poses.q
        # More sessions also say better how much sessions scatter.
        dof = max(fit.dof, 1) + np.array([number, number + 1])
        before_quantile, quantile = scipy.special.stdtrit(dof, 0.975)
        share = np.exp(-gains[best]) * quantile / before_quantile
        position = tip_jacobian(fit.robot, q).position.mean(axis=0)
        best_sessions.append(ProposedSession(q, position, float(1.0 - share)))
    return best_sessions


def _reachable_session(
    fit: GeometryFit,
    poses: int,
    rng: np.random.Generator,
    clearance: Clearance | None,
) -> CalibrationProblem:
    """Return a session of poses around a random posture that the robot can take."""
    robot = fit.robot
    limits = complete_limits(robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    middle = 0.5 * (high + low)
    half_range = 0.5 * (high - low)
    posture = middle + 0.8 * half_range * rng.uniform(-1.0, 1.0, robot.joints)
    shape = (SPARE_POSES * poses, robot.joints)
    q = posture + POSTURE_SPREAD * half_range * rng.normal(size=shape)
    problem = _session_at(fit, posture, q)
    nominal = problem.nominal.vector
    if _is_contact(fit):
        problem = problem.without_errors(nominal)
        errors = problem.error_sizes(problem.pose_errors(nominal).values)
        is_possible = errors.lengths < MAX_ERROR
    else:
        is_possible = np.ones(len(q), bool)
    q = problem.poses.q
    is_possible &= np.all(np.abs(q - middle) <= half_range, axis=1)
    if clearance is not None:
        rest = np.zeros_like(q)
        with double_precision():
            excess = np.asarray(clearance(robot, Motion(q, rest, rest)))
        is_possible &= excess.max(axis=1) <= 0.0
    best = q[is_possible][:poses]
    return _session_at(fit, posture, best)


def _is_contact(fit: GeometryFit) -> bool:
    """Return whether poses of the first place measure the same, as contacts do."""
    poses = fit.problem.poses
    is_first = poses.is_pose & (poses.place == poses.place[0])
    positions = poses.measured.position[is_first]
    return bool(np.all(positions == positions[0]))


def _session_at(fit: GeometryFit, posture: Vector, q: np.ndarray) -> CalibrationProblem:
    """Return a session like the first one, whose tool is in place in a posture."""
    first = fit.problem.poses
    fields = {
        field.name: getattr(first, field.name) for field in dataclasses.fields(first)
    }
    measured = fields.pop("measured").at(np.zeros(len(q), int))
    repeated = {name: np.repeat(x[:1], len(q), axis=0) for name, x in fields.items()}
    repeated |= {"q": q, "torques": gravity_torques(fit.robot, fit.problem.bodies, q)}
    frames = fit.frames
    keys = fit.problem.frame_keys
    tool = frames[keys[first.tool[0]]]
    starts = [frames[key] for key in keys]
    tip = tip_jacobian(fit.robot, posture[None])
    tool_position = (Frame(tip.rotation[0], tip.position[0]) @ tool).position
    place = starts[first.place[0]]
    lever = place.rotation @ first.measured.position[0]
    starts[first.place[0]] = place._replace(position=tool_position - lever)
    problem = dataclasses.replace(
        fit.problem,
        robot=fit.robot,
        starts=Frame(*map(np.stack, zip(*starts, strict=True))),
    )
    return problem.with_poses(measured=measured, **repeated)


def _information(problem: CalibrationProblem) -> Matrix:
    """Return second derivatives by the common unknowns from the poses of a session."""
    nominal = problem.nominal.vector
    # An instrument will measure what it sees then.
    exact = problem.with_poses(measured=problem.pose_errors(nominal).seen)
    equations = session_equations(
        exact,
        exact.linearise(nominal),
        problem.frame_scales,
        np.ones(len(problem.poses.session)),
    )
    return normal_matrices(equations).sum(axis=0)
