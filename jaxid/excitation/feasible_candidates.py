"""The best motions of a search so far, and how a motion is made to keep its limits."""

from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, namespace

from .coefficient_limits import Grid, ScaledMotion, ScaledMotions
from .criterion_gradient import criterion_at_samples
from .problem import MAX_COARSE_EXCESS, ExcitationProblem

PerStart = Float[AnyArray, " starts"]
"""One number for each start of a search."""
EXCESS_PENALTY = 3.0
"""Penalty of a relative excess, added to the criterion's logarithm."""
SLIGHT_SHRINKAGES = (0.9995, 0.998, 0.995, 0.99, 0.98, 0.96, 0.93, 0.9)
"""Factors by which a motion is made smaller that exceeds its constraints a little."""
HALVINGS = 10
"""Bisections of the factor by which a motion is made smaller."""
SAME_VALUE = 2e-5
"""Difference of two criteria's logarithms below which motions are the same."""


class Candidates(NamedTuple):
    """The best motion of each start so far, within the limits of the joints."""

    x: ScaledMotions  # scaled coefficients
    value: PerStart  # logarithm of the criterion, exact
    # relative excess of the worst constraint; not positive where all are kept
    excess: PerStart

    @property
    def violation(self) -> PerStart:
        """Excess where a constraint is not kept; zero elsewhere."""
        return namespace(self.excess).maximum(self.excess, 0.0)

    @property
    def is_feasible(self) -> bool:
        """Whether one of the motions keeps all constraints."""
        return bool((self.violation == 0).any())

    @property
    def best_value(self) -> float:
        """Value of the criterion itself for the best motion."""
        return float(np.exp(self.value[self.order()[0]]))

    @property
    def best_motion(self) -> ScaledMotion:
        """Scaled coefficients of the best motion."""
        return np.asarray(self.x[self.order()[0]])

    def order(self) -> AnyArray:
        """Return the starts from best to worst, feasible motions first."""
        return namespace(self.value).lexsort((self.value, self.violation))

    def promising(self) -> np.ndarray:
        """Return the starts, the most promising first: a small excess counts little."""
        penalty = EXCESS_PENALTY * self.violation
        return np.argsort(np.asarray(self.value) + penalty, kind="stable")

    def at(self, places: Any) -> "Candidates":
        """Return the motions at some places."""
        return Candidates(*(part[places] for part in self))

    def improved(self, places: np.ndarray, others: "Candidates") -> "Candidates":
        """Return these motions, with others at some places if those are better."""
        better_motions = self.at(places).better_of(others)
        candidates = Candidates(*(np.array(part) for part in self))
        for part, values in zip(candidates, better_motions, strict=True):
            part[places] = values
        return candidates

    def better_of(self, others: "Candidates") -> "Candidates":
        """Return the better one of both motions at each place."""
        xp = namespace(self.value)
        is_smaller = others.violation < self.violation
        is_as_small = others.violation == self.violation
        is_better = is_smaller | (is_as_small & (others.value < self.value))
        x = xp.where(is_better[:, None], others.x, self.x)
        value = xp.where(is_better, others.value, self.value)
        return Candidates(x, value, xp.where(is_better, others.excess, self.excess))

    def survivors(self, others: "Candidates") -> "Candidates":
        """Return the best of both, as many as these are; duplicates come last."""
        xp = namespace(self.value)
        pairs = zip(self, others, strict=True)
        all_motions = Candidates(*(xp.concatenate(pair) for pair in pairs))
        sorted_motions = all_motions.at(all_motions.order())
        # Infinite where motions determine too little, or are far beyond a limit: these
        # are no duplicates.
        with np.errstate(invalid="ignore"):
            value_steps = xp.diff(sorted_motions.value, prepend=np.nan)
            violation_steps = xp.diff(sorted_motions.violation, prepend=np.nan)
        is_duplicate = (value_steps <= SAME_VALUE) & (violation_steps == 0.0)
        order = xp.lexsort((is_duplicate,))
        return sorted_motions.at(order[: len(self.value)])


def criterion_values(problem: ExcitationProblem, x: ScaledMotions) -> PerStart:
    """Return the exact logarithms of the criterion."""
    samples = problem.samples
    # One by one: all samples of many motions take much memory.
    values = [criterion_at_samples(problem, y[None], None, samples) for y in x]
    return np.concatenate(values)


def evaluate(problem: ExcitationProblem, x: ScaledMotions) -> Candidates:
    """Return motions as they are, with their exact values."""
    x = np.asarray(x)
    values = criterion_values(problem, x)
    excess = np.array([problem.excess(motion) for motion in x])
    is_finite = np.isfinite(values) & ~np.isnan(excess)
    values = np.where(is_finite, values, np.inf)
    return Candidates(x, values, np.where(is_finite, excess, np.inf))


def evaluate_within_limits(problem: ExcitationProblem, x: ScaledMotions) -> Candidates:
    """Return motions that are made to keep the limits of the joints for all times.

    Where they almost keep the other constraints, they are made smaller until they do.
    """
    grid = problem.limits.grid()
    motions = []
    for motion in x:
        scaled_motion = grid.scale_into_limits(motion)
        motions.append(_shrink_slightly(problem, grid, scaled_motion))
    return evaluate(problem, np.array(motions))


def _shrink_slightly(
    problem: ExcitationProblem,
    grid: Grid,
    motion: ScaledMotion,
):
    """Return a smaller motion that keeps constraints which are exceeded a little."""
    if not 0.0 < problem.excess(motion) <= MAX_COARSE_EXCESS:
        return motion
    for factor in SLIGHT_SHRINKAGES:
        smaller_motion = grid.shrink(motion, factor)
        if problem.excess(smaller_motion) <= 0.0:
            return smaller_motion
    return motion


def shrink_to_constraints(problem: ExcitationProblem, x: ScaledMotion) -> Candidates:
    """Return a motion so small that it keeps all constraints, if any size does."""
    motion = np.asarray(x)
    grid = problem.limits.grid()
    low = 0.0
    high = 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        smaller_motion = grid.shrink(x, middle)
        if problem.excess(smaller_motion) <= 0.0:
            low = middle
            motion = smaller_motion
        else:
            high = middle
    return evaluate(problem, motion[None])
