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
SPARE_POSES = 20
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
    middle, half_range = _middle_and_half_range(fit)
    shape = (SPARE_POSES * poses, fit.robot.joints)
    shares = rng.uniform(-1.0, 1.0, (candidates * shape[0], shape[1]))
    postures = _possible_poses(fit, middle + half_range * shares, clearance)
    sessions_of_poses = np.split(postures, range(poses, len(postures), poses))
    if _is_contact(fit):
        sessions_of_poses = []
        for posture in postures[:candidates]:
            spread = POSTURE_SPREAD * half_range * rng.normal(size=shape)
            q = _touching_poses(_session_at(fit, posture, posture + spread))
            sessions_of_poses.append(_possible_poses(fit, q, clearance)[:poses])
    drafts = [
        _session_at(fit, q[0], q)
        for q in sessions_of_poses[:candidates]
        if len(q) == poses
    ]
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


def _middle_and_half_range(fit: GeometryFit) -> tuple[Vector, Vector]:
    """Return the middles of the joints' ranges, and half of these."""
    limits = complete_limits(fit.robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    return 0.5 * (high + low), 0.5 * (high - low)


def _possible_poses(
    fit: GeometryFit, q: np.ndarray, clearance: Clearance | None
) -> np.ndarray:
    """Return the poses within the limits of the joints that keep a distance."""
    middle, half_range = _middle_and_half_range(fit)
    q = q[np.all(np.abs(q - middle) <= half_range, axis=1)]
    if clearance is None or not len(q):
        return q
    rest = np.zeros_like(q)
    # Shapes belong to the nominal frames of the bodies.
    with double_precision():
        excess = clearance(fit.problem.robot, Motion(q, rest, rest))
    excess = np.asarray(excess)
    return q[excess.max(axis=1) <= 0.0]


def _touching_poses(problem: CalibrationProblem) -> np.ndarray:
    """Return poses near those of a problem in which the tool is in its place."""
    nominal = problem.nominal.vector
    exact = problem.without_errors(nominal)
    errors = exact.error_sizes(exact.pose_errors(nominal).values)
    return exact.poses.q[errors.lengths < MAX_ERROR]


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
