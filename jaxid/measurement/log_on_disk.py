"""Logs that stay on disk: read in parts, filtered with overlap, for files larger than memory."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.chunked_files import AbstractLogFile, open_log_file
from jaxid.measurement.columns import Columns, Selection
from jaxid.measurement.decimation import AbstractDecimation, Subsample
from jaxid.measurement.files import LogTable
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.observations import (
    AbstractSamples,
    Observations,
    Progress,
    joint_side,
    require_fast_rows,
    usable_segments,
)
from jaxid.measurement.timestamps import NeedsMemory, TimeGrid, find_grid, uniform_grid
from jaxid.robot.joints import per_joint
from jaxid.robot.robot import Robot

AT_ONCE = 65536
"""Samples that are read at once."""


class SamplesOnDisk(AbstractSamples):
    """Samples of a log that stays on disk.

    Attributes:
        files: Files by channel: angles, forces and, where measured, velocities.
        columns: Meaning of the files' columns.
        robot: Robot, whose drives convert from motors to joints.
        filter: Filter of the motion.
        overlap: Samples that are read before and after each part, for the filter.
        segments: Half-open ranges of samples without gaps.
        first_rows: Row of the file at which each segment begins.
        sample_time: Time between two samples [s].
    """

    files: dict[str, AbstractLogFile] = eqx.field(static=True)
    columns: Columns
    robot: Robot
    filter: AbstractFilter
    overlap: int = eqx.field(static=True)
    segments: tuple[tuple[int, int], ...] = eqx.field(static=True)
    first_rows: tuple[int, ...] = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)

    def read(self, samples: slice) -> tuple[Motion, np.ndarray]:
        """Return motion and forces of some samples of one segment, joint side.

        Raises:
            InputError: If a column holds something else than numbers.
        """
        motion, forces, _ = self.read_with_angles(samples)
        return motion, forces

    def read_all(self) -> tuple[Motion, np.ndarray]:
        """Return motion and forces of all segments; they must fit into memory."""
        motions, forces = zip(*(self.read(slice(a, b)) for a, b in self.segments), strict=True)
        parts = [np.concatenate([getattr(m, x) for m in motions]) for x in ("q", "qd", "qdd")]
        return Motion(*parts), np.concatenate(forces)

    def read_with_angles(self, samples: slice) -> tuple[Motion, np.ndarray, np.ndarray]:
        """Return motion, forces and unfiltered angles of some samples of one segment.

        Raises:
            InputError: Like `read`.
        """
        begin, end, _ = self._segment(samples)
        a, b = max(begin, samples.start - self.overlap), min(end, samples.stop + self.overlap)
        angles, velocities, forces = self.read_unfiltered(slice(a, b))
        motion = self.filter.motion(angles, velocities, self.sample_time)
        wanted = slice(samples.start - a, samples.stop - a, samples.step)
        return motion[wanted], forces[wanted], angles[wanted]

    def read_unfiltered(self, samples: slice) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return angles, velocities and forces of some samples of one segment, joint side.

        Raises:
            InputError: Like `read`.
        """
        sides = self.columns.angles_on_motor_side, self.columns.forces_on_motor_side
        return joint_side(self.robot, *self.read_recorded(samples), *sides)

    def read_recorded(self, samples: slice) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return the same in SI units, on the sides on which they were recorded.

        Raises:
            InputError: Like `read`.
        """
        begin, _, first = self._segment(samples)
        rows = first + samples.start - begin, first + samples.stop - begin
        columns, n = self.columns, self.robot.joints
        tables = {id(file): file.read(*rows) for file in self.files.values()}
        table = {channel: tables[id(file)] for channel, file in self.files.items()}
        angles = table["angles"].array("angles", columns.angles)
        angles = angles * columns.angle_scale(n) + columns.angle_shift(n)
        forces = table["forces"].array("forces", columns.forces) * columns.force_scale(n)
        velocities = None
        if columns.velocities is not None:
            velocities = table["velocities"].array("velocities", columns.velocities)
            velocities = velocities * columns.velocity_scale(n)
        return angles, velocities, forces

    def _segment(self, samples: slice) -> tuple[int, int, int]:
        """Return where the segment of some samples begins and ends, and its first row."""
        starts = [a for a, _ in self.segments]
        k = int(np.searchsorted(starts, samples.start, "right")) - 1
        return *self.segments[k], self.first_rows[k]


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

    The result equals that of `read_recording` and `observe`, but the samples stay on disk. The time
    stamps are read once to find gaps; between gaps they must be uniform. With `min_speed`, the
    motion is read once as well.

    Args:
        path: File with the angles, and with all other channels that have no file of their own.
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
        progress: Callback, called with the completed fraction (0 to 1) of the pass for `min_speed`.

    Raises:
        NeedsMemory: If the filter needs the whole log at once, or rows must be moved or removed
            to make the stamps uniform: use `read_recording`.
        InputError: If the file is of another kind, its columns are not the robot's, forces and
            columns would be aliased, or no samples are left.
    """
    path, n = Path(path), robot.joints
    decimation = Subsample(1) if decimation is None else decimation
    files, columns = _open_files(path, columns, n, forces_path, velocities_path)
    grid = _find_grid(files["angles"], columns, path.name, largest_gap)
    name = path.stem if name is None else name
    if start > -np.inf or stop < np.inf:
        grid = grid.cropped(start, stop, name)
    dt = grid.sample_time
    decimation.check(filter.low_pass(dt).cutoff, dt)
    used, omitted = usable_segments(grid.ranges, filter, decimation, dt, name)
    segments = tuple(itertools.pairwise([0, *itertools.accumulate(b - a for a, b in used)]))
    edge = filter.edge(dt)
    rows = sum(len(range(a + edge, b - edge, decimation.factor)) for a, b in segments)
    observations = Observations(
        source=SamplesOnDisk(
            files=files,
            columns=columns,
            robot=robot,
            filter=filter,
            overlap=filter_memory(filter, dt, columns.velocities is not None),
            segments=segments,
            first_rows=tuple(a for a, _ in used),
            sample_time=dt,
        ),
        filter=filter,
        decimation=decimation,
        segments=segments,
        start_times=tuple(
            t for r, t in zip(grid.ranges, grid.start_times, strict=True) if r in used
        ),
        mask=np.broadcast_to(np.ones(1, bool), (rows, n)),
        sample_time=dt,
        name=name,
        notes=(*grid.notes, *omitted),
    )
    if min_speed is None:
        return observations
    speeds = per_joint("min_speed", np.asarray(min_speed, np.float64), n, 0.0)
    mask = _fast_rows(observations, speeds, progress)
    require_fast_rows(mask, speeds, robot, name)
    return observations.replace(mask=mask)


def _open_files(
    path: Path,
    columns: Columns,
    joints: int,
    forces_path: str | Path | None,
    velocities_path: str | Path | None,
) -> tuple[dict[str, AbstractLogFile], Columns]:
    """Return the file of each channel, and the names of the columns."""
    if velocities_path is not None and columns.velocities is None:
        raise InputError("`velocities_path` is given, but `Columns.velocities` names no columns.")
    paths = {
        "angles": path,
        "forces": Path(forces_path or path),
        "velocities": Path(velocities_path or path),
        "time": path,
    }
    files: dict[Path, AbstractLogFile] = {}
    names: dict = {}
    for one in dict.fromkeys(paths.values()):
        selections: dict[str, Selection] = {
            channel: getattr(columns, channel)
            for channel in paths
            if paths[channel] == one and getattr(columns, channel) is not None
        }
        if not selections:
            continue

        def select(first: LogTable, selections=selections) -> tuple[str, ...]:
            first.refuse_shared(selections)
            for channel, selection in selections.items():
                names[channel] = first.expand(channel, selection)
                if channel != "time":
                    _require_joints(first, channel, selection, joints)
            return tuple(dict.fromkeys(name for c in selections for name in names[c]))

        files[one] = open_log_file(one, select)
        if files[one].rows != files[path].rows:
            raise InputError(
                f"`{one.name}` has {files[one].rows} rows, but `{path.name}` has "
                f"{files[path].rows}: they must be of one run, row by row."
            )
    if columns.time is not None:
        (names["time"],) = names["time"]
    channels = {channel: files[one] for channel, one in paths.items() if channel in names}
    return channels, dataclasses.replace(columns, **names)


def _require_joints(table: LogTable, channel: str, selection: Selection, joints: int) -> None:
    columns = table.array(channel, selection).shape[1]
    if columns != joints:
        raise InputError(
            f"`{channel}` of `{table.source}` have {columns} columns, but the robot has {joints} "
            "joints: name one column for each joint."
        )


def _find_grid(
    file: AbstractLogFile, columns: Columns, source: str, largest_gap: float
) -> TimeGrid:
    if columns.sample_time is not None:
        return uniform_grid(file.rows, columns.sample_time)
    selection = str(columns.time)
    file = file.only((selection,))

    def stamps() -> Iterator[np.ndarray]:
        last, rows = 0.0, file.rows
        for start in range(0, rows, AT_ONCE):
            # Integers and dates count from a part's first row: the row before links parts.
            table = file.read(max(0, start - 1), min(start + AT_ONCE, rows))
            part, dates = table.stamps(selection)
            part = part if dates else part * columns.time_unit.factor
            if start:
                part = (part - part[0] + last)[1:]
            last = float(part[-1])
            yield part

    first_line = file.read(0, 1).first_line
    return find_grid(
        stamps,
        source=source,
        largest_gap=largest_gap,
        first_row=1 if first_line is None else first_line,
        in_parts=True,
    )


def _fast_rows(
    observations: Observations, speeds: np.ndarray, progress: Progress | None
) -> np.ndarray:
    """Return the rows in which each joint reaches its minimum speed."""
    o = observations
    mask = np.empty((o.rows, o.joints), bool)
    factor, edge = o.decimation.factor, o.filter.edge(o.sample_time)
    for (a, _), (r0, r1) in zip(o.segments, o.row_segments, strict=True):
        step = max(1, AT_ONCE // factor)
        for r in range(r0, r1, step):
            stop = min(r + step, r1)
            first = a + edge + (r - r0) * factor
            motion, _ = o.read(slice(first, first + (stop - 1 - r) * factor + 1, factor))
            mask[r:stop] = np.abs(np.asarray(motion.qd)) >= speeds
            if progress is not None:
                progress(stop / o.rows)
    return mask


def filter_memory(filter: AbstractFilter, sample_time: float, measured: bool) -> int:
    """Return after how many samples a filter's motion no longer depends on an angle or velocity.

    Args:
        filter: Filter of the motion.
        sample_time: Time between two samples [s].
        measured: Whether velocities are measured.

    Raises:
        NeedsMemory: If the memory is not finite.
    """
    refusal = (
        f"`{type(filter).__name__}` needs the whole log at once: take another filter, or a log "
        "that fits into memory (`read_recording`)."
    )
    half = 4096
    while half <= 2**20:
        impulse = np.zeros((2 * half + 1, 1))
        impulse[half] = 1e-3
        try:
            motion = filter.motion(impulse, impulse if measured else None, sample_time)
        except ValueError as error:
            raise NeedsMemory(refusal) from error
        reach = 0
        for x in (motion.q, motion.qd, motion.qdd):
            size = np.abs(np.asarray(x)[:, 0])
            last = np.flatnonzero(size > 1e-13 * size.max())
            reach = max(reach, int(np.abs(last - half).max(initial=0)))
        if reach < half // 2:
            # The part below rounding decays at the same rate.
            return int(1.3 * reach) + 4
        half *= 4
    raise NeedsMemory(refusal)
