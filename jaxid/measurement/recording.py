"""Recordings: uniform samples of angles and forces of one experiment, in SI units."""

import dataclasses
import itertools
import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray, Float, JointSamples, Matrix, Texts, Vector
from jaxid.errors import InputError

from .time_grid import MIN_SAMPLES, Ranges, TimeGrid, resampling
from .time_series import interpolate_turns
from .time_stamps import refuse_shared_stamps

MAX_NUMBER = 1e30
"""Largest number in a log, in any unit: its square still is finite."""
JUDGED_WAY_TIME = 0.2
"""Time within which velocities must make the way of their angles [s]."""
MAX_WAY_ERROR = 0.2
"""Largest error of the way of velocities, relative to that of the angles (RMS)."""
MIN_WAY_TO_NOISE = 10.0
"""Way over noise of the angles (RMS) from which velocities are judged."""


class BaseSignals(eqx.Module):
    """Signals of a floating base, in the frame of its IMU.

    Attributes:
        rates: Angular velocity, as a gyroscope measures it [rad/s].
        accelerations: Acceleration less gravity, as an accelerometer measures it
            [m/s²].
        contacts: Whether each foot stands, as 1 or 0 [samples contacts].
    """

    rates: Float[AnyArray, "samples 3"]
    accelerations: Float[AnyArray, "samples 3"]
    contacts: Float[AnyArray, "samples contacts"]

    @property
    def stands(self) -> np.ndarray:
        """Whether each foot stands."""
        return np.asarray(self.contacts) > 0.5


class Recording(eqx.Module):
    """Log of one experiment: in SI units, uniform in time between gaps.

    Attributes:
        time: Times of the samples, uniform within each segment [s].
        angles: Angles of joints or motors, as the robot reported them, unfiltered [rad
            or m].
        forces: Forces of joints or motors [N m or N]; None if not measured.
        velocities: Measured velocities, on the angles' side [rad/s or m/s]; None if not
            measured.
        angles_on_motor_side: Whether angles and velocities are the motors'.
        forces_on_motor_side: Whether forces are the motors'.
        segments: Half-open ranges of samples without gaps.
        sample_time: Time between two samples [s].
        name: Name of the log.
        notes: Changes between the file and these samples, as sentences.
        stamp_deviation: Largest deviation of the time stamps from a uniform grid, in
            sample times; None if the sample time was given instead.
        angle_unit: Unit of the angles in the file, for messages.
        wrench: Force and moment that each force sensor exerts on what is behind it [N,
            N m]; None if there are none.
        base: Signals of a floating base; None if there are none.
        commands: Commanded angles, on the angles' side [rad or m]; None if there are
            none.
    """

    time: Float[AnyArray, " samples"]
    angles: JointSamples
    forces: JointSamples | None
    velocities: JointSamples | None
    angles_on_motor_side: bool = eqx.field(static=True)
    forces_on_motor_side: bool = eqx.field(static=True)
    segments: Ranges = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="recording")
    notes: Texts = eqx.field(static=True, default=())
    stamp_deviation: float | None = eqx.field(static=True, default=None)
    angle_unit: str = eqx.field(static=True, default="rad")
    wrench: Float[AnyArray, "samples wrenches"] | None = None
    base: BaseSignals | None = None
    commands: JointSamples | None = None

    @classmethod
    def of(
        cls,
        angles: ArrayLike,
        forces: ArrayLike | None,
        *,
        velocities: ArrayLike | None = None,
        commands: ArrayLike | None = None,
        wrench: ArrayLike | None = None,
        gyro: ArrayLike | None = None,
        accelerometer: ArrayLike | None = None,
        contact: ArrayLike | None = None,
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

        Arrays of `float64` are not copied.
        Repeated stamps are removed, uneven ones are interpolated on a uniform grid, and
        gaps split the recording into segments; `notes` says what was done.

        Args:
            angles: Angles of joints or motors [rad or m].
            forces: Forces of joints or motors [N m or N]; None if only wrenches are
                measured.
            velocities: Measured velocities [rad/s or m/s].
            commands: Commanded angles [rad or m].
            wrench: Force and moment that each force sensor exerts on what is behind it:
                three forces [N], three moments [N m].
            gyro: Angular velocity of a floating base, in the frame of its IMU [rad/s].
            accelerometer: Acceleration that the IMU measures there [m/s²].
            contact: Whether each foot stands, as 1 or 0 (samples x contacts).
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
            InputError: If shapes differ, a value is not finite, the clock was set back
                or stands still, or there are fewer than ten samples.
        """
        if not largest_gap > 1.0:
            raise InputError(
                f"`largest_gap` must be above 1 sample time, but is {largest_gap:g}."
            )
        channels = {
            "angles": angles,
            "forces": forces,
            "velocities": velocities,
            "commands": commands,
        }
        shape = np.shape(angles)
        data: dict[str, Any] = {
            key: None if x is None else finite_channel(name, key, x, shape, first_row)
            for key, x in channels.items()
        }
        samples = len(data["angles"])
        if wrench is None and forces is None and commands is None:
            raise InputError(
                f"`{name}` needs `forces`, a `wrench` or `commands`, but has none of "
                "them."
            )
        if wrench is not None:
            size = (samples, np.shape(wrench)[-1])
            data["wrench"] = finite_channel(name, "wrench", wrench, size, first_row)
        signals = {"gyro": gyro, "accelerometer": accelerometer, "contact": contact}
        data |= _base_channels(name, samples, signals, first_row)
        if samples < MIN_SAMPLES:
            raise InputError(
                f"`{name}` has {samples} samples, but at least {MIN_SAMPLES} are "
                "needed: is the log cut?"
            )
        if (time is None) == (sample_time is None):
            raise InputError(
                "a recording needs either `time` or `sample_time`, and not both."
            )
        if time is not None:
            stamps = _finite_stamps(name, time, samples)
            refuse_shared_stamps(stamps, data["angles"], name)
            resample = resampling(stamps, name, (largest_gap, bridged), first_row)
            grid = resample.grid
            rows = data
            data = {key: None if x is None else resample(x) for key, x in data.items()}
            for key in ("angles", "commands"):
                if not grid.is_exact and rows[key] is not None:
                    data[key] = interpolate_turns(resample, rows[key])
            times = resample.times
            deviation = grid.deviation / grid.sample_time
        else:
            dt = positive_time(sample_time or 0.0)
            grid = TimeGrid(dt, {(0, samples): 0.0})
            times = [dt * np.arange(samples)]
            deviation = None
        signals = [data.pop(key, None) for key in signals]
        return cls(
            time=np.concatenate(times),
            **data,
            base=None if signals[0] is None else BaseSignals(*signals),
            angles_on_motor_side=angles_on_motor_side,
            forces_on_motor_side=forces_on_motor_side,
            segments=consecutive(map(len, times)),
            sample_time=grid.sample_time,
            name=name,
            notes=grid.notes,
            stamp_deviation=deviation,
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
    def grid(self) -> TimeGrid:
        """Segments, their start times and notes."""
        segments = {(a, b): float(self.time[a]) for a, b in self.segments}
        return TimeGrid(self.sample_time, segments, self.notes)

    def crop(
        self, start: float | int = -np.inf, stop: float | int = np.inf
    ) -> "Recording":
        """Return the part from `start` [s] on and before `stop` [s], by its clock.

        Raises:
            InputError: If fewer than ten samples are left.
        """
        ranges = [*self.grid.cropped(start, stop, self.name).segments]
        return self._range(ranges[0][0], ranges[-1][1])

    def split(self, fraction: float) -> "tuple[Recording, Recording]":
        """Return the first fraction (0 to 1) of the recorded time, and the rest.

        Raises:
            InputError: If a part has fewer than ten samples.
        """
        cut = round(fraction * self.samples)
        if not MIN_SAMPLES <= cut <= self.samples - MIN_SAMPLES:
            raise InputError(
                f"`fraction` must leave at least {MIN_SAMPLES} samples on both sides, "
                f"but {fraction:g} of the {self.samples} samples of `{self.name}` "
                f"leaves {cut}."
            )
        return self._range(0, cut), self._range(cut, self.samples)

    def _range(self, start: int, stop: int) -> "Recording":
        """Return some samples, with the segments that they touch."""
        bounds = np.clip(self.segments, start, stop) - start
        segments = tuple((a, b) for a, b in bounds.tolist() if a < b)
        part = jax.tree.map(lambda x: x[start:stop], self)
        return dataclasses.replace(part, segments=segments)


def _base_channels(
    name: str, samples: int, signals: dict[str, Any], first_row: int
) -> dict[str, np.ndarray]:
    """Return the channels of a floating base, checked; nothing if there are none.

    Raises:
        InputError: If only one of gyroscope and accelerometer is there.
    """
    imu = [key for key in ("gyro", "accelerometer") if signals[key] is not None]
    if not imu and signals["contact"] is None:
        return {}
    if len(imu) < 2:
        raise InputError(
            f"`{name}` must have both `gyro` and `accelerometer` of the base, but has "
            f"{'only `' + imu[0] + '`' if imu else 'neither'}."
        )
    widths = dict.fromkeys(imu, 3)
    if signals["contact"] is None:
        signals = signals | {"contact": np.zeros((samples, 0))}
    widths["contact"] = np.shape(signals["contact"])[-1]
    return {
        key: finite_channel(name, key, signals[key], (samples, width), first_row)
        for key, width in widths.items()
    }


def finite_channel(
    name: str, key: str, value: ArrayLike, shape: tuple[int, ...], first_row: int
) -> Matrix:
    """Return a channel as finite real numbers."""
    array = np.asarray(value, np.float64)
    if array.ndim != 2 or array.shape != shape:
        raise InputError(
            f"`{key}` of `{name}` must have one row for each sample and one column "
            f"for each joint, like the angles with shape {shape}, but has shape "
            f"{array.shape}."
        )
    if not array.size or max(-array.min(), array.max()) <= MAX_NUMBER:
        return array
    # NaN is neither above nor below the limit.
    row, joint = np.argwhere(~(np.abs(array) <= MAX_NUMBER))[0].tolist()
    raise InputError(
        f"`{key}` of `{name}` must be finite and below {MAX_NUMBER:g}, but are "
        f"{array[row, joint]:.3g} for joint {joint + 1} at row {row + first_row}: "
        "check the unit, or repair or remove that row."
    )


def _finite_stamps(name: str, time: ArrayLike, samples: int) -> Vector:
    """Return time stamps as finite numbers."""
    stamps = np.array(time, np.float64)
    if stamps.shape != (samples,) or not np.isfinite(stamps).all():
        raise InputError(
            f"`time` of `{name}` must hold {samples} finite stamps, but has shape "
            f"{stamps.shape} or stamps that are not finite."
        )
    return stamps


def positive_time(sample_time: float) -> float:
    """Check and return the time between two samples [s]."""
    if not 0 < sample_time < np.inf:
        raise InputError(f"`sample_time` must be positive [s], but is {sample_time:g}.")
    return float(sample_time)


def consecutive(lengths: Iterable[int]) -> Ranges:
    """Return half-open ranges of these lengths, one behind the other."""
    return tuple(itertools.pairwise(itertools.accumulate(lengths, initial=0)))


def unlike_derivatives(recording: Recording) -> dict[int, float]:
    """Return the channels whose velocities do not make the way of their angles.

    The ways of 0.2 s are compared. Only channels whose way is well above the noise of
    their angles are judged. Each comes with the factor by which its velocities are too
    large.
    """
    dt = recording.sample_time
    steps = max(1, round(JUDGED_WAY_TIME / dt))
    # Sums of squares and products over all windows.
    errors = np.zeros(recording.joints)
    ways = np.zeros(recording.joints)
    noises = np.zeros(recording.joints)
    products = np.zeros(recording.joints)
    for a, b in recording.segments:
        q = np.asarray(recording.angles)[a:b]
        qd = np.asarray(recording.velocities)[a:b]
        integral = scipy.integrate.cumulative_trapezoid(qd, dx=dt, axis=0, initial=0.0)
        way = q[steps:] - q[:-steps]
        expected_way = integral[steps:] - integral[:-steps]
        error = way - expected_way
        noise = np.diff(q, 2, axis=0)

        errors += np.sum(error**2, axis=0)
        ways += np.sum(way**2, axis=0)
        noises += np.sum(noise**2, axis=0)
        products += np.sum(way * expected_way, axis=0)
    is_wrong = errors > MAX_WAY_ERROR**2 * ways
    is_clear = ways > MIN_WAY_TO_NOISE**2 * noises
    channels = np.flatnonzero(is_wrong & is_clear).tolist()
    return {k: float(products[k] / ways[k]) for k in channels}


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
    lost_samples = math.ceil(abs(seconds) / recording.sample_time - 1e-9)
    longest_segment = max(b - a for a, b in recording.segments)
    if longest_segment - lost_samples < MIN_SAMPLES:
        raise InputError(
            f"the delay is {seconds:g} s, but the longest segment of "
            f"`{recording.name}` lasts {longest_segment * recording.sample_time:g} s."
        )
    parts = [
        _without_delay(recording._range(a, b), seconds, lost_samples)
        for a, b in recording.segments
        if b - a - lost_samples >= MIN_SAMPLES
    ]
    note = f"a delay of the forces of {1e3 * seconds:.4g} ms was removed"
    return dataclasses.replace(
        recording,
        **jax.tree.map(lambda *x: np.concatenate(x), *parts),
        segments=consecutive(len(part["time"]) for part in parts),
        notes=(*recording.notes, note),
    )


def _without_delay(segment: Recording, seconds: float, lost_samples: int) -> dict:
    """Return the arrays of a segment, with angles at the instants of the forces."""
    start = lost_samples if seconds > 0 else 0
    samples = slice(start, start + segment.samples - lost_samples)
    time = np.asarray(segment.time)

    def shift(values):
        if values is None:
            return None
        return scipy.interpolate.CubicSpline(time, values)(time[samples] - seconds)

    return {
        "time": time[samples],
        "angles": shift(segment.angles),
        "forces": _part(segment.forces, samples),
        "velocities": shift(segment.velocities),
        "commands": shift(segment.commands),
        "wrench": _part(segment.wrench, samples),
    }


def _part(values: AnyArray | None, samples: slice) -> AnyArray | None:
    """Return some samples of a channel; None if it is not measured."""
    return None if values is None else np.asarray(values)[samples]


def require_finite_delay(seconds: float) -> None:
    """Refuse a delay that is infinite or not a number."""
    if not math.isfinite(seconds):
        raise InputError(f"the delay must be a finite time [s], but is {seconds:g}.")
