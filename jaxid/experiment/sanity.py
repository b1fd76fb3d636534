"""Is this log sane? Ranges, speeds and forces of a log beside the limits of its robot."""

import dataclasses
from collections.abc import Collection

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.experiment.channels import (
    SLACK,
    STANDING,
    rate_doubts,
    stuck_doubts,
    unit_doubts,
)
from jaxid.experiment.faults import channel_faults
from jaxid.experiment.mistakes import FRICTION
from jaxid.identification.fit import Fit
from jaxid.measurement.observations import Observations, Progress
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot

FAST, STRONG = 1.1, 1.2
"""Parts of the limits above which speeds and forces are doubtful."""
WEAK = 0.02
"""Part of its largest force that some joint of a robot in motion needs at least."""
SURE = 3.0
"""Standard deviations beyond which a sign is certain."""
STANDS = 2**18
"""Samples by which it is judged how long joints stand."""
AT_ONCE = 65536
"""Samples of a long log that are read at once."""
HARDLY = 0.02
"""A motion in [rad] or [m] that is too small to tell anything."""


@dataclasses.dataclass(frozen=True)
class LogCheck:
    """What a log holds, joint by joint, and what is strange about it.

    Attributes:
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        speed: Largest speed of each joint [rad/s or m/s].
        acceleration: Largest acceleration of each joint [rad/s² or m/s²].
        force: Largest force of each joint [N m or N].
        standing: Share of the samples in which each joint stands, of 1.
        all_standing: Share of the samples in which all joints stand, of 1.
        warnings: What is strange, in sentences.
        faulty: Joints with channels that are held, spiky or wrapped: the model cannot fit them.
    """

    lowest: Float[np.ndarray, " joints"]
    highest: Float[np.ndarray, " joints"]
    speed: Float[np.ndarray, " joints"]
    acceleration: Float[np.ndarray, " joints"]
    force: Float[np.ndarray, " joints"]
    standing: Float[np.ndarray, " joints"]
    all_standing: float
    warnings: tuple[str, ...]
    faulty: tuple[int, ...] = ()


def check_log(robot: Robot, recording: Recording, observations: Observations) -> LogCheck:
    """Compares a log with what its robot can do: a wrong unit or sign shows here.

    Args:
        robot: Whose log it is.
        recording: As it was read.
        observations: What the filter made of it.
    """
    look = _Look(robot.joints, 1)
    angles = np.asarray(recording.angles)
    for a, b in recording.segments:
        look.steps(angles[a:b])
    for a, b in observations.segments:
        look.motion(observations.motion[a:b], observations.forces[a:b], observations.sample_time)
    return _with_channels(look, robot, recording)


def check_long_log(
    robot: Robot, log: Observations, part: Recording, progress: Progress | None = None
) -> LogCheck:
    """The same for a log that is gone through part by part.

    Whether joints stand is judged by every n-th sample, and channels by a part of the log.

    Args:
        robot: Whose log it is.
        log: The log.
        part: Of it, as it was recorded.
        progress: Is told now and then which share is done, of 1.
    """
    look = _Look(robot.joints, -(-log.samples // STANDS))
    for a, b in log.segments:
        last = np.zeros((0, robot.joints))
        for start in range(a, b, AT_ONCE):
            stop = min(start + AT_ONCE, b)
            motion, forces, angles = log.source.read_with_angles(slice(start, stop))
            look.steps(np.concatenate([last, angles]))
            look.motion(motion, forces, log.sample_time)
            last = angles[-1:]
            if progress is not None:
                progress(stop / log.samples)
    return _with_channels(look, robot, part)


def _with_channels(look: "_Look", robot: Robot, recording: Recording) -> LogCheck:
    """What was seen, and what single channels give away."""
    faults = channel_faults(robot, recording)
    faulty = tuple(dict.fromkeys(fault.joint for fault in faults))
    measured = recording.velocities is not None
    check = look.check(robot, recording.angles_on_motor_side, measured, faulty)
    more = (*rate_doubts(recording.sample_time), *stuck_doubts(robot, recording, faulty))
    warnings = (*(fault.said for fault in faults), *check.warnings, *more)
    return dataclasses.replace(check, warnings=warnings, faulty=faulty)


class _Look:
    """What was seen of a log so far: extremes and sums, and every n-th velocity."""

    def __init__(self, joints: int, every: int):
        self._every, self._samples = every, 0
        self._lowest, self._highest = np.full(joints, np.inf), np.full(joints, -np.inf)
        self._speed, self._acceleration, self._force, self._jump = np.zeros((4, joints))
        self._power, self._forces, self._velocities = 0.0, 0.0, 0.0
        self._rates, self._along = np.zeros((2, joints))
        self._kept: list[np.ndarray] = []

    def steps(self, angles: np.ndarray) -> None:
        """Unfiltered angles of consecutive samples."""
        if len(angles) > 1:
            self._jump = np.maximum(self._jump, np.abs(np.diff(angles, axis=0)).max(axis=0))

    def motion(self, motion: Motion, forces: AnyArray, sample_time: float) -> None:
        """What the filter made of consecutive samples."""
        q, qd, qdd = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd))
        forces = np.asarray(forces)
        self._lowest = np.minimum(self._lowest, q.min(axis=0))
        self._highest = np.maximum(self._highest, q.max(axis=0))
        self._speed = np.maximum(self._speed, np.abs(qd).max(axis=0))
        self._acceleration = np.maximum(self._acceleration, np.abs(qdd).max(axis=0))
        self._force = np.maximum(self._force, np.abs(forces).max(axis=0))
        self._power += float(np.sum(forces * qd))
        self._forces += float(np.sum(forces**2))
        self._velocities += float(np.sum(qd**2))
        if len(q) > 1:
            rate = np.gradient(q, sample_time, axis=0)
            self._rates = self._rates + np.sum(rate**2, axis=0)
            self._along = self._along + np.sum(rate * qd, axis=0)
        self._kept.append(qd[-self._samples % self._every :: self._every])
        self._samples += len(q)

    def check(
        self, robot: Robot, on_motor_side: bool, velocities: bool, faulty: Collection[int] = ()
    ) -> LogCheck:
        """What is strange about it, apart from what faults of channels bring with them."""
        kept = np.concatenate(self._kept)
        stands = np.abs(kept) < STANDING * np.maximum(self._speed, 1e-12)
        check = LogCheck(
            lowest=self._lowest,
            highest=self._highest,
            speed=self._speed,
            acceleration=self._acceleration,
            force=self._force,
            standing=stands.mean(axis=0),
            all_standing=float(stands.all(axis=1).mean()),
            warnings=(),
        )
        sound = [j for j in range(robot.joints) if j not in faulty]
        warnings: list[str] = []
        if not faulty:
            warnings = unit_doubts(robot, check.lowest, check.highest, on_motor_side)
        if not warnings:
            warnings = [w for j in sound for w in _range(robot, j, check)]
        warnings += (said := [] if faulty else _all_forces(robot, check))
        for j in sound:
            warnings += _joint(robot, j, check) + ([] if said else _force(robot, j, check))
        # Over a whole log, friction makes a robot consume energy.
        least = -0.05 * np.sqrt(self._forces * self._velocities)
        if not faulty and self._power < least:
            warnings.append(
                "the robot gives off energy over the whole log: check the signs of its angles and "
                "forces (`recording.angle_signs`, `force_signs`)."
            )
        warnings += [] if on_motor_side else _jumps(robot, self._jump, sound)
        warnings += _velocities(robot, self._rates, self._along, sound) if velocities else []
        if check.all_standing > 0.5:
            warnings.append(
                f"the robot stands still for {100 * check.all_standing:.0f} % of the log: crop it "
                "with `recording.start` and `recording.stop`."
            )
        return dataclasses.replace(check, warnings=tuple(warnings))


def _range(robot: Robot, j: int, check: LogCheck) -> list[str]:
    name, unit, limits = robot.joint_names[j], robot.joint_unit(j), robot.limits
    low, high = float(limits.position_min[j]), float(limits.position_max[j])
    slack = SLACK * (high - low) if np.isfinite(high - low) else 0.0
    if check.lowest[j] >= low - slack and check.highest[j] <= high + slack:
        return []
    return [
        f"joint `{name}` moves from {check.lowest[j]:.3g} to {check.highest[j]:.3g} {unit}, "
        f"outside its range from {low:.3g} to {high:.3g} {unit}: check `recording.angle_unit`, "
        "`side`, `angle_signs` and `angle_offsets`."
    ]


def _joint(robot: Robot, j: int, check: LogCheck) -> list[str]:
    name, unit, limits = robot.joint_names[j], robot.joint_unit(j), robot.limits
    said = []
    if check.speed[j] > FAST * limits.velocity[j]:
        said.append(
            f"joint `{name}` reaches {check.speed[j]:.3g} {unit}/s, but its limit is "
            f"{float(limits.velocity[j]):.3g} {unit}/s: check the units of angles and time, or "
            "lower the filter's cut-off."
        )
    if check.highest[j] - check.lowest[j] < HARDLY:
        said.append(
            f"joint `{name}` moves by {check.highest[j] - check.lowest[j]:.2g} {unit} only: its "
            "parameters cannot be told from this log; is it the right column and unit?"
        )
    if check.force[j] == 0.0:
        said.append(f"the forces of joint `{name}` are zero throughout: is it the right column?")
    return said


def _force(robot: Robot, j: int, check: LogCheck) -> list[str]:
    name, unit, known = robot.joint_names[j], robot.force_unit(j), float(robot.known_max_forces[j])
    if check.force[j] <= STRONG * known:
        return []
    return [
        f"joint `{name}` needs {check.force[j]:.3g} {unit}, but its limit is {known:.3g} {unit}: "
        "check `recording.force_unit` and `forces_side`."
    ]


def _all_forces(robot: Robot, check: LogCheck) -> list[str]:
    """That all forces are of another size than the robot's: one unit or side is wrong."""
    known = np.asarray(robot.known_max_forces)
    known = np.where(np.isfinite(known), known, np.nan)
    share = check.force / known
    share = share[np.isfinite(share)]
    cure = "check `recording.force_unit`, `forces_side` and `torque_constants`."
    if share.size > 1 and share.min() > STRONG:
        return [
            f"all joints need more than their largest forces, {share.min():.2g} to "
            f"{share.max():.2g} times as much: {cure}"
        ]
    if share.size > 1 and 0 < share.max() < WEAK:
        return [f"no joint needs more than {100 * share.max():.2g} % of its largest force: {cure}"]
    return []


def _jumps(robot: Robot, largest: np.ndarray, joints: list[int]) -> list[str]:
    """A joint does not turn by half a turn or more from one sample to the next."""
    return [
        f"the angle of joint `{robot.joint_names[j]}` jumps by {largest[j]:.3g} rad from one "
        "sample to the next: undo the wrapping at a full turn before the log is filtered."
        for j in joints
        if robot.revolute[j] and largest[j] > np.pi
    ]


def negative_friction(fit: Fit) -> tuple[str, ...]:
    """Joints whose friction comes out negative beyond doubt: a sign is wrong, or the model is."""
    robot, names = fit.base.model.robot, fit.base.names
    certain = np.asarray(fit.parameters) < -SURE * np.asarray(fit.standard_deviations)
    wrong = {name for name, negative in zip(names, certain, strict=True) if negative}
    return tuple(
        f"friction of joint `{label}` comes out negative ({' and '.join(found)}): check the signs "
        "of its angles and forces (`recording.angle_signs`, `force_signs`)."
        for j, label in enumerate(robot.joint_names)
        if (found := [f"{kind}{j + 1}" for kind in FRICTION if f"{kind}{j + 1}" in wrong])
    )


def _velocities(
    robot: Robot, squares: np.ndarray, along: np.ndarray, joints: list[int]
) -> list[str]:
    """Measured velocities must be the derivatives of the angles."""
    ratio = along / np.where(squares > 0, squares, 1.0)
    return [
        f"the measured velocities of joint `{robot.joint_names[j]}` are {ratio[j]:.3g} times the "
        "derivatives of its angles: check `recording.velocity_unit` and the order of the columns."
        for j in joints
        if squares[j] > 0 and abs(ratio[j] - 1.0) > 0.2
    ]
