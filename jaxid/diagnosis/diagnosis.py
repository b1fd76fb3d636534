"""Diagnosis of a log: signs of wrong units, signs, channels, sensors and delays, as sentences."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray
from jaxid.diagnosis.limits import (
    LogStatistics,
    StatisticsAccumulator,
    limit_findings,
    rate_findings,
)
from jaxid.diagnosis.mislabelled import delay_finding, likely_mistakes, negative_friction
from jaxid.diagnosis.sensor_faults import channel_faults, stuck_findings
from jaxid.errors import InputError
from jaxid.identification.fit import Fit
from jaxid.measurement.filters import ZeroPhaseButterworth
from jaxid.measurement.log_on_disk import AT_ONCE, SamplesOnDisk
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.table import Column, Remark, Status, Table, significant


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Statistics of a log beside the limits of its robot, and findings.

    Attributes:
        name: Name of the log.
        robot: Robot of the log.
        statistics: Extremes of the log, joint by joint.
        findings: Signs of mistakes, as sentences; empty if there are none.
        faulty: Joints with held, spiky or wrapped channels, which no model can fit.
        observations: Observations in which mistakes are looked for, of a long log a part; None if
            no part is long enough.
        motor_sides: Whether angles and forces of the log are taken for the motors'.
        notes: Remarks on how the log was examined, as sentences.
    """

    name: str
    robot: Robot
    statistics: LogStatistics
    findings: tuple[str, ...]
    faulty: tuple[int, ...]
    observations: Observations | None
    motor_sides: tuple[bool, bool]
    notes: tuple[str, ...] = ()

    def mistakes(self, fit: Fit) -> tuple[str, ...]:
        """Return the likely mistakes in signs, order, units and sides of the log's columns.

        Args:
            fit: Fit of the robot's model, to this log or to several.
        """
        # Faults of channels explain the rest.
        if self.faulty or self.observations is None:
            return ()
        return likely_mistakes(fit.base, self.observations, *self.motor_sides)

    def fit_findings(self, fit: Fit) -> tuple[str, ...]:
        """Return what a fit to this log alone reveals, including delays.

        Args:
            fit: Fit to this log.
        """
        if self.faulty:
            return ()
        if mistakes := self.mistakes(fit):
            return mistakes
        if self.observations is None:
            return negative_friction(fit)
        return (*negative_friction(fit), *delay_finding(fit.base, self.observations, fit))

    def summary(self) -> Table:
        """Return a table: motion and forces of each joint beside its limits, and the findings."""
        robot, s = self.robot, self.statistics
        mixed = len(set(robot.revolute)) > 1
        unit, force_unit = ("", "") if mixed else (robot.joint_unit(0), robot.force_unit(0))
        columns = [
            Column("joint", robot.joint_names),
            _beside("from", s.lowest, robot.limits.position_min, unit),
            _beside("to", s.highest, robot.limits.position_max, unit),
            _beside("speed", s.speed, robot.limits.velocity, f"{unit}/s" if unit else ""),
            _beside("force", s.force, robot.known_max_forces, force_unit),
            Column("stands", [f"{100 * x:.0f}" for x in s.standing], "%", kind="number"),
        ]
        if mixed:
            joints = range(robot.joints)
            units = [f"{robot.joint_unit(j)}, {robot.force_unit(j)}" for j in joints]
            columns.append(Column("units", units))
        return Table(
            f"{self.name}: motion and forces, with the robot's limits in brackets",
            *columns,
            remarks=[Remark(text, Status.DOUBTFUL) for text in self.findings]
            or [Remark("Nothing suspicious was found.", Status.GOOD)],
        )

    def __str__(self) -> str:
        return str(self.summary())


def _beside(name: str, values: np.ndarray, limits: AnyArray, unit: str) -> Column:
    """Return a column of values with limits in brackets."""
    texts = [
        f"{significant(float(x))} ({significant(float(limit)) if np.isfinite(limit) else '–'})"  # noqa: RUF001
        for x, limit in zip(values, np.asarray(limits), strict=True)
    ]
    return Column(name, texts, unit)


def diagnose(
    log: Recording | Observations,
    robot: Robot,
    fit: Fit | None = None,
    *,
    observations: Observations | None = None,
    min_speed: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Look for mistakes in a log: units, signs, order, sides, sensor faults and delays.

    Observations on disk are read in parts, and single channels are examined in a part of the log.
    Observations in memory hold no unfiltered angles, so spikes may escape.

    Args:
        log: Recording or observations of the robot.
        robot: Robot, whose limits are compared with the log.
        fit: Fit to this log; mistakes that only a model reveals are left out if None.
        observations: Observations of the recording; filtered below a tenth of its sampling rate,
            and 20 Hz at most, if None.
        min_speed: Speed of each joint below which rows do not count [rad/s or m/s].
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If log and robot do not belong together, or the log is too short to filter.
    """
    notes: tuple[str, ...] = ()
    if isinstance(log, Recording):
        recording = log
        if observations is None:
            cutoff = min(20.0, 0.1 / log.sample_time)
            observations = observe(log, robot, ZeroPhaseButterworth(cutoff), min_speed=min_speed)
        statistics = _statistics(observations, progress, recording)
    elif isinstance(log.source, SamplesOnDisk):
        statistics = _statistics(log, progress)
        recording = _excerpt(log, log.source)
        observations, notes = _observe_excerpt(log, recording, robot, min_speed)
    else:
        statistics, observations = _statistics(log, progress), log
        recording = _as_recording(log)
    faults = channel_faults(robot, recording)
    faulty = tuple(dict.fromkeys(fault.joint for fault in faults))
    measured = recording.velocities is not None
    findings = (
        *(fault.text for fault in faults),
        *limit_findings(robot, statistics, recording.angles_on_motor_side, measured, faulty),
        *rate_findings(recording.sample_time),
        *stuck_findings(robot, recording, faulty),
    )
    sides = recording.angles_on_motor_side, recording.forces_on_motor_side
    diagnosis = Diagnosis(log.name, robot, statistics, findings, faulty, observations, sides, notes)
    if fit is None:
        return diagnosis
    return dataclasses.replace(diagnosis, findings=(*diagnosis.fit_findings(fit), *findings))


def mistakes_in_logs(diagnoses: Sequence[Diagnosis], fit: Fit) -> tuple[str, ...]:
    """Return what a fit to several logs reveals, apart from delays, with the names of the logs.

    Args:
        diagnoses: Diagnoses of all logs of the fit.
        fit: Fit to these logs together.
    """
    friction = () if any(d.faulty for d in diagnoses) else negative_friction(fit)
    return (*friction, *(f"{d.name}: {text}" for d in diagnoses for text in d.mistakes(fit)))


def _statistics(
    observations: Observations, progress: Progress | None, recording: Recording | None = None
) -> LogStatistics:
    """Go through a log in parts."""
    o = observations
    accumulator = StatisticsAccumulator(o.joints, o.samples)
    if recording is not None:
        for a, b in recording.segments:
            accumulator.add_angles(np.asarray(recording.angles)[a:b])
    for a, b in o.segments:
        last = np.zeros((0, o.joints))
        # Differences at the ends of parts are not central: logs in memory are taken at once.
        step = AT_ONCE if isinstance(o.source, SamplesOnDisk) else b - a
        for start in range(a, b, step):
            samples = slice(start, min(start + step, b))
            if isinstance(o.source, SamplesOnDisk):
                motion, forces, angles = o.source.read_with_angles(samples)
                accumulator.add_angles(np.concatenate([last, angles]))
                last = angles[-1:]
            else:
                motion, forces = o.read(samples)
            accumulator.add(motion, forces, o.sample_time)
            if progress is not None:
                progress(samples.stop / o.samples)
    return accumulator.result()


def _as_recording(observations: Observations) -> Recording:
    """Return observations in memory as a recording, with filtered angles."""
    return Recording(
        time=observations.time,
        angles=np.asarray(observations.motion.q),
        forces=np.asarray(observations.forces),
        velocities=None,
        angles_on_motor_side=False,
        forces_on_motor_side=False,
        segments=observations.segments,
        sample_time=observations.sample_time,
        name=observations.name,
    )


def _observe_excerpt(
    log: Observations, part: Recording, robot: Robot, min_speed: ArrayLike | None
) -> tuple[Observations | None, tuple[str, ...]]:
    """Return observations of a part of a log, if it is long enough, and a remark."""
    try:
        observations = observe(part, robot, log.filter, log.decimation, min_speed)
        reason = ""
    except InputError as error:
        observations, reason = None, f" of single channels only: {error}"
    if part.samples == log.samples and observations is not None:
        return observations, ()
    note = f"{part.samples} of the {log.samples} samples were examined for mistakes{reason}"
    return observations, (note,)


_EXAMINED = 2**17
"""Largest number of samples of a long log that are examined."""


def _excerpt(log: Observations, source: SamplesOnDisk) -> Recording:
    """Return stretches of a log as they were recorded: from its beginning, middle and end."""
    stretches = _stretches(log)
    angles, velocities, forces = zip(
        *(source.read_recorded(slice(a, b)) for a, b in stretches), strict=True
    )
    times = []
    for a, b in stretches:
        k = next(k for k, (_, end) in enumerate(log.segments) if end > a)
        times.append(log.start_times[k] + log.sample_time * (np.arange(a, b) - log.segments[k][0]))
    ends = itertools.accumulate((b - a for a, b in stretches), initial=0)
    return Recording(
        time=np.concatenate(times),
        angles=np.concatenate(angles),
        forces=np.concatenate(forces),
        velocities=None if velocities[0] is None else np.concatenate(velocities),
        angles_on_motor_side=source.columns.angles_on_motor_side,
        forces_on_motor_side=source.columns.forces_on_motor_side,
        segments=tuple(itertools.pairwise(ends)),
        sample_time=log.sample_time,
        name=log.name,
    )


def _stretches(log: Observations) -> list[tuple[int, int]]:
    """Return half-open ranges of samples, none of which goes over a gap."""
    if log.samples <= _EXAMINED:
        return list(log.segments)
    count = 4
    length = _EXAMINED // count
    stretches: list[tuple[int, int]] = []
    for start in np.linspace(0, log.samples - length, count).astype(int):
        a = max(int(start), stretches[-1][1] if stretches else 0)
        b = min(a + length, next(end for _, end in log.segments if end > a))
        stretches.append((a, b))
    if min(b - a for a, b in stretches) >= 20 * log.filter.edge(log.sample_time):
        return stretches
    # Gaps, or a filter with a long memory: one long stretch tells more than several short ones.
    a, b = max(log.segments, key=lambda ends: ends[1] - ends[0])
    return [(a, min(b, a + _EXAMINED))]
