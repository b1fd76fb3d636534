"""Values of the constraints that a search watches, and their derivatives.

Of each constraint these are the worst value at equidistant instants, and its highest
peaks.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, namespace
from jaxid.dynamics.motion import Motion

from .coefficient_limits import ScaledMotion, ScaledMotions
from .constraints.constraint import linearise_values
from .problem import COARSE_STEP, WATCHED_INSTANTS, ExcitationProblem

PEAKS = 48
"""Number of peaks of each constraint that are watched."""


class WatchedValues(NamedTuple):
    """Watched values of one constraint, near each of some motions."""

    instants: AnyArray  # places among the checked instants
    entries: AnyArray  # places in the entries of the constraint


class WatchedSlopes(NamedTuple):
    """Watched values of several motions, and their derivatives."""

    values: AnyArray  # [starts, values]
    slopes: AnyArray  # [starts, values, scaled coefficients]


def count_watched(problem: ExcitationProblem) -> int:
    """Return the number of watched values of one motion."""
    return len(problem.constraints) * (len(WATCHED_INSTANTS) + PEAKS)


def watch(problem: ExcitationProblem, x: ScaledMotions) -> list[WatchedValues]:
    """Return the values of each constraint that are to be watched near each motion."""
    if namespace(x) is jnp:
        return jax.vmap(lambda motion: _watch_motion(problem, motion))(x)
    values_of_motions = [_watch_motion(problem, motion) for motion in x]
    return jax.tree.map(lambda *parts: np.stack(parts), *values_of_motions)


def _watch_motion(problem: ExcitationProblem, x: ScaledMotion) -> list[WatchedValues]:
    """Return the values of each constraint that are to be watched near a motion."""
    xp = namespace(x)
    watched_values = []
    rows = WATCHED_INSTANTS // COARSE_STEP
    for values in problem.constraint_values(x, slice(None, None, COARSE_STEP)):
        values = xp.asarray(values)
        is_above_next = values >= xp.roll(values, -1, axis=0)
        is_peak = is_above_next & (values >= xp.roll(values, 1, axis=0))
        heights = xp.where(is_peak, values, -np.inf)
        # A constraint with fewer values repeats them.
        count = min(PEAKS, heights.size)
        peak_places = xp.argpartition(heights.ravel(), -count)[-count:]
        peak_places = xp.resize(peak_places.astype(int), PEAKS)
        peak_rows, peak_entries = xp.unravel_index(peak_places, values.shape)
        instants = COARSE_STEP * xp.concatenate([rows, peak_rows])
        worst_entries = values[rows].argmax(axis=1)
        entries = xp.concatenate([worst_entries, peak_entries])
        watched_values.append(WatchedValues(instants, entries))
    return watched_values


def watched_excess(
    problem: ExcitationProblem,
    x: ScaledMotions,
    instants: np.ndarray = WATCHED_INSTANTS,
) -> AnyArray:
    """Return the largest excess of the constraints of each motion at some instants."""
    xp = namespace(x)
    motions = len(x)
    rows = problem.checked_rows[:, instants]
    coefficients = problem.limits.coefficients(x)
    states = xp.einsum("owk,bjk->obwj", rows, coefficients, optimize=True)
    q, qd, qdd = states.reshape(3, motions * len(instants), -1)
    excess = xp.full(motions, -np.inf)
    for constraint in problem.constraints:
        values = xp.asarray(constraint(problem.robot, Motion(q, qd, qdd)))
        highest_values = values.reshape(motions, -1).max(axis=1)
        excess = xp.maximum(excess, highest_values)
    return excess


def linearise(
    problem: ExcitationProblem, x: ScaledMotions, watched: list[WatchedValues]
) -> WatchedSlopes:
    """Return watched values of several motions, and their derivatives."""
    xp = namespace(x)
    starts, size = x.shape
    values = [xp.zeros((starts, 0))]
    slopes = [xp.zeros((starts, 0, size))]
    for number, places in enumerate(watched):
        linear_model = _linearise_constraint(problem, number, x, places)
        values.append(linear_model.values)
        slopes.append(linear_model.slopes)
    return WatchedSlopes(xp.concatenate(values, axis=1), xp.concatenate(slopes, axis=1))


def _linearise_constraint(
    problem: ExcitationProblem, number: int, x: ScaledMotions, places: WatchedValues
):
    """Return watched values of one constraint, of all starts together."""
    xp = namespace(x)
    instants, entries = places
    rows = xp.asarray(problem.checked_rows)[:, instants]
    coefficients = problem.limits.coefficients(x)
    states = xp.einsum("obwk,bjk->obwj", rows, coefficients, optimize=True)
    q, qd, qdd = states.reshape(3, instants.size, -1)
    motion = Motion(q, qd, qdd)
    if xp is jnp:
        values, motion_slopes = linearise_values(
            problem.constraints[number], problem.robot, motion, entries.ravel()
        )
    else:
        linearisation = problem.linearisations[number]
        values, motion_slopes = linearisation(motion, np.ravel(entries))

    slopes_by_coefficients = []
    for order_slopes, part in zip(motion_slopes, rows, strict=False):
        joint_slopes = order_slopes.reshape(*instants.shape, -1, 1)
        slopes_by_coefficients.append(joint_slopes * part[:, :, None])
    scale = np.asarray(problem.limits.scale)[None, None]
    slopes = sum(slopes_by_coefficients) * scale
    return WatchedSlopes(
        values.reshape(instants.shape), slopes.reshape(*instants.shape, -1)
    )
