"""Polishing of one motion by sequential quadratic programming with exact gradients.

Of the limits' many rows only a permanent coarse grid and the peaks that a motion
reaches are given to the solver; after each run new peaks are added. Constraints are
treated in the same way.
"""

import functools
from typing import Any

import numpy as np
import scipy.optimize

from jaxid.arrays import Bool, Float

from .coefficient_limits import scale_samples
from .problem import (
    MARGIN,
    WATCHED,
    Candidates,
    ExcitationProblem,
    Watched,
    are_peaks,
    evaluate_within_limits,
)


def polish(
    problem: ExcitationProblem, start: Float[np.ndarray, " scaled"]
) -> Candidates:
    """Return a better motion within all limits, or the same."""
    x: np.ndarray = np.array(start, np.float64)
    grid = problem.limits.grid()
    rows = np.zeros((2, *grid.c.shape), bool)
    for kind in grid.kinds:
        rows[:, :, kind[:: max(1, len(kind) // 12)]] = True
    peaks: list[np.ndarray] = []
    best = evaluate_within_limits(problem, x[None])
    rounds = ((8.0, 5), (None, 8)) if problem.criterion.extreme else ((None, 8),)
    for sharpness, runs in rounds:
        _add_peaks(problem, x, rows, 0.8)
        smooth = np.inf
        for _ in range(runs):
            watched = _watched(problem, x, peaks)
            result = _minimise(problem, x, sharpness, rows, watched)
            if not np.isfinite(result.x).all():
                break
            x, before = result.x, best
            peak = _add_peaks(problem, x, rows, 0.97)
            best = best.improved(evaluate_within_limits(problem, x[None]))
            gained = float(before.value[0] - best.value[0])
            if sharpness is not None:
                # A smooth round's steps need not show in the exact value at once.
                gained, smooth = smooth - float(result.fun), float(result.fun)
            kept = problem.excess(x) <= 0.0
            if peak < 1.003 and kept and (result.nit <= 3 or gained < 1e-4):
                break
    return best


def _minimise(
    problem: ExcitationProblem,
    x: np.ndarray,
    sharpness: float | None,
    rows: Bool[np.ndarray, "2 joints rows"],
    watched: Watched,
) -> Any:
    grid = problem.limits.grid()
    side, joint, row = np.nonzero(rows)
    sign = 1.0 - 2.0 * side
    G = np.zeros((len(side), *problem.limits.shape))
    G[np.arange(len(side)), joint] = sign[:, None] * grid.R[joint, row]
    G, h = G.reshape(len(side), -1), grid.bound + sign * grid.c[joint, row]
    conditions = [{"type": "ineq", "fun": lambda z: h - G @ z, "jac": lambda z: -G}]
    if watched:

        @functools.lru_cache(maxsize=1)
        def linearised(z: bytes) -> tuple[np.ndarray, np.ndarray]:
            values, slopes = problem.linearise(np.frombuffer(z)[None], [watched])
            return values[0], slopes[0]

        fun, jac = (lambda z, k=k: -linearised(z.tobytes())[k] for k in (0, 1))
        conditions.append(
            {"type": "ineq", "fun": lambda z: fun(z) - MARGIN, "jac": jac}
        )

    samples = scale_samples(100, problem.basis)

    def objective(z: np.ndarray) -> tuple[float, np.ndarray]:
        values, gradients = problem.value_and_gradient(z[None], sharpness, samples)
        return float(values[0]), gradients[0]

    return scipy.optimize.minimize(
        objective,
        x,
        jac=True,
        method="SLSQP",
        constraints=conditions,
        options={"maxiter": 60, "ftol": 1e-5},
    )


def _add_peaks(
    problem: ExcitationProblem,
    x: np.ndarray,
    rows: Bool[np.ndarray, "2 joints rows"],
    threshold: float,
) -> float:
    """Mark the peaks above a fraction of the limits; return the largest one."""
    grid = problem.limits.grid()
    use = np.asarray(grid.use(x))
    use = np.stack([use, -use])
    for kind in grid.kinds:
        part = use[:, :, kind]
        rows[:, :, kind] |= are_peaks(part, 2) & (part > threshold)
    return float(use.max())


def _watched(
    problem: ExcitationProblem, x: np.ndarray, peaks: list[np.ndarray]
) -> Watched:
    """Return the watched values of constraints with the peaks of this and earlier runs."""
    found = []
    for number, (instants, entries) in enumerate(problem.watched(x)):
        now = np.stack([instants, entries])
        peaks += [now[:, :0]] if number == len(peaks) else []
        both = np.unique(np.concatenate([now, peaks[number]], axis=1), axis=1)
        peaks[number] = np.unique(
            np.concatenate([peaks[number], now[:, len(WATCHED) :]], 1), axis=1
        )
        found.append((both[0], both[1]))
    return found
