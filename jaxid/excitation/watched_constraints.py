"""Values of the constraints that a search watches, and their derivatives, in NumPy.

Of each constraint these are the worst value at equidistant instants, and its highest
peaks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.motion import Motion

from .coefficient_limits import ScaledMotion, ScaledMotions
from .constraints.constraint import Linearisation
from .problem import COARSE_STEP, WATCHED_INSTANTS, ExcitationProblem

PEAKS = 48
"""Number of peaks of each constraint that are watched."""


class WatchedValues(NamedTuple):
    """Watched values of one constraint, near one motion."""

    instants: np.ndarray  # places among the checked instants
    entries: np.ndarray  # places in the entries of the constraint


class WatchedSlopes(NamedTuple):
    """Watched values of several motions, and their derivatives."""

    values: np.ndarray  # [starts, values]
    slopes: np.ndarray  # [starts, values, scaled coefficients]


def count_watched(problem: ExcitationProblem) -> int:
    """Return the number of watched values of one motion."""
    return len(problem.constraints) * (len(WATCHED_INSTANTS) + PEAKS)


def watch(problem: ExcitationProblem, x: ScaledMotion) -> list[WatchedValues]:
    """Return the values of each constraint that are to be watched near a motion."""
    watched_values = []
    rows = WATCHED_INSTANTS // COARSE_STEP
    for values in problem.constraint_values(x, slice(None, None, COARSE_STEP)):
        values = np.asarray(values)
        is_above_next = values >= np.roll(values, -1, axis=0)
        is_peak = is_above_next & (values >= np.roll(values, 1, axis=0))
        heights = np.where(is_peak, values, -np.inf)
        # A constraint with fewer values repeats them.
        count = min(PEAKS, heights.size)
        peak_places = np.argpartition(heights, -count, axis=None)[-count:]
        peak_places = np.resize(peak_places, PEAKS)
        peak_rows, peak_entries = np.unravel_index(peak_places, values.shape)
        instants = COARSE_STEP * np.concatenate([rows, peak_rows])
        worst_entries = values[rows].argmax(axis=1)
        entries = np.concatenate([worst_entries, peak_entries])
        watched_values.append(WatchedValues(instants, entries))
    return watched_values


def watched_excess(
    problem: ExcitationProblem,
    x: ScaledMotions,
    instants: np.ndarray = WATCHED_INSTANTS,
) -> np.ndarray:
    """Return the largest excess of the constraints of each motion at some instants."""
    motions = len(x)
    rows = problem.checked_rows[:, instants]
    coefficients = problem.limits.coefficients(x)
    states = np.einsum("owk,bjk->obwj", rows, coefficients, optimize=True)
    q, qd, qdd = states.reshape(3, motions * len(instants), -1)
    excess = np.full(motions, -np.inf)
    for constraint in problem.constraints:
        values = np.asarray(constraint(problem.robot, Motion(q, qd, qdd)))
        highest_values = values.reshape(motions, -1).max(axis=1)
        excess = np.maximum(excess, highest_values)
    return excess


def linearise(
    problem: ExcitationProblem,
    x: ScaledMotions,
    watched: Sequence[list[WatchedValues]],
) -> WatchedSlopes:
    """Return watched values of several motions, and their derivatives."""
    starts, size = x.shape
    values = [np.zeros((starts, 0))]
    slopes = [np.zeros((starts, 0, size))]
    for number, linearisation in enumerate(problem.linearisations):
        places = [start_values[number] for start_values in watched]
        linear_model = _linearise_constraint(problem, linearisation, x, places)
        values.append(linear_model.values)
        slopes.append(linear_model.slopes)
    return WatchedSlopes(np.concatenate(values, axis=1), np.concatenate(slopes, axis=1))


def _linearise_constraint(
    problem: ExcitationProblem,
    linearisation: Linearisation,
    x: ScaledMotions,
    places: list[WatchedValues],
):
    """Return watched values of one constraint, of all starts together."""
    instants = np.array([place.instants for place in places])
    entries = np.array([place.entries for place in places])
    rows = problem.checked_rows[:, instants]
    coefficients = problem.limits.coefficients(x)
    states = np.einsum("obwk,bjk->obwj", rows, coefficients, optimize=True)
    q, qd, qdd = states.reshape(3, instants.size, -1)
    values, motion_slopes = linearisation(Motion(q, qd, qdd), entries.ravel())

    coefficient_slopes = np.zeros((*instants.shape, *problem.limits.shape))
    for order_slopes, part in zip(motion_slopes, rows, strict=False):
        joint_slopes = order_slopes.reshape(*instants.shape, -1, 1)
        coefficient_slopes += joint_slopes * part[:, :, None]
    slopes = coefficient_slopes * np.asarray(problem.limits.scale)
    return WatchedSlopes(
        values.reshape(instants.shape), slopes.reshape(*instants.shape, -1)
    )
