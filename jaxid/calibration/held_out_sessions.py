"""Errors on sessions that a calibration has not seen, each held out in turn."""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Vector

from .adjustment import Weights, adjust
from .problem import CalibrationProblem, ErrorSizes
from .solution import Solution, covariances, solve


class DistanceCheck(NamedTuple):
    """Known distance of two places in a session that was held out."""

    session: str
    error: float  # predicted less known distance [m]
    half_width: float  # of the 95 % interval of the prediction [m]

    @property
    def is_inside(self) -> bool:
        """Whether the known distance lies in the interval."""
        return abs(self.error) <= self.half_width


class HeldOutErrors(NamedTuple):
    """Errors of each pose by a calibration without its session.

    Attributes:
        calibrated: Errors of the calibrated geometry.
        nominal: Errors of the nominal geometry, whose tool comes from the other
            sessions, too.
        distances: Known distances between places.
    """

    calibrated: ErrorSizes
    nominal: ErrorSizes
    distances: tuple[DistanceCheck, ...]


def held_out_errors(problem: CalibrationProblem, has_compliance: bool) -> HeldOutErrors:
    """Hold each session out in turn, with all that is chosen from the others.

    Only the places of the session come from itself, by all its poses.
    """
    count = len(problem.pose_sessions)
    calibrated = ErrorSizes(np.zeros(count), np.zeros(count))
    nominal = ErrorSizes(np.zeros(count), np.zeros(count))
    distances = []
    for session in range(len(problem.sessions)):
        session_weights = np.ones(len(problem.sessions))
        session_weights[session] = 0.0
        solution = solve(problem, session_weights, has_compliance)
        is_own = problem.pose_sessions == session
        errors = solution.adjustment.linearisation.errors
        nominal_errors = nominal_solution_errors(problem, solution.weights)
        for sizes, values in ((calibrated, errors), (nominal, nominal_errors)):
            for part, value in zip(sizes, problem.error_sizes(values), strict=True):
                part[is_own] = value[is_own]
        distances += _check_distances(problem, solution, session)
    return HeldOutErrors(calibrated, nominal, tuple(distances))


def nominal_solution_errors(problem: CalibrationProblem, weights: Weights) -> Vector:
    """Return the errors of the nominal geometry with the best tools and places."""
    start = problem.nominal
    scales = start._replace(frames=problem.freedoms.astype(float)).vector
    return adjust(problem, start.vector, scales, weights).linearisation.errors


def _check_distances(
    problem: CalibrationProblem, solution: Solution, session: int
) -> list[DistanceCheck]:
    """Return the known distances in a session that has no weight.

    Their predictions vary with the geometry, and with the noise of the session's poses.
    """
    adjustment = solution.adjustment
    rows = problem.session_rows[session]
    is_distance = ~problem.is_pose[problem.rows.pose[rows]]
    columns = problem.session_columns[session]
    jacobian = adjustment.linearisation.jacobian[np.ix_(rows, columns)]
    errors = adjustment.linearisation.errors[rows]
    by_places = jacobian[is_distance]

    slopes = by_places @ adjustment.equations[session].frame_slopes
    parts = covariances(problem, solution)
    geometry_covariance = parts.scatter + parts.prior
    geometry_variances = np.sum((slopes @ geometry_covariance) * slopes, axis=1)

    contacts = jacobian[~is_distance]
    noise = np.mean(errors[~is_distance] ** 2)
    place_covariance = noise * np.linalg.pinv(contacts.T @ contacts)
    place_variances = np.sum((by_places @ place_covariance) * by_places, axis=1)

    dof = np.count_nonzero(solution.weights.sessions) - 1
    quantile = scipy.special.stdtrit(max(dof, 1), 0.975)
    half_widths = quantile * np.sqrt(geometry_variances + place_variances)
    deviations = problem.row_deviations[rows][is_distance]
    return [
        DistanceCheck(problem.sessions[session], *numbers)
        for numbers in zip(
            (deviations * errors[is_distance]).tolist(),
            (deviations * half_widths).tolist(),
            strict=True,
        )
    ]
