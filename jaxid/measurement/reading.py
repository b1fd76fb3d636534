"""Logs read as a whole, or in parts with overlap for filters: larger than memory."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import numpy as np

from jaxid.arrays import Indices, Numbers, Vector
from jaxid.errors import InputError
from jaxid.io import FilePath
from jaxid.result_table import printable
from jaxid.robot.robot import Robot

from .columns import Columns, Log, open_log
from .filters import AbstractFilter, Subsample
from .filters.filter import EVERY_SAMPLE
from .log_files import COMMENT, NO_NUMBER, Complaints, LogTable
from .observations import Observations, Progress, prepare
from .recording import MIN_SAMPLES, Recording, consecutive
from .samples import AbstractSamples, joined, joint_side
from .time_grid import NeedsMemory, Range, Ranges, TimeGrid, find_grid
from .time_series import (
    NamedChannels,
    hold_notes,
    is_sparse,
    join_channels,
    without_filling,
)
from .time_stamps import MAX_LATE_ROWS

PART_SIZE = 65536
"""Samples that are read at once."""
MAX_BAD_ROWS = 1e-3
"""Fraction of the rows of a log that may be bad."""
MAX_SPARED_ROWS = 0.5
"""Fraction of bad rows from which leaving them out is no cure."""
MAX_STRAY_STAMPS = 1e-2
"""Fraction of the rows that may have a wrong stamp; more are out of order only."""
MAX_END_ROWS = 5
"""Rows at the end that may be bad, such as a summary."""
MAX_NAMED_ROWS = 6
"""Causes of bad rows that are named."""
MAX_EQUAL_ROWS = 5
"""Rows that are named for one cause."""


def read_recording(
    path: FilePath,
    columns: Columns,
    name: str | None = None,
    *,
    forces_path: FilePath | None = None,
    largest_gap: float | int = 1.75,
    bridged: float = 0.0,
    bad_rows: float = MAX_BAD_ROWS,
    start: float | int = -np.inf,
    stop: float | int = np.inf,
) -> Recording:
    """Read a log, in the format that the suffix of its file says.

    Args:
        path: File with the angles, and with all other channels that have no file of
            their own.
        columns: Meaning of the columns.
        name: Name of the recording; the file's if None.
        forces_path: File with the forces.
        largest_gap: Longest pause that is bridged by interpolation, in sample times;
            longer ones split the recording into segments.
        bridged: Pause that is bridged in any case [s].
        bad_rows: Fraction of the rows that may be bad: they are left out, and `notes`
            names them.
        start: Start of the part that counts, from the log's first row on [s].
        stop: End of the part that counts [s]; bad rows elsewhere do not matter.

    Raises:
        InputError: If a file, a column, a number or the time is invalid; the message
            names file, column and line.
    """
    log = open_log(path, columns, forces_path)
    channels = log.read()
    sample_time = columns.sample_time
    stamps = log.stamps() if sample_time is None else None
    complaints = log.bad_rows
    notes = [*log.notes, *(note for table in log.tables for note in table.notes)]
    is_row = np.ones(len(channels["angles"]), bool)
    is_row[[row for row, text in complaints.items() if COMMENT in text]] = False
    if not is_row.all():
        rows_before = np.cumsum(is_row) - 1
        complaints = {
            int(rows_before[row]): text
            for row, text in complaints.items()
            if is_row[row]
        }
        channels = {name: values[is_row] for name, values in channels.items()}
        stamps = None if stamps is None else stamps[is_row]
    is_merged = log.tables[0].is_merged
    if stamps is not None:
        sparse_channels = without_filling(channels)
        is_merged |= sparse_channels is not channels
        channels = sparse_channels
    # Cells with texts do not mean that a channel has no value then.
    has_texts = any(NO_NUMBER in text for text in complaints.values())
    if is_merged or (complaints and not has_texts and is_sparse(channels)):
        joined_channels = join_channels(stamps, channels, log.tables[0].source)
        stamps, channels, join_notes = joined_channels
        complaints = {}
        notes += join_notes
    rows = len(channels["angles"])
    strays: Complaints = {}
    if stamps is not None:
        strays = _stray_stamps(stamps, complaints, log.tables[0])
        complaints |= strays
    is_part = bool(np.isfinite((start, stop)).any())
    if complaints and is_part:
        times = (sample_time or 0.0) * np.arange(rows) if stamps is None else stamps
        is_sound = np.isfinite(times)
        is_sound[[*strays]] = False
        arrays = [times, *channels.values()]
        complaints = _fill_outside(complaints, is_sound, arrays, start, stop)
    good_rows = slice(None)
    if complaints:
        good_rows = np.setdiff1d(np.arange(rows), [*complaints])
        notes.append(_bad_row_note(complaints, rows, bad_rows))
        if sample_time is not None:
            # Rows that are left out leave gaps, which only stamps can tell.
            stamps = sample_time * np.arange(rows)
            sample_time = None
    channels = {name: values[good_rows] for name, values in channels.items()}
    if columns.unwrap:
        for name in {"angles", "commands"} & channels.keys():
            channels[name] = np.unwrap(channels[name], axis=0)
    measured: dict[str, Any] = {"forces": None, **channels}
    recording = Recording.of(
        **measured,
        time=None if stamps is None else stamps[good_rows],
        sample_time=sample_time,
        angles_on_motor_side=columns.angles_on_motor_side,
        forces_on_motor_side=columns.forces_on_motor_side,
        largest_gap=largest_gap,
        bridged=bridged,
        name=printable(Path(path).stem) if name is None else name,
        first_row=log.tables[0].first_row,
    )
    recording = dataclasses.replace(
        recording,
        notes=(*notes, *hold_notes(channels, recording.sample_time), *recording.notes),
        angle_unit=columns.angle_symbol,
    )
    return recording.crop(start, stop) if is_part else recording


def _fill_outside(
    complaints: Complaints,
    is_sound: np.ndarray,
    arrays: Sequence[np.ndarray],
    start: float,
    stop: float,
) -> Complaints:
    """Fill bad rows that will be cut off, and return complaints about all others.

    They get the values of the next good row, so that the times of all rows stay; the
    first of the arrays has their stamps, of which some are sound.
    """
    rows = np.arange(len(is_sound))
    good_rows = np.setdiff1d(rows, [*complaints])
    if good_rows.size < 2:
        return complaints
    stamps = arrays[0]
    step = float(np.median(np.diff(stamps[is_sound])))
    delays = stamps - step * rows
    stamps[:] = step * rows + np.interp(rows, rows[is_sound], delays[is_sound])

    elapsed = stamps - stamps[0]
    # The row at `start` is inside, and that at `stop` outside, in spite of rounding.
    is_inside = (elapsed > start - 0.5 * step) & (elapsed < stop - 1e-6 * step)
    outer_rows = [row for row in complaints if not is_inside[row]]
    positions = np.searchsorted(good_rows, outer_rows)
    next_good_rows = good_rows[np.minimum(positions, len(good_rows) - 1)]
    for values in arrays[1:]:
        values[outer_rows] = values[next_good_rows]
    return {row: text for row, text in complaints.items() if is_inside[row]}


def _bad_row_note(complaints: Complaints, rows: int, max_share: float) -> str:
    """Return a remark about the rows that are left out; refuse too many of them.

    Those at the end do not count, which a summary or a cut file has.
    """
    end = rows
    while end - 1 in complaints and rows - end < MAX_END_ROWS:
        end -= 1
    count = len(complaints)
    inner_count = sum(row < end for row in complaints)
    texts = _complaints_by_cause(complaints)
    words = "; ".join(texts[:MAX_NAMED_ROWS])
    if len(texts) > MAX_NAMED_ROWS:
        words = f"{words}; and {len(texts) - MAX_NAMED_ROWS} more"
    share = inner_count / rows
    cure = (
        f"repair the log, or set `bad_rows` above {share:.2g} (a fraction) to leave "
        "these rows out"
    )
    if share > MAX_SPARED_ROWS:
        cure = (
            "name other columns, or export the log again, with one number in each "
            "cell and no commas between thousands"
        )
    if share > max_share:
        raise InputError(f"{count} of {rows} rows are bad: {words}; {cure}.")
    verb = "is bad and was" if count == 1 else "are bad and were"
    return f"{count} of {rows} rows {verb} left out: {words}"


def _complaints_by_cause(complaints: Complaints) -> list[str]:
    """Return one text for all rows with the same cause, like `line 2, 3 (empty)`."""
    numbers: dict[tuple[str, str], list[str]] = {}
    for _, text in sorted(complaints.items()):
        unit, number, cause = text.split(" ", 2)
        numbers.setdefault((unit, cause), []).append(number)
    texts = []
    for (unit, cause), rows in numbers.items():
        places = ", ".join(rows[:MAX_EQUAL_ROWS])
        if len(rows) > MAX_EQUAL_ROWS:
            places = f"{places} and {len(rows) - MAX_EQUAL_ROWS} more"
        texts.append(f"{unit} {places} {cause}")
    return texts


def _stray_stamps(
    stamps: Vector, complaints: Complaints, table: LogTable
) -> Complaints:
    """Return complaints about rows whose stamp alone is far out of order.

    Rows that came late only, and a clock that was set back, are no such complaints.
    """
    is_good = np.ones(len(stamps), bool)
    is_good[[*complaints]] = False
    good_rows = np.flatnonzero(is_good)
    order = np.argsort(stamps[good_rows], kind="stable")
    shifts = np.abs(order - np.arange(len(order)))
    stray_rows = good_rows[order[shifts > MAX_LATE_ROWS]].tolist()
    if len(stray_rows) > 1 + MAX_STRAY_STAMPS * len(stamps):
        return {}
    return {
        row: f"{table.unit} {row + table.first_row} (its time {stamps[row]:.9g} s is "
        "out of order)"
        for row in stray_rows
    }


class SamplesOnDisk(AbstractSamples):
    """Samples of a log that stays on disk; each segment begins at a row of the files.

    Parts are read with `overlap` samples before and behind them, for the filter.
    """

    log: Log = eqx.field(static=True)
    robot: Robot
    filter: AbstractFilter
    overlap: int = eqx.field(static=True)
    segments: Ranges = eqx.field(static=True)
    first_rows: Indices = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)

    def read(self, samples):  # noqa: D102
        a, b = self.segments[self._segment(samples)]
        # With the neighbours that the filter needs.
        start = max(a, samples.start - self.overlap)
        stop = min(b, samples.stop + self.overlap)
        channels = self.read_rows(slice(start, stop))
        q, qd, forces = joint_side(
            self.robot,
            self.log.columns,
            channels["angles"],
            channels.get("velocities"),
            channels["forces"],
        )
        motion = self.filter.motion(q, qd, self.sample_time)

        first_row = samples.start - start
        end_row = samples.stop - start
        rows = slice(first_row, end_row, samples.step)
        return motion[rows], forces[rows]

    def read_all(self):  # noqa: D102
        return joined(self.read(slice(a, b)) for a, b in self.segments)

    def read_rows(self, samples: slice) -> NamedChannels:
        """Return the channels of a segment's samples as recorded."""
        k = self._segment(samples)
        shift = self.first_rows[k] - self.segments[k][0]
        return self.log.read(samples.start + shift, samples.stop + shift)

    def _segment(self, samples: slice) -> int:
        """Return the number of the segment that holds some samples."""
        return sum(a <= samples.start for a, _ in self.segments) - 1


def scan_log(
    path: FilePath,
    columns: Columns,
    robot: Robot,
    filter: AbstractFilter,
    decimation: Subsample = EVERY_SAMPLE,
    min_speed: Numbers | None = None,
    name: str | None = None,
    *,
    forces_path: FilePath | None = None,
    largest_gap: float | int = 1.75,
    start: float | int = -np.inf,
    stop: float | int = np.inf,
    progress: Progress | None = None,
) -> Observations:
    """Open a log that need not fit into memory: CSV or Parquet.

    The result equals that of `read_recording` and `observe`, but the samples stay on
    disk. The time stamps are read once to find gaps; between gaps they must be uniform.
    With `min_speed`, the motion is read once as well.

    Args:
        path: File with the angles, and with all other channels that have no file of
            their own.
        columns: Meaning of the columns.
        robot: Robot, whose drives convert from motors to joints.
        filter: Filter of the motion, and of forces and columns, with a finite memory.
        decimation: Samples that become rows; by default every sample.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        name: Name of the log; the file's if None.
        forces_path: File with the forces.
        largest_gap: Longest pause that is no gap, in sample times.
        start: Start of the part that counts, from the log's first row on [s].
        stop: End of the part that counts [s].
        progress: Callback, called with the completed fraction (0 to 1) of the pass for
            `min_speed`.

    Raises:
        NeedsMemory: If the filter needs the whole log at once, or rows must be moved or
            removed to make the stamps uniform: use `read_recording`.
        InputError: If the file is of another kind, its columns are not the robot's,
            forces and columns would be aliased, or no samples are left.
    """
    if columns.wrench is not None:
        raise NeedsMemory("the wrench of a force sensor is read with whole logs")
    if columns.gyro is not None:
        raise NeedsMemory("a floating base needs its whole log")
    if columns.unwrap:
        raise NeedsMemory("`unwrap` counts the turns of whole logs")
    log = open_log(path, columns, forces_path, on_disk=True)
    table = log.tables[0]
    has_velocities = columns.velocities is not None
    name = printable(Path(path).stem) if name is None else name
    if columns.sample_time is not None:
        grid = TimeGrid(columns.sample_time, {(0, table.rows): 0.0})
    else:
        grid = find_grid(
            lambda: _stamps(log),
            Path(path).name,
            (largest_gap, 0.0),
            table.first_row,
            in_parts=True,
        )
    grid = grid.cropped(start, stop, name)
    memory = filter.memory(grid.sample_time)
    if memory is None:
        raise NeedsMemory(
            f"`{type(filter).__name__}` needs the whole log: use another filter, or "
            "`read_recording`."
        )

    def load(ranges: Iterable[Range]) -> SamplesOnDisk:
        return SamplesOnDisk(
            log,
            robot,
            filter,
            overlap=memory,
            segments=consecutive(b - a for a, b in ranges),
            first_rows=tuple(a for a, _ in ranges),
            sample_time=grid.sample_time,
        )

    first_angles = log.read(0, 1)["angles"]
    return prepare(
        load,
        grid,
        first_angles.shape[1],
        has_velocities,
        robot,
        filter,
        decimation,
        min_speed,
        name,
        progress,
    )


def read_excerpt(log: Observations, max_samples: int, share: float = 1.0) -> Recording:
    """Return stretches of a log on disk as recorded: from beginning, middle and end.

    Args:
        log: Result of `scan_log`.
        max_samples: Largest number of samples of all stretches together.
        share: Fraction of the log, its first part, from which they are taken.
    """
    source = cast(SamplesOnDisk, log.source)
    dt = log.sample_time
    samples = int(share * log.samples)
    # With a filter of a long memory, one long stretch tells more than several short
    # ones.
    count = 4 if samples > max_samples >= 80 * log.filter.edge(dt) else 1
    length = min(samples, max_samples) // count
    parts = []
    times = []
    for start in np.linspace(0, samples - length, count).astype(int).tolist():
        for (begin, end), time in zip(log.segments, log.start_times, strict=True):
            a = max(begin, start)
            b = min(end, start + length)
            if b - a >= MIN_SAMPLES:
                parts.append(source.read_rows(slice(a, b)))
                times.append(time + dt * (np.arange(a, b) - begin))
    channels = {x: np.concatenate([part[x] for part in parts]) for x in parts[0]}
    columns = source.log.columns
    return Recording(
        time=np.concatenate(times),
        angles=channels["angles"],
        forces=channels["forces"],
        velocities=channels.get("velocities"),
        angles_on_motor_side=columns.angles_on_motor_side,
        forces_on_motor_side=columns.forces_on_motor_side,
        segments=consecutive(map(len, times)),
        sample_time=dt,
        name=log.name,
        stamp_deviation=0.0 if columns.sample_time is None else None,
        angle_unit=columns.angle_symbol,
    )


def _stamps(log: Log) -> Iterator[Vector]:
    """Yield the time stamps in parts [s], with the last one of the part before."""
    rows = log.tables[0].rows
    previous_time = 0.0
    for start in range(0, rows, PART_SIZE):
        first_row = max(0, start - 1)
        part = log.stamps(first_row, min(start + PART_SIZE, rows))
        if start > 0:
            # Integers and dates count from a part's first row.
            part = part - part[0] + previous_time
        previous_time = float(part[-1])
        yield part
