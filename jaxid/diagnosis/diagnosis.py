"""Diagnosis of a log: signs of wrong units, signs, channels, sensors and delays, as sentences.

For mislabelled channels, every possible mistake is corrected in turn, and the model is fitted anew
to some instants of the log, with friction that takes energy from the robot, as all friction does.
Without that condition a wrong sign would only change signs of parameters where joints are hardly
coupled.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxid.arrays import AnyArray, Float
from jaxid.diagnosis.findings import (
    LogStatistics,
    channel_findings,
    limit_findings,
    stuck_findings,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.delay import estimate_delay
from jaxid.identification.estimators import GivenWeights
from jaxid.identification.fit import Fit
from jaxid.measurement.filters import ZeroPhaseButterworth
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.reading import AT_ONCE, SamplesOnDisk
from jaxid.measurement.recording import Recording, consecutive
from jaxid.robot.robot import Robot
from jaxid.table import MISSING, Column, Remark, Status, Table, significant

BAD = 0.03
"""Fraction (0 to 1) of the forces left unexplained from which mistakes are looked for."""
SURE = 3.0
"""Standard deviations beyond which a sign is certain."""
EXAMINED = 2**17
"""Largest number of samples of a long log that are examined."""


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Statistics of a log beside the limits of its robot, and findings.

    Attributes:
        log: Log that was examined.
        robot: Robot of the log.
        statistics: Extremes of the log, joint by joint.
        findings: Signs of mistakes, as sentences; empty if there are none.
        faulty: Joints with held, spiky or wrapped channels, which no model can fit.
        observations: Observations in which mistakes are looked for, of a long log a part; None if
            no part is long enough.
        motor_sides: Whether angles and forces of the log are taken for the motors'.
        notes: Remarks on how the log was examined, as sentences.
    """

    log: Recording | Observations
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

    def with_fit(self, fit: Fit) -> "Diagnosis":
        """Return the diagnosis with what a fit to this log alone reveals, including delays.

        Args:
            fit: Fit to this log.
        """
        found = () if self.faulty else self.mistakes(fit)
        if not found and not self.faulty:
            found = negative_friction(fit)
            if self.observations is not None:
                found += delay_finding(fit.base, self.observations, fit)
        return dataclasses.replace(self, findings=(*found, *self.findings))

    def summary(self) -> Table:
        """Return a table: motion and forces of each joint beside its limits, and the findings."""
        robot, log, s = self.robot, self.log, self.statistics
        limits, gaps, joints = robot.limits, len(log.segments) - 1, range(robot.joints)
        return Table(
            f"log {log.name} (limits of the robot in brackets)",
            Column("joint", robot.joint_names),
            _beside("from", s.lowest, limits.position_min),
            _beside("to", s.highest, limits.position_max),
            _beside("speed", s.speed, limits.velocity, "unit/s"),
            _beside("force", s.force, robot.known_max_forces),
            Column("at rest", s.standing, "%", lambda x: f"{100 * x:.0f}"),
            Column("unit", [robot.joint_unit(j) for j in joints]),
            Column("force\nunit", [robot.force_unit(j) for j in joints]),
            facts=[
                ("samples", f"{log.samples} at {significant(1 / log.sample_time, 4)} Hz"),
                ("duration", f"{significant(log.duration, 4)} s"),
                ("gaps", "none" if gaps == 0 else str(gaps)),
            ],
            remarks=[
                *(Remark(note) for note in (*log.notes, *self.notes)),
                *(Remark(text, Status.DOUBTFUL) for text in dict.fromkeys(self.findings)),
                *([] if self.findings else [Remark("Nothing suspicious was found.", Status.GOOD)]),
            ],
        )

    def __str__(self) -> str:
        return str(self.summary())


def _beside(name: str, values: np.ndarray, limits: AnyArray, unit: str = "") -> Column:
    """Return a column of values with limits in brackets."""
    pairs = zip(values.tolist(), np.asarray(limits).tolist(), strict=True)
    texts = [f"{significant(x)} ({MISSING if np.isinf(y) else significant(y)})" for x, y in pairs]
    return Column(name, texts, unit, kind="number")


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
        part = log
        if observations is None:
            cutoff = min(20.0, 0.1 / log.sample_time)
            observations = observe(log, robot, ZeroPhaseButterworth(cutoff), min_speed=min_speed)
        whole = observations
    elif isinstance(log.source, SamplesOnDisk):
        part, whole = _excerpt(log, log.source), log
        observations, notes = _observe_excerpt(log, part, robot, min_speed)
    else:
        whole = observations = log
        part = Recording(
            *(log.time, np.asarray(log.motion.q), np.asarray(log.forces), None, False, False),
            *(log.segments, log.sample_time),
        )
    statistics = _statistics(whole, progress)
    sides = part.angles_on_motor_side, part.forces_on_motor_side
    faults = channel_findings(robot, part)
    faulty = tuple(dict.fromkeys(joint for joint, _ in faults))
    findings = [
        *(text for _, text in faults),
        *limit_findings(robot, statistics, sides[0], part.velocities is not None, faulty),
        *stuck_findings(robot, part, faulty),
    ]
    rate = 1.0 / part.sample_time
    if not 5.0 <= rate <= 5e4:
        cure = "check `recording.time_unit` or `sample_time`."
        findings.append(f"the log has {rate:.3g} samples in a second: {cure}")
    found = tuple(findings)
    diagnosis = Diagnosis(log, robot, statistics, found, faulty, observations, sides, notes)
    return diagnosis if fit is None else diagnosis.with_fit(fit)


def mistakes_in_logs(diagnoses: Sequence[Diagnosis], fit: Fit) -> tuple[str, ...]:
    """Return what a fit to several logs reveals, apart from delays, with the names of the logs."""
    friction = () if any(d.faulty for d in diagnoses) else negative_friction(fit)
    return (*friction, *(f"{d.log.name}: {text}" for d in diagnoses for text in d.mistakes(fit)))


def _statistics(observations: Observations, progress: Progress | None) -> LogStatistics:
    """Go through a log in parts."""
    o = observations
    statistics = LogStatistics(o.joints, o.samples)
    for a, b in o.segments:
        # Differences at the ends of parts are not central: logs in memory are taken at once.
        step = AT_ONCE if isinstance(o.source, SamplesOnDisk) else b - a
        for start in range(a, b, step):
            samples = slice(start, min(start + step, b))
            statistics.add(*o.read(samples), o.sample_time)
            if progress is not None:
                progress(samples.stop / o.samples)
    return statistics


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


def _excerpt(log: Observations, source: SamplesOnDisk) -> Recording:
    """Return stretches of a log as they were recorded: from its beginning, middle and end."""
    stretches = _stretches(log)
    angles, velocities, forces = zip(
        *(source.read_rows(slice(a, b)) for a, b in stretches), strict=True
    )
    times = []
    for a, b in stretches:
        k = next(k for k, (_, end) in enumerate(log.segments) if end > a)
        times.append(log.start_times[k] + log.sample_time * (np.arange(a, b) - log.segments[k][0]))
    return Recording(
        time=np.concatenate(times),
        angles=np.concatenate(angles),
        forces=np.concatenate(forces),
        velocities=None if velocities[0] is None else np.concatenate(velocities),
        angles_on_motor_side=source.log.columns.angles_on_motor_side,
        forces_on_motor_side=source.log.columns.forces_on_motor_side,
        segments=consecutive(b - a for a, b in stretches),
        sample_time=log.sample_time,
        name=log.name,
    )


def _stretches(log: Observations) -> list[tuple[int, int]]:
    """Return half-open ranges of samples, none of which goes over a gap."""
    if log.samples <= EXAMINED:
        return list(log.segments)
    count = 4
    length = EXAMINED // count
    stretches: list[tuple[int, int]] = []
    for start in np.linspace(0, log.samples - length, count).astype(int):
        a = max(int(start), stretches[-1][1] if stretches else 0)
        b = min(a + length, next(end for _, end in log.segments if end > a))
        stretches.append((a, b))
    if min(b - a for a, b in stretches) >= 20 * log.filter.edge(log.sample_time):
        return stretches
    # Gaps, or a filter with a long memory: one long stretch tells more than several short ones.
    a, b = max(log.segments, key=lambda ends: ends[1] - ends[0])
    return [(a, min(b, a + EXAMINED))]


def likely_mistakes(
    base: BaseParameters,
    observations: Observations,
    angles_on_motor_side: bool = False,
    forces_on_motor_side: bool = False,
) -> tuple[str, ...]:
    """Look for a single sign, exchange, unit or side whose correction makes the model fit the log.

    Returns:
        A sentence; nothing if the model fits, or no single mistake explains why it does not.
    """
    step = -(-observations.rows // 300)
    forces = observations.reduced_forces[::step]
    motion = observations.motion[observations.instants[::step]]
    left = _unexplained(base, motion, forces)
    if left < BAD:
        return ()
    sides = angles_on_motor_side, forces_on_motor_side
    corrected = _corrected(base.model.robot, motion, forces, *sides)
    tried = sorted((_unexplained(base, m, f), text) for text, m, f in corrected)
    best = tried[0][0]
    likely = [text for rest, text in tried if rest <= 1.05 * best]
    # With more than three candidates nothing is known.
    if best > 0.9 * left or len(likely) > 3:
        return ()
    return (
        f"{', or '.join(likely)}: the model then misses {100 * best:.2g} % of the forces instead "
        f"of {100 * left:.2g} %.",
    )


def _corrected(
    robot: Robot,
    motion: Motion,
    forces: Float[np.ndarray, "rows joints"],
    angles_on_motor_side: bool,
    forces_on_motor_side: bool,
) -> Iterator[tuple[str, Motion, np.ndarray]]:
    """Yield possible mistakes, as clauses, each with the motion and forces without it."""
    drives, names, n = robot.drives, robot.joint_names, robot.joints
    still = np.asarray(drives.joint_angles(np.zeros(n)))
    to_joint = np.asarray(drives.joint_angles(np.eye(n))) - still
    to_motor = np.linalg.inv(to_joint)

    def moved(by: np.ndarray, q: AnyArray | None = None) -> Motion:
        q = motion.q @ by if q is None else np.asarray(q)
        return Motion(q, motion.qd @ by, motion.qdd @ by)

    def change_angles(change: np.ndarray) -> Motion:
        """Return the motion with other combinations of the log's columns."""
        if not angles_on_motor_side:
            return moved(change)
        q = drives.joint_angles(np.asarray(drives.motor_angles(motion.q)) @ change)
        return moved(to_motor @ change @ to_joint, q)

    def change_forces(change: np.ndarray) -> np.ndarray:
        return forces @ (to_joint.T @ change @ to_motor.T if forces_on_motor_side else change)

    for j, name in enumerate(names):
        change = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        key = f"of joint `{name}` seems to be wrong (`recording."
        yield f"the sign of the force {key}force_signs`)", motion, change_forces(change)
        yield f"the sign of the angle {key}angle_signs`)", change_angles(change), forces
    # The number of pairs grows with the square.
    for i, j in itertools.combinations(range(n), 2) if n <= 12 else ():
        change = np.eye(n)
        change[[i, j]] = change[[j, i]]
        key = f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        yield f"the forces {key}forces`)", motion, change_forces(change)
        yield f"the angles {key}angles`)", change_angles(change), forces
    for unit, factor in (("deg", np.pi / 180), ("rev", 2 * np.pi)):
        for said, by in ((f"{unit}", factor), (f"rad, not in {unit}", 1 / factor)):
            scaled = moved(np.diag(np.where(robot.revolute, by, 1.0)))
            text = f"the angles of the log seem to be in {said} (`recording.angle_unit`)"
            yield text, scaled, forces
    if drives.is_direct:
        return
    for side, owner, by, angles, changed in (
        ("motor", "motors'", to_joint, drives.joint_angles, forces @ to_motor.T),
        ("joint", "joints'", to_motor, drives.motor_angles, forces @ to_joint.T),
    ):
        other, text = moved(by, angles(motion.q)), f"of the log seem to be the {owner} (`recording."
        yield f'the angles and forces {text}side = "{side}"`)', other, changed
        yield f'the forces {text}forces_side = "{side}"`)', motion, changed
        yield f"the angles {text}side`, with `forces_side` as it is)", other, forces


def _unexplained(
    base: BaseParameters, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> float:
    """Return the fraction (0 to 1) of the forces that least squares leave unexplained.

    All joints count equally. Friction terms that would come out negative are left out.
    """
    wanted = forces - base.tool_forces(motion)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    scale = 1.0 / np.where(size > 0, size, np.inf)
    rows = base.regressor_rows(motion)
    joints = len(scale)
    theta = np.zeros((joints, len(forces), base.size + 1))
    for joint, columns in enumerate(base.acting_columns):
        theta[joint][:, columns] = rows[joint] * scale[joint]
    theta[..., -1] = (wanted * scale).T
    theta = theta.reshape(-1, base.size + 1)
    if not np.isfinite(theta).all():
        return np.inf
    R = np.asarray(np.linalg.qr(theta, mode="r"))
    length = np.linalg.norm(R, axis=0)
    R, target = R[:, :-1] / np.where(length[:-1] > 0, length[:-1], 1.0), R[:, -1]
    named = {f"{kind}{j + 1}" for kind in ("fv", "fc") for j in range(joints)}
    used = np.ones(base.size, bool)
    braking = np.array([name in named for name in base.names])
    while True:
        found = np.zeros(base.size)
        found[used] = np.linalg.lstsq(R[:, used], target, rcond=1e-9)[0]
        pushing = braking & (found < 0)
        if not pushing.any():
            break
        used &= ~pushing
    return float(np.linalg.norm(R @ found - target) / max(length[-1], 1e-300))


def negative_friction(fit: Fit) -> tuple[str, ...]:
    """Report joints whose friction is negative beyond doubt: a sign or the model is wrong."""
    robot, names = fit.base.model.robot, fit.base.names
    certain = np.asarray(fit.parameters) < -SURE * np.asarray(fit.standard_deviations)
    wrong = {name for name, negative in zip(names, certain, strict=True) if negative}
    return tuple(
        f"friction of joint `{label}` comes out negative ({' and '.join(found)}): check the signs "
        "of its angles and forces (`recording.angle_signs`, `force_signs`)."
        for j, label in enumerate(robot.joint_names)
        if (found := [f"{kind}{j + 1}" for kind in ("fv", "fc") if f"{kind}{j + 1}" in wrong])
    )


def delay_finding(base: BaseParameters, observations: Observations, fit: Fit) -> tuple[str, ...]:
    """Return a sentence about a delay of the forces that the model sees, or nothing."""
    # A model that explains too little sees no delay.
    if not fit.residual < 0.3:
        return ()
    try:
        delay = estimate_delay(base, observations, GivenWeights(np.asarray(fit.weights)))
    except ValueError:
        return ()
    half = delay.interval()[1] - delay.seconds
    # A delay of a bus is that of all joints; other effects differ from joint to joint.
    scatter = float(np.std(delay.of_joints))
    if abs(delay.seconds) < max(half, scatter, 0.1 * observations.sample_time):
        return ()
    text = (
        f"the forces seem to stand {1e3 * abs(delay.seconds):.3g} ± {1e3 * half:.2g} ms "
        f"{'later' if delay.seconds > 0 else 'earlier'} in the log than the angles: "
    )
    if delay.p_value > 0.001:
        cure = f"`force_delay = {delay.seconds:.3g}` in `[recording]` removes that"
        return (f"{text}{cure}, unless the model lacks an effect instead.",)
    low, high = (1e3 * float(x) for x in (np.min(delay.of_joints), np.max(delay.of_joints)))
    return (
        f"{text}from {low:.3g} to {high:.3g} ms joint by joint, so that some effect which the "
        "model lacks is as likely (`force_delay` in `[recording]`).",
    )
