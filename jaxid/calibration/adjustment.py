"""Gauss-Newton search in which each session's own frames are eliminated first.

What remains are normal equations of each session in the unknowns that all share. Sums
of them with other weights are the searches without a session, and bootstrap draws.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Vector

from .problem import CalibrationProblem, Linearisation

MAX_STEPS = 30
"""Steps after which a search is given up."""
END_OF_SEARCH = 1e-6
"""Largest step at which a search has ended, relative to the prior's deviations."""


class SessionEquations(NamedTuple):
    """Normal equations of one session, without the frames that only it has.

    Attributes:
        matrix: Second derivatives of half the sum of squares by the common unknowns.
        gradient: Its gradient.
        frame_slopes: Change of the frames by that of the common unknowns.
        frame_step: Step of the frames while the common unknowns stay.
    """

    matrix: Matrix
    gradient: Vector
    frame_slopes: Matrix
    frame_step: Vector


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
    state = _linearised(problem, start, scales, weights)
    for _ in range(max_steps):
        step = common_step(
            state.equations, state.vector[common], scales[common], weights.sessions
        )
        if np.abs(divided(step, scales[common])).max() < END_OF_SEARCH:
            return state._replace(has_converged=True)
        vector = moved(problem, state.equations, state.vector, step)
        state = _linearised(problem, vector, scales, weights)
    return state


def _linearised(
    problem: CalibrationProblem, vector: Vector, scales: Vector, weights: Weights
) -> Adjustment:
    """Return unknowns with the equations there."""
    linearisation = problem.linearise(vector)
    equations = session_equations(problem, linearisation, vector, scales, weights.poses)
    return Adjustment(vector, linearisation, equations, False)


def session_equations(
    problem: CalibrationProblem,
    linearisation: Linearisation,
    vector: Vector,
    scales: Vector,
    pose_weights: Vector,
) -> list[SessionEquations]:
    """Return the normal equations of each session at some unknowns."""
    roots = np.sqrt(pose_weights)[problem.rows.pose]
    errors = roots * linearisation.errors
    jacobian = roots[:, None] * linearisation.jacobian
    common = problem.common_columns
    return [
        _eliminate_frames(
            errors[rows],
            jacobian[np.ix_(rows, common)],
            jacobian[np.ix_(rows, columns)],
            vector[columns],
            scales[columns],
        )
        for rows, columns in zip(
            problem.session_rows, problem.session_columns, strict=True
        )
    ]


def _eliminate_frames(
    errors: Vector, jacobian: Matrix, by_frames: Matrix, frames: Vector, scales: Vector
) -> SessionEquations:
    """Return normal equations without the frames of a session.

    Args:
        errors: Errors of the session.
        jacobian: Derivatives by the common unknowns.
        by_frames: Derivatives by the frames.
        frames: Corrections of the frames.
        scales: Their prior deviations, in which their equations are solved.
    """
    columns = by_frames * scales
    # The prior keeps what the poses of the session do not determine.
    frame_matrix = np.eye(len(scales)) + columns.T @ columns
    coupling = columns.T @ jacobian
    frame_gradient = columns.T @ errors + divided(frames, scales)
    right_sides = np.column_stack([coupling, frame_gradient])
    solution = np.linalg.solve(frame_matrix, right_sides)
    slopes = solution[:, :-1]
    step = solution[:, -1]
    return SessionEquations(
        jacobian.T @ jacobian - coupling.T @ slopes,
        jacobian.T @ errors - coupling.T @ step,
        -scales[:, None] * slopes,
        -scales * step,
    )


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
    matrices = np.stack([x.matrix for x in equations])
    gradients = np.stack([x.gradient for x in equations])
    matrix = np.einsum("...s,sij->...ij", session_weights, matrices)
    gradient = session_weights @ gradients
    # In units of the prior, which then is the identity.
    scaled_matrix = scales[..., :, None] * matrix * scales[..., None, :]
    system = np.eye(len(common)) + scaled_matrix
    right_side = scales * gradient + divided(common, scales)
    return -scales * np.linalg.solve(system, right_side[..., None])[..., 0]


def moved(
    problem: CalibrationProblem,
    equations: list[SessionEquations],
    vector: Vector,
    step: Vector,
) -> Vector:
    """Return all unknowns after a step of the common ones."""
    end = vector.copy()
    end[problem.common_columns] += step
    for columns, x in zip(problem.session_columns, equations, strict=True):
        end[columns] += x.frame_slopes @ step + x.frame_step
    return end


def divided(values: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return values in units of their scales; zero where the scale is zero."""
    return np.where(scales > 0.0, values / np.where(scales > 0.0, scales, 1.0), 0.0)
