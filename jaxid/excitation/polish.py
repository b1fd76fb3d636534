"""Polishing of one motion: sequential quadratic programming with exact gradients.

Of the limits' many rows only a permanent coarse grid and the peaks that a motion reaches are given
to the solver; after each run new peaks are added. The same for constraints.
"""

from typing import Any

import jax
import numpy as np
import scipy.optimize

from jaxid.arrays import AnyArray, Float
from jaxid.excitation.judge import Best, Judge
from jaxid.excitation.limits import CERTIFIED, Grid, enough
from jaxid.excitation.problem import CHECKED, MARGIN, Context, Problem

SEEN = 100
"""Samples on which a motion is judged."""
PERMANENT = 12
"""Rows of each order that always belong to the problem."""
NEAR = 0.8
"""Share of a limit from which a peak is given to the solver at once."""
NEW = 0.97
"""Share of a limit from which a later peak is added."""
CLOSED = 1.003
"""Peaks up to which the exchange has nothing left to add."""
STEADY = 48
"""Instants at which constraints belong to the problem if they are not far from binding there."""
FAR = 0.6
"""Relative distance from which they are."""
WITHIN = 0.3
"""Relative distance from which a constraint's peak is given to the solver."""
BATCH = 64
"""Instants whose constraints are differentiated in one call."""
GAINED = 1e-4
"""Improvement below which a motion within its limits is left as it is."""
ROUNDS = ((8.0, 60, 5), (None, 60, 8))
"""Sharpness, iterations of a run, and most runs."""


class Polish:
    """Improves single motions of one problem.

    Args:
        problem: Criterion, limits and constraints.
    """

    def __init__(self, problem: Problem):
        self._problem = problem
        limits = problem.limits
        self._fine = limits.grid(CERTIFIED)
        objective, none = problem.objective(enough(SEEN, problem.basis)), np.zeros((1, 0), int)
        self._smooth = jax.jit(lambda y, p: objective(y[None], Context(p, none)))
        self._exact = jax.jit(lambda y: objective(y[None], Context(None, none)))
        self._judge = Judge(problem)
        self._local = jax.jit(problem.constrained)

    def __call__(self, start: Float[AnyArray, " scaled"]) -> Best:
        """A better motion than any before it, or the same; within all limits."""
        limits = _Exchange(self._fine)
        constraints = _Instants(self) if self._problem.constraints else None
        y: np.ndarray = np.array(start, np.float64)
        best = self._judge.within(y[None])
        rounds = ROUNDS if self._problem.criterion.extreme else ROUNDS[1:]
        for sharpness, iterations, runs in rounds:
            limits.add(y, NEAR)
            smooth = np.inf
            for _ in range(runs):
                if constraints is not None:
                    constraints.add(y)
                result = self._minimised(y, sharpness, iterations, limits, constraints)
                if not np.isfinite(result.x).all():
                    break
                y = result.x
                peak, before = limits.add(y, NEW), best
                best = best.improved(self._judge.within(y[None]))
                gained = float(before.value[0] - best.value[0])
                if sharpness is not None:
                    # A smooth round's steps need not show in the exact value at once.
                    gained, smooth = smooth - float(result.fun), float(result.fun)
                kept = constraints is None or constraints.worst(y) <= 0.0
                if peak < CLOSED and kept and (result.nit <= 3 or gained < GAINED):
                    break
        return best

    def _minimised(
        self,
        y: np.ndarray,
        sharpness: float | None,
        iterations: int,
        limits: "_Exchange",
        constraints: "_Instants | None",
    ) -> Any:
        def value(z: np.ndarray) -> tuple[float, np.ndarray]:
            v, g = self._exact(z) if sharpness is None else self._smooth(z, sharpness)
            return float(v[0]), np.asarray(g[0])

        G, h = limits.rows()
        conditions = [{"type": "ineq", "fun": lambda z: h - G @ z, "jac": lambda z: -G}]
        if constraints is not None and len(constraints):
            conditions.append({"type": "ineq", "fun": constraints.slack, "jac": constraints.slope})
        return scipy.optimize.minimize(
            value,
            y,
            jac=True,
            method="SLSQP",
            constraints=conditions,
            options={"maxiter": iterations, "ftol": 1e-5},
        )


class _Exchange:
    """Rows of the joints' limits that the solver sees."""

    def __init__(self, grid: Grid):
        self._grid = grid
        self._chosen = {
            (joint, row, sign)
            for joint in range(len(grid.c))
            for kind in grid.kinds
            for row in kind[:: max(1, len(kind) // PERMANENT)]
            for sign in (1, -1)
        }

    def add(self, y: np.ndarray, threshold: float) -> float:
        """Adds the peaks of a motion above a share of its limits; the largest peak."""
        joints = len(self._grid.c)
        motion = y.reshape(joints, -1)
        values = np.einsum("jrk,jk->jr", self._grid.R, motion) - self._grid.c
        values = values / self._grid.bound
        for joint in range(joints):
            for kind in self._grid.kinds:
                part = values[joint, kind.start : kind.stop]
                for sign in (1, -1):
                    x = sign * part
                    peaks = (x >= np.roll(x, 1)) & (x >= np.roll(x, -1)) & (x > threshold)
                    self._chosen |= {
                        (joint, kind.start + int(k), sign) for k in np.flatnonzero(peaks)
                    }
        return float(np.abs(values).max())

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """G and h of G y <= h."""
        chosen = np.array(sorted(self._chosen))
        joint, row, sign = chosen.T
        joints, _, variables = self._grid.R.shape
        G = np.zeros((len(chosen), joints, variables))
        G[np.arange(len(chosen)), joint] = sign[:, None] * self._grid.R[joint, row]
        return G.reshape(len(chosen), -1), self._grid.bound + sign * self._grid.c[joint, row]


class _Instants:
    """Constraints at the instants of their peaks."""

    def __init__(self, polish: Polish):
        self._polish = polish
        self._peaks: set[tuple[int, int]] = set()
        self._chosen: set[tuple[int, int]] = set()
        self._last: tuple[bytes, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self._chosen)

    def worst(self, y: np.ndarray) -> float:
        """The largest excess at all instants."""
        return float(np.max(self._polish._problem.checked(y)))

    def add(self, y: np.ndarray) -> None:
        """Adds the peaks of a motion, and what else it may soon meet in place of what was that."""
        values = np.asarray(self._polish._problem.checked(y))
        peaks = (values >= np.roll(values, 1, 0)) & (values >= np.roll(values, -1, 0))
        found = np.argwhere(peaks & (values > -WITHIN))
        self._peaks |= {(int(t), int(v)) for t, v in found}
        step = CHECKED // STEADY
        near = np.argwhere(values[::step] > -FAR)
        self._chosen = self._peaks | {(step * int(t), int(v)) for t, v in near}
        self._last = None

    def slack(self, y: np.ndarray) -> np.ndarray:
        """How far the constraints are kept."""
        return -self._evaluated(y)[0] - MARGIN

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Its derivatives."""
        return -self._evaluated(y)[1]

    def _evaluated(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._last is not None and self._last[0] == y.tobytes():
            return self._last[1:]
        chosen = np.array(sorted(self._chosen))
        instants, place = np.unique(chosen[:, 0], return_inverse=True)
        padded = np.concatenate([instants, np.full(-len(instants) % BATCH, instants[0])])
        parts = [self._polish._local(y, part) for part in padded.reshape(-1, BATCH)]
        values, slopes = (np.concatenate([np.asarray(p[k]) for p in parts]) for k in (0, 1))
        where = place, chosen[:, 1]
        self._last = y.tobytes(), values[where], slopes[where]
        return self._last[1:]
