"""Levenberg-Marquardt within bounds, for many independent problems in one batch."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

MAX_BOUND_ROUNDS = 6
"""Largest number of times that parameters are brought to their bounds in a step."""
START_DAMPING = 1e-2
"""Damping of the first step, relative to the diagonal of the Gauss-Newton matrix."""
Moments = Callable[[np.ndarray], tuple[np.ndarray, ...]]
"""Function of parameters [..., size] of some problems.

It returns costs, gradients and Gauss-Newton matrices.
"""
Costs = Callable[[np.ndarray], np.ndarray]
"""Function of the same that returns the costs alone."""


class Solution(NamedTuple):
    """Minima of many problems.

    Attributes:
        x: Parameters.
        cost: Sums of squares.
        gradient: Half the gradient of the costs.
        information: Gauss-Newton matrices.
    """

    x: np.ndarray
    cost: np.ndarray
    gradient: np.ndarray
    information: np.ndarray


def minimise(
    moments: Moments,
    costs: Costs,
    x: np.ndarray,
    free_mask: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    iterations: int = 30,
    tolerance: float = 1e-3,
) -> Solution:
    """Minimise sums of squares over free parameters; each problem has its own damping.

    A parameter at a bound that its gradient would leave is held there for one step.
    Problems of one index along the first axis are left alone as soon as each of them
    has converged once.

    Args:
        moments: Costs and their derivatives at parameters of all problems.
        costs: Costs alone.
        x: Start of each problem.
        free_mask: Parameters that may change.
        bounds: Lower and upper limits of the parameters.
        iterations: Largest number of steps.
        tolerance: Relative decrease of the cost below which a problem has converged.
    """
    x = np.clip(x, *bounds)
    dampings = np.full(x.shape[:-1], START_DAMPING)
    subset = np.arange(len(x))
    convergence = np.zeros(x.shape[:-1], bool)
    cost, g, H = moments(x)
    for _ in range(iterations):
        terms = [y[subset] for y in (x, cost, g, H, free_mask, dampings)]
        x[subset], dampings[subset], new_convergence = improve(
            costs, terms, bounds, tolerance
        )
        cost[subset], g[subset], H[subset] = moments(x[subset])
        convergence[subset] |= new_convergence
        subset = subset[~convergence[subset].reshape(len(subset), -1).all(axis=1)]
        if not subset.size:
            break
    return Solution(x, cost, g, H)


def improve(costs, terms, bounds, tolerance):
    """Return parameters of lower costs, their damping, and the converged problems."""
    x, cost, g, H, free_mask, damping = terms
    decrease = np.zeros_like(cost)
    for _ in range(5):
        step = bounded_step(g, H, x, free_mask, bounds, damping)
        trial = np.clip(x + step, *bounds)
        trial_cost = costs(trial)
        is_better = (trial_cost < cost) & (decrease == 0.0)
        decrease = np.where(
            is_better, (cost - trial_cost) / np.maximum(cost, 1e-300), decrease
        )
        x = np.where(is_better[..., None], trial, x)
        factor = np.where(is_better, 0.2, np.where(decrease > 0.0, 1.0, 8.0))
        damping = np.clip(damping * factor, 1e-9, 1e6)
        if (decrease > 0.0).mean() > 0.7:
            break
    return x, damping, decrease < tolerance


def bounded_step(
    gradient: np.ndarray,
    information: np.ndarray,
    x: np.ndarray,
    free_mask: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    damping: np.ndarray | float,
) -> np.ndarray:
    """Return damped Gauss-Newton steps of the free parameters within their bounds.

    A parameter that would leave its bounds goes to them, and the others follow. Where
    derivatives have overflowed, the step is zero.
    """
    lower_limits, upper_limits = bounds
    is_finite = np.isfinite(gradient).all(axis=-1)
    is_finite &= np.isfinite(information).all(axis=(-1, -2))
    is_finite = np.asarray(is_finite)
    information = np.where(is_finite[..., None, None], information, 0.0)
    gradient = np.where(is_finite[..., None], gradient, 0.0)
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    size = np.sqrt(np.maximum(diagonal, 1e-300))
    scaled_matrix = information / size[..., None] / size[..., None, :]
    identity = np.eye(x.shape[-1])
    diagonal_damping = np.asarray(damping)[..., None, None] + 1e-12
    leaves_below = (x <= lower_limits) & (gradient > 0)
    leaves_above = (x >= upper_limits) & (gradient < 0)
    is_moving = free_mask & ~leaves_below & ~leaves_above & (size > 1e-140)
    moving_mask = is_moving.astype(float)
    step = np.zeros_like(gradient)
    for _ in range(MAX_BOUND_ROUNDS):
        A = scaled_matrix * moving_mask[..., None] * moving_mask[..., None, :]
        A = A + identity * (diagonal_damping + (1.0 - moving_mask)[..., None])
        change = np.einsum("...ij,...j->...i", scaled_matrix, step * size)
        residual = (-gradient / size - change) * moving_mask
        solution = np.linalg.solve(A, residual[..., None])[..., 0]
        is_moving = moving_mask > 0
        step = np.where(is_moving, solution / size, step)
        end = x + step
        is_leaving = is_moving & ((end < lower_limits) | (end > upper_limits))
        if not is_leaving.any():
            break
        # Those that move start again, now that others have gone to their bounds.
        step = np.where(is_moving, 0.0, step)
        step = np.where(is_leaving, np.clip(end, lower_limits, upper_limits) - x, step)
        moving_mask = np.where(is_leaving, 0.0, moving_mask)
    return step
