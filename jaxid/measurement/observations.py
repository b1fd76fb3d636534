"""What an estimator sees: a motion and forces with the filter and the rows that belong to them."""

import itertools
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.decimation import AbstractDecimation, Subsample
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.low_pass import said_hasty
from jaxid.measurement.recording import Recording
from jaxid.robot.limits import per_joint
from jaxid.robot.robot import Robot

FEWEST_ROWS = 4
"""Rows below which a segment is not worth its edges."""


class Chunk(eqx.Module):
    """A part of the observations whose columns fit into memory.

    Attributes:
        samples: Half-open range of samples whose columns are needed (rows and overlap).
        rows: Half-open range of rows that come out.
        smoothed: Of what was smoothed, the part that decimation needs, from the chunk's first.
        wanted: Of what was decimated, the rows.
        filter: Of forces and columns.
        decimation: Of forces and columns.
        sample_time: Time between two samples [s].
    """

    samples: tuple[int, int] = eqx.field(static=True)
    rows: tuple[int, int] = eqx.field(static=True)
    smoothed: tuple[int, int] = eqx.field(static=True)
    wanted: tuple[int, int] = eqx.field(static=True)
    filter: AbstractFilter
    decimation: AbstractDecimation
    sample_time: float = eqx.field(static=True)

    def reduce(self, x: Float[AnyArray, "samples *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """Reduces columns at the chunk's samples to its rows."""
        x = self.filter.smooth(x, self.sample_time)[slice(*self.smoothed)]
        return self.decimation(x)[slice(*self.wanted)]


class Observations(eqx.Module):
    """Motion and forces at the full rate, joint side, and how both become rows.

    Attributes:
        time: Of the samples [s].
        motion: Filtered joint angles, velocities and accelerations.
        forces: Generalized forces, not filtered [N m or N].
        filter: Of forces and columns.
        decimation: Of forces and columns.
        segments: Half-open ranges of samples without gaps.
        mask: Which rows count for which joint.
        sample_time: Time between two samples [s].
        name: Of the recording.
        notes: Of the recording, and what was left out, in sentences.
    """

    time: Float[AnyArray, " samples"]
    motion: Motion
    forces: Float[AnyArray, "samples joints"]
    filter: AbstractFilter
    decimation: AbstractDecimation
    segments: tuple[tuple[int, int], ...] = eqx.field(static=True)
    mask: Bool[AnyArray, "rows joints"]
    sample_time: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="observations")
    notes: tuple[str, ...] = eqx.field(static=True, default=())

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
        return self.sample_time * self.decimation.factor

    @property
    def row_segments(self) -> tuple[tuple[int, int], ...]:
        """Half-open ranges of rows without gaps."""
        ends = np.cumsum([0, *(len(r) for r in self._kept())])
        return tuple((int(a), int(b)) for a, b in itertools.pairwise(ends))

    @property
    def instants(self) -> np.ndarray:
        """Indices of the samples at which the rows lie."""
        return np.concatenate([np.arange(r.start, r.stop, r.step) for r in self._kept()])

    def _kept(self) -> list[range]:
        edge = self.filter.edge(self.sample_time)
        return [range(a + edge, b - edge, self.decimation.factor) for a, b in self.segments]

    def reduce(self, x: Float[AnyArray, "samples *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """Turns forces or columns at all samples into rows: smooths, trims and decimates.

        Linear, and the same for every column: what holds between columns and forces at the samples
        holds between the rows.
        """
        edge = self.filter.edge(self.sample_time)
        parts = []
        for a, b in self.segments:
            smoothed = self.filter.smooth(x[a:b], self.sample_time)
            parts.append(self.decimation(smoothed[edge : b - a - edge]))
        return np.concatenate(parts)

    def chunks(self, samples: int = 16384) -> tuple[Chunk, ...]:
        """Parts of about so many samples, each with the overlap that its filters need.

        For columns that do not fit into memory at the full rate: evaluate them at
        `motion[slice(*chunk.samples)]`, and `chunk.reduce` gives `reduce`'s rows
        `slice(*chunk.rows)`, up to rounding.

        Raises:
            InputError: If `samples` is not positive.
        """
        if samples < 1:
            raise InputError(f"`samples` must be positive, but is {samples}.")
        factor, edge = self.decimation.factor, self.filter.edge(self.sample_time)
        before, after = self.decimation.memory(), self.filter.memory(self.sample_time)
        found, step = [], max(1, samples // factor)
        for (a, b), (r0, r1) in zip(self.segments, self.row_segments, strict=True):
            first, last = a + edge, b - edge
            for start in range(r0, r1, step):
                stop = min(start + step, r1)
                # Decimation keeps its phase: what it is given starts at a row.
                skipped = max(0, start - r0 - -(-before // factor))
                low = first + skipped * factor
                high = min(last, first + (stop - 1 - r0) * factor + before + 1)
                begin, end = max(a, low - after), min(b, high + after)
                found.append(
                    Chunk(
                        samples=(begin, end),
                        rows=(start, stop),
                        smoothed=(low - begin, high - begin),
                        wanted=(start - r0 - skipped, stop - r0 - skipped),
                        filter=self.filter,
                        decimation=self.decimation,
                        sample_time=self.sample_time,
                    )
                )
        return tuple(found)

    def between(self, start: float, stop: float) -> "Observations":
        """The same observations, of which only rows from `start` to before `stop` [s] count.

        The log is filtered as a whole: no rows are lost where it is divided.

        Raises:
            InputError: If no row is left for some joint.
        """
        time = self.reduced_time
        mask = np.asarray(self.mask) & ((time >= start) & (time < stop))[:, None]
        if not mask.any(axis=0).all():
            raise InputError(
                f"`{self.name}` has no rows from {start:g} s to {stop:g} s for every joint: its "
                f"rows reach from {time[0]:g} s to {time[-1]:g} s."
            )
        return eqx.tree_at(lambda o: o.mask, self, mask)

    def split(self, fraction: float) -> tuple["Observations", "Observations"]:
        """Divides the rows in time: a part to identify with, and the rest to verify with.

        Args:
            fraction: Of the recording's duration that belongs to the first part, of 1.

        Raises:
            InputError: If `fraction` is not between 0 and 1.
        """
        if not 0 < fraction < 1:
            raise InputError(f"`fraction` must lie between 0 and 1, but is {fraction:g}.")
        time = np.asarray(self.time)
        middle = float(time[0] + fraction * (time[-1] - time[0]))
        return self.between(-np.inf, middle), self.between(middle, np.inf)

    @property
    def reduced_time(self) -> Float[np.ndarray, " rows"]:
        """Times of the rows [s]."""
        return np.asarray(self.time)[self.instants]

    @property
    def reduced_forces(self) -> Float[np.ndarray, "rows joints"]:
        """Forces of the rows, filtered and decimated [N m or N]."""
        return self.reduce(self.forces)

    @property
    def reduced_motion(self) -> Motion:
        """The motion at the rows' instants, for figures: columns are reduced, not the motion."""
        return self.motion[self.instants]


def observe(
    recording: Recording,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None = None,
    slow: ArrayLike | tuple[float | int, ...] | None = None,
    name: str | None = None,
) -> Observations:
    """Prepares a recording for estimation: joint side, derivatives, rows and their mask.

    Args:
        recording: What was logged.
        robot: Its drives lead from the motors to the joints where the recording is on their side.
        filter: For the motion, and for forces and columns.
        decimation: For forces and columns; every sample is a row if None.
        slow: Speed of each joint below which its rows do not count [rad/s or m/s]: stiction is not
            in the model.
        name: Of the observations; the recording's if None.

    Raises:
        InputError: If the numbers of joints differ, forces and columns would be aliased, nothing
            is left between the edges of the segments, or nothing of a joint is fast enough.
    """
    n = robot.joints
    if recording.joints != n:
        raise InputError(
            f"`{recording.name}` has {recording.joints} joints, but the robot `{robot.name}` has "
            f"{n}: choose the columns of its joints, or the robot of this log."
        )
    decimation = Subsample(1) if decimation is None else decimation
    dt = recording.sample_time
    decimation.check(filter.low_pass(dt).cutoff, dt)
    speeds = per_joint("slow", None if slow is None else np.asarray(slow, np.float64), n, 0.0)
    used, said = usable(recording.segments, filter, decimation, dt, recording.name)
    notes = [*recording.notes, *said, *filter.said(recording.velocities is not None)]
    angles, forces, velocities = _joint_side(recording, robot)
    motions = [
        filter.motion(angles[a:b], None if velocities is None else velocities[a:b], dt)
        for a, b in used
    ]
    ends = np.cumsum([0, *(b - a for a, b in used)])
    observations = Observations(
        time=_join([np.asarray(recording.time)[a:b] for a, b in used]),
        motion=Motion(
            _join([m.q for m in motions]),
            _join([m.qd for m in motions]),
            _join([m.qdd for m in motions]),
        ),
        forces=_join([forces[a:b] for a, b in used]),
        filter=filter,
        decimation=decimation,
        segments=tuple((int(a), int(b)) for a, b in itertools.pairwise(ends)),
        mask=np.ones((0, n), bool),
        sample_time=dt,
        name=recording.name if name is None else name,
        notes=tuple(notes),
    )
    mask = np.abs(np.asarray(observations.reduced_motion.qd)) >= speeds
    refuse_standstill(mask, speeds, robot, recording.name)
    return eqx.tree_at(lambda o: o.mask, observations, mask)


def usable(
    segments: Sequence[tuple[int, int]],
    filter: AbstractFilter,
    decimation: AbstractDecimation,
    sample_time: float,
    name: str,
) -> tuple[list[tuple[int, int]], list[str]]:
    """The segments that are longer than what filters lose at their ends, and what to say.

    Raises:
        InputError: If there is none.
    """
    edge = filter.edge(sample_time)
    fewest = 2 * edge + (FEWEST_ROWS - 1) * decimation.factor + 1
    used = [(a, b) for a, b in segments if b - a >= max(fewest, 5)]
    if not used:
        longest = max(b - a for a, b in segments)
        raise InputError(
            f"the longest segment of `{name}` has {longest} samples, but {edge} at each "
            f"end are lost to the filter and {FEWEST_ROWS} rows of {decimation.factor} are needed: "
            "record longer, close the gaps (`largest_gap`), or set a smaller `margin`."
            f"{said_hasty(sample_time)}"
        )
    short = len(segments) - len(used)
    if not short:
        return used, []
    return used, [f"{short} segment(s), shorter than the filter's edges, were left out"]


def refuse_standstill(
    mask: Bool[np.ndarray, "rows joints"],
    speeds: Float[np.ndarray, " joints"],
    robot: Robot,
    name: str,
) -> None:
    """Refuses a log in which a joint is never fast enough.

    Raises:
        InputError: If no row of some joint counts.
    """
    slow = np.flatnonzero(~mask.any(axis=0))
    if slow.size:
        j = int(slow[0])
        raise InputError(
            f"joint `{robot.joint_names[j]}` never reaches the speed {speeds[j]:g} of `slow` in "
            f"`{name}`: take a smaller one, or a log in which it moves."
        )


def _join(parts: list) -> np.ndarray:
    return np.concatenate([np.asarray(p, np.float64) for p in parts])


def _joint_side(recording: Recording, robot: Robot):
    angles = np.asarray(recording.angles)
    forces = np.asarray(recording.forces)
    velocities = None if recording.velocities is None else np.asarray(recording.velocities)
    if recording.angles_on_motor_side:
        angles = np.asarray(robot.drives.joint_angles(angles))
        if velocities is not None:
            velocities = np.asarray(robot.drives.joint_velocities(velocities))
    if recording.forces_on_motor_side:
        forces = np.asarray(robot.drives.joint_forces(forces))
    return angles, forces, velocities
