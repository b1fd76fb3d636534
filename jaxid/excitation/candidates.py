"""Candidates of a search: brought into the limits of the joints, then evaluated exactly."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float
from jaxid.excitation.problem import ExcitationProblem

PENALTY = 3.0
"""Penalty of a relative excess beside the criterion's logarithm, where it is to be improved."""


class Candidates(NamedTuple):
    """The best motion of each start so far, certified to keep the limits of the joints.

    Attributes:
        x: Scaled coefficients.
        value: Logarithm of the criterion, exact.
        excess: Relative excess of the worst constraint; not positive where all are kept.
    """

    x: Float[AnyArray, "starts scaled"]
    value: Float[AnyArray, " starts"]
    excess: Float[AnyArray, " starts"]

    def order(self) -> np.ndarray:
        """Return the starts from best to worst; motions that keep their constraints come first."""
        broken = np.maximum(np.asarray(self.excess), 0.0)
        return np.lexsort((np.asarray(self.value), broken))

    def promising(self) -> np.ndarray:
        """Return the starts, the most promising first: a small excess is soon mended."""
        broken = np.maximum(np.asarray(self.excess), 0.0)
        return np.argsort(np.asarray(self.value) + PENALTY * broken, kind="stable")

    def improved(self, other: "Candidates") -> "Candidates":
        """Return start by start the better of two; this one where they are equal."""
        a, b = np.maximum(self.excess, 0.0), np.maximum(other.excess, 0.0)
        better = (b < a) | ((b == a) & (other.value < self.value))
        return self._replaced(better, other)

    def survivors(self, other: "Candidates", tolerance: float = 2e-5) -> "Candidates":
        """Return as many of both together as these are, the best first, duplicates last.

        Args:
            other: Candidates of the same problem.
            tolerance: Difference of values up to which two motions count as one found twice.
        """
        both = Candidates(*(np.concatenate([a, b]) for a, b in zip(self, other, strict=True)))
        order = both.order()
        value, excess = both.value[order], np.maximum(both.excess[order], 0.0)
        again = np.diff(value, prepend=np.nan) <= tolerance
        again &= np.diff(excess, prepend=np.nan) == 0.0
        order = np.concatenate([order[~again], order[again]])[: len(self.value)]
        return Candidates(*(np.asarray(part)[order] for part in both))

    def improved_at(self, place: int, other: "Candidates") -> "Candidates":
        """Return the candidates with a single motion in the place of one start, if it is better.

        Args:
            place: Index of the start.
            other: The motion.
        """
        present = Candidates(*(np.asarray(part)[[place]] for part in self))
        return self._replaced(np.arange(len(self.value)) == place, present.improved(other))

    def _replaced(self, chosen: Bool[np.ndarray, " starts"], other: "Candidates") -> "Candidates":
        return Candidates(
            np.where(chosen[:, None], other.x, self.x),
            np.where(chosen, other.value, self.value),
            np.where(chosen, other.excess, self.excess),
        )


def evaluate(problem: ExcitationProblem, x: Float[AnyArray, "starts scaled"]) -> Candidates:
    """Return motions as they are, with their exact values.

    Args:
        problem: Criterion, limits and constraints.
        x: Scaled coefficients.
    """
    x = np.asarray(x)
    values = np.array([problem.exact_value(one) for one in x])
    excess = np.array([problem.excess(one) for one in x])
    finite = np.isfinite(values) & ~np.isnan(excess)
    return Candidates(x, np.where(finite, values, np.inf), np.where(finite, excess, np.inf))


def evaluate_within_limits(
    problem: ExcitationProblem, x: Float[AnyArray, "starts scaled"]
) -> Candidates:
    """Return motions after they were made to keep the limits of the joints for all times.

    Where they almost keep the other constraints, they are made smaller until they do; without
    constraints they fill their limits where that is better.

    Args:
        problem: Criterion, limits and constraints.
        x: Scaled coefficients.
    """
    # A larger motion mostly tells more, but a condition number may well become worse by it.
    growths = (1.0,) if problem.constraints else (1.0, 1.05)
    scaled = (np.asarray(_scale_into_limits(problem, growth, x)) for growth in growths)
    found = [evaluate(problem, np.array([_mend(problem, y) for y in some])) for some in scaled]
    return functools.reduce(Candidates.improved, found)


def shrink_to_constraints(
    problem: ExcitationProblem, x: Float[AnyArray, " scaled"], step: float = 0.05
) -> Candidates:
    """Return a motion made so small that it keeps all constraints; unchanged if no size does.

    Args:
        problem: Criterion, limits and constraints.
        x: Scaled coefficients of a motion that keeps the limits of the joints.
        step: First step of the size, which is then halved.
    """

    def keeps(fraction: float) -> bool:
        return problem.excess(np.asarray(_shrink(problem, x, fraction))) <= 0.0

    low = next((s for s in np.arange(1.0 - step, 0.0, -step) if keeps(s)), None)
    if low is None:
        return evaluate(problem, np.asarray(x)[None])
    high = low + step
    for _ in range(6):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return evaluate(problem, np.asarray(_shrink(problem, x, low))[None])


def _mend(problem: ExcitationProblem, x: np.ndarray) -> np.ndarray:
    """Return a motion that almost keeps its constraints so much smaller that it does."""
    if not 0.0 < problem.excess(x) <= 0.1:
        return x
    fractions = (0.9995, 0.998, 0.995, 0.99, 0.98, 0.96, 0.93, 0.9)
    smaller = (np.asarray(_shrink(problem, x, fraction)) for fraction in fractions)
    return next((y for y in smaller if problem.excess(y) <= 0.0), x)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _scale_into_limits(problem: ExcitationProblem, growth: float, x: AnyArray) -> Array:
    grid = problem.limits.grid()
    return jax.vmap(lambda y: grid.scale_into_limits(y, growth=growth))(x)


@functools.partial(jax.jit, static_argnums=0)
def _shrink(problem: ExcitationProblem, x: Array, fraction: Any) -> Array:
    return problem.limits.grid().shrink(x, fraction)
