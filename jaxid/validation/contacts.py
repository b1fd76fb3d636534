"""A stretch of a log in which something else pushes: a contact or a person."""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from .descriptions import DescribedLog
from .filtered_log import GRID_RATE
from .row_fits import RowFit

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


class ContactSearch:
    """Search for the stretch that explains most of a fit's errors."""

    def __init__(self, described_log: DescribedLog, fit: RowFit):
        self._log = described_log
        self._fit = fit
        columns = described_log.rows.columns
        self._weights = described_log.judge.mask * fit.weights
        weighted_columns = columns * self._weights[..., None]
        self._matrix = weighted_columns.reshape(-1, columns.shape[2])
        self._errors = (fit.errors * self._weights).ravel()
        self._times = np.arange(len(described_log.log.forces)) / GRID_RATE

    def best(self) -> Contact:
        """Return the contact that explains most."""
        end = self._times[-1]
        candidates = [
            self._contact(start, duration)
            for duration in DURATIONS
            for start in np.arange(0.0, end - duration, duration / 4)
        ]
        best = max(candidates)
        step = 0.1
        while step > MIN_STEP:
            neighbours = [
                self._contact(best.start + step * k, best.duration + step * (m - k))
                for k in (-1, 0, 1)
                for m in (-1, 0, 1)
                if best.duration + step * (m - k) > 0.1
            ]
            if max(neighbours).gain > best.gain + 1e-9:
                best = max(neighbours)
            else:
                step /= 2
        return best

    def _contact(self, start: float, duration: float) -> Contact:
        """Return what a constant force of each joint in one stretch explains."""
        columns = self._columns(start, duration)
        if not columns.shape[1]:
            return Contact(0.0, float(start), float(duration))
        remainder = columns - self._matrix @ self._explained(columns)
        amounts, *_ = np.linalg.lstsq(remainder, self._errors, rcond=1e-6)
        errors = self._errors - remainder @ amounts
        joint_errors = errors.reshape(self._weights.shape) / self._fit.weights
        judge = self._log.judge
        squares = judge.mean_squares(joint_errors, self._log.rows.forces)
        gain = self._fit.score - judge.score(squares)
        return Contact(gain, float(start), float(duration))

    def _columns(self, start: float, duration: float) -> np.ndarray:
        """Return weighted columns that are one in a stretch, one for each joint."""
        is_inside = (self._times >= start) & (self._times < start + duration)
        samples = is_inside.astype(float)[:, None]
        inside_rows = self._log.log.rows_of(samples)
        joints = self._weights.shape[1]
        weights = inside_rows * self._weights
        columns = weights[..., None] * np.eye(joints)
        # A joint of which less than three rows lie inside has no say.
        is_inside_often = np.count_nonzero(weights > 0.0, axis=0) > 2
        return columns.reshape(-1, joints)[:, is_inside_often]

    def _explained(self, columns: np.ndarray) -> np.ndarray:
        """Return the parameters by which a fit imitates columns."""
        scales = self._fit.scales[:, None]
        products = self._matrix.T @ columns / scales
        return linalg.cho_solve(self._fit.factor, products, check_finite=False) / scales
