"""Where a long log is uniform in time: found from its stamps, part by part."""

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np

from jaxid.errors import InputError
from jaxid.measurement.clock import (
    JITTER,
    TWINS,
    rounded,
    said_gaps,
    said_lonely,
    said_start,
)
from jaxid.measurement.recording import FEWEST

FEWEST_IN_SEQUENCE = 4
"""Rows between two gaps below which they are left out, as in `clock`."""
ALIKE = 64
"""Rows whose distances from the grid are remembered together."""


class NeedsMemory(ValueError):  # noqa: N818 (it says what to do, and is caught for that)
    """A log that can be read only as a whole; the sentence says why."""


@dataclasses.dataclass(frozen=True)
class Survey:
    """The uniform stretches of a log.

    Attributes:
        sample_time: Time between two rows [s].
        ranges: Half-open ranges of rows without gaps.
        times: Of the first row of each range, from the log's first row on [s].
        notes: What was seen, in sentences.
    """

    sample_time: float
    ranges: tuple[tuple[int, int], ...]
    times: tuple[float, ...]
    notes: tuple[str, ...] = ()

    @classmethod
    def uniform(cls, rows: int, sample_time: float) -> "Survey":
        """Of a log whose rows are known to be equally far apart."""
        return cls(sample_time, ((0, rows),), (0.0,))

    def cropped(self, start: float, stop: float, name: str) -> "Survey":
        """The part from `start` [s] on and before `stop` [s].

        Raises:
            InputError: If fewer than ten rows are left.
        """
        dt = self.sample_time
        ranges, times = [], []
        for (a, b), t in zip(self.ranges, self.times, strict=True):
            low, high = (
                int(np.clip(np.ceil((limit - t) / dt - 1e-6), 0, b - a)) for limit in (start, stop)
            )
            if low < high:
                ranges.append((a + low, a + high))
                times.append(t + low * dt)
        left = sum(b - a for a, b in ranges)
        if left < FEWEST:
            a, b = self.ranges[-1]
            raise InputError(
                f"`{name}` has {left} samples from {start:g} s to {stop:g} s, but at least "
                f"{FEWEST} are needed: it lasts from {self.times[0]:g} s to "
                f"{self.times[-1] + (b - a - 1) * dt:g} s."
            )
        return dataclasses.replace(self, ranges=tuple(ranges), times=tuple(times))


class _Surveyor:
    """What is known after some parts of the stamps."""

    def __init__(self, first: np.ndarray, source: str, largest_gap: float, first_row: int):
        self._source, self._first_row = source, first_row
        steps = np.diff(first)
        moving = steps[steps > 0]
        if not moving.size:
            raise InputError(f"time of `{source}` stands still: check the column of time stamps.")
        self.typical = float(np.median(moving))
        spread = 1.4826 * float(np.median(np.abs(moving - self.typical)))
        self._gap = max(largest_gap * self.typical, self.typical + 8.0 * spread)
        self._regular = 1.5 * self.typical + 8.0 * spread
        self._sum, self._count, self.rows = 0.0, 0, 0
        self._last, self._origin = None, float(first[0])
        self.ranges, self.times = [], []
        self.gaps, self.first_gap, self.longest = 0, 0.0, 0.0
        # Of some rows after the other: their distance from the range's start, and between which
        # limits they leave the grid.
        self._leaves: list[np.ndarray] = []

    def add(self, stamps: np.ndarray) -> None:
        t = stamps - self._origin
        whole = t if self._last is None else np.concatenate([[self._last], t])
        steps, before = np.diff(whole), self.rows - len(whole) + len(t)
        self._refuse(whole, steps, before)
        gaps = np.flatnonzero(steps > self._gap)
        if gaps.size:
            self.first_gap = self.first_gap if self.gaps else float(whole[gaps[0]])
            self.longest = max(self.longest, float(steps[gaps].max()))
            self.gaps += len(gaps)
        regular = steps[steps < self._regular]
        self._sum, self._count = self._sum + float(regular.sum()), self._count + len(regular)
        edges = [0, *(gaps + 1 - (len(whole) - len(t))).tolist(), len(t)]
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            if a == b:
                continue
            if k > 0 or not self.ranges:
                self.ranges.append([self.rows + a, self.rows + a])
                self.times.append(float(t[a]))
            first = self.ranges[-1][1] - self.ranges[-1][0]
            off = t[a:b] - self.times[-1] - self.typical * (first + np.arange(b - a))
            starts = np.arange(0, b - a, ALIKE)
            lows, highs = (f.reduceat(off, starts) for f in (np.minimum, np.maximum))
            self._leaves.append(np.stack([first + starts + 0.5 * ALIKE, lows, highs]))
            self.ranges[-1][1] += b - a
        self.rows += len(t)
        self._last = float(t[-1])

    def _refuse(self, t: np.ndarray, steps: np.ndarray, before: int) -> None:
        back = np.flatnonzero(steps < 0)
        if back.size:
            i = int(back[0])
            raise InputError(
                f"time of `{self._source}` runs backwards from {t[i] + self._origin:.9g} s to "
                f"{t[i + 1] + self._origin:.9g} s at row {before + i + 1 + self._first_row}: sort "
                "the log, or split it where the clock was set back."
            )
        twins = np.flatnonzero(steps <= TWINS * self.typical)
        if twins.size:
            raise NeedsMemory(
                f"rows of `{self._source}` repeat the time stamp of the row before, first at row "
                f"{before + int(twins[0]) + 1 + self._first_row}: remove them, or give "
                "`sample_time` if every row is a sample."
            )

    def found(self) -> Survey:
        ranges = [
            ((a, b), t)
            for (a, b), t in zip(self.ranges, self.times, strict=True)
            if b - a >= FEWEST_IN_SEQUENCE
        ]
        if not ranges:
            raise InputError(
                f"`{self._source}` has no four rows in sequence: its time stamps are "
                f"{self.typical:.6g} s apart at the median, with {self.gaps} gaps; check "
                "`time_unit`, or give `sample_time`."
            )
        sample_time = rounded(self._sum / self._count, self.rows)
        slope = sample_time - self.typical
        middle, low, high = np.concatenate(self._leaves, axis=1)
        uneven = float(np.maximum(slope * middle - low, high - slope * middle).max())
        if uneven > JITTER * sample_time:
            raise NeedsMemory(
                f"time stamps of `{self._source}` leave a uniform grid of {sample_time:.6g} s by "
                f"{uneven:.6g} s: give `sample_time` if the robot samples uniformly and only the "
                "stamps are late."
            )
        notes = said_start(self._origin)
        if self.gaps:
            notes += said_gaps(self.gaps, self.first_gap, self.longest, sample_time)
        notes += said_lonely(self.rows - sum(b - a for (a, b), _ in ranges))
        return Survey(
            sample_time,
            tuple(r for r, _ in ranges),
            tuple(t for _, t in ranges),
            tuple(notes),
        )


def survey(
    stamps: Iterable[np.ndarray], *, source: str, largest_gap: float = 1.75, first_row: int = 1
) -> Survey:
    """Finds the uniform stretches behind time stamps, which are never held together.

    Like `clock`, except that what is typical is taken from the first part, and that rows are
    neither moved nor removed.

    Args:
        stamps: Finite times of the rows, consecutive parts [s].
        source: Name of the log, for messages.
        largest_gap: Longest pause that is no gap, in sample times.
        first_row: Number of the first row, as its file counts.

    Raises:
        NeedsMemory: If rows would have to be moved or removed.
        InputError: If time runs backwards, or stands still.
    """
    surveyor = None
    for part in stamps:
        if surveyor is None:
            surveyor = _Surveyor(part, source, largest_gap, first_row)
        surveyor.add(part)
    if surveyor is None:
        raise InputError(f"`{source}` has no rows: is the log cut?")
    return surveyor.found()
