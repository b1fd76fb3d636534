"""Logs larger than memory: read part by part, filtered with overlap, never held."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.streaming import Read, held
from jaxid.measurement.columns import Columns
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.observations import Observations
from jaxid.measurement.parts import AbstractParts
from jaxid.measurement.survey import NeedsMemory
from jaxid.robot.robot import Robot

PROBE = 4096
"""Samples of the first look at how long a filter remembers."""
LONGEST = 2**20
"""Samples after which a filter must have forgotten."""
FADED = 1e-13
"""Part of a response's peak that no longer matters."""


class LongLog(eqx.Module):
    """A log that stays on the disk; `identify` takes it like observations.

    Attributes:
        outline: Observations without numbers: filter, decimation, segments, rows that count.
        angles: The file of the angles, and of what has no other.
        forces: Another file of the forces.
        velocities: Another file of the velocities.
        columns: What its columns hold.
        robot: Whose log it is.
        overlap: Samples that are read before and after each part, for the filter of the motion.
        first_rows: Row of the file at which each segment begins.
        times: Of each segment's first sample [s].
    """

    outline: Observations
    angles: AbstractParts
    forces: AbstractParts | None
    velocities: AbstractParts | None
    columns: Columns
    robot: Robot
    overlap: int = eqx.field(static=True)
    first_rows: tuple[int, ...] = eqx.field(static=True)
    times: tuple[float, ...] = eqx.field(static=True)

    @property
    def name(self) -> str:
        """Of the log."""
        return self.outline.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What was seen and left out, in sentences."""
        return self.outline.notes

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.outline.joints

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.outline.time)

    @property
    def rows(self) -> int:
        """Number of rows of each joint after decimation."""
        return self.outline.rows

    @property
    def sample_time(self) -> float:
        """Time between two samples [s]."""
        return self.outline.sample_time

    @property
    def duration(self) -> float:
        """Time that was recorded, gaps not counted [s]."""
        return self.samples * self.sample_time

    @property
    def segments(self) -> tuple[tuple[int, int], ...]:
        """Half-open ranges of samples without gaps."""
        return self.outline.segments

    @property
    def row_time(self) -> float:
        """Time between two rows [s]."""
        return self.outline.row_time

    @property
    def reduced_time(self) -> np.ndarray:
        """Times of the rows [s]."""
        o = self.outline
        edge = o.filter.edge(o.sample_time)
        return np.concatenate(
            [
                t + o.sample_time * (edge + o.decimation.factor * np.arange(b - a))
                for (a, b), t in zip(o.row_segments, self.times, strict=True)
            ]
        )

    def read(self, samples: slice) -> tuple[Motion, np.ndarray]:
        """Motion and forces of some samples of one segment, joint side, as `observe` makes them.

        Raises:
            InputError: If a column holds what is no number.
        """
        motion, forces, _ = self.seen(samples)
        return motion, forces

    def seen(self, samples: slice) -> tuple[Motion, np.ndarray, np.ndarray]:
        """Motion and forces like `read`, and the angles before any filter.

        Raises:
            InputError: Like `read`.
        """
        begin, end, _ = self._placed(samples)
        a, b = max(begin, samples.start - self.overlap), min(end, samples.stop + self.overlap)
        angles, velocities, forces = self.measured(slice(a, b))
        motion = self.outline.filter.motion(angles, velocities, self.outline.sample_time)
        own = slice(samples.start - a, samples.stop - a, samples.step)
        return motion[own], forces[own], angles[own]

    def measured(self, samples: slice) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Angles, velocities and forces of some samples of one segment, joint side, unfiltered.

        Raises:
            InputError: Like `read`.
        """
        angles, velocities, forces = self.recorded(samples)
        drives = self.robot.drives
        if self.columns.angles_on_motor_side:
            angles = np.asarray(drives.joint_angles(angles))
            velocities = None if velocities is None else drives.joint_velocities(velocities)
        if self.columns.forces_on_motor_side:
            forces = np.asarray(drives.joint_forces(forces))
        return angles, None if velocities is None else np.asarray(velocities), forces

    def recorded(self, samples: slice) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """The same in SI units, on the sides on which they were recorded.

        Raises:
            InputError: Like `read`.
        """
        begin, _, first = self._placed(samples)
        rows = first + samples.start - begin, first + samples.stop - begin
        columns, n = self.columns, self.joints
        table = self.angles.part(*rows)
        angles = table.array("angles", columns.angles)
        angles = angles * columns.angle_scale(n) + columns.angle_shift(n)
        other = table if self.forces is None else self.forces.part(*rows)
        forces = other.array("forces", columns.forces) * columns.force_scale(n)
        velocities = None
        if columns.velocities is not None:
            other = table if self.velocities is None else self.velocities.part(*rows)
            velocities = other.array("velocities", columns.velocities) * columns.velocity_scale(n)
        return angles, velocities, forces

    def _placed(self, samples: slice) -> tuple[int, int, int]:
        """Where the segment of some samples begins and ends, and its first row in the file."""
        starts = [a for a, _ in self.outline.segments]
        k = int(np.searchsorted(starts, samples.start, "right")) - 1
        return *self.outline.segments[k], self.first_rows[k]

    def split(self, fraction: float) -> "tuple[LongLog, LongLog]":
        """Divides the rows in time, like `Observations.split`.

        Raises:
            InputError: If `fraction` is not between 0 and 1, or a part has no rows.
        """
        if not 0 < fraction < 1:
            raise InputError(f"`fraction` must lie between 0 and 1, but is {fraction:g}.")
        (a, b), first = self.outline.segments[-1], self.times[0]
        last = self.times[-1] + (b - a - 1) * self.outline.sample_time
        before = (self.reduced_time < first + fraction * (last - first))[:, None]
        parts = []
        for chosen in (before, ~before):
            mask = np.asarray(self.outline.mask) & chosen
            if not mask.any(axis=0).all():
                raise InputError(
                    f"`{self.name}` has no rows for every joint in one of the parts that "
                    f"`fraction` = {fraction:g} leaves: choose another."
                )
            parts.append(eqx.tree_at(lambda log: log.outline.mask, self, mask))
        return parts[0], parts[1]

    def named(self, name: str) -> "LongLog":
        """The same log under another name."""
        return dataclasses.replace(self, outline=dataclasses.replace(self.outline, name=name))


def source(observations: Observations | LongLog) -> tuple[Observations, Read]:
    """What becomes a row, and where motion and forces come from."""
    if isinstance(observations, LongLog):
        return observations.outline, observations.read
    return observations, held(observations)


def forgetting(filter: AbstractFilter, sample_time: float, measured: bool) -> int:
    """Samples after which a filter's motion no longer depends on an angle or velocity.

    Raises:
        NeedsMemory: If it never forgets.
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
            raise NeedsMemory(refusal) from error
        reach = 0
        for x in (motion.q, motion.qd, motion.qdd):
            size = np.abs(np.asarray(x)[:, 0])
            last = np.flatnonzero(size > FADED * size.max())
            reach = max(reach, int(np.abs(last - half).max(initial=0)))
        if reach < half // 2:
            # What lies below rounding fades likewise.
            return int(1.3 * reach) + 4
        half *= 4
    raise NeedsMemory(refusal)
