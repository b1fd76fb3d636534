"""What a motion is worth: brought within all limits, then judged by the whole run, exactly."""

import functools
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.excitation.limits import CERTIFIED, calmed, held_within
from jaxid.excitation.problem import Problem

GROWTH = 1.05
"""Most by which a motion is enlarged to meet its limits in the end."""
CALMER = (0.9995, 0.998, 0.995, 0.99, 0.98, 0.96, 0.93, 0.9)
"""Shares of its size to which a motion that almost keeps its constraints is made smaller."""
ALMOST = 0.1
"""Relative excess up to which that is tried."""
PRICE = 3.0
"""What a motion's excess counts beside its value, where it is to be improved further."""
SHARES = np.arange(0.95, 0.0, -0.05)
"""Shares of its size that are tried where nothing else keeps the constraints."""
SAME = 2e-5
"""Difference of values up to which two motions count as one found twice."""
HALVED = 6
"""How often the step between such a share and the one before it is then halved."""


class Best(NamedTuple):
    """The best motion of each start so far, certified to keep the joints' limits.

    Attributes:
        y: Scaled numbers.
        value: The criterion's logarithm, exact.
        excess: Relative excess of the worst constraint; not positive where all are kept.
    """

    y: Float[AnyArray, "starts scaled"]
    value: Float[AnyArray, " starts"]
    excess: Float[AnyArray, " starts"]

    def order(self) -> np.ndarray:
        """Starts from the best to the worst; what keeps its constraints comes first."""
        broken = np.maximum(np.asarray(self.excess), 0.0)
        return np.lexsort((np.asarray(self.value), broken))

    def promising(self) -> np.ndarray:
        """Starts from the one to improve first to the last: a small excess is soon mended."""
        broken = np.maximum(np.asarray(self.excess), 0.0)
        return np.argsort(np.asarray(self.value) + PRICE * broken, kind="stable")

    def improved(self, other: "Best") -> "Best":
        """Start by start the better of two; this one where they are equal."""
        a, b = np.maximum(self.excess, 0.0), np.maximum(other.excess, 0.0)
        better = (b < a) | ((b == a) & (other.value < self.value))
        return self._replaced(better, other)

    def survivors(self, other: "Best") -> "Best":
        """As many of both together as these are, the best first; what was found twice comes last.

        Args:
            other: Of the same problem.
        """
        both = Best(*(np.concatenate([a, b]) for a, b in zip(self, other, strict=True)))
        order = both.order()
        value, excess = both.value[order], np.maximum(both.excess[order], 0.0)
        again = (np.diff(value, prepend=np.nan) <= SAME) & (np.diff(excess, prepend=np.nan) == 0.0)
        order = np.concatenate([order[~again], order[again]])[: len(self.value)]
        return Best(*(np.asarray(part)[order] for part in both))

    def improved_at(self, place: int, other: "Best") -> "Best":
        """With one motion in the place of one start, if it is better.

        Args:
            place: Of the start.
            other: The motion by itself.
        """
        own = Best(*(np.asarray(part)[[place]] for part in self))
        return self._replaced(np.arange(len(self.value)) == place, own.improved(other))

    def _replaced(self, chosen: Bool[np.ndarray, " starts"], other: "Best") -> "Best":
        return Best(
            np.where(chosen[:, None], other.y, self.y),
            np.where(chosen, other.value, self.value),
            np.where(chosen, other.excess, self.excess),
        )


class Judge:
    """Brings motions of one problem within its limits, and judges them.

    Args:
        problem: Criterion, limits and constraints.
    """

    def __init__(self, problem: Problem):
        self._problem = problem
        limits, fine = problem.limits, problem.limits.grid(CERTIFIED)
        # A larger motion mostly tells more, but a condition number may well become worse by it.
        growths = (1.0,) if problem.constraints else (1.0, GROWTH)
        self._held = [
            jax.jit(jax.vmap(lambda y, g=g: held_within(fine, limits.still, y, fine.bound, g)))
            for g in growths
        ]
        self._calmed = jax.jit(lambda y, share: calmed(fine, limits.still, y, share))

    def __call__(self, y: Float[AnyArray, "starts scaled"]) -> Best:
        """The motions as they are."""
        values = np.array([self._problem.value(self._numbers(one)) for one in np.asarray(y)])
        excess = np.array([self._excess(one) for one in np.asarray(y)])
        finite = np.isfinite(values) & ~np.isnan(excess)
        return Best(
            np.asarray(y), np.where(finite, values, np.inf), np.where(finite, excess, np.inf)
        )

    def within(self, y: Float[AnyArray, "starts scaled"]) -> Best:
        """The motions after they were made to keep the limits of the joints for all times.

        Where they all but keep the other constraints, they are made smaller until they do; without
        constraints they fill their limits where that is better.
        """
        held = (np.asarray(hold(y)) for hold in self._held)
        return functools.reduce(
            Best.improved, (self(np.array([self._smaller(one) for one in some])) for some in held)
        )

    def shrunk(self, y: Float[AnyArray, " scaled"]) -> Best:
        """The motion made so small that it keeps all constraints; as it is if no size does.

        Args:
            y: Scaled numbers of a motion that keeps the limits of the joints.
        """
        y = np.asarray(y)
        kept = (s for s in SHARES if self._excess(np.asarray(self._calmed(y, s))) <= 0.0)
        share = next(kept, None)
        if share is None:
            return self(y[None])
        low, high = share, share + SHARES[0] - SHARES[1]
        for _ in range(HALVED):
            middle = 0.5 * (low + high)
            fits = self._excess(np.asarray(self._calmed(y, middle))) <= 0.0
            low, high = (middle, high) if fits else (low, middle)
        return self(np.asarray(self._calmed(y, low))[None])

    def _smaller(self, y: np.ndarray) -> np.ndarray:
        if not 0.0 < self._excess(y) <= ALMOST:
            return y
        tried = (np.asarray(self._calmed(y, share)) for share in CALMER)
        return next((z for z in tried if self._excess(z) <= 0.0), y)

    def _excess(self, y: np.ndarray) -> float:
        return self._problem.excess(self._numbers(y))

    def _numbers(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(self._problem.limits.numbers(y))
