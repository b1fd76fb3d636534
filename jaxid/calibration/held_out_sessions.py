"""Errors on sessions that a calibration has not seen, each held out in turn."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix

from .adjustment import Weights, adjust
from .problem import CalibrationProblem, ErrorSizes
from .solution import solve


class HeldOutErrors(NamedTuple):
    """Errors of each pose by a calibration without its session.

    Attributes:
        calibrated: Errors of the calibrated geometry.
        nominal: Errors of the nominal geometry, whose tool comes from the other
            sessions, too.
        distances: Errors of known distances of places, predicted less known [m].
    """

    calibrated: ErrorSizes
    nominal: ErrorSizes
    distances: np.ndarray


def held_out_errors(problem: CalibrationProblem, has_compliance: bool) -> HeldOutErrors:
    """Hold each session out in turn, with all that is chosen from the others.

    Only the places of the session come from itself, by all its poses.
    """
    poses = problem.poses
    calibrated = np.zeros(poses.deviations.shape)
    nominal = np.zeros(poses.deviations.shape)
    for session in range(len(problem.sessions)):
        session_weights = np.ones(len(problem.sessions))
        session_weights[session] = 0.0
        solution = solve(problem, session_weights, has_compliance)
        rows = poses.session == session
        calibrated[rows] = solution.adjustment.linearisation.errors[rows]
        nominal[rows] = nominal_solution_errors(problem, solution.weights)[rows]
    # Places that all sessions share keep their distance in every fit.
    is_shared = np.array([not owner for owner, _ in problem.frame_keys])
    rows = ~poses.is_pose & ~is_shared[poses.place]
    distances = calibrated[rows, 0] * poses.deviations[rows, 0]
    return HeldOutErrors(
        problem.error_sizes(calibrated), problem.error_sizes(nominal), distances
    )


def nominal_solution_errors(problem: CalibrationProblem, weights: Weights) -> Matrix:
    """Return the errors of the nominal geometry with the best tools and places."""
    start = problem.nominal.vector
    end = adjust(problem, start, problem.frame_scales, weights)
    return end.linearisation.errors
