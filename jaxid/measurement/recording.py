"""Recordings: uniform samples of angles and forces of one experiment, in SI units."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

JITTER = 0.05
"""Largest deviation of stamps from a uniform grid, in sample times, that is ignored."""
REPEATED = 0.1
"""Distance of two stamps, in sample times, up to which their rows are one sample, logged twice."""
MAX_NUMBER = 1e30
"""Largest number in a log, in any unit: its square still is finite."""
MIN_SAMPLES = 10
"""Smallest number of samples that can be filtered."""


class NeedsMemory(InputError):  # noqa: N818 (the name says what to do)
    """A log that can be read only as a whole; the message gives the reason."""


class Recording(eqx.Module):
    """Log of one experiment: in SI units, uniform in time between gaps.

    Attributes:
        time: Times of the samples, uniform within each segment [s].
        angles: Angles of joints or motors, as the robot reported them, unfiltered [rad
            or m].
        forces: Forces of joints or motors [N m or N].
        velocities: Measured velocities, on the angles' side [rad/s or m/s]; None if not
            measured.
        angles_on_motor_side: Whether angles and velocities are the motors'.
        forces_on_motor_side: Whether forces are the motors'.
        segments: Half-open ranges of samples without gaps.
        sample_time: Time between two samples [s].
        name: Name of the log.
        notes: Changes between the file and these samples, as sentences.
    """

    time: Float[AnyArray, " samples"]
    angles: Float[AnyArray, "samples joints"]
    forces: Float[AnyArray, "samples joints"]
    velocities: Float[AnyArray, "samples joints"] | None
    angles_on_motor_side: bool = eqx.field(static=True)
    forces_on_motor_side: bool = eqx.field(static=True)
    segments: tuple[tuple[int, int], ...] = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="recording")
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        angles: ArrayLike,
        forces: ArrayLike,
        *,
        velocities: ArrayLike | None = None,
        time: ArrayLike | None = None,
        sample_time: float | int | None = None,
        angles_on_motor_side: bool = False,
        forces_on_motor_side: bool = False,
        largest_gap: float | int = 1.75,
        bridged: float = 0.0,
        name: str = "recording",
        first_row: int = 1,
    ) -> "Recording":
        """Make a recording of arrays (samples x joints) in SI units, and check them.

        Repeated stamps are removed, uneven ones are interpolated on a uniform grid, and
        gaps split the recording into segments; `notes` says what was done.

        Args:
            angles: Angles of joints or motors [rad or m].
            forces: Forces of joints or motors [N m or N].
            velocities: Measured velocities [rad/s or m/s].
            time: Time stamps [s]; either they or `sample_time`.
            sample_time: Time between two samples [s].
            angles_on_motor_side: Whether angles and velocities are the motors'.
            forces_on_motor_side: Whether forces are the motors'.
            largest_gap: Longest pause that is bridged by interpolation, in sample
                times.
            bridged: Pause that is bridged in any case [s].
            name: Name of the log.
            first_row: Number of the first row in its file, for messages.

        Raises:
            InputError: If shapes differ, a value is not finite, time runs backwards or
                does not advance, or there are fewer than ten samples.
        """
        if not largest_gap > 1.0:
            raise InputError(
                f"`largest_gap` must be above 1 sample time, but is {largest_gap:g}."
            )
        channels = {"angles": angles, "forces": forces, "velocities": velocities}
        shape = np.shape(angles)
        data: dict[str, Any] = {
            key: None if x is None else finite_channel(name, key, x, shape, first_row)
            for key, x in channels.items()
        }
        samples = len(data["angles"])
        if samples < MIN_SAMPLES:
            raise InputError(
                f"`{name}` has {samples} samples, but at least {MIN_SAMPLES} are needed: "
                "is the log cut?"
            )
        if (time is None) == (sample_time is None):
            raise InputError(
                "a recording needs either `time` or `sample_time`, and not both."
            )
        if time is not None:
            stamps = np.array(time, np.float64)
            if stamps.shape != (samples,) or not np.isfinite(stamps).all():
                raise InputError(
                    f"`time` of `{name}` must hold {samples} finite stamps, but has "
                    "shape "
                    f"{stamps.shape} or stamps that are not finite."
                )
            limits = largest_gap, bridged
            dt, times, added, resample = _resampling(stamps, name, limits, first_row)
            data = {key: None if x is None else resample(x) for key, x in data.items()}
        else:
            dt, added = positive_time(sample_time or 0.0), []
            times = [dt * np.arange(samples)]
        return cls(
            time=np.concatenate(times),
            **data,
            angles_on_motor_side=angles_on_motor_side,
            forces_on_motor_side=forces_on_motor_side,
            segments=consecutive(map(len, times)),
            sample_time=dt,
            name=name,
            notes=tuple(added),
        )

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.angles.shape[1]

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.time)

    @property
    def duration(self) -> float:
        """Recorded time without gaps [s]."""
        return self.samples * self.sample_time

    @property
    def grid(self) -> "TimeGrid":
        """Segments, their start times and notes."""
        starts = tuple(float(self.time[a]) for a, _ in self.segments)
        return TimeGrid(self.sample_time, self.segments, starts, self.notes)

    def crop(
        self, start: float | int = -np.inf, stop: float | int = np.inf
    ) -> "Recording":
        """Return the part from `start` [s] on and before `stop` [s], on the clock of `time`.

        Raises:
            InputError: If fewer than ten samples are left.
        """
        grid = self.grid.cropped(start, stop, self.name)
        return self._range(grid.ranges[0][0], grid.ranges[-1][1])

    def split(self, fraction: float) -> "tuple[Recording, Recording]":
        """Return the first fraction (0 to 1) of the recorded time, and the rest.

        Raises:
            InputError: If a part has fewer than ten samples.
        """
        cut = round(fraction * self.samples)
        if not MIN_SAMPLES <= cut <= self.samples - MIN_SAMPLES:
            raise InputError(
                f"`fraction` must leave at least {MIN_SAMPLES} samples on both sides, but "
                f"{fraction:g} "
                f"of the {self.samples} samples of `{self.name}` leaves {cut}."
            )
        return self._range(0, cut), self._range(cut, self.samples)

    def _range(self, a: int, b: int) -> "Recording":
        segments = ((max(i, a) - a, min(j, b) - a) for i, j in self.segments)
        kept = tuple((i, j) for i, j in segments if i < j)
        return dataclasses.replace(jax.tree.map(lambda x: x[a:b], self), segments=kept)


def finite_channel(
    name: str, key: str, value: ArrayLike, shape: tuple[int, ...], first_row: int
) -> np.ndarray:
    """Return a channel as finite real numbers."""
    array = np.array(value, np.float64)
    if array.ndim != 2 or array.shape != shape:
        raise InputError(
            f"`{key}` of `{name}` must have one row for each sample and one column "
            "for each "
            f"joint, like the angles with shape {shape}, but has shape {array.shape}."
        )
    bad = np.argwhere(~(np.abs(array) <= MAX_NUMBER))
    if bad.size:
        row, joint = (int(i) for i in bad[0])
        raise InputError(
            f"`{key}` of `{name}` must be finite and below {MAX_NUMBER:g}, but are "
            f"{array[row, joint]:.3g} for joint {joint + 1} at row {row + first_row}: "
            "check the "
            "unit, or repair or remove that row."
        )
    return array


def positive_time(sample_time: float) -> float:
    """Check and return the time between two samples [s]."""
    if not 0 < sample_time < np.inf:
        raise InputError(f"`sample_time` must be positive [s], but is {sample_time:g}.")
    return float(sample_time)


def consecutive(lengths: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Return half-open ranges of these lengths, one behind the other."""
    return tuple(itertools.pairwise(itertools.accumulate(lengths, initial=0)))


def remove_delay(recording: Recording, seconds: float) -> Recording:
    """Remove a delay of the forces, also by a fraction of a sample.

    The forces stay as they are; the angles, which are smooth, are interpolated by cubic
    splines to the instants at which the forces acted. Samples at the ends of segments
    for which there are no angles are dropped.

    Args:
        recording: Recording whose forces are delayed.
        seconds: Delay of the forces [s]; negative if they are early.

    Raises:
        InputError: If the delay is longer than the segments.
    """
    require_finite_delay(seconds)
    lost = math.ceil(abs(seconds) / recording.sample_time - 1e-9)
    early, late = (lost, 0) if seconds > 0 else (0, lost)
    whole = [(a, b) for a, b in recording.segments if b - a - lost >= MIN_SAMPLES]
    if not whole:
        raise InputError(
            f"the delay is {seconds:g} s, but the longest segment of "
            f"`{recording.name}` lasts "
            f"{max(b - a for a, b in recording.segments) * recording.sample_time:g} s."
        )
    kept = [np.arange(a + early, b - late) for a, b in whole]
    time = np.asarray(recording.time)

    def shift(values):
        parts = [
            CubicSpline(time[a:b], np.asarray(values)[a:b])(time[samples] - seconds)
            for (a, b), samples in zip(whole, kept, strict=True)
        ]
        return np.concatenate(parts)

    samples = np.concatenate(kept)
    return dataclasses.replace(
        recording,
        time=time[samples],
        angles=shift(recording.angles),
        forces=np.asarray(recording.forces)[samples],
        velocities=None
        if recording.velocities is None
        else shift(recording.velocities),
        segments=consecutive(map(len, kept)),
        notes=(
            *recording.notes,
            f"a delay of the forces of {1e3 * seconds:.4g} ms was removed",
        ),
    )


def require_finite_delay(seconds: float) -> None:
    """Refuse a delay that is infinite or not a number."""
    if not math.isfinite(seconds):
        raise InputError(f"the delay must be a finite time [s], but is {seconds:g}.")


class TimeGrid(NamedTuple):
    """Uniform stretches of a log: half-open ranges of rows, and the times at which they start [s].

    The `deviation` is the largest one of the stamps from the grid [s].
    """

    sample_time: float
    ranges: tuple[tuple[int, int], ...]
    start_times: tuple[float, ...] = (0.0,)
    notes: tuple[str, ...] = ()
    deviation: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Whether the rows lie on the grid as they are."""
        return self.deviation <= JITTER * self.sample_time

    def cropped(self, start: float, stop: float, name: str) -> "TimeGrid":
        """Return the part from `start` [s] on and before `stop` [s]."""
        dt = self.sample_time
        ranges, times = [], []
        for (a, b), t in zip(self.ranges, self.start_times, strict=True):
            limits = np.ceil((np.array([start, stop]) - t) / dt - 1e-6)
            low, high = (int(x) for x in np.clip(limits, 0, b - a))
            if low < high:
                ranges.append((a + low, a + high))
                times.append(t + low * dt)
        left = sum(b - a for a, b in ranges)
        if left < MIN_SAMPLES:
            a, b = self.ranges[-1]
            raise InputError(
                f"`{name}` has {left} samples from {start:g} s to {stop:g} s, but at "
                "least "
                f"{MIN_SAMPLES} are needed: it lasts from {self.start_times[0]:g} s to "
                f"{self.start_times[-1] + (b - a - 1) * dt:g} s."
            )
        return self._replace(ranges=tuple(ranges), start_times=tuple(times))


def find_grid(
    read: Callable[[], Iterable[np.ndarray]],
    source: str,
    limits: tuple[float, float],
    first_row: int,
    in_parts: bool = False,
) -> TimeGrid:
    """Find the uniform grid behind time stamps; the typical step is that of the first part.

    `read` yields the finite stamps [s] in consecutive parts, and is called three times;
    `limits` are the pauses that are bridged, in sample times and in seconds. Where
    `in_parts`, the log is too large to move or remove rows.
    """
    first = next(iter(read()), np.zeros(0))
    steps = np.diff(first)
    steps = steps[steps > 0]
    if not steps.size:
        raise InputError(
            f"time of `{source}` stands still: check the column of time stamps."
        )
    origin, typical = float(first[0]), float(np.median(steps))
    spread = 1.4826 * float(np.median(np.abs(steps - typical)))
    # A gap is a pause that neither the limit nor the usual jitter explains.
    limit = max(limits[0] * typical, limits[1], typical + 8.0 * spread)
    starts, start_times, pauses = [0], [0.0], []
    rows, total, count = 0, 0.0, 0
    for t, row in _linked(read(), origin):
        steps = np.diff(t)
        _require_forward(t + origin, steps, row + first_row, source)
        repeated = np.flatnonzero(steps <= REPEATED * typical)
        if in_parts and repeated.size:
            raise NeedsMemory(
                f"rows of `{source}` repeat the time stamp of the row before, first "
                "at row "
                f"{row + int(repeated[0]) + 1 + first_row}: remove them, or give "
                "`sample_time`."
            )
        gaps = np.flatnonzero(steps > limit)
        starts += (row + gaps + 1).tolist()
        start_times += t[gaps + 1].tolist()
        pauses += steps[gaps].tolist()
        regular = steps[steps < 1.5 * typical + 8.0 * spread]
        total = total + float(regular.sum())
        count = count + len(regular)
        rows = row + len(t)
    # Stamps are rounded numbers: a round sample time that fits them as well is the true
    # one.
    sample_time = total / count
    short = float(f"{sample_time:.6g}")
    sample_time = (
        short if abs(short - sample_time) * rows < 0.01 * sample_time else sample_time
    )
    lengths = np.diff([*starts, rows]).tolist()
    stretches = zip(starts, lengths, start_times, strict=True)
    kept = {(a, a + n): t for a, n, t in stretches if n >= 4}
    if not kept:
        raise InputError(
            f"`{source}` has no four rows in sequence: its time stamps are "
            f"{typical:.6g} s apart "
            f"at the median, with {len(pauses)} gaps; check `time_unit`, or give "
            "`sample_time`."
        )
    notes = []
    if origin != 0:
        notes.append(
            f"time counts from the first row, which was stamped {origin:.9g} s"
        )
    if pauses:
        notes.append(
            f"{len(pauses)} gap{'s' if len(pauses) > 1 else ''} in time, the first "
            "after "
            f"{start_times[1] - pauses[0]:.6g} s, the longest of {max(pauses):.6g} s "
            "(sample time "
            f"{sample_time:.6g} s), split the log into segments; a `largest_gap` above "
            f"{max(pauses) / sample_time:.3g} would bridge them"
        )
    if lost := rows - sum(b - a for a, b in kept):
        notes.append(
            f"{lost} rows between gaps are too few for a segment and were left out"
        )
    grid = TimeGrid(sample_time, tuple(kept), tuple(kept.values()), tuple(notes))
    grid = grid._replace(deviation=_deviation(grid, _linked(read(), origin)))
    if in_parts and not grid.is_exact:
        raise NeedsMemory(
            f"time stamps of `{source}` leave a uniform grid of {sample_time:.6g} s by "
            f"{grid.deviation:.6g} s: give `sample_time` if only the stamps are late."
        )
    return grid


def _linked(
    parts: Iterable[np.ndarray], origin: float
) -> Iterable[tuple[np.ndarray, int]]:
    """Yield the times of each part behind the last one before it, and the row of the first."""
    last, row = np.zeros(0), 0
    for part in parts:
        t = np.concatenate([last, part - origin])
        yield t, row
        last, row = t[-1:], row + len(t) - 1


def _require_forward(
    stamps: np.ndarray, steps: np.ndarray, row: int, source: str
) -> None:
    back = np.flatnonzero(steps < 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"time of `{source}` runs backwards from {stamps[i]:.9g} s to "
            f"{stamps[i + 1]:.9g} s at "
            f"row {row + i + 1}: sort the log, or split it where the clock was set "
            "back."
        )


def _deviation(grid: TimeGrid, parts: Iterable[tuple[np.ndarray, int]]) -> float:
    """Return the largest deviation from the grid [s]."""
    (first, last), start, largest = (
        np.transpose(grid.ranges),
        np.array(grid.start_times),
        0.0,
    )
    for t, row in parts:
        rows = row + np.arange(len(t))
        k = np.maximum(np.searchsorted(first, rows, "right") - 1, 0)
        off = np.abs(t - start[k] - grid.sample_time * (rows - first[k]))
        inside = (first[k] <= rows) & (rows < last[k])
        largest = max(largest, float(off[inside].max(initial=0.0)))
    return largest


def _resampling(
    stamps: np.ndarray, source: str, limits: tuple[float, float], first_row: int
) -> tuple[float, list[np.ndarray], list[str], Callable[[np.ndarray], np.ndarray]]:
    """Return how rows come to the uniform grid behind their time stamps.

    That is the time between two samples [s]; times of each segment's samples [s];
    remarks; and a function of a channel's rows: its samples as they are, or
    interpolated by cubic splines.
    """
    _require_forward(stamps, np.diff(stamps), first_row, source)
    kept = np.flatnonzero(np.diff(stamps, prepend=-np.inf) > 0)
    if len(kept) > 1:
        steps = np.diff(stamps[kept])
        kept = kept[np.append(True, steps > REPEATED * float(np.median(steps)))]
    t = stamps[kept]
    grid = find_grid(lambda: [t], source, limits, first_row)
    t = t - stamps[0]
    dt = grid.sample_time
    notes = list(grid.notes)
    if removed := len(stamps) - len(kept):
        notes.insert(
            0,
            f"{removed} of {len(stamps)} rows repeat the time stamp of the row before "
            "and were "
            "removed; if every row is a sample, give `sample_time` instead of the "
            "time stamps",
        )
    counts = [b - a for a, b in grid.ranges]
    if not grid.is_exact:
        missing = -sum(counts)
        counts = [
            int(np.floor((t[b - 1] - t[a]) / dt + 1e-3)) + 1 for a, b in grid.ranges
        ]
        missing += sum(counts)
        steps = np.diff(t) / dt
        if np.abs(steps - np.round(steps)).max() <= JITTER:
            notes.append(
                f"{missing} missing sample{'s were' if missing > 1 else ' was'} "
                "interpolated by "
                "cubic splines"
            )
        else:
            notes.append(
                f"time stamps jitter by up to {100 * grid.deviation / dt:.1f} % of "
                "the sample "
                f"time: resampled to a uniform grid of {dt:.6g} s by cubic splines; "
                "if the robot "
                "samples uniformly and only the stamps are late, give `sample_time` "
                "instead"
            )
    starts = zip(grid.start_times, counts, strict=True)
    times = [start + dt * np.arange(count) for start, count in starts]

    def resample(x: np.ndarray) -> np.ndarray:
        x = x[kept]
        if grid.is_exact:
            return np.concatenate([x[a:b] for a, b in grid.ranges])
        segments = zip(grid.ranges, times, strict=True)
        return np.concatenate(
            [CubicSpline(t[a:b], x[a:b])(at) for (a, b), at in segments]
        )

    return dt, times, notes, resample
