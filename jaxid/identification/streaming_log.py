"""Logs larger than memory: read part by part, filtered with overlap, never held."""

import itertools
import zipfile
from abc import abstractmethod
from pathlib import Path

import equinox as eqx
import numpy as np
import polars as pl

from jaxid.dynamics.motion import Motion
from jaxid.identification.streaming import Read, held
from jaxid.measurement.columns import Columns
from jaxid.measurement.decimation import AbstractDecimation, Subsample
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.observations import Observations
from jaxid.measurement.tables import Table
from jaxid.robot.robot import Robot

PROBE = 4096
"""Samples of the first look at how long a filter remembers."""
LONGEST = 2**20
"""Samples after which a filter must have forgotten."""
FADED = 1e-13
"""Part of a response's peak that no longer matters."""
UNEVEN = 0.05
"""Part of the sample time by which stamps may leave the uniform grid."""


class AbstractTables(eqx.Module):
    """A file from which rows can be read anywhere."""

    @property
    @abstractmethod
    def rows(self) -> int:
        """Number of rows."""

    @abstractmethod
    def part(self, start: int, stop: int) -> Table:
        """Some consecutive rows."""


class ParquetTables(AbstractTables):
    """A Parquet file; only the row groups and columns in question are read.

    Attributes:
        path: Of the file.
        names: Of the columns that are read; all if None.
    """

    path: Path = eqx.field(static=True)
    names: tuple[str, ...] | None = eqx.field(static=True, default=None)

    @property
    def rows(self) -> int:  # noqa: D102
        return int(pl.scan_parquet(self.path).select(pl.len()).collect().item())

    def part(self, start, stop):  # noqa: D102
        frame = pl.scan_parquet(self.path)
        if self.names is not None:
            frame = frame.select(self.names)
        frame = frame.slice(start, stop - start).collect()
        return Table(self.path.name, frame.to_dict(as_series=True))


class ArrayTables(AbstractTables):
    """The arrays of an NPZ file that was not compressed, mapped and not read.

    Attributes:
        path: Of the file.
        arrays: By name.
    """

    path: Path = eqx.field(static=True)
    arrays: dict[str, np.ndarray]

    @classmethod
    def of(cls, path: Path) -> "ArrayTables":
        """Maps the arrays.

        Raises:
            ValueError: If an array is compressed.
        """
        arrays = {}
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            for entry in archive.infolist():
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise ValueError(
                        f"`{entry.filename}` in `{path.name}` is compressed, so it cannot be "
                        "mapped: write it with `np.savez`, or as Parquet."
                    )
                file.seek(entry.header_offset + 26)
                lengths = np.frombuffer(file.read(4), "<u2")
                file.seek(entry.header_offset + 30 + int(lengths.sum()))
                version = np.lib.format.read_magic(file)
                first = version == (1, 0)
                read = (
                    np.lib.format.read_array_header_1_0
                    if first
                    else np.lib.format.read_array_header_2_0
                )
                shape, fortran, dtype = read(file)
                order = "F" if fortran else "C"
                arrays[entry.filename.removesuffix(".npy")] = np.memmap(
                    path, dtype, "r", file.tell(), shape, order
                )
        return cls(path, arrays)

    @property
    def rows(self) -> int:  # noqa: D102
        return max((len(x) for x in self.arrays.values() if x.ndim), default=0)

    def part(self, start, stop):  # noqa: D102
        return Table(self.path.name, {k: x[start:stop] for k, x in self.arrays.items() if x.ndim})


class LongLog(eqx.Module):
    """A log that stays on the disk; `identify` takes it like observations.

    Attributes:
        outline: Observations without numbers: filter, decimation, rows.
        tables: The file.
        columns: What its columns hold.
        robot: Whose log it is.
        overlap: Samples that are read before and after each part, for the filter of the motion.
    """

    outline: Observations
    tables: AbstractTables
    columns: Columns
    robot: Robot
    overlap: int = eqx.field(static=True)

    @property
    def name(self) -> str:
        """Of the log."""
        return self.outline.name

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.outline.joints

    @property
    def rows(self) -> int:
        """Number of rows of each joint after decimation."""
        return self.outline.rows

    def read(self, samples: slice) -> tuple[Motion, np.ndarray]:
        """Motion and forces of some samples, joint side, as `observe` makes them.

        Raises:
            ValueError: If a column holds what is no number, or stamps are not uniform.
        """
        count = len(self.outline.time)
        a, b = max(0, samples.start - self.overlap), min(count, samples.stop + self.overlap)
        angles, velocities, forces = self._measured(a, b)
        motion = self.outline.filter.motion(angles, velocities, self.outline.sample_time)
        own = slice(samples.start - a, samples.stop - a, samples.step)
        return motion[own], forces[own]

    def _measured(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        table, columns, n = self.tables.part(a, b), self.columns, self.joints
        if columns.time is not None:
            _refuse_uneven(table, columns, self.outline.sample_time, a)
        drives, velocities = self.robot.drives, None
        angles = table.array("angles", columns.angles) * columns.angle_scale(n)
        angles = angles + columns.angle_shift(n)
        forces = table.array("forces", columns.forces) * columns.force_scale(n)
        if columns.velocities is not None:
            velocities = table.array("velocities", columns.velocities) * columns.velocity_scale(n)
        if columns.angles_on_motor_side:
            angles = np.asarray(drives.joint_angles(angles))
            velocities = None if velocities is None else drives.joint_velocities(velocities)
        if columns.forces_on_motor_side:
            forces = np.asarray(drives.joint_forces(forces))
        return angles, None if velocities is None else np.asarray(velocities), forces


def open_log(
    path: str | Path,
    columns: Columns,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None = None,
    name: str | None = None,
) -> LongLog:
    """Opens a log that does not fit into memory: Parquet, or NPZ that was not compressed.

    It must be uniform in time and without gaps; every row counts.

    Args:
        path: Of the file.
        columns: What its columns hold.
        robot: Its drives lead from the motors to the joints.
        filter: For the motion, and for forces and columns; it must forget.
        decimation: For forces and columns; every sample is a row if None.
        name: Of the log; the file's if None.

    Raises:
        ValueError: If the file is of another kind, its columns are not the robot's, forces and
            columns would be aliased, or the filter needs the whole log at once.
    """
    path = Path(path)
    decimation = Subsample(1) if decimation is None else decimation
    if not path.is_file():
        raise ValueError(f"`{path}` is no file: check the path of the log.")
    if path.suffix.lower() not in (".parquet", ".npz"):
        raise ValueError(
            f"`{path.name}` must end in .parquet or .npz to be read part by part: convert it, for "
            "instance by polars' `scan_csv` and `sink_parquet`, or use `read_recording`."
        )
    parquet = path.suffix.lower() == ".parquet"
    tables = ParquetTables(path) if parquet else ArrayTables.of(path)
    first = tables.part(0, min(tables.rows, PROBE))
    n = robot.joints
    for what, selection in (("angles", columns.angles), ("forces", columns.forces)):
        found = first.array(what, selection).shape[1]
        if found != n:
            raise ValueError(
                f"`{what}` of `{path.name}` have {found} columns, but `{robot.name}` has {n} "
                "joints: name one column for each joint."
            )
    if parquet:
        tables = ParquetTables(path, _names(first, columns))
    dt = _sample_time(first, columns)
    decimation.check(filter.low_pass(dt).cutoff, dt)
    samples, edge = tables.rows, filter.edge(dt)
    rows = len(range(edge, samples - edge, decimation.factor))
    nothing = np.broadcast_to(np.zeros(1), (samples, n))
    outline = Observations(
        time=np.broadcast_to(np.zeros(1), (samples,)),
        motion=Motion(nothing, nothing, nothing),
        forces=nothing,
        filter=filter,
        decimation=decimation,
        segments=((0, samples),),
        mask=np.broadcast_to(np.ones(1, bool), (rows, n)),
        sample_time=dt,
        name=path.stem if name is None else name,
    )
    overlap = forgetting(filter, dt, columns.velocities is not None)
    return LongLog(outline, tables, columns, robot, overlap)


def source(observations: Observations | LongLog) -> tuple[Observations, Read]:
    """What becomes a row, and where motion and forces come from."""
    if isinstance(observations, LongLog):
        return observations.outline, observations.read
    return observations, held(observations)


def forgetting(filter: AbstractFilter, sample_time: float, measured: bool) -> int:
    """Samples after which a filter's motion no longer depends on an angle or velocity.

    Raises:
        ValueError: If it never forgets.
    """
    refusal = (
        f"`{type(filter).__name__}` needs the whole log at once: take another filter, or a log "
        "that fits into memory (`read_recording`)."
    )
    half = PROBE
    while half <= LONGEST:
        impulse = np.zeros((2 * half + 1, 1))
        impulse[half] = 1e-3
        try:
            motion = filter.motion(impulse, impulse if measured else None, sample_time)
        except ValueError as error:
            raise ValueError(refusal) from error
        reach = 0
        for x in (motion.q, motion.qd, motion.qdd):
            size = np.abs(np.asarray(x)[:, 0])
            last = np.flatnonzero(size > FADED * size.max())
            reach = max(reach, int(np.abs(last - half).max(initial=0)))
        if reach < half // 2:
            # What lies below rounding fades likewise.
            return int(1.3 * reach) + 4
        half *= 4
    raise ValueError(refusal)


def _names(table: Table, columns: Columns) -> tuple[str, ...] | None:
    """The columns that are needed, in the order of the file; None if they are told by position."""
    wanted = [("angles", columns.angles), ("forces", columns.forces)]
    if columns.velocities is not None:
        wanted.append(("velocities", columns.velocities))
    if columns.time is not None:
        wanted.append(("time", columns.time))
    told = (columns.angles, columns.forces, columns.velocities, columns.time)
    if any(isinstance(x, int) for t in told for x in (t if isinstance(t, tuple) else (t,))):
        return None
    chosen = set(itertools.chain.from_iterable(table.expand(*one) for one in wanted))
    return tuple(name for name in table.columns if name in chosen)


def _sample_time(table: Table, columns: Columns) -> float:
    if columns.sample_time is not None:
        return columns.sample_time
    stamps = _stamps(table, columns)
    return float((stamps[-1] - stamps[0]) / (len(stamps) - 1))


def _stamps(table: Table, columns: Columns) -> np.ndarray:
    if columns.time is None:
        raise ValueError("`columns` must name the column of the time stamps, or a `sample_time`.")
    stamps, dates = table.stamps(columns.time)
    return stamps if dates else stamps * columns.time_unit.factor


def _refuse_uneven(table: Table, columns: Columns, sample_time: float, first: int) -> None:
    steps = np.diff(_stamps(table, columns))
    wrong = np.flatnonzero(np.abs(steps - sample_time) > UNEVEN * sample_time)
    if wrong.size:
        row = int(wrong[0])
        raise ValueError(
            f"the time of `{table.source}` steps by {steps[row]:.6g} s after row "
            f"{first + row + 1}, and not by {sample_time:.6g} s: a log that is read part by part "
            "must be uniform; use `read_recording`, which divides it at gaps."
        )
