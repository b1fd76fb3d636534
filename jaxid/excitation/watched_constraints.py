"""Values of the constraints that a search watches, and their derivatives, in NumPy.

Of each constraint these are the worst value at equidistant instants, and its highest
peaks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Int
from jaxid.dynamics.motion import Motion

from .coefficient_limits import ScaledMotion, ScaledMotions
from .problem import COARSE_STEP, WATCHED_INSTANTS, ExcitationProblem

PEAKS = 48
"""Number of peaks of each constraint that are watched."""


class WatchedValues(NamedTuple):
    """Watched values of one constraint, near one motion."""

    instants: Int[np.ndarray, " values"]  # places among the checked instants
    entries: Int[np.ndarray, " values"]  # places in the entries of the constraint


def count_watched(problem: ExcitationProblem) -> int:
    """Return the number of watched values of one motion."""
    return len(problem.constraints) * (len(WATCHED_INSTANTS) + PEAKS)


def watch(problem: ExcitationProblem, x: ScaledMotion) -> list[WatchedValues]:
    """Return the values of each constraint that are to be watched near a motion."""
    watched = []
    rows = WATCHED_INSTANTS // COARSE_STEP
    for values in problem.constraint_values(x, slice(None, None, COARSE_STEP)):
        values = np.asarray(values)
        is_peak = (values >= np.roll(values, 1, 0)) & (values >= np.roll(values, -1, 0))
        heights = np.where(is_peak, values, -np.inf)
        highest = np.resize(np.argsort(heights, axis=None)[-PEAKS:], PEAKS)
        peak_rows, peak_entries = np.unravel_index(highest, values.shape)
        instants = COARSE_STEP * np.concatenate([rows, peak_rows])
        worst_entries = values[rows].argmax(axis=1)
        entries = np.concatenate([worst_entries, peak_entries])
        watched.append(WatchedValues(instants, entries))
    return watched


def watched_excess(problem: ExcitationProblem, x: ScaledMotion) -> float:
    """Return the largest excess of the constraints at the equidistant watched instants."""
    values = problem.constraint_values(x, WATCHED_INSTANTS)
    return max((float(each.max()) for each in values), default=-np.inf)


def linearise(
    problem: ExcitationProblem,
    x: ScaledMotions,
    watched: Sequence[list[WatchedValues]],
) -> tuple[
    Float[np.ndarray, "starts values"], Float[np.ndarray, "starts values scaled"]
]:
    """Return watched values of several motions, and their derivatives by each motion."""
    coefficients = problem.limits.coefficients(x)
    excess: list[np.ndarray] = [np.zeros((len(x), 0))]
    derivatives: list[np.ndarray] = [np.zeros((len(x), 0, x.shape[-1]))]
    by_constraint = zip(*watched, strict=True)
    for linearisation, places in zip(
        problem.linearisations, by_constraint, strict=True
    ):
        instants = np.array([each.instants for each in places])
        entries = np.array([each.entries for each in places])
        rows = problem.checked_rows[:, instants]
        q, qd, qdd = np.einsum("obwk,bjk->obwj", rows, coefficients, optimize=True)
        # All starts are evaluated together, one after the other.
        motion = Motion(*(part.reshape(instants.size, -1) for part in (q, qd, qdd)))
        values, by_motion = linearisation(motion, entries.ravel())

        by_coefficients = np.zeros((*instants.shape, *problem.limits.shape))
        for by_order, part in zip(by_motion, rows, strict=False):
            by_joints = by_order.reshape(*instants.shape, -1, 1)
            by_coefficients += by_joints * part[:, :, None]
        by_x = by_coefficients * np.asarray(problem.limits.scale)
        excess.append(values.reshape(instants.shape))
        derivatives.append(by_x.reshape(*instants.shape, -1))
    return np.concatenate(excess, axis=1), np.concatenate(derivatives, axis=1)
