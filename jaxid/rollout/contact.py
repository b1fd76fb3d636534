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

SUSTAINED = 0.5
"""Time over which errors are averaged [s]: friction and vibration change faster."""
SEVERE = 5.0
"""Multiple of a joint's typical averaged error above which it is held by something."""
LEAST = 0.03
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
    mean, measured = np.empty_like(errors), np.asarray(motion.positions)
    for k, dt in enumerate(motion.sample_time):
        size = max(1, round(SUSTAINED / float(dt)))
        mean[k] = np.abs(uniform_filter1d(errors[k], size, axis=-1, mode="nearest"))
        high, low = (
            f(measured[k], 2 * size, axis=-1)
            for f in (maximum_filter1d, minimum_filter1d)
        )
        mean[k] *= high - low < np.maximum(mean[k], LEAST)
    return mean * (
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
    mean = sustained_errors(motion, errors)
    typical = typical_errors(motion, mean) if typical is None else typical
    limit = np.maximum(SEVERE * np.asarray(typical), LEAST)[None, :, None]
    rows = mean > limit
    for k, dt in enumerate(motion.sample_time):
        size = 2 * round(SUSTAINED / float(dt)) + 1
        rows[k] = binary_dilation(rows[k], np.ones((1, size), bool))
    return rows


def typical_errors(
    motion: ServoMotion, mean: np.ndarray
) -> Float[np.ndarray, " joints"]:
    """Return each joint's usual size of averaged errors at rest, without contacts.

    It is the median of these errors over that of normal ones of unit variance. The
    median motion counts, since contact may last in some of them.
    """
    typical = np.zeros(mean.shape[1])
    for j in range(len(typical)):
        still = [np.median(x[x > 0]) for x in mean[:, j] if (x > 0).any()]
        typical[j] = np.median(still) / 0.6745 if still else 0.0
    return typical


def contacts(
    motion: ServoMotion, errors: np.ndarray, typical: np.ndarray | None = None
) -> tuple[Contact, ...]:
    """Return the stretches of sustained errors that friction cannot explain."""
    mean, found = sustained_errors(motion, errors), []
    typical = typical_errors(motion, mean) if typical is None else typical
    rows = contact_rows(motion, errors, typical)
    for k, j in np.argwhere(rows.any(axis=2)):
        dt = float(motion.sample_time[k])
        edges = np.flatnonzero(
            np.diff(np.concatenate([[0], rows[k, j].astype(int), [0]]))
        )
        for a, b in edges.reshape(-1, 2):
            peak = float(mean[k, j, a:b].max())
            start, stop = (float(motion.begin[k] + dt * i) for i in (a, b))
            found.append(Contact(motion.names[k], int(j), start, stop, peak))
    return tuple(found)
