"""Levenberg-Marquardt within bounds, for many independent problems in one batch."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Bool, Float

HELD = 6
"""Largest number of times that parameters are brought to their bounds in a step."""
Moments = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
"""Function of parameters [..., size] and their problems' indices along the first axis.

It returns costs, gradients and Gauss-Newton matrices.
"""
Costs = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of the same that returns the costs alone."""


class Solution(NamedTuple):
    """Minima of many problems.

    Attributes:
        x: Parameters.
        cost: Sums of squares.
        gradient: Half the gradient of the costs.
        information: Gauss-Newton matrices.
    """

    x: Float[np.ndarray, "*batch size"]
    cost: Float[np.ndarray, "*batch"]
    gradient: Float[np.ndarray, "*batch size"]
    information: Float[np.ndarray, "*batch size size"]


def minimise(
    moments: Moments,
    costs: Costs,
    x: Float[np.ndarray, "*batch size"],
    free: Bool[np.ndarray, "*batch size"],
    bounds: tuple[np.ndarray, np.ndarray],
    iterations: int = 30,
    tolerance: float = 1e-3,
    damping: float = 1e-2,
) -> Solution:
    """Minimise sums of squares over free parameters; each problem has its own damping.

    A parameter at a bound that its gradient would leave is held there for one step.
    Problems of one index along the first axis are left alone as soon as each of them
    has converged once.

    Args:
        moments: Costs and their derivatives at parameters of all problems.
        costs: Costs alone.
        x: Start of each problem.
        free: Parameters that may change.
        bounds: Lower and upper limits of the parameters.
        iterations: Largest number of steps.
        tolerance: Relative decrease of the cost below which a problem has converged.
        damping: Damping of the first step, relative to the diagonal of the Gauss-Newton
            matrix.
    """
    x = np.clip(x, *bounds)
    dampings, left = np.full(x.shape[:-1], damping), np.arange(len(x))
    done = np.zeros(x.shape[:-1], bool)
    cost, g, H = moments(x, left)
    for _ in range(iterations):
        own = [y[left] for y in (x, cost, g, H, free, dampings)]
        x[left], dampings[left], converged = improve(
            costs, left, own, bounds, tolerance
        )
        cost[left], g[left], H[left] = moments(x[left], left)
        done[left] |= converged
        left = left[~done[left].reshape(len(left), -1).all(axis=1)]
        if not left.size:
            break
    return Solution(x, cost, g, H)


def improve(costs, problems, terms, bounds, tolerance):
    """Return parameters of lower costs, their damping, and the converged problems."""
    x, cost, g, H, free, damping = terms
    decrease = np.zeros_like(cost)
    for _ in range(5):
        step = bounded_step(g, H, x, free, bounds, damping)
        trial = np.clip(x + step, *bounds)
        found = costs(trial, problems)
        better = (found < cost) & (decrease == 0.0)
        decrease = np.where(better, (cost - found) / np.maximum(cost, 1e-300), decrease)
        x = np.where(better[..., None], trial, x)
        factor = np.where(better, 0.2, np.where(decrease > 0.0, 1.0, 8.0))
        damping = np.clip(damping * factor, 1e-9, 1e6)
        if (decrease > 0.0).mean() > 0.7:
            break
    return x, damping, decrease < tolerance


def bounded_step(
    gradient: np.ndarray,
    information: np.ndarray,
    x: np.ndarray,
    free: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    damping: np.ndarray | float,
) -> np.ndarray:
    """Return damped Gauss-Newton steps of the free parameters within their bounds.

    A parameter that would leave its bounds goes to them, and the others follow. Where
    derivatives have overflowed, the step is zero.
    """
    low, high = bounds
    known = np.isfinite(information).all(axis=(-1, -2)) & np.isfinite(gradient).all(
        axis=-1
    )
    known = np.asarray(known)
    information = np.where(known[..., None, None], information, 0.0)
    gradient = np.where(known[..., None], gradient, 0.0)
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))
    scaled = information / size[..., None] / size[..., None, :]
    identity, more = np.eye(x.shape[-1]), np.asarray(damping)[..., None, None] + 1e-12
    held = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
    moving, step = (
        (free & ~held & (size > 1e-140)).astype(float),
        np.zeros_like(gradient),
    )
    for _ in range(HELD):
        A = scaled * moving[..., None] * moving[..., None, :]
        A = A + identity * (more + (1.0 - moving)[..., None])
        rest = -gradient / size - np.einsum("...ij,...j->...i", scaled, step * size)
        own = np.linalg.solve(A, (rest * moving)[..., None])[..., 0] / size
        step = np.where(moving > 0, own, step)
        leaves = (moving > 0) & ((x + step < low) | (x + step > high))
        if not leaves.any():
            break
        step = np.where(
            leaves, np.clip(x + step, low, high) - x, np.where(moving > 0, 0.0, step)
        )
        moving = np.where(leaves, 0.0, moving)
    return step
