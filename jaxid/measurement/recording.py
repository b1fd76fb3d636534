"""Recordings: uniform samples of angles and forces of one experiment, in SI units."""

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.measurement.columns import Columns, Selection
from jaxid.measurement.files import LARGEST, LogTable, read_table
from jaxid.measurement.timestamps import FEWEST, Resampler, resampler, uniform_grid


class Recording(eqx.Module):
    """Log of one experiment: in SI units, uniform in time between gaps.

    Attributes:
        time: Times of the samples, uniform within each segment [s].
        angles: Angles of joints or motors, as the robot reported them, unfiltered [rad or m].
        forces: Forces of joints or motors [N m or N].
        velocities: Measured velocities, on the angles' side [rad/s or m/s]; None if not measured.
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
        name: str = "recording",
        notes: tuple[str, ...] = (),
        first_row: int = 1,
    ) -> "Recording":
        """Make a recording of arrays (samples x joints) in SI units, and check them.

        Repeated stamps are removed, uneven ones are interpolated on a uniform grid, and gaps split
        the recording into segments; `notes` says what was done.

        Args:
            angles: Angles of joints or motors [rad or m].
            forces: Forces of joints or motors [N m or N].
            velocities: Measured velocities [rad/s or m/s].
            time: Time stamps [s]; either they or `sample_time`.
            sample_time: Time between two samples [s].
            angles_on_motor_side: Whether angles and velocities are the motors'.
            forces_on_motor_side: Whether forces are the motors'.
            largest_gap: Longest pause that is bridged by interpolation, in sample times.
            name: Name of the log.
            notes: Earlier changes, as sentences.
            first_row: Number of the first row in its file, for messages.

        Raises:
            InputError: If shapes differ, a value is not finite, time runs backwards or does not
                advance, or there are fewer than ten samples.
        """
        if not largest_gap > 1.0:
            raise InputError(f"`largest_gap` must be above 1 sample time, but is {largest_gap:g}.")
        channels = {"angles": angles, "forces": forces, "velocities": velocities}
        data = {key: _real(name, key, x) for key, x in channels.items() if x is not None}
        shape = data["angles"].shape
        for key, array in data.items():
            _check_channel(name, key, array, shape, first_row)
        samples = shape[0]
        if samples < FEWEST:
            raise InputError(
                f"`{name}` has {samples} samples, but at least {FEWEST} are needed: is the log cut?"
            )
        if (time is None) == (sample_time is None):
            raise InputError("a recording needs either `time` or `sample_time`, and not both.")
        if sample_time is not None:
            if not 0 < sample_time < np.inf:
                raise InputError(f"`sample_time` must be positive [s], but is {sample_time:g}.")
            dt = float(sample_time)
            rows = np.arange(samples)
            resample = Resampler(rows, dt * rows, uniform_grid(samples, dt))
        else:
            stamps = _real(name, "time", time)
            if stamps.shape != (samples,) or not np.isfinite(stamps).all():
                raise InputError(
                    f"`time` of `{name}` must hold one finite stamp for each of the {samples} "
                    f"samples, but has shape {stamps.shape}."
                )
            resample = resampler(stamps, source=name, largest_gap=largest_gap, first_row=first_row)
        return cls(
            time=np.concatenate(resample.times),
            angles=resample(data["angles"]),
            forces=resample(data["forces"]),
            velocities=None if velocities is None else resample(data["velocities"]),
            angles_on_motor_side=angles_on_motor_side,
            forces_on_motor_side=forces_on_motor_side,
            segments=resample.segments,
            sample_time=resample.grid.sample_time,
            name=name,
            notes=(*notes, *resample.notes),
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

    def crop(self, start: float | int = -np.inf, stop: float | int = np.inf) -> "Recording":
        """Return the part from `start` [s] on and before `stop` [s], on the clock of `time`.

        Raises:
            InputError: If fewer than ten samples are left.
        """
        slack = 1e-6 * self.sample_time
        a, b = (int(i) for i in np.searchsorted(self.time, [start - slack, stop - slack]))
        if b - a < FEWEST:
            raise InputError(
                f"`{self.name}` has {max(b - a, 0)} samples from {start:g} s to {stop:g} s, but at "
                f"least {FEWEST} are needed: it lasts from {self.time[0]:g} s to "
                f"{self.time[-1]:g} s."
            )
        return self._range(a, b)

    def split(self, fraction: float) -> "tuple[Recording, Recording]":
        """Return the first fraction (0 to 1) of the recorded time, and the rest.

        Raises:
            InputError: If a part has fewer than ten samples.
        """
        cut = round(fraction * self.samples)
        if not FEWEST <= cut <= self.samples - FEWEST:
            raise InputError(
                f"`fraction` must leave at least {FEWEST} samples on both sides, but {fraction:g} "
                f"of the {self.samples} samples of `{self.name}` leaves {cut}."
            )
        return self._range(0, cut), self._range(cut, self.samples)

    def _range(self, a: int, b: int) -> "Recording":
        segments = ((max(i, a) - a, min(j, b) - a) for i, j in self.segments)
        return dataclasses.replace(
            self,
            time=self.time[a:b],
            angles=self.angles[a:b],
            forces=self.forces[a:b],
            velocities=None if self.velocities is None else self.velocities[a:b],
            segments=tuple((i, j) for i, j in segments if i < j),
        )


def _real(name: str, key: str, value: Any) -> np.ndarray:
    if np.iscomplexobj(value):
        raise InputError(f"`{key}` of `{name}` holds complex numbers: give real ones.")
    return np.array(value, np.float64)


def _check_channel(
    name: str, key: str, array: np.ndarray, shape: tuple[int, ...], first_row: int
) -> None:
    if array.ndim != 2 or array.shape != shape:
        raise InputError(
            f"`{key}` of `{name}` must have one row for each sample and one column for "
            f"each joint, like `angles` with shape {shape}, but has shape {array.shape}."
        )
    if not np.isfinite(array).all():
        row, joint = (int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(
            f"`{key}` of `{name}` must be finite, but are {array[row, joint]} for joint "
            f"{joint + 1} at row {row + first_row}: repair or remove the row."
        )
    if np.abs(array).max(initial=0.0) > LARGEST:
        raise InputError(
            f"`{key}` of `{name}` must be numbers that can be measured, but go up to "
            f"{np.abs(array).max():.3g}: check their units, or remove the rows."
        )


def read_recording(
    path: str | Path,
    columns: Columns,
    name: str | None = None,
    *,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    largest_gap: float | int = 1.75,
) -> Recording:
    """Read a log from CSV (any separator, with or without header), Parquet, NPZ or MAT.

    Args:
        path: File with the angles, and with all other channels that have no file of their own.
        columns: Meaning of the columns.
        name: Name of the recording; the file's if None.
        forces_path: File with the forces.
        velocities_path: File with the velocities.
        largest_gap: Longest pause that is bridged by interpolation, in sample times; longer ones
            split the recording into segments.

    Raises:
        InputError: If a file, a column, a number or the time is invalid; the message names file,
            column and line.
    """
    if velocities_path is not None and columns.velocities is None:
        raise InputError("`velocities_path` is given, but `Columns.velocities` names no columns.")
    table = read_table(path)
    forces_table = table if forces_path is None else read_table(forces_path)
    velocities_table = table if velocities_path is None else read_table(velocities_path)
    shared: dict = {"angles": columns.angles, "time": columns.time}
    if forces_path is None:
        shared["forces"] = columns.forces
    if velocities_path is None:
        shared["velocities"] = columns.velocities
    table.refuse_shared(shared)
    angles = table.array("angles", columns.angles)
    joints = angles.shape[1]
    forces = _channel_like(angles, table, forces_table, "forces", columns.forces)
    velocities = None
    if columns.velocities is not None:
        velocities = _channel_like(
            angles, table, velocities_table, "velocities", columns.velocities
        )
        velocities = velocities * columns.velocity_scale(joints)
    stamps = None
    if columns.time is not None:
        stamps, dates = table.stamps(columns.time)
        stamps = stamps if dates else stamps * columns.time_unit.factor
        if len(stamps) != len(angles):
            raise InputError(
                f"`time` of `{table.source}` has {len(stamps)} stamps for {len(angles)} samples of "
                "the angles: arrays must have one row for each sample (transpose them)."
            )
    return Recording.of(
        angles * columns.angle_scale(joints) + columns.angle_shift(joints),
        forces * columns.force_scale(joints),
        velocities=velocities,
        time=stamps,
        sample_time=columns.sample_time,
        angles_on_motor_side=columns.angles_on_motor_side,
        forces_on_motor_side=columns.forces_on_motor_side,
        largest_gap=largest_gap,
        name=Path(path).stem if name is None else name,
        first_row=1 if table.first_line is None else table.first_line,
    )


def _channel_like(
    angles: np.ndarray,
    angles_table: LogTable,
    table: LogTable,
    channel: str,
    selection: Selection,
) -> np.ndarray:
    """Return a channel with as many samples and joints as the angles."""
    array = table.array(channel, selection)
    if len(array) != len(angles):
        raise InputError(
            f"`{channel}` in `{table.source}` have {len(array)} samples, but the angles in "
            f"`{angles_table.source}` have {len(angles)}: they must be of one run, row by row."
        )
    if array.shape[1] != angles.shape[1]:
        raise InputError(
            f"`{channel}` in `{table.source}` have {array.shape[1]} joints, but the angles in "
            f"`{angles_table.source}` have {angles.shape[1]}: name one column for each joint."
        )
    return array


def remove_delay(recording: Recording, seconds: float) -> Recording:
    """Remove a delay of the forces, also by a fraction of a sample.

    The forces stay as they are; the angles, which are smooth, are interpolated by cubic splines to
    the instants at which the forces acted. Samples at the ends of segments for which there are no
    angles are dropped.

    Args:
        recording: Recording whose forces are delayed.
        seconds: Delay of the forces [s]; negative if they are early.

    Raises:
        InputError: If the delay is longer than the segments.
    """
    require_finite_delay(seconds)
    lost = math.ceil(abs(seconds) / recording.sample_time - 1e-9)
    early, late = (lost, 0) if seconds > 0 else (0, lost)
    whole = [(a, b) for a, b in recording.segments if b - a - lost >= FEWEST]
    if not whole:
        raise InputError(
            f"the delay is {seconds:g} s, but the longest segment of `{recording.name}` lasts "
            f"{max(b - a for a, b in recording.segments) * recording.sample_time:g} s."
        )
    kept = [np.arange(a + early, b - late) for a, b in whole]
    ends = np.cumsum([0, *map(len, kept)]).tolist()
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
        velocities=None if recording.velocities is None else shift(recording.velocities),
        segments=tuple(itertools.pairwise(ends)),
        notes=(*recording.notes, f"a delay of the forces of {1e3 * seconds:.4g} ms was removed"),
    )


def require_finite_delay(seconds: float) -> None:
    """Refuse a delay that is infinite or not a number."""
    if not math.isfinite(seconds):
        raise InputError(f"the delay must be a finite time [s], but is {seconds:g}.")
