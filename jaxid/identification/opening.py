"""Opens a log that stays on the disk: its files, its clock, and the rows that count."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.streaming import Progress
from jaxid.identification.streaming_log import LongLog, forgetting
from jaxid.measurement.columns import Columns, Selection
from jaxid.measurement.decimation import AbstractDecimation, Subsample
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.observations import Observations, refuse_standstill, usable
from jaxid.measurement.parts import FIRST, AbstractParts, open_parts
from jaxid.measurement.survey import Survey, survey
from jaxid.robot.limits import per_joint
from jaxid.robot.robot import Robot

AT_ONCE = 65536
"""Samples that are read at once."""


def open_log(
    path: str | Path,
    columns: Columns,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None = None,
    slow: ArrayLike | tuple[float | int, ...] | None = None,
    name: str | None = None,
    *,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    largest_gap: float | int = 1.75,
    start: float | int = -np.inf,
    stop: float | int = np.inf,
    progress: Progress | None = None,
) -> LongLog:
    """Opens a log that need not fit into memory: CSV, Parquet, or NPZ that was not compressed.

    What it gives is what `read_recording` and `observe` give, but nothing is held: a text is gone
    through once to count its lines, the stamps once to find gaps. Stamps between gaps must be
    uniform. With `slow`, the motion is gone through as well.

    Args:
        path: Of the file with the angles, and with the rest if no other is named.
        columns: What its columns hold.
        robot: Its drives lead from the motors to the joints.
        filter: For the motion, and for forces and columns; it must forget.
        decimation: For forces and columns; every sample is a row if None.
        slow: Speed of each joint below which its rows do not count [rad/s or m/s].
        name: Of the log; the file's if None.
        forces_path: Of the file with the forces.
        velocities_path: Of the file with the velocities.
        largest_gap: Longest pause that is no gap, in sample times.
        start: Time from which on samples count, on the log's clock from zero [s].
        stop: Time before which samples count [s].
        progress: Is told which share of the motion was gone through for `slow`, of 1.

    Raises:
        NeedsMemory: If the filter needs the whole log at once, or stamps must be mended: it fits
            `read_recording` only.
        InputError: If the file is of another kind, its columns are not the robot's, forces and
            columns would be aliased, or no samples are left.
    """
    path, n = Path(path), robot.joints
    decimation = Subsample(1) if decimation is None else decimation
    forces_at, velocities_at = _path(forces_path), _path(velocities_path)
    files = _Files(path, n)
    chosen: dict = {"angles": files.want("angles", columns.angles)}
    chosen["forces"] = files.want("forces", columns.forces, forces_at)
    if columns.velocities is not None:
        chosen["velocities"] = files.want("velocities", columns.velocities, velocities_at)
    elif velocities_path is not None:
        raise InputError("`velocities_path` is given, but `Columns.velocities` names no columns.")
    if columns.time is not None:
        (chosen["time"],) = files.want("time", columns.time)
    columns = dataclasses.replace(columns, **chosen)
    found = _surveyed(files.narrowed(), columns, path.name, largest_gap)
    name = path.stem if name is None else name
    if start > -np.inf or stop < np.inf:
        found = found.cropped(start, stop, name)
    dt = found.sample_time
    decimation.check(filter.low_pass(dt).cutoff, dt)
    used, said = usable(found.ranges, filter, decimation, dt, name)
    ends = [0, *itertools.accumulate(b - a for a, b in used)]
    edge = filter.edge(dt)
    rows = sum(len(range(edge, b - a - edge, decimation.factor)) for a, b in used)
    nothing = np.broadcast_to(np.zeros(1), (ends[-1], n))
    outline = Observations(
        time=np.broadcast_to(np.zeros(1), (ends[-1],)),
        motion=Motion(nothing, nothing, nothing),
        forces=nothing,
        filter=filter,
        decimation=decimation,
        segments=tuple(itertools.pairwise(ends)),
        mask=np.broadcast_to(np.ones(1, bool), (rows, n)),
        sample_time=dt,
        name=name,
        notes=(*found.notes, *said),
    )
    times = [t for r, t in zip(found.ranges, found.times, strict=True) if r in used]
    overlap = forgetting(filter, dt, columns.velocities is not None)
    log = LongLog(
        outline,
        files.narrowed(),
        None if forces_at is None else files.narrowed(forces_at),
        None if velocities_at is None else files.narrowed(velocities_at),
        columns,
        robot,
        overlap,
        tuple(a for a, _ in used),
        tuple(times),
    )
    if slow is None:
        return log
    speeds = per_joint("slow", np.asarray(slow, np.float64), n, 0.0)
    mask = _fast_rows(log, speeds, progress)
    refuse_standstill(mask, speeds, robot, name)
    return eqx.tree_at(lambda x: x.outline.mask, log, mask)


class _Files:
    """The files of a log, and for each what is wanted of it."""

    def __init__(self, path: Path, joints: int):
        self._path, self._joints = path, joints
        self._parts: dict[Path, AbstractParts] = {}
        self._wanted: dict[Path, list[str]] = {}
        self._channels: dict[Path, dict[str, Selection | None]] = {}

    def want(self, what: str, selection: Selection, path: Path | None = None) -> tuple[str, ...]:
        """Names of the columns of a selection in one of the files."""
        path = self._path if path is None else path
        if path not in self._parts:
            self._parts[path] = open_parts(path)
        parts = self._parts[path]
        first = parts.part(0, min(parts.rows, FIRST))
        names = first.expand(what, selection)
        self._channels.setdefault(path, {})[what] = selection
        first.refuse_shared(self._channels[path])
        if what != "time":
            found = first.array(what, selection).shape[1]
            if found != self._joints:
                raise InputError(
                    f"`{what}` of `{path.name}` have {found} columns, but the robot has "
                    f"{self._joints} joints: name one column for each joint."
                )
        rows = self._parts[self._path].rows
        if parts.rows != rows:
            raise InputError(
                f"`{path.name}` has {parts.rows} rows, but `{self._path.name}` has {rows}: they "
                "must be of one run, row by row."
            )
        self._wanted.setdefault(path, []).extend(names)
        return names

    def narrowed(self, path: Path | None = None) -> AbstractParts:
        """A file with only the columns that are wanted of it."""
        path = self._path if path is None else path
        return self._parts[path].only(tuple(dict.fromkeys(self._wanted[path])))


def _path(given: str | Path | None) -> Path | None:
    return None if given is None else Path(given)


def _surveyed(parts: AbstractParts, columns: Columns, source: str, largest_gap: float) -> Survey:
    if columns.sample_time is not None:
        return Survey.uniform(parts.rows, columns.sample_time)
    selection = str(columns.time)
    parts = parts.only((selection,))

    def stamps() -> Iterator[np.ndarray]:
        last, rows = 0.0, parts.rows
        for start in range(0, rows, AT_ONCE):
            # Whole numbers and dates count from a part's first row: the row before links parts.
            table = parts.part(max(0, start - 1), min(start + AT_ONCE, rows))
            found, dates = table.stamps(selection)
            found = found if dates else found * columns.time_unit.factor
            if start:
                found = (found - found[0] + last)[1:]
            last = float(found[-1])
            yield found

    first_line = parts.part(0, 1).first_line
    first_row = 1 if first_line is None else first_line
    return survey(stamps(), source=source, largest_gap=largest_gap, first_row=first_row)


def _fast_rows(log: LongLog, speeds: np.ndarray, progress: Progress | None) -> np.ndarray:
    """Which rows of which joints are fast enough."""
    o, mask = log.outline, np.empty((log.rows, log.joints), bool)
    factor, edge = o.decimation.factor, o.filter.edge(o.sample_time)
    for (a, _), (r0, r1) in zip(o.segments, o.row_segments, strict=True):
        step = max(1, AT_ONCE // factor)
        for r in range(r0, r1, step):
            stop = min(r + step, r1)
            first = a + edge + (r - r0) * factor
            motion, _ = log.read(slice(first, first + (stop - 1 - r) * factor + 1, factor))
            mask[r:stop] = np.abs(np.asarray(motion.qd)) >= speeds
            if progress is not None:
                progress(stop / log.rows)
    return mask
