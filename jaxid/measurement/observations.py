"""Observations: motion and forces of a log, and the filters that make rows (Eq. 26)."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import (
    AnyArray,
    Bool,
    Float,
    JointSamples,
    Numbers,
    Texts,
    Vector,
)
from jaxid.dynamics.contact_elimination import contact_mask
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import per_joint
from jaxid.robot.robot import Robot

from .filters import AbstractFilter, Subsample, ZeroPhaseButterworth
from .filters.filter import EVERY_SAMPLE
from .floating_base import contact_grid, floating_samples
from .force_sensors import (
    measured_joints,
    refuse_missing_wrench,
    speeds_of_all_joints,
    with_wrench,
)
from .recording import (
    Recording,
    consecutive,
    finite_channel,
    positive_time,
    unlike_derivatives,
)
from .samples import (
    AbstractSamples,
    Chunk,
    MotionAndForces,
    Overlap,
    SamplesInMemory,
    joined,
    joint_side,
)
from .time_grid import Range, Ranges, TimeGrid, usable_segments

Progress = Callable[[float], None]
"""Callback, called with the completed fraction (0 to 1)."""


class Observations(eqx.Module):
    """Motion and forces at the full rate, joint side, and the filters that make rows.

    The samples are in memory (`observe`, `Observations.of`) or stay on disk
    (`scan_log`).

    Attributes:
        source: Motion and forces of the samples.
        filter: Filter of forces and columns.
        decimation: Samples that become rows of forces and columns.
        segments: Half-open ranges of samples without gaps.
        start_times: Time of the first sample of each segment [s].
        mask: Rows that count, for each joint.
        sample_time: Time between two samples [s].
        name: Name of the recording.
        notes: Remarks on what was changed or left out, as sentences.
    """

    source: AbstractSamples
    filter: AbstractFilter
    decimation: Subsample
    segments: Ranges = eqx.field(static=True)
    start_times: tuple[float, ...] = eqx.field(static=True)
    mask: Bool[np.ndarray, "rows joints"]
    sample_time: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="observations")
    notes: Texts = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        forces: ArrayLike,
        *,
        sample_time: float | int,
        filter: AbstractFilter | None = None,
        decimation: Subsample = EVERY_SAMPLE,
        segments: Sequence[Range] | None = None,
        mask: ArrayLike | None = None,
        name: str = "observations",
    ) -> "Observations":
        """Make observations of arrays (samples x joints) of the joint side.

        The motion must be filtered already; arrays of `float64` are not copied.

        Args:
            q: Joint angles [rad or m].
            qd: Velocities [rad/s or m/s].
            qdd: Accelerations [rad/s² or m/s²].
            forces: Generalised forces [N m or N].
            sample_time: Time between two samples [s].
            filter: Filter of forces and columns; neither is filtered if None.
            decimation: Samples that become rows; by default every sample.
            segments: Half-open ranges of samples without gaps; one segment if None.
            mask: Rows that count (rows x joints); all if None.
            name: Name of the observations.

        Raises:
            InputError: If shapes differ, values are not finite, or `sample_time` is not
                positive.
        """
        arrays = {"q": q, "qd": qd, "qdd": qdd, "forces": forces}
        shape = np.shape(q)
        data = {
            key: finite_channel(name, key, x, shape, 1) for key, x in arrays.items()
        }
        dt = positive_time(sample_time)
        filter = ZeroPhaseButterworth(math.inf) if filter is None else filter
        segments = ((0, len(data["q"])),) if segments is None else tuple(segments)
        row_samples = _row_samples(segments, filter.edge(dt), decimation.step)
        mask_shape = (sum(map(len, row_samples)), shape[1])
        mask = np.ones(mask_shape, bool) if mask is None else np.asarray(mask, bool)
        if mask.shape != mask_shape:
            raise InputError(
                f"`mask` must have the shape {mask_shape}, but has {mask.shape}."
            )
        motion = Motion(data["q"], data["qd"], data["qdd"])
        return cls(
            source=SamplesInMemory(motion, data["forces"]),
            filter=filter,
            decimation=decimation,
            segments=segments,
            start_times=tuple(a * dt for a, _ in segments),
            mask=mask,
            sample_time=dt,
            name=name,
        )

    def replace(self, **changes: Any) -> "Observations":
        """Return the same observations with other fields.

        `motion` and `forces` are fields too.
        """
        if "motion" in changes or "forces" in changes:
            motion, forces = self.source.read_all()
            changes["source"] = SamplesInMemory(
                changes.pop("motion", motion), changes.pop("forces", forces)
            )
        return dataclasses.replace(self, **changes)

    @property
    def motion(self) -> Motion:
        """Filtered joint angles, velocities and accelerations of all samples."""
        return self.source.read_all()[0]

    @property
    def forces(self) -> JointSamples:
        """Generalised forces of all samples, not filtered [N m or N]."""
        return self.source.read_all()[1]

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples [s]."""
        return self._times(_row_samples(self.segments, 0, 1))

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.segments[-1][1]

    @property
    def duration(self) -> float:
        """Recorded time without gaps [s]."""
        return self.samples * self.sample_time

    @property
    def rows(self) -> int:
        """Number of rows of each joint after decimation, masked ones included."""
        return self.mask.shape[0]

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.mask.shape[1]

    @property
    def row_time(self) -> float:
        """Time between two rows [s]."""
        return self.sample_time * self.decimation.step

    @property
    def row_segments(self) -> Ranges:
        """Half-open ranges of rows without gaps."""
        return consecutive(map(len, self._row_samples()))

    @property
    def instants(self) -> np.ndarray:
        """Indices of the samples at which the rows lie."""
        parts = [np.arange(r.start, r.stop, r.step) for r in self._row_samples()]
        return np.concatenate(parts)

    def _row_samples(self) -> list[range]:
        edge = self.filter.edge(self.sample_time)
        return _row_samples(self.segments, edge, self.decimation.step)

    def _times(self, samples: Sequence[range]) -> Vector:
        """Return the times of samples of each segment [s]."""
        parts = []
        segments = zip(samples, self.segments, self.start_times, strict=True)
        for indices, (a, _), start in segments:
            parts.append(start + self.sample_time * (np.asarray(indices) - a))
        return np.concatenate(parts)

    def read(self, samples: slice) -> MotionAndForces:
        """Return motion and forces of some samples of one segment."""
        return self.source.read(samples)

    def row_motion(self, rows: slice) -> Motion:
        """Return the motion at some rows of one segment; it is not reduced."""
        samples = self.instants[rows]
        first_sample = int(samples[0])
        last_sample = int(samples[-1])
        step = self.decimation.step
        motion, _ = self.read(slice(first_sample, last_sample + 1, step))
        return motion

    def reduce(self, x: Float[AnyArray, "samples *columns"]) -> np.ndarray:
        """Turn forces or columns at all samples into rows (Eq. 26).

        The steps are smoothing, trimming and decimation. They are linear, and the same
        for every column: what holds between columns and forces at the samples holds
        between the rows.
        """
        edge = self.filter.edge(self.sample_time)
        parts = []
        for a, b in self.segments:
            inner_samples = slice(edge, b - a - edge)
            parts.append(self._reduce(inner_samples, x[a:b]))
        return np.concatenate(parts)

    def _reduce(self, samples: slice, x: AnyArray) -> np.ndarray:
        """Smooth, and take the rows among the samples between the edges."""
        smooth_samples = self.filter.smooth(x, self.sample_time)
        return smooth_samples[samples][:: self.decimation.step]

    def chunks(
        self, samples: int = 16384, row_ranges: Sequence[Range] | None = None
    ) -> tuple[Chunk, ...]:
        """Divide into parts of about so many samples, with the filters' overlap.

        For columns that do not fit into memory at the full rate: evaluate them at the
        motion of `read(slice(*chunk.samples))`, and `chunk.reduce` gives the rows
        `slice(*chunk.rows)` of `reduce`, up to rounding.

        Args:
            samples: Number of samples of a part.
            row_ranges: Half-open ranges of the rows that are needed; all if None.
        """
        overlap = Overlap(
            edge=self.filter.edge(self.sample_time),
            smoothing=self.filter.low_pass(self.sample_time).memory(),
            step=self.decimation.step,
        )
        reduce = self._reduce
        step = max(1, samples // overlap.step)
        chunks = []
        for segment, segment_rows in zip(self.segments, self.row_segments, strict=True):
            first_row, end_row = segment_rows
            for start, stop in [segment_rows] if row_ranges is None else row_ranges:
                stop = min(stop, end_row)
                for row in range(max(start, first_row), stop, step):
                    rows = (row, min(row + step, stop))
                    chunks.append(overlap.chunk(segment, first_row, rows, reduce))
        return tuple(chunks)

    def split(self, fraction: float) -> tuple["Observations", "Observations"]:
        """Divide the rows in time: a part for identification, the rest for validation.

        The log is filtered as a whole: no rows are lost where it is divided.

        Args:
            fraction: Fraction (0 to 1) of the recording's duration in the first part.

        Raises:
            InputError: If `fraction` is not between 0 and 1, or a part has no rows.
        """
        if not 0 < fraction < 1:
            raise InputError(
                f"`fraction` must lie between 0 and 1, but is {fraction:g}."
            )
        a, b = self.segments[-1]
        start_time = self.start_times[0]
        end_time = self.start_times[-1] + (b - a - 1) * self.sample_time
        middle_time = float(start_time + fraction * (end_time - start_time))
        is_early = self.reduced_time[:, None] < middle_time
        mask = self.mask
        first_part = self.replace(mask=mask & is_early)
        second_part = self.replace(mask=mask & ~is_early)
        has_rows = mask.any(axis=0)
        for part in (first_part, second_part):
            if (has_rows & ~part.mask.any(axis=0)).any():
                raise InputError(
                    f"`fraction` of {fraction:g} leaves no rows of some joint of "
                    f"`{self.name}`: validate with another log (`--verify`)."
                )
        return first_part, second_part

    @property
    def reduced_time(self) -> Float[np.ndarray, " rows"]:
        """Times of the rows [s]."""
        return self._times(self._row_samples())

    @property
    def reduced_forces(self) -> Float[np.ndarray, "rows joints"]:
        """Forces of the rows, filtered and decimated [N m or N]."""
        return self.reduce(self.forces)

    @property
    def reduced_motion(self) -> Motion:
        """Motion at the rows' instants, for figures; it is not reduced like columns."""
        return self.motion[self.instants]


ObservedLogs = Observations | Sequence[Observations]
"""Observations of one log, or of several."""


def observe(
    recording: Recording,
    robot: Robot,
    filter: AbstractFilter,
    decimation: Subsample = EVERY_SAMPLE,
    min_speed: Numbers | None = None,
    name: str | None = None,
) -> Observations:
    """Prepare a recording for estimation: joint side, derivatives, rows and their mask.

    Args:
        recording: Recording of the robot.
        robot: Robot, whose drives convert from motors to joints where the recording
            needs it.
        filter: Filter of the motion, and of forces and columns.
        decimation: Samples that become rows; by default every sample.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s],
            since stiction is not in the model.
        name: Name of the observations; the recording's if None.

    Raises:
        InputError: If the numbers of joints differ, forces and columns would be
            aliased, nothing is left between the edges of the segments, or some joint is
            never fast enough.
    """
    notes = ()
    if recording.velocities is not None:
        wrong_channels = unlike_derivatives(recording)
        if wrong_channels:
            numbers = ", ".join(str(j + 1) for j in wrong_channels)
            note = (
                f"the velocities of channels {numbers} are not the derivatives of "
                "their angles: all velocities are taken from the angles"
            )
            notes = (note,)
            recording = dataclasses.replace(recording, velocities=None)

    refuse_missing_wrench(recording, robot)
    if recording.forces is None and recording.wrench is None:
        raise InputError(
            f"`{recording.name}` has no forces: name their columns (`forces`)."
        )
    measured_forces = recording.forces
    if measured_forces is None:
        measured_forces = np.zeros(recording.angles.shape)

    def load(segments: Iterable[Range]) -> SamplesInMemory:
        if robot.floating:
            return floating_samples(recording, robot, filter, [*segments])
        q, qd, forces = joint_side(
            robot, recording, recording.angles, recording.velocities, measured_forces
        )
        parts = []
        for a, b in segments:
            segment_qd = None if qd is None else qd[a:b]
            motion = filter.motion(q[a:b], segment_qd, recording.sample_time)
            samples = (motion, forces[a:b])
            if recording.wrench is not None:
                samples = with_wrench(robot, *samples, recording.wrench[a:b])
            parts.append(samples)
        return SamplesInMemory(*joined(parts))

    observations = prepare(
        load,
        contact_grid(recording, robot) if robot.floating else recording.grid,
        recording.joints + len(robot.virtual),
        recording.velocities is not None,
        robot,
        filter,
        decimation,
        speeds_of_all_joints(robot, min_speed),
        recording.name if name is None else name,
    )
    mask = observations.mask & measured_joints(robot, recording)
    if robot.contacts:
        mask = mask & contact_mask(robot, observations.reduced_motion)
    return observations.replace(notes=(*observations.notes, *notes), mask=mask)


def prepare(
    load: Callable[[Iterable[Range]], AbstractSamples],
    grid: TimeGrid,
    joints: int,
    has_velocities: bool,
    robot: Robot,
    filter: AbstractFilter,
    decimation: Subsample,
    min_speed: Numbers | None,
    name: str,
    progress: Progress | None = None,
) -> Observations:
    """Return observations of a log whose usable segments `load` reads and filters.

    For the other arguments see `observe` and `scan_log`.
    """
    if joints != robot.joints:
        virtual = len(robot.virtual)
        raise InputError(
            f"`{name}` has {joints - virtual} joints, but the robot `{robot.name}` has "
            f"{robot.joints - virtual}: choose the columns of its joints, or the robot "
            "of this log."
        )
    dt = grid.sample_time
    try:
        decimation.check(filter.low_pass(dt).cutoff, dt)
        edge = filter.edge(dt)
    except InputError as error:
        raise InputError(f"`{name}`: {error}") from error
    grid = usable_segments(grid, edge, decimation.step, name)
    notes = grid.notes
    if has_velocities and not filter.uses_velocities:
        kind = type(filter).__name__
        note = (
            f"the measured velocities are not used: `{kind}` takes them from the angles"
        )
        notes = (*notes, note)
    rows = sum(map(len, _row_samples(grid.segments, edge, decimation.step)))
    observations = Observations(
        source=load(grid.segments),
        filter=filter,
        decimation=decimation,
        segments=consecutive(b - a for a, b in grid.segments),
        start_times=tuple(grid.segments.values()),
        mask=np.broadcast_to(True, (rows, joints)),
        sample_time=dt,
        name=name,
        notes=notes,
    )
    if min_speed is None:
        return observations
    speeds = per_joint("min_speed", np.asarray(min_speed, np.float64), joints, 0.0)
    mask = _speed_mask(observations, speeds, progress)
    slow_joints = np.flatnonzero(~mask.any(axis=0)).tolist()
    if slow_joints:
        j = slow_joints[0]
        raise InputError(
            f"joint `{robot.joint_names[j]}` never reaches the speed {speeds[j]:g} of "
            f"`min_speed` in `{name}`: use a smaller one, or a log in which it moves."
        )
    return observations.replace(mask=mask)


def _speed_mask(
    observations: Observations, speeds: Vector, progress: Progress | None
) -> Bool[np.ndarray, "rows joints"]:
    """Return the rows at which each joint is as fast as its speed."""
    masks = []
    for chunk in observations.chunks(65536):
        motion = observations.row_motion(slice(*chunk.rows))
        masks.append(np.abs(motion.qd) >= speeds)
        if progress is not None:
            progress(chunk.rows[1] / observations.rows)
    return np.concatenate(masks)


def _row_samples(segments: Iterable[Range], edge: int, factor: int) -> list[range]:
    """Return the samples of each segment at which rows lie."""
    return [range(a + edge, b - edge, factor) for a, b in segments]
