"""Logs read as a whole, or in parts with overlap for the filters: larger than memory."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.result_table import printable
from jaxid.robot.robot import Robot

from .columns import Columns, Log, open_log
from .filters import AbstractDecimation, AbstractFilter
from .log_files import LogTable
from .observations import (
    AbstractSamples,
    Observations,
    Progress,
    joined,
    joint_side,
    prepare,
)
from .recording import NeedsMemory, Recording, TimeGrid, consecutive, find_grid

AT_ONCE = 65536
"""Samples that are read at once."""
BAD_ROWS = 1e-3
"""Fraction of the rows of a log that may be bad."""
NAMED = 20
"""Bad rows that are named."""


def read_recording(
    path: str | Path,
    columns: Columns,
    name: str | None = None,
    *,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    largest_gap: float | int = 1.75,
    bridged: float = 0.0,
    bad_rows: float = BAD_ROWS,
) -> Recording:
    """Read a log from CSV (any separator), Parquet, NPZ, MAT, HDF5, or a bag of ROS 1 or 2.

    Args:
        path: File with the angles, and with all other channels that have no file of
            their own.
        columns: Meaning of the columns.
        name: Name of the recording; the file's if None.
        forces_path: File with the forces.
        velocities_path: File with the velocities.
        largest_gap: Longest pause that is bridged by interpolation, in sample times;
            longer ones split the recording into segments.
        bridged: Pause that is bridged in any case [s].
        bad_rows: Fraction of the rows that may be bad: they are left out, and `notes`
            names them.

    Raises:
        InputError: If a file, a column, a number or the time is invalid; the message
            names file, column and line.
    """
    log = open_log(path, columns, forces_path, velocities_path, is_lenient=True)
    angles, velocities, forces = log.read()
    time = None if columns.sample_time is not None else log.stamps()
    bad = log.bad_rows
    if time is not None:
        _find_stray_stamps(time, bad, log.tables[0])
    rows, sample_time = len(angles), columns.sample_time
    notes = tuple(note for table in log.tables for note in table.notes)
    named = "; ".join(text for _, text in sorted(bad.items())[:NAMED])
    named += f"; and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
    if len(bad) > bad_rows * rows:
        raise InputError(
            f"{len(bad)} of {rows} rows are bad: {named}; repair the log, or let "
            "`bad_rows` be "
            f"above {len(bad) / rows:.2g} (fraction), which leaves them out."
        )
    if bad:
        kept = np.setdiff1d(np.arange(rows), [*bad])
        if time is None:
            time, sample_time = (columns.sample_time or 0.0) * np.arange(rows), None
        angles, forces, time = angles[kept], forces[kept], time[kept]
        velocities = None if velocities is None else velocities[kept]
        left = "is bad and was" if len(bad) == 1 else "are bad and were"
        notes += (f"{len(bad)} of {rows} rows {left} left out: {named}",)
    angles = np.unwrap(angles, axis=0) if columns.unwrap else angles
    recording = Recording.of(
        angles,
        forces,
        velocities=velocities,
        time=time,
        sample_time=sample_time,
        angles_on_motor_side=columns.angles_on_motor_side,
        forces_on_motor_side=columns.forces_on_motor_side,
        largest_gap=largest_gap,
        bridged=bridged,
        name=printable(Path(path).stem) if name is None else name,
        first_row=log.tables[0].first_row,
    )
    return dataclasses.replace(recording, notes=(*notes, *recording.notes))


def _find_stray_stamps(time: np.ndarray, bad: dict[int, str], table: LogTable) -> None:
    """Add rows to the bad ones whose stamp alone is out of order."""
    good = np.setdiff1d(np.arange(len(time)), [*bad])
    for k in np.flatnonzero(np.diff(time[good]) < 0).tolist():
        ahead = k == 0 or time[good[k + 1]] >= time[good[k - 1]]
        row = int(good[k] if ahead else good[k + 1])
        bad[row] = (
            f"{table.unit} {row + table.first_row} (its time {time[row]:.9g} s is out "
            "of order)"
        )


class SamplesOnDisk(AbstractSamples):
    """Samples of a log that stays on disk; each segment begins at its own row of the files.

    Parts are read with `overlap` samples before and behind them, for the filter.
    """

    log: Log = eqx.field(static=True)
    robot: Robot
    filter: AbstractFilter
    overlap: int = eqx.field(static=True)
    segments: tuple[tuple[int, int], ...] = eqx.field(static=True)
    first_rows: tuple[int, ...] = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)

    def read(self, samples: slice) -> tuple[Motion, np.ndarray]:
        """Return motion and forces of some samples of one segment, joint side."""
        begin, end = self.segments[self._segment(samples)]
        a = max(begin, samples.start - self.overlap)
        b = min(end, samples.stop + self.overlap)
        rows = self.read_rows(slice(a, b))
        angles, velocities, forces = joint_side(self.robot, self.log.columns, *rows)
        motion = self.filter.motion(angles, velocities, self.sample_time)
        wanted = slice(samples.start - a, samples.stop - a, samples.step)
        return motion[wanted], forces[wanted]

    def read_all(self) -> tuple[Motion, np.ndarray]:
        """Return motion and forces of all segments; they must fit into memory."""
        return joined(self.read(slice(a, b)) for a, b in self.segments)

    def read_rows(
        self, samples: slice
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return angles, velocities and forces of a segment's samples as they were recorded."""
        k = self._segment(samples)
        behind = self.first_rows[k] - self.segments[k][0]
        return self.log.read(behind + samples.start, behind + samples.stop)

    def _segment(self, samples: slice) -> int:
        return sum(a <= samples.start for a, _ in self.segments) - 1


def scan_log(
    path: str | Path,
    columns: Columns,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None = None,
    min_speed: ArrayLike | tuple[float | int, ...] | None = None,
    name: str | None = None,
    *,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    largest_gap: float | int = 1.75,
    start: float | int = -np.inf,
    stop: float | int = np.inf,
    progress: Progress | None = None,
) -> Observations:
    """Open a log that need not fit into memory: CSV, Parquet, or uncompressed NPZ.

    The result equals that of `read_recording` and `observe`, but the samples stay on
    disk. The time stamps are read once to find gaps; between gaps they must be uniform.
    With `min_speed`, the motion is read once as well.

    Args:
        path: File with the angles, and with all other channels that have no file of
            their own.
        columns: Meaning of the columns.
        robot: Robot, whose drives convert from motors to joints.
        filter: Filter of the motion, and of forces and columns, with a finite memory.
        decimation: Decimation of forces and columns; every sample is a row if None.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        name: Name of the log; the file's if None.
        forces_path: File with the forces.
        velocities_path: File with the velocities.
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
    if columns.unwrap:
        raise NeedsMemory("`unwrap` counts the turns of whole logs")
    log = open_log(path, columns, forces_path, velocities_path, on_disk=True)
    rows = log.tables[0].rows
    first_row = log.tables[0].first_row
    source = Path(path)
    measured = columns.velocities is not None
    name = printable(source.stem) if name is None else name
    if columns.sample_time is not None:
        grid = TimeGrid(columns.sample_time, ((0, rows),))
    else:
        limits = largest_gap, 0.0
        grid = find_grid(
            lambda: _stamps(log), source.name, limits, first_row, in_parts=True
        )
    grid = grid.cropped(start, stop, name)

    def load(segments: list[tuple[int, int]]) -> SamplesOnDisk:
        overlap = filter_memory(filter, grid.sample_time, measured)
        first_rows = tuple(a for a, _ in segments)
        segments_here = consecutive(b - a for a, b in segments)
        return SamplesOnDisk(
            log, robot, filter, overlap, segments_here, first_rows, grid.sample_time
        )

    joints = log.read(0, 1)[0].shape[1]
    return prepare(
        load,
        grid,
        joints,
        measured,
        robot,
        filter,
        decimation,
        min_speed,
        name,
        progress,
    )


def _stamps(log: Log) -> Iterator[np.ndarray]:
    """Yield the time stamps in parts [s]."""
    last = 0.0
    for start in range(0, log.tables[0].rows, AT_ONCE):
        # Integers and dates count from a part's first row: the row before links parts.
        part = log.stamps(max(0, start - 1), min(start + AT_ONCE, log.tables[0].rows))
        if start:
            part = (part - part[0] + last)[1:]
        last = float(part[-1])
        yield part


def filter_memory(filter: AbstractFilter, sample_time: float, measured: bool) -> int:
    """Return after how many samples a filter's motion no longer depends on an angle or velocity."""
    refusal = (
        f"`{type(filter).__name__}` needs the whole log: take another filter, "
        "or `read_recording`."
    )
    half = 4096
    while half <= 2**20:
        impulse = 1e-3 * (np.arange(2 * half + 1) == half)[:, None]
        try:
            motion = filter.motion(impulse, impulse if measured else None, sample_time)
        except ValueError as error:
            raise NeedsMemory(refusal) from error
        size = np.abs(np.hstack([motion.q, motion.qd, motion.qdd]))
        last, _ = np.nonzero(size > 1e-13 * size.max(axis=0))
        reach = int(np.abs(last - half).max(initial=0))
        if reach < half // 2:
            # The part below rounding decays at the same rate.
            return int(1.3 * reach) + 4
        half *= 4
    raise NeedsMemory(refusal)
