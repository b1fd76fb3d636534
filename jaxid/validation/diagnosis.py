"""Diagnosis of a log: sentences on wrong units, signs, channels, sensors and delays."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Indices, Numbers, Texts
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.delay import Delay
from jaxid.identification.fit_result import Fit
from jaxid.measurement.filters import ZeroPhaseButterworth
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.reading import PART_SIZE, SamplesOnDisk, read_excerpt
from jaxid.measurement.recording import Recording
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    significant,
)
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import driven_robot

from .clipped_forces import clipped_forces, limited_forces
from .clock import clock_finding, held_forces
from .limit_checks import MAX_REST, LogStatistics, limit_findings
from .mistake_search import find_mistakes, ignore_progress
from .sensor_checks import channel_findings, constant_forces, repeated_channels
from .wrench_checks import wrench_remarks

MAX_SAMPLES = 2**17
"""Largest number of samples of a long log that are examined."""


@dataclasses.dataclass(frozen=True)
class Diagnosis(Summarised):
    """Statistics of a log beside the limits of its robot, and findings.

    Attributes:
        log: Log that was examined.
        robot: Robot of the log.
        statistics: Extremes of the log, joint by joint.
        findings: Signs of mistakes, as sentences; empty if there are none.
        faulty: Joints whose channels no model can fit: held, spiky, wrapped, or with
            rows lost.
        observations: Observations in which mistakes are looked for, of a long log a
            part; None if no part is long enough.
        excerpt: Samples of single channels, of a long log a part.
        notes: Remarks on how the log was examined, as sentences.
        commands: Excerpt with the commanded angles as angles; None if not known.
        is_mistaken: Whether a mistake in log or robot spoils any fit.
        leg_mistakes: What is wrong with the log of a robot on legs, as sentences.
    """

    log: Recording | Observations
    robot: Robot
    statistics: LogStatistics
    findings: Texts
    faulty: Indices
    observations: Observations | None
    excerpt: Recording
    notes: Texts = ()
    commands: Recording | None = None
    is_mistaken: bool = False
    leg_mistakes: Texts = ()

    def with_fit(self, fit: Fit, bodies: np.ndarray | None = None) -> "Diagnosis":
        """Return the diagnosis with findings of a fit to this log alone.

        The inertial parameters of the robot's file are in `bodies`.
        """
        mistakes = _mistakes([self], fit, bodies)
        fit_findings = (*mistakes.certain, *mistakes.doubts)
        notes = (*self.notes, *mistakes.remarks)
        findings = (*fit_findings, *self.findings)
        return dataclasses.replace(
            self, findings=findings, notes=notes, is_mistaken=bool(mistakes.certain)
        )

    def summary(self) -> Table:
        """Return a table: motion and forces beside their limits, and the findings."""
        robot = self.robot
        log = self.log
        statistics = self.statistics
        limits = robot.limits
        gaps = len(log.segments) - 1
        unit, force_unit, units = robot.unit_columns()
        return Table(
            f"log {log.name} (limits of the robot in brackets)",
            Column("joint", robot.joint_names),
            *units,
            _column_with_limits("from", statistics.lowest, limits.position_min, unit),
            _column_with_limits("to", statistics.highest, limits.position_max, unit),
            _column_with_limits(
                "speed", statistics.speed, limits.velocity, f"{unit}/s"
            ),
            _column_with_limits(
                "force", statistics.force, robot.known_max_forces, force_unit
            ),
            Column(
                "at rest",
                statistics.stands.mean(axis=0),
                "%",
                lambda x: f"{100 * x:.0f}",
            ),
            facts=[
                (
                    "samples",
                    f"{log.samples} at {significant(1 / log.sample_time, 4)} Hz",
                ),
                ("duration", f"{significant(log.duration, 4)} s"),
                ("gaps", "none" if gaps == 0 else str(gaps)),
            ],
            remarks=[
                *(Remark(note) for note in (*log.notes, *self.notes)),
                *(
                    Remark(text, Status.DOUBTFUL)
                    for text in dict.fromkeys(self.findings)
                ),
                *(
                    []
                    if self.findings
                    else [Remark("Nothing suspicious was found.", Status.GOOD)]
                ),
            ],
        )


def _column_with_limits(
    name: str, values: np.ndarray, limits: AnyArray, unit: str
) -> Column:
    """Return a column of values with limits in brackets."""
    pairs = zip(values, np.asarray(limits), strict=True)
    texts = [f"{significant(x)} ({significant(limit)})" for x, limit in pairs]
    return Column(name, texts, unit, kind="number")


def diagnose(
    log: Recording | Observations,
    robot: Robot,
    fit: Fit | None = None,
    *,
    observations: Observations | None = None,
    min_speed: Numbers | None = None,
    commands: Recording | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Look for mistakes in a log: units, signs, order, sides, sensor faults and delays.

    Observations on disk are read in parts, and single channels are examined in a part
    of the log.

    Args:
        log: Recording of the robot, or observations on disk.
        robot: Robot, whose limits are compared with the log.
        fit: Fit to this log; mistakes that only a model reveals are left out if None.
        observations: Observations of the recording; filtered below a tenth of its
            sampling rate, and 20 Hz at most, if None.
        min_speed: Speed of each joint below which rows do not count [rad/s or m/s].
        commands: The log with the commanded angles as angles, if they are known.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If log and robot do not belong together, the log is too short to
            filter, or it is neither a recording nor on disk.
    """
    examined_log = _examined_log(log, robot, observations, min_speed)
    excerpt = examined_log.excerpt
    # Channels are those of the driven joints; the other rows follow from an IMU.
    driven = robot.driven
    # Gravity at rest tells a wrist sensor of its load.
    is_at_wrist = bool(robot.sensor_bodies) and not robot.has_base_sensor
    max_rest = 1.0 if is_at_wrist else MAX_REST
    robot = driven_robot(robot)
    statistics = _statistics(examined_log.all_observations, driven, progress)
    faults = channel_findings(robot, excerpt, statistics)
    faulty_joints = tuple(dict.fromkeys(joint for joint, _ in faults))
    clock_text = clock_finding(excerpt)
    findings = [
        *dict.fromkeys(text for _, text in faults),
        *([clock_text] if clock_text else []),
        *limit_findings(robot, statistics, faulty_joints, max_rest),
        *constant_forces(robot, excerpt),
        *repeated_channels(robot, excerpt),
        *held_forces(robot, excerpt),
    ]
    limit_notes = [
        f"{force.sentence(robot)}: a drive at its limit."
        for force in limited_forces(excerpt)
        if force.joint not in faulty_joints
    ]
    rate = 1.0 / excerpt.sample_time
    if not 5.0 <= rate <= 5e4:
        cure = "check `recording.time_unit` or `sample_time`."
        findings.append(f"the log has {rate:.3g} samples in a second: {cure}")
    if clock_text:
        faulty_joints = tuple(range(robot.joints))
    diagnosis = Diagnosis(
        log,
        robot,
        statistics,
        tuple(findings),
        faulty_joints,
        examined_log.observations,
        excerpt,
        (*examined_log.notes, *limit_notes),
        commands,
    )
    return diagnosis if fit is None else diagnosis.with_fit(fit)


class _ExaminedLog(NamedTuple):
    """Parts of a log that are examined.

    Attributes:
        excerpt: Samples of single channels, of a long log a part.
        all_observations: Observations of the whole log.
        observations: Observations in which mistakes are looked for, if any.
        notes: What was left out, as sentences.
    """

    excerpt: Recording
    all_observations: Observations
    observations: Observations | None
    notes: Texts = ()


def _examined_log(
    log: Recording | Observations,
    robot: Robot,
    observations: Observations | None,
    min_speed: Numbers | None,
) -> _ExaminedLog:
    """Return the parts of a log that are examined, in memory or read from the disk."""
    if isinstance(log, Recording):
        if observations is None:
            cutoff = min(20.0, 0.1 / log.sample_time)
            low_pass = ZeroPhaseButterworth(cutoff)
            observations = observe(log, robot, low_pass, min_speed=min_speed)
        return _ExaminedLog(log, observations, observations)
    if not isinstance(log.source, SamplesOnDisk):
        raise InputError(
            "`log` holds filtered samples in memory, which do not show faults of "
            "single channels: give the recording itself, and the filtered samples as "
            "`observations`."
        )
    excerpt = read_excerpt(log, MAX_SAMPLES)
    reason = ""
    try:
        observations = observe(excerpt, robot, log.filter, log.decimation, min_speed)
    except InputError as error:
        observations = None
        reason = f" of single channels only: {error}"
    if not reason and excerpt.samples == log.samples:
        return _ExaminedLog(excerpt, log, observations)
    examined_samples = f"{excerpt.samples} of the {log.samples} samples"
    note = f"{examined_samples} were examined for mistakes{reason}"
    return _ExaminedLog(excerpt, log, observations, (note,))


def _statistics(
    observations: Observations, driven: Indices, progress: Progress | None
) -> LogStatistics:
    """Return the statistics of a whole log, which is read in parts from the disk."""
    statistics = LogStatistics(len(driven), observations.samples)
    joints = list(driven)
    is_on_disk = isinstance(observations.source, SamplesOnDisk)
    for a, b in observations.segments:
        # Differences at the ends of parts are not central: logs in memory are taken at
        # once.
        step = PART_SIZE if is_on_disk else b - a
        for start in range(a, b, step):
            samples = slice(start, min(start + step, b))
            motion, forces = observations.read(samples)
            motion = Motion(*(x[:, joints] for x in (motion.q, motion.qd, motion.qdd)))
            statistics.add(motion, forces[:, joints], observations.sample_time)
            if progress is not None:
                progress(samples.stop / observations.samples)
    return statistics


class LogMistakes(NamedTuple):
    """Mistakes in logs or their robot, as sentences.

    Attributes:
        certain: Mistakes, contacts, and that the model does not fit.
        doubts: Mistakes that explain only a part of what the model misses, and what
            fits, but needs a look.
        remarks: That most of what the model misses is missed at rest.
        delay: Delay of all forces; None where no mistakes were looked for.
        are_gains: Whether the certain mistakes are gains of forces.
    """

    certain: Texts = ()
    doubts: Texts = ()
    remarks: Texts = ()
    delay: Delay | None = None
    are_gains: bool = False


def mistakes_in_logs(
    diagnoses: Sequence[Diagnosis],
    fit: Fit,
    bodies: np.ndarray | None = None,
    progress: Progress = ignore_progress,
) -> LogMistakes:
    """Return findings of a fit to several logs, which are judged together.

    The inertial parameters of the robot's file are in `bodies`, if it states some.
    """
    mistakes = _mistakes(diagnoses, fit, bodies, progress)
    if len(diagnoses) > 1:
        return mistakes

    def named(texts: Iterable[str]) -> Texts:
        return tuple(f"{diagnoses[0].log.name}: {text}" for text in texts)

    return LogMistakes(
        named(mistakes.certain),
        named(mistakes.doubts),
        named(mistakes.remarks),
        mistakes.delay,
        mistakes.are_gains,
    )


def _mistakes_in_base_wrenches(
    model: Model, logs: Sequence[Observations]
) -> LogMistakes:
    """Return what is wrong with the wrenches of a sensor under the base."""
    certain = []
    doubts = []
    for log in logs:
        name = f"{log.name}: " if len(logs) > 1 else ""
        for remark in wrench_remarks(model, log):
            texts = certain if remark.status is Status.BAD else doubts
            texts.append(f"{name}{remark.text}")
    return LogMistakes(tuple(certain), tuple(doubts))


def _mistakes_of_legs(diagnoses: Sequence[Diagnosis]) -> LogMistakes:
    """Return what is wrong with the logs of a robot on legs."""
    texts = []
    for diagnosis in diagnoses:
        name = f"{diagnosis.log.name}: " if len(diagnoses) > 1 else ""
        texts += [f"{name}{text}" for text in diagnosis.leg_mistakes]
    return LogMistakes(tuple(texts))


def _mistakes(
    diagnoses: Sequence[Diagnosis],
    fit: Fit,
    bodies: np.ndarray | None,
    progress: Progress = ignore_progress,
) -> LogMistakes:
    """Return the mistake that explains most, and what only a model reveals."""
    model = fit.base.model
    if model.robot.has_base_sensor:
        logs = [x.observations for x in diagnoses if x.observations is not None]
        return _mistakes_in_base_wrenches(model, logs)
    if model.robot.virtual:
        return _mistakes_of_legs(diagnoses)
    recordings = []
    commands = []
    doubts = []
    for diagnosis in diagnoses:
        observations = diagnosis.observations
        # Faults of channels explain the rest.
        if observations is None or diagnosis.faulty:
            continue
        log_name = observations.name
        recording = dataclasses.replace(diagnosis.excerpt, name=log_name)
        recordings.append(recording)
        if diagnosis.commands is not None:
            commands.append(diagnosis.commands)
        name = f"{log_name}: " if len(diagnoses) > 1 else ""
        limits = list(limited_forces(recording))
        doubts += [
            f"{name}{force.sentence(model.robot)}, and the model needs larger ones: "
            "the sensor or the log clips them; leave that part out "
            "(`recording.stop`)."
            for force in clipped_forces(model, recording, limits)
        ]
    if not recordings:
        return LogMistakes()
    if len(commands) < len(recordings):
        commands = []
    mistakes = find_mistakes(model, recordings, bodies, commands, progress)
    certain = mistakes.explained or mistakes.unexplained
    doubts = (*mistakes.possible, *mistakes.doubts, *doubts)
    logs = [x.observations for x in diagnoses if x.observations is not None]
    # Otherwise, rows at rest have been left out.
    has_all_rows = all(np.all(log.mask) for log in logs)
    remarks = mistakes.rest if has_all_rows else ()
    return LogMistakes(certain, doubts, remarks, mistakes.delay, mistakes.are_gains)
