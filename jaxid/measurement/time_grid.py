"""The uniform grid behind a log's time stamps, its gaps, and resampling onto it."""

import itertools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.errors import InputError

from .time_stamps import burst_length, even_stamps, stamp_order

MAX_JITTER = 0.05
"""Largest deviation of stamps from a uniform grid, in sample times, that is ignored."""
MIN_STEP = 0.1
"""Distance of two stamps, in sample times, up to which one sample was logged twice."""
MIN_SEGMENT = 4
"""Smallest number of rows without a gap that can be a segment."""
MIN_LIKELY_SAMPLE_TIME = 5e-5
"""Sample time below which the unit of the time is likely to be wrong [s]."""
MIN_ROWS = 4
"""Smallest number of rows for which a segment is used."""
MIN_FILTERED = 5
"""Smallest number of samples of a segment: differences of fourth order need them."""
MIN_SAMPLES = 10
"""Smallest number of samples that can be filtered."""


Range = tuple[int, int]
"""A half-open range of rows or samples."""
Ranges = tuple[Range, ...]
"""Ranges between gaps."""
Pauses = tuple[float, float]
"""Pauses that are bridged: in sample times, and in seconds."""


class NeedsMemory(InputError):  # noqa: N818 (the name says what to do)
    """A log that can be read only as a whole; the message gives the reason."""


class TimeGrid(NamedTuple):
    """Uniform stretches of a log.

    The `segments` are half-open ranges of rows and their start times [s]; the
    `deviation` is the largest one of the stamps from the grid [s].
    """

    sample_time: float
    segments: dict[Range, float]
    notes: Texts = ()
    deviation: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Whether the rows lie on the grid as they are."""
        return self.deviation <= MAX_JITTER * self.sample_time

    @property
    def cure_of_short_segments(self) -> str:
        """Advice for a log whose segments are all too short for a filter."""
        if self.sample_time < MIN_LIKELY_SAMPLE_TIME:
            return "check `time_unit`, or give `sample_time`"
        gap_notes = [note for note in self.notes if "largest_gap" in note]
        cause = f"{gap_notes[0]};" if gap_notes else "record longer,"
        return f"{cause} lower `margin`, or leave this log out"

    def cropped(self, start: float, stop: float, name: str) -> "TimeGrid":
        """Return the part from `start` [s] on and before `stop` [s]."""
        dt = self.sample_time
        segments = {}
        for (a, b), t in self.segments.items():
            times = np.array([start, stop])
            steps = (times - t) / dt
            # A time on the grid counts as such in spite of rounding.
            samples_before = np.ceil(steps - 1e-6)
            bounds = np.clip(samples_before, 0, b - a)
            first_sample, end_sample = bounds.astype(int).tolist()
            if first_sample < end_sample:
                segments[a + first_sample, a + end_sample] = t + first_sample * dt
        samples = sum(b - a for a, b in segments)
        if samples < MIN_SAMPLES:
            times = [*self.segments.values()]
            a, b = [*self.segments][-1]
            end = times[-1] + (b - a - 1) * dt
            raise InputError(
                f"`{name}` has {samples} samples from {start:g} s to {stop:g} s, but "
                f"at least {MIN_SAMPLES} are needed: it lasts from {times[0]:g} s to "
                f"{end:g} s."
            )
        return self._replace(segments=segments)


def usable_segments(grid: TimeGrid, edge: int, factor: int, name: str) -> TimeGrid:
    """Return the segments that are long enough for a filter with edges, and rows."""
    row_samples = (MIN_ROWS - 1) * factor + 1
    min_samples = max(2 * edge + row_samples, MIN_FILTERED)
    segments = {
        (a, b): t for (a, b), t in grid.segments.items() if b - a >= min_samples
    }
    if not segments:
        samples = max(b - a for a, b in grid.segments)
        raise InputError(
            f"the longest segment of `{name}` has {samples} samples at "
            f"{1 / grid.sample_time:.6g} Hz, but the filter removes {edge} at each "
            f"end, and {MIN_ROWS * factor} more are needed: "
            f"{grid.cure_of_short_segments}."
        )
    notes = grid.notes
    lost_segments = len(grid.segments) - len(segments)
    if lost_segments:
        note = (
            f"{lost_segments} segment(s), shorter than the filter's edges, were left "
            "out"
        )
        notes = (*notes, note)
    return TimeGrid(grid.sample_time, segments, notes)


class StepStatistics(NamedTuple):
    """Time from one row to the next, as the first part of a log has it [s]."""

    origin: float  # first stamp
    median: float
    max_regular: float  # longest step at which no row is missing
    max_pause: float  # longest pause that is no gap


class Stretches(NamedTuple):
    """Stretches of rows between gaps."""

    starts: list[int]  # first row of each
    start_times: list[float]  # [s]
    pauses: list[float]  # gaps between them [s]
    rows: int  # number of rows of the log
    sample_time: float  # mean step without missing rows [s]

    @property
    def segments(self) -> dict[Range, float]:
        """Ranges of rows that are long enough, and their start times [s]."""
        ranges = itertools.pairwise([*self.starts, self.rows])
        segments = zip(ranges, self.start_times, strict=True)
        return {(a, b): t for (a, b), t in segments if b - a >= MIN_SEGMENT}


def find_grid(
    read: Callable[[], Iterable[Vector]],
    source: str,
    limits: Pauses,
    first_row: int,
    in_parts: bool = False,
) -> TimeGrid:
    """Find the uniform grid behind time stamps, whose typical step is the first part's.

    `read` yields the finite stamps [s] in parts, each of which begins with the last
    stamp of the part before, and is called three times; `limits` are the pauses that
    are bridged, in sample times and in seconds. Where `in_parts`, the log is too large
    to move or remove rows.
    """
    first_part = next(iter(read()))
    if in_parts and burst_length(first_part):
        raise NeedsMemory(
            f"rows of `{source}` were received in bursts: give `sample_time`."
        )
    statistics = _step_statistics(first_part, source, limits)
    stretches = _find_stretches(read(), source, statistics, first_row, in_parts)
    sample_time = _round_time(stretches.sample_time, stretches.rows)
    segments = stretches.segments
    if not segments:
        raise InputError(
            f"`{source}` has no four rows in sequence without a gap: its time stamps "
            f"are {statistics.median:.6g} s apart at the median, with "
            f"{len(stretches.pauses)} gaps; check `time_unit`, or give `sample_time`."
        )
    grid = TimeGrid(sample_time, segments)
    deviation = _deviation(grid, read(), statistics.origin)
    notes = _gap_notes(grid, stretches, statistics.origin)
    grid = TimeGrid(sample_time, segments, notes, deviation)
    if in_parts and not grid.is_exact:
        raise NeedsMemory(
            f"time stamps of `{source}` deviate from a uniform grid of "
            f"{sample_time:.6g} s by {deviation:.6g} s: give `sample_time` if "
            "only the stamps are late."
        )
    return grid


def _step_statistics(stamps: Vector, source: str, limits: Pauses) -> StepStatistics:
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not steps.size:
        raise InputError(
            f"the time of `{source}` does not advance: name another column of time "
            "stamps, or give `sample_time`."
        )
    median = float(np.median(steps))
    absolute_deviation = float(np.median(np.abs(steps - median)))
    jitter = 8.0 * (1.4826 * absolute_deviation)  # eight standard deviations
    # A gap is a pause that neither the limits nor the jitter explain.
    max_pause = max(limits[0] * median, limits[1], median + jitter)
    return StepStatistics(float(stamps[0]), median, 1.5 * median + jitter, max_pause)


def _find_stretches(
    parts: Iterable[Vector],
    source: str,
    statistics: StepStatistics,
    first_row: int,
    in_parts: bool,
) -> Stretches:
    """Return the stretches between gaps, and refuse time that runs backwards."""
    starts = [0]
    start_times = [0.0]
    pauses = []
    row = 0
    regular_time = 0.0
    regular_steps = 0
    for stamps in parts:
        t = stamps - statistics.origin
        steps = np.diff(t)
        _require_forward(stamps, steps, row + first_row, source)
        repeated_rows = np.flatnonzero(steps <= MIN_STEP * statistics.median)
        if in_parts and repeated_rows.size:
            number = row + int(repeated_rows[0]) + 1 + first_row
            raise NeedsMemory(
                f"rows of `{source}` repeat the time stamp of the row before, first "
                f"at row {number}: remove them, or give `sample_time`."
            )
        gaps = np.flatnonzero(steps > statistics.max_pause)
        starts += (row + gaps + 1).tolist()
        start_times += t[gaps + 1].tolist()
        pauses += steps[gaps].tolist()
        regular_gaps = steps[steps < statistics.max_regular]
        regular_time += float(regular_gaps.sum())
        regular_steps += len(regular_gaps)
        row += len(steps)
    sample_time = regular_time / regular_steps
    return Stretches(starts, start_times, pauses, row + 1, sample_time)


def _round_time(sample_time: float, rows: int) -> float:
    """Return a round sample time if it fits stamps (rounded numbers) as well."""
    round_time = float(f"{sample_time:.6g}")
    shift = abs(round_time - sample_time) * rows
    return round_time if shift < 0.01 * sample_time else sample_time


def _gap_notes(grid: TimeGrid, stretches: Stretches, origin: float) -> Texts:
    """Return remarks about the start, the gaps and the rows between them."""
    notes = []
    pauses = stretches.pauses
    if origin != 0:
        notes.append(
            f"time starts at zero at the first row, whose stamp was {origin:.9g} s"
        )
    if pauses:
        first_gap = stretches.start_times[1] - pauses[0]
        longest_pause = max(pauses)
        plural = "s" if len(pauses) > 1 else ""
        notes.append(
            f"{len(pauses)} gap{plural} in time, the first after {first_gap:.6g} s, "
            f"the longest of {longest_pause:.6g} s (sample time {grid.sample_time:.6g} "
            "s), split the log into segments; a `largest_gap` above "
            f"{longest_pause / grid.sample_time:.3g} would interpolate them"
        )
    lost_rows = stretches.rows - sum(b - a for a, b in grid.segments)
    if lost_rows:
        notes.append(
            f"{lost_rows} rows between gaps are too few for a segment and were left out"
        )
    return tuple(notes)


def _require_forward(stamps: Vector, steps: Vector, row: int, source: str) -> None:
    backward_steps = np.flatnonzero(steps < 0)
    if backward_steps.size:
        i = int(backward_steps[0])
        raise NeedsMemory(
            f"the time of `{source}` runs backwards from {stamps[i]:.9g} s to "
            f"{stamps[i + 1]:.9g} s at row {row + i + 1}: sort the log, or split it "
            "where the clock was set back."
        )


def _deviation(grid: TimeGrid, parts: Iterable[Vector], origin: float) -> float:
    """Return the largest deviation of stamps from the grid [s]."""
    starts, ends = np.transpose([*grid.segments])
    start_times = np.array([*grid.segments.values()])
    first_row = 0
    deviation = 0.0
    for stamps in parts:
        rows = first_row + np.arange(len(stamps))
        segment = np.searchsorted(starts, rows, "right") - 1
        segment = np.maximum(segment, 0)
        rows_before = rows - starts[segment]
        grid_times = start_times[segment] + grid.sample_time * rows_before
        is_inside = (rows_before >= 0) & (rows < ends[segment])
        deviations = np.abs(stamps - origin - grid_times)[is_inside]
        deviation = max(deviation, float(deviations.max(initial=0.0)))
        first_row += len(stamps) - 1
    return deviation


class Resampling(NamedTuple):
    """Way of the rows of a log onto the uniform grid behind their time stamps."""

    rows: np.ndarray  # rows that count: repeated ones do not
    stamps: Vector  # their times from the first row on [s]
    grid: TimeGrid
    times: list[Vector]  # times of each segment's samples [s]

    def __call__(self, x: Matrix) -> Matrix:
        """Return the samples of a channel: its rows, or values of cubic splines."""
        x = x[self.rows]
        segments = []
        for (a, b), times in zip(self.grid.segments, self.times, strict=True):
            if self.grid.is_exact:
                segments.append(x[a:b])
            else:
                spline = scipy.interpolate.CubicSpline(self.stamps[a:b], x[a:b])
                segments.append(spline(times))
        return np.concatenate(segments)


def resampling(
    stamps: Vector, source: str, limits: Pauses, first_row: int
) -> Resampling:
    """Find the way of rows onto the uniform grid behind their time stamps [s]."""
    order, order_notes = stamp_order(stamps, source, first_row)
    stamps, burst_notes = even_stamps(stamps[order], source)
    distinct_rows = _distinct_rows(stamps)
    rows = order[distinct_rows]
    distinct_stamps = stamps[distinct_rows]
    grid = find_grid(lambda: [distinct_stamps], source, limits, first_row)
    t = distinct_stamps - stamps[0]
    times = []
    missing_samples = 0
    for (a, b), start_time in grid.segments.items():
        count = b - a
        if not grid.is_exact:
            count = int((t[b - 1] - t[a]) / grid.sample_time + 1e-3) + 1
        missing_samples += count - (b - a)
        times.append(start_time + grid.sample_time * np.arange(count))

    notes = [*order_notes, *burst_notes, *grid.notes]
    repeated_rows = len(stamps) - len(rows)
    if repeated_rows:
        note = (
            f"{repeated_rows} of {len(stamps)} rows repeat the time stamp of the row "
            "before and were removed; if every row is a sample, give `sample_time` "
            "instead of the time stamps"
        )
        notes.insert(0, note)
    if not grid.is_exact:
        notes.append(_interpolation_note(t, grid, missing_samples))
    return Resampling(rows, t, grid._replace(notes=tuple(notes)), times)


def _distinct_rows(stamps: Vector) -> np.ndarray:
    """Return the rows that do not repeat the stamp of the row before."""
    rows = np.flatnonzero(np.diff(stamps, prepend=-np.inf) > 0)
    if len(rows) == 1:
        return rows
    steps = np.diff(stamps[rows])
    is_distinct = steps > MIN_STEP * float(np.median(steps))
    return rows[np.append(True, is_distinct)]


def _interpolation_note(t: Vector, grid: TimeGrid, missing_samples: int) -> str:
    """Return why the samples had to be interpolated: missing ones, or jitter."""
    dt = grid.sample_time
    steps = np.diff(t) / dt
    if np.abs(steps - np.round(steps)).max() <= MAX_JITTER:
        verb = "s were" if missing_samples > 1 else " was"
        return f"{missing_samples} missing sample{verb} interpolated by cubic splines"
    return (
        f"time stamps jitter by up to {100 * grid.deviation / dt:.1f} % of the sample "
        f"time: resampled to a uniform grid of {dt:.6g} s by cubic splines; if the "
        "robot samples uniformly and only the stamps are late, give `sample_time` "
        "instead"
    )
