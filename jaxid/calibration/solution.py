"""Geometry from some sessions, and how well they determine it."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Vector

from .adjustment import Adjustment, Weights, adjust, common_step, normal_matrices
from .prior_choice import MIDDLE_PRIOR, GeometryPrior, choose_prior, prior_scales
from .problem import CalibrationProblem
from .wrong_poses import find_wrong_poses


class Solution(NamedTuple):
    """Geometry from some sessions.

    Attributes:
        adjustment: Unknowns and equations.
        prior: Chosen prior.
        scales: Deviation of each unknown by this prior.
        weights: Weights of sessions and poses.
        is_wrong: Whether each pose was left out as wrong.
    """

    adjustment: Adjustment
    prior: GeometryPrior
    scales: Vector
    weights: Weights
    is_wrong: np.ndarray


def solve(
    problem: CalibrationProblem, session_weights: Vector, has_compliance: bool
) -> Solution:
    """Return the geometry from the sessions that have a weight.

    Wrong poses and the prior are found from these sessions alone. Those without weight
    only get their places, by all their poses.
    """
    scales = prior_scales(problem, MIDDLE_PRIOR, has_compliance)
    start = problem.nominal.vector
    is_wrong, vector = find_wrong_poses(problem, start, scales, session_weights)
    is_unseen = session_weights[problem.poses.session] == 0.0
    # Known distances between places of other sessions are not used, either.
    is_left_out = is_wrong | (is_unseen & ~problem.poses.is_pose)
    weights = Weights(session_weights, np.where(is_left_out, 0.0, 1.0))
    prior = choose_prior(problem, vector, weights, has_compliance)
    scales = prior_scales(problem, prior, has_compliance)
    adjustment = adjust(problem, vector, scales, weights)
    return Solution(adjustment, prior, scales, weights, is_wrong)


class Covariances(NamedTuple):
    """Covariance of the common unknowns, in two parts.

    Attributes:
        scatter: Scatter of the solutions that leave one session out (jackknife).
        prior: Error of estimates that are drawn to the nominal geometry.
        of_equal_noise: Covariance if every error had its stated deviation.
    """

    scatter: Matrix
    prior: Matrix
    of_equal_noise: Matrix


def covariances(problem: CalibrationProblem, solution: Solution) -> Covariances:
    """Return how well the sessions of a solution determine the common unknowns.

    The unit is the session: its poses share the errors of its setup, so that there are
    fewer independent errors than poses.
    """
    common = problem.common_columns
    scales = solution.scales[common]
    equations = solution.adjustment.equations
    vector = solution.adjustment.vector[common]
    session_weights = solution.weights.sessions
    sessions = np.flatnonzero(session_weights)
    count = len(sessions)

    weights = np.tile(session_weights, (count, 1))
    weights[np.arange(count), sessions] = 0.0
    steps = common_step(equations, vector, scales, weights)
    deviations = steps - steps.mean(axis=0)
    scatter = (count - 1) / count * deviations.T @ deviations

    matrix = np.tensordot(session_weights, normal_matrices(equations), 1)
    system = np.eye(len(scales)) + scales[:, None] * matrix * scales
    inverse = scales[:, None] * np.linalg.inv(system)
    return Covariances(scatter, inverse @ inverse.T, inverse * scales)
