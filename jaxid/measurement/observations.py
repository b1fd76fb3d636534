"""Observations: motion and forces of a log, and the filters that turn them into rows (Eq. 26)."""

import abc
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray, Bool, Float, namespace
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import per_joint
from jaxid.robot.robot import Robot

from .filters import AbstractDecimation, AbstractFilter, Subsample, ZeroPhaseButterworth
from .recording import Recording, TimeGrid, consecutive, finite_channel, positive_time

FEWEST_ROWS = 4
"""Smallest number of rows for which a segment is used."""

Progress = Callable[[float], None]
"""Callback, called with the completed fraction (0 to 1)."""


class AbstractSamples(eqx.Module):
    """Motion and forces at the full rate, joint side, in memory or on disk."""

    @abc.abstractmethod
    def read(self, samples: slice) -> tuple[Motion, Float[AnyArray, "samples joints"]]:
        """Return motion and forces of some samples of one segment."""

    @abc.abstractmethod
    def read_all(self) -> tuple[Motion, Float[AnyArray, "samples joints"]]:
        """Return motion and forces of all segments."""


class SamplesInMemory(AbstractSamples):
    """Filtered motion and unfiltered forces [N m or N] as arrays."""

    motion: Motion
    forces: Float[AnyArray, "samples joints"]

    def read(self, samples):  # noqa: D102
        return self.motion[samples], np.asarray(self.forces)[samples]

    def read_all(self):  # noqa: D102
        return self.motion, self.forces


class Chunk(NamedTuple):
    """Part of the observations whose columns fit into memory."""

    # half-open range of samples whose columns are needed (rows and overlap)
    samples: tuple[int, int]
    rows: tuple[int, int]  # half-open range of the resulting rows
    # function that turns columns at these samples into these rows
    reduce: Callable[[AnyArray], np.ndarray]


class Observations(eqx.Module):
    """Motion and forces at the full rate, joint side, and the filters that turn them into rows.

    The samples are in memory (`observe`, `Observations.of`) or stay on disk
    (`scan_log`).

    Attributes:
        source: Motion and forces of the samples.
        filter: Filter of forces and columns.
        decimation: Decimation of forces and columns.
        segments: Half-open ranges of samples without gaps.
        start_times: Time of the first sample of each segment [s].
        mask: Rows that count, for each joint.
        sample_time: Time between two samples [s].
        name: Name of the recording.
        notes: Remarks on what was changed or left out, as sentences.
    """

    source: AbstractSamples
    filter: AbstractFilter
    decimation: AbstractDecimation
    segments: tuple[tuple[int, int], ...] = eqx.field(static=True)
    start_times: tuple[float, ...] = eqx.field(static=True)
    mask: Bool[AnyArray, "rows joints"]
    sample_time: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="observations")
    notes: tuple[str, ...] = eqx.field(static=True, default=())

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
        decimation: AbstractDecimation | None = None,
        segments: Sequence[tuple[int, int]] | None = None,
        mask: ArrayLike | None = None,
        name: str = "observations",
    ) -> "Observations":
        """Make observations of arrays (samples x joints), joint side, whose motion is filtered.

        Args:
            q: Joint angles [rad or m].
            qd: Velocities [rad/s or m/s].
            qdd: Accelerations [rad/s² or m/s²].
            forces: Generalised forces [N m or N].
            sample_time: Time between two samples [s].
            filter: Filter of forces and columns; neither is filtered if None.
            decimation: Decimation of forces and columns; every sample is a row if None.
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
        decimation = Subsample(1) if decimation is None else decimation
        segments = ((0, len(data["q"])),) if segments is None else tuple(segments)
        rows = sum(map(len, _row_samples(segments, filter.edge(dt), decimation.factor)))
        counted = (
            np.ones((rows, shape[1]), bool) if mask is None else np.asarray(mask, bool)
        )
        if counted.shape != (rows, shape[1]):
            raise InputError(
                f"`mask` must have the shape {(rows, shape[1])}, but has "
                f"{counted.shape}."
            )
        motion = Motion(data["q"], data["qd"], data["qdd"])
        return cls(
            source=SamplesInMemory(motion, data["forces"]),
            filter=filter,
            decimation=decimation,
            segments=segments,
            start_times=tuple(a * dt for a, _ in segments),
            mask=counted,
            sample_time=dt,
            name=name,
        )

    def replace(self, **changes: Any) -> "Observations":
        """Return the same observations with other fields; `motion` and `forces` are fields too."""
        arrays = {
            key: changes.pop(key) for key in ("motion", "forces") if key in changes
        }
        if arrays:
            motion, forces = self.source.read_all()
            changes["source"] = SamplesInMemory(
                **({"motion": motion, "forces": forces} | arrays)
            )
        return dataclasses.replace(self, **changes)

    @property
    def motion(self) -> Motion:
        """Filtered joint angles, velocities and accelerations of all samples."""
        return self.source.read_all()[0]

    @property
    def forces(self) -> Float[AnyArray, "samples joints"]:
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
        return self.sample_time * self.decimation.factor

    @property
    def row_segments(self) -> tuple[tuple[int, int], ...]:
        """Half-open ranges of rows without gaps."""
        return consecutive(map(len, self._row_samples()))

    @property
    def instants(self) -> np.ndarray:
        """Indices of the samples at which the rows lie."""
        return np.concatenate([np.asarray(r) for r in self._row_samples()])

    def _row_samples(self) -> list[range]:
        edge = self.filter.edge(self.sample_time)
        return _row_samples(self.segments, edge, self.decimation.factor)

    def _times(self, samples: Sequence[range]) -> np.ndarray:
        """Return the times of samples of each segment [s]."""
        dt = self.sample_time
        parts = zip(samples, self.segments, self.start_times, strict=True)
        return np.concatenate(
            [t + dt * (np.asarray(own) - a) for own, (a, _), t in parts]
        )

    def read(self, samples: slice) -> tuple[Motion, Float[AnyArray, "samples joints"]]:
        """Return motion and forces of some samples of one segment."""
        return self.source.read(samples)

    def reduce(self, x: Float[AnyArray, "samples *columns"]) -> Any:
        """Turn forces or columns at all samples into rows: smooth, trim and decimate (Eq. 26).

        Linear, and the same for every column: what holds between columns and forces at
        the samples holds between the rows. JAX can compile and differentiate it.
        """
        edge = self.filter.edge(self.sample_time)
        every = slice(None)
        parts = [
            self._reduce(slice(edge, b - a - edge), every, x[a:b])
            for a, b in self.segments
        ]
        return namespace(x).concatenate(parts)

    def _reduce(self, kept: slice, wanted: slice, x: AnyArray) -> Any:
        return self.decimation(self.filter.smooth(x, self.sample_time)[kept])[wanted]

    def chunks(
        self, samples: int = 16384, wanted: Sequence[tuple[int, int]] | None = None
    ) -> tuple[Chunk, ...]:
        """Divide into parts of about so many samples, each with the overlap that its filters need.

        For columns that do not fit into memory at the full rate: evaluate them at the
        motion of `read(slice(*chunk.samples))`, and `chunk.reduce` gives the rows
        `slice(*chunk.rows)` of `reduce`, up to rounding.

        Args:
            samples: Number of samples of a part.
            wanted: Half-open ranges of the rows that are needed; all if None.
        """
        factor = self.decimation.factor
        edge = self.filter.edge(self.sample_time)
        low_pass = self.filter.low_pass(self.sample_time)
        before = self.decimation.memory()
        after = low_pass.memory()
        chunks, step = [], max(1, samples // factor)
        for (a, b), (r0, r1) in zip(self.segments, self.row_segments, strict=True):
            first, last = a + edge, b - edge
            ranges = [(r0, r1)] if wanted is None else wanted
            parts = [(max(r0, low), min(r1, high)) for low, high in ranges]
            for start, end in (
                (k, high) for low, high in parts for k in range(low, high, step)
            ):
                stop = min(start + step, end)
                # Decimation keeps its phase: its first input sample is a row.
                skipped = max(0, start - r0 - -(-before // factor))
                low = first + skipped * factor
                high = min(last, first + (stop - 1 - r0) * factor + before + 1)
                begin = max(a, low - after)
                final = min(b, high + after)
                kept = slice(low - begin, high - begin)
                rows = slice(start - r0 - skipped, stop - r0 - skipped)
                reduce = functools.partial(self._reduce, kept, rows)
                chunks.append(Chunk((begin, final), (start, stop), reduce))
        return tuple(chunks)

    def split(self, fraction: float) -> tuple["Observations", "Observations"]:
        """Divide the rows in time: a part for identification and the rest for validation.

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
        (a, b), first = self.segments[-1], self.start_times[0]
        last = self.start_times[-1] + (b - a - 1) * self.sample_time
        middle = float(first + fraction * (last - first))
        early = self.reduced_time[:, None] < middle
        masks = np.asarray(self.mask) & early, np.asarray(self.mask) & ~early
        if not all(mask.any(axis=0).all() for mask in masks):
            raise InputError(
                f"`fraction` of {fraction:g} leaves no rows of some joint of "
                f"`{self.name}`."
            )
        return self.replace(mask=masks[0]), self.replace(mask=masks[1])

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
        """Motion at the rows' instants, for figures: columns are reduced, not the motion."""
        return self.motion[self.instants]


def joined(parts: Iterable[Any]) -> Any:
    """Return trees of arrays, such as motions and forces, one behind the other."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _row_samples(
    segments: Sequence[tuple[int, int]], edge: int, factor: int
) -> list[range]:
    """Return the samples of each segment at which rows lie."""
    return [range(a + edge, b - edge, factor) for a, b in segments]


def observe(
    recording: Recording,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None = None,
    min_speed: ArrayLike | tuple[float | int, ...] | None = None,
    name: str | None = None,
) -> Observations:
    """Prepare a recording for estimation: joint side, derivatives, rows and their mask.

    Args:
        recording: Recording of the robot.
        robot: Robot, whose drives convert from motors to joints where the recording
            needs it.
        filter: Filter of the motion, and of forces and columns.
        decimation: Decimation of forces and columns; every sample is a row if None.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s],
            since stiction is not in the model.
        name: Name of the observations; the recording's if None.

    Raises:
        InputError: If the numbers of joints differ, forces and columns would be
            aliased, nothing is left between the edges of the segments, or some joint is
            never fast enough.
    """
    r, notes = recording, ()
    if r.velocities is not None and (unlike := unlike_derivatives(r)):
        numbers = ", ".join(str(j + 1) for j in unlike)
        notes = (
            f"the velocities of channels {numbers} are not the derivatives of their "
            "angles: all "
            "velocities are taken from the angles",
        )
        r = dataclasses.replace(r, velocities=None)

    def load(segments: list[tuple[int, int]]) -> SamplesInMemory:
        q, qd, forces = joint_side(robot, r, r.angles, r.velocities, r.forces)
        parts = []
        for a, b in segments:
            measured = None if qd is None else qd[a:b]
            parts.append((filter.motion(q[a:b], measured, r.sample_time), forces[a:b]))
        return SamplesInMemory(*joined(parts))

    name = r.name if name is None else name
    measured = r.velocities is not None
    found = prepare(
        load, r.grid, r.joints, measured, robot, filter, decimation, min_speed, name
    )
    return found.replace(notes=(*found.notes, *notes))


def unlike_derivatives(recording: Recording) -> dict[int, float]:
    """Return the channels whose velocities do not make the way of their angles within 0.2 s.

    Only channels whose way is well above the noise of their angles are judged. Each
    comes with the factor by which its velocities are too large.
    """
    r, squares, products = (
        recording,
        np.zeros((3, recording.joints)),
        np.zeros(recording.joints),
    )
    steps = max(1, round(0.2 / r.sample_time))
    for a, b in r.grid.ranges:
        q, qd = np.asarray(r.angles)[a:b], np.asarray(r.velocities)[a:b]
        way = r.sample_time * np.cumsum(0.5 * (qd[1:] + qd[:-1]), axis=0)
        ends = np.concatenate([np.zeros((1, r.joints)), way])
        moved, expected = q[steps:] - q[:-steps], ends[steps:] - ends[:-steps]
        noise = np.diff(q, 2, axis=0)
        products += np.sum(moved * expected, axis=0)
        squares += [np.sum(x**2, axis=0) for x in (moved - expected, moved, noise)]
    wrong, way, noise = squares
    unlike = np.flatnonzero((wrong > 0.2**2 * way) & (way > 10.0**2 * noise)).tolist()
    return {k: float(products[k] / way[k]) for k in unlike}


def prepare(
    load: Callable[[list[tuple[int, int]]], AbstractSamples],
    grid: TimeGrid,
    joints: int,
    measured: bool,
    robot: Robot,
    filter: AbstractFilter,
    decimation: AbstractDecimation | None,
    min_speed: ArrayLike | tuple[float | int, ...] | None,
    name: str,
    progress: Progress | None = None,
) -> Observations:
    """Return observations of a log whose usable segments `load` reads and filters.

    `measured` tells whether the log holds velocities; for the rest see `observe` and
    `scan_log`.
    """
    if joints != robot.joints:
        raise InputError(
            f"`{name}` has {joints} joints, but the robot `{robot.name}` has "
            f"{robot.joints}: "
            "choose the columns of its joints, or the robot of this log."
        )
    decimation = Subsample(1) if decimation is None else decimation
    dt = grid.sample_time
    factor = decimation.factor
    notes = [*grid.notes]
    decimation.check(filter.low_pass(dt).cutoff, dt)
    edge = filter.edge(dt)
    fewest = 2 * edge + (FEWEST_ROWS - 1) * factor + 1
    used = {
        ends: t
        for ends, t in zip(grid.ranges, grid.start_times, strict=True)
        if ends[1] - ends[0] >= max(fewest, 5)
    }
    if not used:
        longest = max(b - a for a, b in grid.ranges)
        raise InputError(
            f"the longest segment of `{name}` has {longest} samples at {1 / dt:.6g} "
            "Hz, "
            f"but the filter takes {edge} at each end, and {FEWEST_ROWS * factor} "
            "more are needed: "
            "record longer, raise `largest_gap`, lower `margin`, or check `time_unit`."
        )
    if short := len(grid.ranges) - len(used):
        notes.append(
            f"{short} segment(s), shorter than the filter's edges, were left out"
        )
    if measured and not filter.uses_velocities:
        kind = type(filter).__name__
        notes.append(
            f"the measured velocities are not used: `{kind}` takes them from the angles"
        )
    rows = sum(map(len, _row_samples([*used], edge, factor)))
    observations = Observations(
        source=load([*used]),
        filter=filter,
        decimation=decimation,
        segments=consecutive(b - a for a, b in used),
        start_times=tuple(used.values()),
        mask=np.broadcast_to(True, (rows, joints)),
        sample_time=dt,
        name=name,
        notes=tuple(notes),
    )
    if min_speed is None:
        return observations
    speeds = per_joint("min_speed", np.asarray(min_speed, np.float64), joints, 0.0)
    instants, parts = observations.instants, []
    for chunk in observations.chunks(65536):
        k = instants[slice(*chunk.rows)].tolist()
        motion, _ = observations.read(slice(k[0], k[-1] + 1, factor))
        parts.append(np.abs(np.asarray(motion.qd)) >= speeds)
        if progress is not None:
            progress(chunk.rows[1] / rows)
    mask = np.concatenate(parts)
    slow = np.flatnonzero(~mask.any(axis=0))
    if slow.size:
        j = int(slow[0])
        raise InputError(
            f"joint `{robot.joint_names[j]}` never reaches the speed {speeds[j]:g} of "
            "`min_speed` "
            f"in `{name}`: take a smaller one, or a log in which it moves."
        )
    return observations.replace(mask=mask)


def joint_side(
    robot: Robot,
    log: Any,
    angles: AnyArray,
    velocities: AnyArray | None,
    forces: AnyArray,
) -> tuple[Any, ...]:
    """Convert angles, velocities, forces to the joints' side; `log`: a recording, or `Columns`."""
    angles, forces = np.asarray(angles), np.asarray(forces)
    velocities = None if velocities is None else np.asarray(velocities)
    if log.angles_on_motor_side:
        angles = robot.drives.joint_angles(angles)
        velocities = (
            None if velocities is None else robot.drives.joint_velocities(velocities)
        )
    if log.forces_on_motor_side:
        forces = robot.drives.joint_forces(forces)
    return angles, velocities, forces
