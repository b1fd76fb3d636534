"""From time stamps as loggers write them to a uniform grid with gaps."""

import dataclasses
import itertools

import numpy as np
from scipy.interpolate import CubicSpline

from jaxid.errors import InputError

JITTER = 0.05
"""Stamps may leave the uniform grid by this part of the sample time before samples are moved."""
TWINS = 0.1
"""Stamps closer than this part of the sample time are of one sample, logged twice."""


@dataclasses.dataclass(frozen=True)
class Clock:
    """How the rows of a log become uniform samples.

    Attributes:
        kept: Rows that are used (not logged twice).
        stamps: Their times, from the first on [s].
        sample_time: Of the uniform grid [s].
        ranges: Rows (of those kept) between two gaps, half open.
        exact: Whether the rows already lie on the grid; otherwise they are interpolated.
        notes: What was seen, in sentences.
    """

    kept: np.ndarray
    stamps: np.ndarray
    sample_time: float
    ranges: tuple[tuple[int, int], ...]
    exact: bool
    notes: tuple[str, ...]

    def counts(self) -> tuple[int, ...]:
        """Samples on the grid between two gaps."""
        return tuple(
            int(np.floor((self.stamps[b - 1] - self.stamps[a]) / self.sample_time + 1e-3)) + 1
            if not self.exact
            else b - a
            for a, b in self.ranges
        )

    def grid(self) -> np.ndarray:
        """Times on the grid, without gaps' [s]."""
        return np.concatenate(
            [
                self.stamps[a] + self.sample_time * np.arange(count)
                for (a, _), count in zip(self.ranges, self.counts(), strict=True)
            ]
        )

    def segments(self) -> tuple[tuple[int, int], ...]:
        """Ranges of the grid without gaps."""
        ends = np.cumsum((0, *self.counts()))
        return tuple((int(a), int(b)) for a, b in itertools.pairwise(ends))

    def resample(self, x: np.ndarray) -> np.ndarray:
        """The rows of a log on the grid: as they are, or by a cubic spline."""
        x = x[self.kept]
        if self.exact:
            return np.concatenate([x[a:b] for a, b in self.ranges])
        parts = []
        for (a, b), count in zip(self.ranges, self.counts(), strict=True):
            t = self.stamps[a] + self.sample_time * np.arange(count)
            parts.append(CubicSpline(self.stamps[a:b], x[a:b])(t))
        return np.concatenate(parts)


def clock(
    stamps: np.ndarray, *, source: str, largest_gap: float = 1.75, first_row: int = 1
) -> Clock:
    """Finds the uniform grid behind time stamps.

    Args:
        stamps: Finite times of the rows [s].
        source: Name of the log, for messages.
        largest_gap: Longest pause that is bridged by interpolation, in sample times.
        first_row: Number of the first row, as its file counts.

    Raises:
        InputError: If time runs backwards, or stands still.
    """
    notes = []
    back = np.flatnonzero(np.diff(stamps) < 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"time of `{source}` runs backwards from {stamps[i]:.9g} s to {stamps[i + 1]:.9g} s at "
            f"row {i + 1 + first_row}: sort the log, or split it where the clock was set back."
        )
    kept = np.flatnonzero(np.concatenate([[True], np.diff(stamps) > 0]))
    if len(kept) > 1:
        typical = float(np.median(np.diff(stamps[kept])))
        near = np.concatenate([[True], np.diff(stamps[kept]) > TWINS * typical])
        kept = kept[near]
    if len(kept) < 2:
        raise InputError(f"time of `{source}` stands still: check the column of time stamps.")
    twins = len(stamps) - len(kept)
    if twins:
        notes.append(
            f"{twins} of {len(stamps)} rows repeat the time stamp of the row before and were "
            "removed; if every row is a sample, give `sample_time` instead of the time stamps"
        )
    notes += said_start(stamps[0])
    t = stamps[kept] - stamps[0]
    steps = np.diff(t)
    typical = float(np.median(steps))
    spread = 1.4826 * float(np.median(np.abs(steps - typical)))
    # A gap is a pause that neither the limit nor the usual jitter explains.
    gaps = np.flatnonzero(steps > max(largest_gap * typical, typical + 8.0 * spread))
    regular = steps[steps < 1.5 * typical + 8.0 * spread]
    sample_time = rounded(float(regular.mean()), len(t))
    edges = [0, *(int(g) + 1 for g in gaps), len(t)]
    ranges = [(a, b) for a, b in itertools.pairwise(edges) if b - a >= 4]
    lonely = len(t) - sum(b - a for a, b in ranges)
    if not ranges:
        raise InputError(
            f"`{source}` has no four rows in sequence: its time stamps are {typical:.6g} s apart "
            f"at the median, with {len(gaps)} gaps; check `time_unit`, or give `sample_time`."
        )
    if gaps.size:
        notes += said_gaps(len(gaps), t[gaps[0]], float(steps[gaps].max()), sample_time)
    notes += said_lonely(lonely)
    uneven = max(np.abs(t[a:b] - t[a] - sample_time * np.arange(b - a)).max() for a, b in ranges)
    exact = bool(uneven <= JITTER * sample_time)
    if not exact:
        off = [steps[a : b - 1] - sample_time for a, b in ranges]
        rms = float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
        notes.append(
            f"time stamps jitter by {100 * rms / sample_time:.1f} % of the sample time (RMS): "
            f"resampled to a uniform grid of {sample_time:.6g} s by cubic splines; if the robot "
            "samples uniformly and only the stamps are late, give `sample_time` instead"
        )
    return Clock(kept, t, sample_time, tuple(ranges), exact, tuple(notes))


def rounded(sample_time: float, rows: int) -> float:
    """A sample time, without what the rounding of stamps has left in it.

    Stamps are rounded numbers: a round sample time that fits them as well is the true one.
    """
    short = float(f"{sample_time:.6g}")
    return short if abs(short - sample_time) * rows < 0.01 * sample_time else sample_time


def said_start(stamp: float) -> list[str]:
    """What became of the first stamp."""
    if stamp == 0:
        return []
    return [f"time counts from the first row, which was stamped {stamp:.9g} s"]


def said_gaps(count: int, first: float, longest: float, sample_time: float) -> list[str]:
    """That there are gaps."""
    return [
        f"{count} gap{'s' if count > 1 else ''} in time, the first after {first:.6g} s, the "
        f"longest of {longest:.6g} s (sample time {sample_time:.6g} s), split the log into "
        f"segments; a `largest_gap` above {longest / sample_time:.3g} would bridge them"
    ]


def said_lonely(rows: int) -> list[str]:
    """That rows between gaps are lost."""
    if not rows:
        return []
    return [f"{rows} rows between gaps are too few for a segment and were left out"]


def uniform(samples: int, sample_time: float) -> Clock:
    """The clock of rows that are equally far apart."""
    return Clock(
        np.arange(samples),
        sample_time * np.arange(samples),
        sample_time,
        ((0, samples),),
        True,
        (),
    )
