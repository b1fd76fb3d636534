"""Time stamps of a log: the uniform grid behind them, gaps, repeated rows and jitter."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from jaxid.errors import InputError

JITTER = 0.05
"""Largest deviation of stamps from a uniform grid, in sample times, that is ignored."""
REPEATED = 0.1
"""Distance of two stamps, in sample times, up to which their rows are one sample, logged twice."""
FEWEST = 10
"""Smallest number of samples that can be filtered."""


class NeedsMemory(InputError):  # noqa: N818 (the name says what to do)
    """A log that can be read only as a whole; the message gives the reason."""


@dataclasses.dataclass(frozen=True)
class TimeGrid:
    """Uniform stretches of a log.

    Attributes:
        sample_time: Time between two samples [s].
        ranges: Half-open ranges of rows without gaps.
        start_times: Time of the first row of each range, from the log's first row on [s].
        notes: Remarks, as sentences.
        deviation: Largest deviation of the stamps from the grid [s].
        jitter: RMS deviation of the steps from the sample time [s].
    """

    sample_time: float
    ranges: tuple[tuple[int, int], ...]
    start_times: tuple[float, ...]
    notes: tuple[str, ...] = ()
    deviation: float = 0.0
    jitter: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Whether the rows lie on the grid as they are."""
        return self.deviation <= JITTER * self.sample_time

    def cropped(self, start: float, stop: float, name: str) -> "TimeGrid":
        """Return the part from `start` [s] on and before `stop` [s].

        Raises:
            InputError: If fewer than ten rows are left.
        """
        dt = self.sample_time
        ranges, times = [], []
        for (a, b), t in zip(self.ranges, self.start_times, strict=True):
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
                f"{FEWEST} are needed: it lasts from {self.start_times[0]:g} s to "
                f"{self.start_times[-1] + (b - a - 1) * dt:g} s."
            )
        return dataclasses.replace(self, ranges=tuple(ranges), start_times=tuple(times))


def uniform_grid(rows: int, sample_time: float) -> TimeGrid:
    """Return the grid of rows that are equally far apart."""
    return TimeGrid(sample_time, ((0, rows),), (0.0,))


def find_grid(
    read: Callable[[], Iterable[np.ndarray]],
    *,
    source: str,
    largest_gap: float = 1.75,
    first_row: int = 1,
    in_parts: bool = False,
) -> TimeGrid:
    """Find the uniform grid behind time stamps.

    The typical step is that of the first part.

    Args:
        read: Function that yields the finite stamps of the rows in consecutive parts [s]; it is
            called three times.
        source: Name of the log, for messages.
        largest_gap: Longest pause that is bridged by interpolation, in sample times.
        first_row: Number of the first row in its file, for messages.
        in_parts: Whether the log is too large to move or remove rows.

    Raises:
        NeedsMemory: If rows of a log in parts must be moved or removed.
        InputError: If time runs backwards, or does not advance.
    """
    origin, typical, spread = _typical_step(read, source)
    # A gap is a pause that neither the limit nor the usual jitter explains.
    limit = max(largest_gap * typical, typical + 8.0 * spread)
    starts, start_times = [0], [0.0]
    before_gaps, pauses = [], []
    rows, total, count = 0, 0.0, 0
    for t, row in _linked(read(), origin):
        steps = np.diff(t)
        _require_forward(t + origin, steps, row + first_row, source)
        repeated = np.flatnonzero(steps <= REPEATED * typical)
        if in_parts and repeated.size:
            raise NeedsMemory(
                f"rows of `{source}` repeat the time stamp of the row before, first at row "
                f"{row + int(repeated[0]) + 1 + first_row}: remove them, or give `sample_time` if "
                "every row is a sample."
            )
        gaps = np.flatnonzero(steps > limit)
        starts += (row + gaps + 1).tolist()
        start_times += t[gaps + 1].tolist()
        before_gaps += t[gaps].tolist()
        pauses += steps[gaps].tolist()
        regular = steps[steps < 1.5 * typical + 8.0 * spread]
        total, count = total + float(regular.sum()), count + len(regular)
        rows = row + len(t)
    sample_time = _rounded(total / count, rows)
    lengths = np.diff([*starts, rows])
    kept = lengths >= 4
    if not kept.any():
        raise InputError(
            f"`{source}` has no four rows in sequence: its time stamps are {typical:.6g} s apart "
            f"at the median, with {len(pauses)} gaps; check `time_unit`, or give `sample_time`."
        )
    deviation, jitter = _deviation(_linked(read(), origin), starts, start_times, kept, sample_time)
    grid = TimeGrid(
        sample_time,
        tuple((a, a + int(n)) for a, n, keep in zip(starts, lengths, kept, strict=True) if keep),
        tuple(t for t, keep in zip(start_times, kept, strict=True) if keep),
        _notes(origin, before_gaps, pauses, int(lengths[~kept].sum()), sample_time),
        deviation,
        jitter,
    )
    if in_parts and not grid.is_exact:
        raise NeedsMemory(
            f"time stamps of `{source}` leave a uniform grid of {sample_time:.6g} s by "
            f"{deviation:.6g} s: give `sample_time` if the robot samples uniformly and only the "
            "stamps are late."
        )
    return grid


def _typical_step(
    read: Callable[[], Iterable[np.ndarray]], source: str
) -> tuple[float, float, float]:
    """Return the first stamp, and median and spread of the steps of the first part."""
    first = next(iter(read()), np.zeros(0))
    steps = np.diff(first)
    steps = steps[steps > 0]
    if not steps.size:
        raise InputError(f"time of `{source}` stands still: check the column of time stamps.")
    typical = float(np.median(steps))
    return float(first[0]), typical, 1.4826 * float(np.median(np.abs(steps - typical)))


def _linked(parts: Iterable[np.ndarray], origin: float) -> Iterable[tuple[np.ndarray, int]]:
    """Yield the times of each part behind the last one before it, and the row of the first."""
    last, row = np.zeros(0), 0
    for part in parts:
        t = np.concatenate([last, part - origin])
        yield t, row
        last, row = t[-1:], row + len(t) - 1


def _require_forward(stamps: np.ndarray, steps: np.ndarray, row: int, source: str) -> None:
    back = np.flatnonzero(steps < 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"time of `{source}` runs backwards from {stamps[i]:.9g} s to {stamps[i + 1]:.9g} s at "
            f"row {row + i + 1}: sort the log, or split it where the clock was set back."
        )


def _rounded(sample_time: float, rows: int) -> float:
    """Return a round sample time if it fits the stamps, which are rounded numbers, as well."""
    short = float(f"{sample_time:.6g}")
    return short if abs(short - sample_time) * rows < 0.01 * sample_time else sample_time


def _deviation(
    parts: Iterable[tuple[np.ndarray, int]],
    starts: Sequence[int],
    start_times: Sequence[float],
    kept: np.ndarray,
    sample_time: float,
) -> tuple[float, float]:
    """Return the largest deviation from the grid, and the RMS deviation of the steps."""
    first_rows, first_times = np.array(starts), np.array(start_times)
    largest, square, count = 0.0, 0.0, 0
    for t, row in parts:
        rows = row + np.arange(len(t))
        number = np.searchsorted(first_rows, rows, "right") - 1
        off = t - first_times[number] - sample_time * (rows - first_rows[number])
        largest = max(largest, float(np.abs(off[kept[number]]).max(initial=0.0)))
        inside = (number[1:] == number[:-1]) & kept[number[1:]]
        steps = np.diff(t)[inside] - sample_time
        square, count = square + float(np.sum(steps**2)), count + len(steps)
    return largest, float(np.sqrt(square / max(count, 1)))


def _notes(
    origin: float,
    before_gaps: Sequence[float],
    pauses: Sequence[float],
    lost: int,
    sample_time: float,
) -> tuple[str, ...]:
    notes = []
    if origin != 0:
        notes.append(f"time counts from the first row, which was stamped {origin:.9g} s")
    if pauses:
        notes.append(
            f"{len(pauses)} gap{'s' if len(pauses) > 1 else ''} in time, the first after "
            f"{before_gaps[0]:.6g} s, the longest of {max(pauses):.6g} s (sample time "
            f"{sample_time:.6g} s), split the log into segments; a `largest_gap` above "
            f"{max(pauses) / sample_time:.3g} would bridge them"
        )
    if lost:
        notes.append(f"{lost} rows between gaps are too few for a segment and were left out")
    return tuple(notes)


@dataclasses.dataclass(frozen=True)
class Resampler:
    """Resampling of the rows of a log in memory to the grid behind their stamps.

    Attributes:
        kept: Rows that are used; repeated ones are not.
        stamps: Times of these rows, from the first on [s].
        grid: Grid behind these stamps.
        notes: Remarks, as sentences.
    """

    kept: np.ndarray
    stamps: np.ndarray
    grid: TimeGrid
    notes: tuple[str, ...] = ()

    @property
    def times(self) -> list[np.ndarray]:
        """Times of the samples of each segment [s]."""
        dt, grid = self.grid.sample_time, self.grid
        times = []
        for (a, b), start in zip(grid.ranges, grid.start_times, strict=True):
            count = b - a
            if not grid.is_exact:
                count = int(np.floor((self.stamps[b - 1] - self.stamps[a]) / dt + 1e-3)) + 1
            times.append(start + dt * np.arange(count))
        return times

    @property
    def segments(self) -> tuple[tuple[int, int], ...]:
        """Half-open ranges of samples without gaps."""
        ends = itertools.accumulate((len(t) for t in self.times), initial=0)
        return tuple(itertools.pairwise(ends))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return a channel at the samples: as it is, or interpolated by cubic splines."""
        x = x[self.kept]
        if self.grid.is_exact:
            return np.concatenate([x[a:b] for a, b in self.grid.ranges])
        parts = [
            CubicSpline(self.stamps[a:b], x[a:b])(t)
            for (a, b), t in zip(self.grid.ranges, self.times, strict=True)
        ]
        return np.concatenate(parts)


def resampler(
    stamps: np.ndarray, *, source: str, largest_gap: float = 1.75, first_row: int = 1
) -> Resampler:
    """Return the resampling to the uniform grid behind time stamps.

    Args:
        stamps: Finite times of the rows [s].
        source: Name of the log, for messages.
        largest_gap: Longest pause that is bridged by interpolation, in sample times.
        first_row: Number of the first row in its file, for messages.

    Raises:
        InputError: If time runs backwards, or does not advance.
    """
    _require_forward(stamps, np.diff(stamps), first_row, source)
    kept = np.flatnonzero(np.diff(stamps, prepend=-np.inf) > 0)
    if len(kept) > 1:
        steps = np.diff(stamps[kept])
        kept = kept[np.append(True, steps > REPEATED * float(np.median(steps)))]
    parts = [stamps[kept]]
    grid = find_grid(lambda: parts, source=source, largest_gap=largest_gap, first_row=first_row)
    notes = list(grid.notes)
    removed = len(stamps) - len(kept)
    if removed:
        notes.insert(
            0,
            f"{removed} of {len(stamps)} rows repeat the time stamp of the row before and were "
            "removed; if every row is a sample, give `sample_time` instead of the time stamps",
        )
    if not grid.is_exact:
        dt = grid.sample_time
        notes.append(
            f"time stamps jitter by {100 * grid.jitter / dt:.1f} % of the sample time (RMS): "
            f"resampled to a uniform grid of {dt:.6g} s by cubic splines; if the robot "
            "samples uniformly and only the stamps are late, give `sample_time` instead"
        )
    return Resampler(kept, stamps[kept] - stamps[0], grid, tuple(notes))
