"""What one experiment left behind: uniform samples of angles and forces, in SI units."""

import dataclasses

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.measurement.clock import clock, uniform
from jaxid.measurement.tables import LARGEST

FEWEST = 10
"""Samples below which nothing can be filtered."""


class Recording(eqx.Module):
    """A log of one experiment: in SI units, uniform in time between gaps.

    Attributes:
        time: Of the samples; uniform within each segment [s].
        angles: Of joints or motors, as the robot reported them, unfiltered [rad or m].
        forces: Of joints or motors [N m or N].
        velocities: Measured, on the angles' side [rad/s or m/s]; None if not measured.
        angles_on_motor_side: Whether angles and velocities are the motors'.
        forces_on_motor_side: Whether forces are the motors'.
        segments: Half-open ranges of samples without gaps.
        sample_time: Time between two samples [s].
        name: Of the log.
        notes: What was changed on the way from the file, in sentences.
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
        """Makes a recording of arrays (samples x joints) in SI units and checks it.

        Repeated stamps are removed, uneven ones lead to interpolation on a uniform grid, and gaps
        split the recording into segments; `notes` says what was done.

        Args:
            angles: Of joints or motors [rad or m].
            forces: Of joints or motors [N m or N].
            velocities: Measured velocities [rad/s or m/s].
            time: Time stamps [s]; either they or `sample_time`.
            sample_time: Time between two samples [s].
            angles_on_motor_side: Whether angles and velocities are the motors'.
            forces_on_motor_side: Whether forces are the motors'.
            largest_gap: Longest pause that is bridged by interpolation, in sample times.
            name: Of the log.
            notes: What happened before, in sentences.
            first_row: Number of the first row in its file, for messages.

        Raises:
            InputError: If shapes differ, a value is not finite, time runs backwards or stands
                still, or there are fewer than ten samples.
        """
        if any(np.iscomplexobj(x) for x in (angles, forces, velocities, time) if x is not None):
            raise InputError(f"`{name}` holds complex numbers: give real ones.")
        if not largest_gap > 1.0:
            raise InputError(f"`largest_gap` must be above 1 sample time, but is {largest_gap:g}.")
        data = {"angles": np.array(angles, np.float64), "forces": np.array(forces, np.float64)}
        if velocities is not None:
            data["velocities"] = np.array(velocities, np.float64)
        shape = data["angles"].shape
        for key, array in data.items():
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
            ticks = uniform(samples, float(sample_time))
        else:
            stamps = np.array(time, np.float64)
            if stamps.shape != (samples,) or not np.isfinite(stamps).all():
                raise InputError(
                    f"`time` of `{name}` must hold one finite stamp for each of the {samples} "
                    f"samples, but has shape {stamps.shape}."
                )
            ticks = clock(stamps, source=name, largest_gap=largest_gap, first_row=first_row)
        return cls(
            time=ticks.grid(),
            angles=ticks.resample(data["angles"]),
            forces=ticks.resample(data["forces"]),
            velocities=None if velocities is None else ticks.resample(data["velocities"]),
            angles_on_motor_side=angles_on_motor_side,
            forces_on_motor_side=forces_on_motor_side,
            segments=ticks.segments(),
            sample_time=ticks.sample_time,
            name=name,
            notes=(*notes, *ticks.notes),
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
        """Time that was recorded, gaps not counted [s]."""
        return self.samples * self.sample_time

    def crop(self, start: float | int = -np.inf, stop: float | int = np.inf) -> "Recording":
        """The part from `start` [s] on and before `stop` [s], on the clock of `time`.

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
        """The first `fraction` of the recorded time, and the rest: to fit and to check.

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
