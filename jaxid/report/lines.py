"""Lines of long logs: no more points than a picture shows, and nothing drawn across gaps."""

import numpy as np

from jaxid.arrays import AnyArray, Float

GAP = 1.5
"""Steps longer than this, in usual steps, are gaps."""


def thinned(
    time: Float[AnyArray, " rows"], values: Float[AnyArray, " rows"], bins: int
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Points of a line: all of them if they are few, else the least and largest of each bin.

    A peak of one sample stays visible however long the log is. Gaps in time become NaN, at which
    a line breaks; values that are NaN stay out of their bin.

    Args:
        time: Of the values [s], rising.
        values: NaN where there is none.
        bins: Of equal duration, about as many as the picture has pixels.
    """
    t, y = np.asarray(time), np.asarray(values)
    if len(t) <= 2 * bins:
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else []
        return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)
    place = np.minimum((bins * ((t - t[0]) / (t[-1] - t[0]))).astype(int), bins - 1)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    last = np.append(first[1:], len(t)) - 1
    least, largest = np.fmin.reduceat(y, first), np.fmax.reduceat(y, first)
    rising = ~(y[last] < y[first])
    points = np.empty((len(first), 2))
    points[:, 0] = np.where(rising, least, largest)
    points[:, 1] = np.where(rising, largest, least)
    times = np.stack([t[first], t[last]], axis=1)
    gaps = np.flatnonzero(np.diff(place[first]) > 1) + 1
    times, points = (np.insert(x, gaps, np.nan, axis=0) for x in (times, points))
    return times.ravel(), points.ravel()
