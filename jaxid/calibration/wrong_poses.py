"""Poses that do not belong to the others: a ball beside its socket, a wrong corner."""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Matrix, Vector

from .adjustment import SessionEquations, Weights, adjust, normal_matrices
from .problem import CalibrationProblem

ROBUST_STEPS = 8
"""Steps with weights that fall with the errors; the first ones have equal weights."""
EQUAL_STEPS = 3


class ErrorLimits(NamedTuple):
    """Errors of poses, in units of the typical error.

    Normal errors are practically never beyond the largest.
    """

    half_weight: float = 3.0
    wrong: float = 3.8
    min_typical_size: float = 0.1  # in units of the stated deviation
    min_share_left: float = 0.1  # of the squares of errors
    max_share: float = 0.5  # of the poses of a session; with more it disagrees itself


LIMITS = ErrorLimits()


def pose_sizes(errors: np.ndarray, deviations: Matrix) -> np.ndarray:
    """Return the size of each pose's errors, of which the median is one for noise.

    Args:
        errors: Errors in units of their deviations [..., poses, 6].
        deviations: Deviations, infinite for numbers that are not measured.
    """
    counts = np.isfinite(deviations).sum(axis=1)
    squares = np.sum(errors**2, axis=-1)
    return np.sqrt(squares / scipy.special.chdtri(counts, 0.5))


def share_of_errors_left(
    problem: CalibrationProblem,
    equations: list[SessionEquations],
    scales: Vector,
    session_weights: Vector,
) -> float:
    """Return the share of noise that remains as errors, of squares.

    It is the share of the measured numbers that no unknown uses up. Those that the
    prior decides use up a part.
    """
    units = scales[problem.common_columns]
    matrix = np.tensordot(session_weights, normal_matrices(equations), 1)
    scaled_matrix = units[:, None] * matrix * units
    system = scaled_matrix + np.eye(len(units))
    count = np.trace(np.linalg.solve(system, scaled_matrix))
    is_used = session_weights > 0.0
    for session in np.flatnonzero(is_used):
        count += np.count_nonzero(scales[problem.session_columns[session]])
    is_measured = np.isfinite(problem.poses.deviations[is_used[problem.poses.session]])
    return max(1.0 - count / is_measured.sum(), LIMITS.min_share_left)


def find_wrong_poses(
    problem: CalibrationProblem,
    start: Vector,
    scales: Vector,
    session_weights: Vector,
) -> tuple[np.ndarray, Vector]:
    """Return whether each pose is wrong, and the unknowns without these poses.

    Sessions without weight are not looked at: none of their poses is wrong.
    """
    is_used = session_weights[problem.poses.session] > 0.0
    is_used &= problem.poses.is_pose
    weights = np.ones(len(is_used))
    relative_sizes = np.zeros(len(is_used))
    vector = start
    for number in range(ROBUST_STEPS):
        end = adjust(
            problem, vector, scales, Weights(session_weights, weights), max_steps=1
        )
        vector = end.vector
        if number < EQUAL_STEPS:
            continue
        sizes = pose_sizes(end.linearisation.errors, problem.poses.deviations)
        # With more unknowns, errors of poses are smaller, and of those that are left
        # out larger.
        error_share = share_of_errors_left(
            problem, end.equations, scales, session_weights
        )
        typical_size = np.median(sizes[is_used]) / error_share
        typical_size = max(typical_size, LIMITS.min_typical_size)
        relative_sizes = np.where(is_used, sizes / typical_size, 0.0)
        weights = 1.0 / (1.0 + (relative_sizes / LIMITS.half_weight) ** 2) ** 2
    is_wrong = np.greater(relative_sizes, LIMITS.wrong)
    for poses in problem.poses_of_sessions:
        if is_wrong[poses].mean() > LIMITS.max_share:
            is_wrong[poses] = False
    return is_wrong, vector
