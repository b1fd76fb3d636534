"""Gauss-Newton search in which each session's own frames are eliminated first.

What remains are equations of each session in the unknowns that all share. Sums of them
with other weights are the searches without a session, and bootstrap draws.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Vector

from .problem import CalibrationProblem, Linearisation

MAX_STEPS = 30
"""Steps after which a search is given up."""
END_OF_SEARCH = 1e-5
"""Largest step at which a search has ended, relative to the prior's deviations."""
MIN_EFFECT = 1e-9
"""Effect of a session's frames, relative to the largest, below which it is rounding."""


class SessionEquations(NamedTuple):
    """Equations of one session for the unknowns that all sessions share.

    Attributes:
        errors: Errors that no motion of the session's own frames explains.
        jacobian: Their derivatives by the common unknowns.
        frame_step: Step of the frames while the common unknowns stay.
        frame_slopes: Change of the frames by that of the common unknowns.
    """

    errors: Vector
    jacobian: Matrix
    frame_step: Vector
    frame_slopes: Matrix


class Adjustment(NamedTuple):
    """Unknowns at the end of a search, and the equations there."""

    vector: Vector  # all unknowns
    linearisation: Linearisation
    equations: list[SessionEquations]
    has_converged: bool


class Weights(NamedTuple):
    """Weights of sessions and of poses."""

    sessions: Vector
    poses: Vector


def adjust(
    problem: CalibrationProblem,
    start: Vector,
    scales: Vector,
    weights: Weights,
    max_steps: int = MAX_STEPS,
) -> Adjustment:
    """Return the unknowns with the smallest weighted sum of squares.

    Args:
        problem: The problem.
        start: Unknowns at which the search starts.
        scales: Prior deviation of each unknown from zero; what has none stays there.
        weights: Weights of sessions and poses.
        max_steps: Largest number of steps.
    """
    common = problem.common_columns
    vector = start
    steps_left = max_steps
    while True:
        linearisation = problem.linearise(vector)
        equations = session_equations(problem, linearisation, scales, weights.poses)
        step = common_step(equations, vector[common], scales[common], weights.sessions)
        largest_step = np.abs(divided(step, scales[common])).max()
        has_converged = bool(largest_step < END_OF_SEARCH)
        if has_converged or steps_left == 0:
            return Adjustment(vector, linearisation, equations, has_converged)
        steps_left -= 1
        vector = vector.copy()
        vector[common] += step
        for columns, x in zip(problem.session_columns, equations, strict=True):
            vector[columns] += x.frame_slopes @ step + x.frame_step


def session_equations(
    problem: CalibrationProblem,
    linearisation: Linearisation,
    scales: Vector,
    pose_weights: Vector,
) -> list[SessionEquations]:
    """Return the equations of each session at some unknowns.

    Args:
        problem: The problem.
        linearisation: Errors and derivatives at these unknowns.
        scales: Prior deviation of each unknown; frames without one stay.
        pose_weights: Weight of each pose.
    """
    is_measured = np.isfinite(problem.poses.deviations)
    roots = np.sqrt(pose_weights)[:, None] * is_measured
    equations = []
    for session, columns in enumerate(problem.session_columns):
        is_row = is_measured & (problem.poses.session == session)[:, None]
        errors = roots[is_row] * linearisation.errors[is_row]
        rows = roots[is_row][:, None] * linearisation.jacobian[is_row]
        by_frames = rows[:, columns] * (scales[columns] > 0.0)
        jacobian = rows[:, problem.common_columns]
        inverse = np.linalg.pinv(by_frames, rcond=MIN_EFFECT)
        step = -inverse @ errors
        slopes = -inverse @ jacobian
        equations.append(
            SessionEquations(
                errors + by_frames @ step,
                jacobian + by_frames @ slopes,
                step,
                slopes,
            )
        )
    return equations


def normal_matrices(equations: list[SessionEquations]) -> np.ndarray:
    """Return the second derivatives of half the sum of squares of each session."""
    return np.stack([x.jacobian.T @ x.jacobian for x in equations])


def common_step(
    equations: list[SessionEquations],
    common: Vector,
    scales: Vector,
    session_weights: np.ndarray,
) -> np.ndarray:
    """Return the Gauss-Newton step of the common unknowns.

    Args:
        equations: Equations of each session.
        common: Common unknowns.
        scales: Their prior deviations; with leading axes for several priors.
        session_weights: Weight of each session; with leading axes for several.
    """
    matrices = normal_matrices(equations)
    gradients = np.stack([x.jacobian.T @ x.errors for x in equations])
    matrix = np.tensordot(session_weights, matrices, 1)
    gradient = session_weights @ gradients
    # In units of the prior, which then is the identity.
    columns = matrix * scales[..., None, :]
    scaled_matrix = scales[..., :, None] * columns
    system = scaled_matrix + np.eye(len(common))
    right_side = scales * gradient + divided(common, scales)
    solution = np.linalg.solve(system, right_side[..., None])
    return -scales * solution[..., 0]


def divided(values: Vector, scales: np.ndarray) -> np.ndarray:
    """Return values in units of their scales; zero where the scale is zero."""
    has_scale = scales > 0.0
    divisors = np.where(has_scale, scales, 1.0)
    return np.where(has_scale, values / divisors, 0.0)
