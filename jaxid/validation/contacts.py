"""A stretch of a log in which something else pushes: a contact or a person."""

from typing import NamedTuple

import numpy as np

from .descriptions import DescribedLog
from .filtered_log import GRID_RATE, FilteredLog
from .row_fits import Judge, RowFit, promise

DURATIONS = (0.4, 0.8, 1.6)
"""Durations that are tried first [s]."""
MIN_STEP = 0.02
"""Step at which the search for begin and end stops [s]."""


class Contact(NamedTuple):
    """Stretch of time with constant additional forces.

    Attributes:
        gain: Fall of the score.
        start: Begin, counted on the grid from the first row of the log [s].
        duration: Duration [s].
    """

    gain: float
    start: float
    duration: float

    @property
    def stop(self) -> float:
        """End [s]."""
        return self.start + self.duration

    def shares(self, log: FilteredLog) -> np.ndarray:
        """Return the share of each row of a log that lies inside [rows, 1]."""
        times = np.arange(len(log.forces)) / GRID_RATE
        is_inside = (times >= self.start) & (times < self.stop)
        return log.rows_of(is_inside.astype(float)[:, None])


def find_contact(described_log: DescribedLog, fit: RowFit) -> Contact:
    """Return the stretch that explains most of a fit's errors."""
    log = described_log.log
    judge = described_log.judge
    end = (len(log.forces) - 1) / GRID_RATE

    def contact(start: float, duration: float) -> Contact:
        """Return what a constant force of each joint in one stretch explains."""
        inside_rows = Contact(0.0, start, duration).shares(log) * judge.mask
        # A joint of which less than three rows lie inside has no say.
        is_inside_often = np.count_nonzero(inside_rows, axis=0) > 2
        columns = inside_rows[..., None] * np.diag(is_inside_often)
        gain = promise(judge, described_log.rows, fit, columns)
        return Contact(gain, float(start), float(duration))

    best = max(
        contact(start, duration)
        for duration in DURATIONS
        for start in np.arange(0.0, end - duration, duration / 4)
    )
    step = 0.1
    while step > MIN_STEP:
        neighbours = [
            contact(best.start + step * k, best.duration + step * (m - k))
            for k in (-1, 0, 1)
            for m in (-1, 0, 1)
            if best.duration + step * (m - k) > 0.1
        ]
        if max(neighbours).gain > best.gain + 1e-9:
            best = max(neighbours)
        else:
            step /= 2
    return best


def concentration(described_log: DescribedLog, contact: Contact) -> float:
    """Return the errors inside a contact over those outside, of a fit to the outside.

    What a model lacks in all of a log, such as cables, is missed outside as well.
    """
    judge = described_log.judge
    rows = described_log.rows
    inside_shares = contact.shares(described_log.log) * judge.mask
    is_outside = judge.mask & (inside_shares == 0.0)
    fit = Judge(is_outside, judge.folds).fit(rows)
    squares = ((rows.forces - rows.columns @ fit.parameters) * fit.weights) ** 2
    inside_square = np.average(squares, weights=inside_shares)
    return float(np.sqrt(inside_square / np.mean(squares[is_outside])))
