"""Contact: stretches of a log in which something outside the model holds the robot."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    maximum_filter1d,
    minimum_filter1d,
    uniform_filter1d,
)

from jaxid.arrays import Bool, Float

from .motion import ServoMotion

AVERAGING_TIME = 0.5
"""Time over which errors are averaged [s]: friction and vibration change faster."""
CONTACT_RATIO = 5.0
"""Multiple of a joint's typical averaged error above which it is held by something."""
MIN_CONTACT_ERROR = 0.03
"""Averaged error below which nothing is suspected [rad or m]."""


class Contact(NamedTuple):
    """Stretch in which a joint stays where the model would have moved it.

    Attributes:
        name: Name of the log.
        joint: Index of the joint.
        start: Begin, by the clock of the log [s].
        stop: End [s].
        error: Largest averaged error [rad or m].
    """

    name: str
    joint: int
    start: float
    stop: float
    error: float


def sustained_errors(
    motion: ServoMotion, errors: Float[np.ndarray, "motions joints samples"]
) -> Float[np.ndarray, "motions joints samples"]:
    """Return errors averaged over half a second, of joints that do not move.

    A joint that moves over more than the error is not held: there the error counts as
    zero.
    """
    mean_errors = np.empty_like(errors)
    positions = np.asarray(motion.positions)
    for k, dt in enumerate(motion.sample_time):
        size = max(1, round(AVERAGING_TIME / float(dt)))
        mean_errors[k] = np.abs(
            uniform_filter1d(errors[k], size, axis=-1, mode="nearest")
        )
        maxima, minima = (
            f(positions[k], 2 * size, axis=-1)
            for f in (maximum_filter1d, minimum_filter1d)
        )
        mean_errors[k] *= maxima - minima < np.maximum(
            mean_errors[k], MIN_CONTACT_ERROR
        )
    return mean_errors * (
        np.arange(errors.shape[-1]) < np.array(motion.lengths)[:, None, None]
    )


def contact_rows(
    motion: ServoMotion,
    errors: Float[np.ndarray, "motions joints samples"],
    typical: Float[np.ndarray, " joints"] | None = None,
) -> Bool[np.ndarray, "motions joints samples"]:
    """Return samples of sustained errors beyond friction, with half a second more.

    Args:
        motion: Measured motions.
        errors: Simulated less measured positions.
        typical: Typical averaged error of each joint; from these errors if None.
    """
    mean_errors = sustained_errors(motion, errors)
    typical = typical_errors(motion, mean_errors) if typical is None else typical
    limit = np.maximum(CONTACT_RATIO * np.asarray(typical), MIN_CONTACT_ERROR)[
        None, :, None
    ]
    rows = mean_errors > limit
    for k, dt in enumerate(motion.sample_time):
        size = 2 * round(AVERAGING_TIME / float(dt)) + 1
        rows[k] = binary_dilation(rows[k], np.ones((1, size), bool))
    return rows


def typical_errors(
    motion: ServoMotion, mean: np.ndarray
) -> Float[np.ndarray, " joints"]:
    """Return each joint's usual size of averaged errors at rest, without contacts.

    It is the median of these errors over that of normal ones of unit variance. The
    median motion counts, since contact may last in some of them.
    """
    error_sizes = np.zeros(mean.shape[1])
    for j in range(len(error_sizes)):
        medians = [np.median(x[x > 0]) for x in mean[:, j] if (x > 0).any()]
        error_sizes[j] = np.median(medians) / 0.6745 if medians else 0.0
    return error_sizes


def contacts(
    motion: ServoMotion, errors: np.ndarray, typical: np.ndarray | None = None
) -> tuple[Contact, ...]:
    """Return the stretches of sustained errors that friction cannot explain."""
    mean_errors = sustained_errors(motion, errors)
    stretches = []
    typical = typical_errors(motion, mean_errors) if typical is None else typical
    rows = contact_rows(motion, errors, typical)
    for k, j in np.argwhere(rows.any(axis=2)):
        dt = float(motion.sample_time[k])
        edges = np.flatnonzero(
            np.diff(np.concatenate([[0], rows[k, j].astype(int), [0]]))
        )
        for a, b in edges.reshape(-1, 2):
            peak = float(mean_errors[k, j, a:b].max())
            start, stop = (float(motion.begin[k] + dt * i) for i in (a, b))
            stretches.append(Contact(motion.names[k], int(j), start, stop, peak))
    return tuple(stretches)
