"""Range, speed and force of each joint in a log, compared with the limits of the robot."""

import dataclasses
from collections.abc import Collection

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.robot.robot import Robot

STANDING = 0.01
"""Fraction of a joint's largest speed below which it stands."""


@dataclasses.dataclass(frozen=True)
class LogStatistics:
    """Extremes of a log, joint by joint.

    Attributes:
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        speed: Largest speed of each joint [rad/s or m/s].
        acceleration: Largest acceleration of each joint [rad/s² or m/s²].
        force: Largest force of each joint [N m or N].
        standing: Fraction (0 to 1) of the samples in which each joint stands.
        all_standing: Fraction (0 to 1) of the samples in which all joints stand.
        largest_step: Largest step of each unfiltered angle between two samples [rad or m].
        power: Mean power over the product of the RMS forces and velocities.
        velocity_ratio: Velocities over derivatives of the angles, by least squares; NaN at rest.
    """

    lowest: Float[np.ndarray, " joints"]
    highest: Float[np.ndarray, " joints"]
    speed: Float[np.ndarray, " joints"]
    acceleration: Float[np.ndarray, " joints"]
    force: Float[np.ndarray, " joints"]
    standing: Float[np.ndarray, " joints"]
    all_standing: float
    largest_step: Float[np.ndarray, " joints"]
    power: float
    velocity_ratio: Float[np.ndarray, " joints"]


class StatisticsAccumulator:
    """Statistics of a log that is read in parts.

    Args:
        joints: Number of joints.
        samples: Number of samples; of long logs every n-th tells how long joints stand.
    """

    def __init__(self, joints: int, samples: int):
        self._step, self._samples = -(-samples // 2**18), 0
        self._lowest, self._highest = np.full(joints, np.inf), np.full(joints, -np.inf)
        self._speed, self._acceleration, self._force, self._largest_step = np.zeros((4, joints))
        self._power, self._forces, self._velocities = 0.0, 0.0, 0.0
        self._derivatives, self._products = np.zeros((2, joints))
        self._kept: list[np.ndarray] = []

    def add_angles(self, angles: np.ndarray) -> None:
        """Take in unfiltered angles of consecutive samples."""
        if len(angles) > 1:
            steps = np.abs(np.diff(angles, axis=0)).max(axis=0)
            self._largest_step = np.maximum(self._largest_step, steps)

    def add(self, motion: Motion, forces: AnyArray, sample_time: float) -> None:
        """Take in the filtered motion and the forces of consecutive samples."""
        q, qd, qdd, forces = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd, forces))
        self._lowest = np.minimum(self._lowest, q.min(axis=0))
        self._highest = np.maximum(self._highest, q.max(axis=0))
        self._speed = np.maximum(self._speed, np.abs(qd).max(axis=0))
        self._acceleration = np.maximum(self._acceleration, np.abs(qdd).max(axis=0))
        self._force = np.maximum(self._force, np.abs(forces).max(axis=0))
        self._power += float(np.sum(forces * qd))
        self._forces += float(np.sum(forces**2))
        self._velocities += float(np.sum(qd**2))
        if len(q) > 1:
            derivative = np.gradient(q, sample_time, axis=0)
            self._derivatives = self._derivatives + np.sum(derivative**2, axis=0)
            self._products = self._products + np.sum(derivative * qd, axis=0)
        self._kept.append(qd[-self._samples % self._step :: self._step])
        self._samples += len(q)

    def result(self) -> LogStatistics:
        """Return the statistics of everything that was taken in."""
        stands = np.abs(np.concatenate(self._kept)) < STANDING * np.maximum(self._speed, 1e-12)
        size = np.sqrt(self._forces * self._velocities)
        squares = np.where(self._derivatives > 0, self._derivatives, np.nan)
        return LogStatistics(
            lowest=self._lowest,
            highest=self._highest,
            speed=self._speed,
            acceleration=self._acceleration,
            force=self._force,
            standing=stands.mean(axis=0),
            all_standing=float(stands.all(axis=1).mean()),
            largest_step=self._largest_step,
            power=self._power / size if size > 0 else 0.0,
            velocity_ratio=self._products / squares,
        )


def limit_findings(
    robot: Robot,
    statistics: LogStatistics,
    on_motor_side: bool,
    measured_velocities: bool,
    faulty: Collection[int] = (),
) -> list[str]:
    """Compare a log with what its robot can do: a wrong unit or sign shows here.

    Args:
        robot: Robot of the log.
        statistics: Extremes of the log.
        on_motor_side: Whether the angles of the log are taken for the motors'.
        measured_velocities: Whether velocities were measured.
        faulty: Joints with faults of single channels, which explain more.
    """
    sound = [j for j in range(robot.joints) if j not in faulty]
    findings: list[str] = []
    if not faulty:
        findings = unit_findings(robot, statistics.lowest, statistics.highest, on_motor_side)
    if not findings:
        findings = [text for j in sound for text in _range(robot, j, statistics)]
    common = [] if faulty else _all_forces(robot, statistics)
    findings += common
    for j in sound:
        findings += _joint(robot, j, statistics)
        findings += [] if common else _force(robot, j, statistics)
    # Over a whole log, friction makes a robot consume energy.
    if not faulty and statistics.power < -0.05:
        findings.append(
            "the robot gives off energy over the whole log: check the signs of its angles and "
            "forces (`recording.angle_signs`, `force_signs`)."
        )
    findings += [] if on_motor_side else _steps(robot, statistics, sound)
    findings += _velocities(robot, statistics, sound) if measured_velocities else []
    if statistics.all_standing > 0.5:
        findings.append(
            f"the robot stands still for {100 * statistics.all_standing:.0f} % of the log: crop it "
            "with `recording.start` and `recording.stop`."
        )
    return findings


def rate_findings(sample_time: float) -> list[str]:
    """Report a sampling rate that no robot's log has."""
    rate = 1.0 / sample_time
    if 5.0 <= rate <= 5e4:
        return []
    return [
        f"the log has {rate:.3g} samples in a second: check `recording.time_unit` or `sample_time`."
    ]


def unit_findings(
    robot: Robot,
    lowest: Float[np.ndarray, " joints"],
    highest: Float[np.ndarray, " joints"],
    on_motor_side: bool,
) -> list[str]:
    """Look for a unit or side that brings the angles of all joints back into their ranges.

    Args:
        robot: Robot of the log.
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        on_motor_side: Whether the angles of the log are taken for the motors'.
    """
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    known = np.array(robot.revolute) & np.isfinite(high - low)
    if not known.any():
        return []
    low, width = low[known], (high - low)[known]
    slack = 0.02 * width

    def used_fraction(ends: np.ndarray) -> float:
        """Return the largest used fraction of a range; zero if some range is left."""
        a, b = np.sort(ends, axis=0)[:, known]
        inside = (a >= low - slack) & (b <= low + width + slack)
        return float(((b - a) / width).max()) if inside.all() else 0.0

    ends = np.stack([lowest, highest])
    moved = float(((highest - lowest)[known] / width).max())
    if moved <= 0.02 and used_fraction(np.where(known, np.rad2deg(ends), ends)) > 0.1:
        return [
            f"no joint moves through more than {100 * moved:.2g} % of its range: are the angles of "
            'the log in radians, though `recording.angle_unit` is "deg"?'
        ]
    if used_fraction(ends):
        return []
    corrected = {
        'degrees (`recording.angle_unit = "deg"`)': np.where(known, np.deg2rad(ends), ends),
        'radians (`recording.angle_unit` is "rev")': np.where(known, ends / (2 * np.pi), ends),
    }
    if not on_motor_side and not robot.drives.is_direct:
        joints = np.asarray(robot.drives.joint_angles(ends))
        corrected['the motors\' (`recording.side = "motor"`)'] = joints
    cures = [cure for cure, angles in corrected.items() if used_fraction(angles) > 0.1]
    if not cures:
        return []
    return [
        "the angles leave the ranges of the joints, but would not if those in the log were "
        f"{', or '.join(cures)}."
    ]


def _range(robot: Robot, j: int, statistics: LogStatistics) -> list[str]:
    name, unit, limits = robot.joint_names[j], robot.joint_unit(j), robot.limits
    low, high = float(limits.position_min[j]), float(limits.position_max[j])
    slack = 0.02 * (high - low) if np.isfinite(high - low) else 0.0
    if statistics.lowest[j] >= low - slack and statistics.highest[j] <= high + slack:
        return []
    return [
        f"joint `{name}` moves from {statistics.lowest[j]:.3g} to {statistics.highest[j]:.3g} "
        f"{unit}, outside its range from {low:.3g} to {high:.3g} {unit}: check "
        "`recording.angle_unit`, `side`, `angle_signs` and `angle_offsets`."
    ]


def _joint(robot: Robot, j: int, statistics: LogStatistics) -> list[str]:
    name, unit, limit = robot.joint_names[j], robot.joint_unit(j), robot.limits.velocity[j]
    findings = []
    if statistics.speed[j] > 1.1 * limit:
        findings.append(
            f"joint `{name}` reaches {statistics.speed[j]:.3g} {unit}/s, but its limit is "
            f"{float(limit):.3g} {unit}/s: check the units of angles and time, or "
            "lower the filter's cut-off."
        )
    moved = statistics.highest[j] - statistics.lowest[j]
    if moved < 0.02:
        findings.append(
            f"joint `{name}` moves by {moved:.2g} {unit} only: its "
            "parameters cannot be told from this log; is it the right column and unit?"
        )
    if statistics.force[j] == 0.0:
        findings.append(
            f"the forces of joint `{name}` are zero throughout: is it the right column?"
        )
    return findings


def _force(robot: Robot, j: int, statistics: LogStatistics) -> list[str]:
    name, unit, known = robot.joint_names[j], robot.force_unit(j), float(robot.known_max_forces[j])
    if statistics.force[j] <= 1.2 * known:
        return []
    return [
        f"joint `{name}` needs {statistics.force[j]:.3g} {unit}, but its limit is {known:.3g} "
        f"{unit}: check `recording.force_unit` and `forces_side`."
    ]


def _all_forces(robot: Robot, statistics: LogStatistics) -> list[str]:
    """Report forces that are all too large or all too small: one unit or side is wrong."""
    known = np.asarray(robot.known_max_forces)
    ratio = statistics.force / np.where(np.isfinite(known), known, np.nan)
    ratio = ratio[np.isfinite(ratio)]
    cure = "check `recording.force_unit`, `forces_side` and `torque_constants`."
    if ratio.size > 1 and ratio.min() > 1.2:
        return [
            f"all joints need more than their largest forces, {ratio.min():.2g} to "
            f"{ratio.max():.2g} times as much: {cure}"
        ]
    if ratio.size > 1 and 0 < ratio.max() < 0.02:
        return [f"no joint needs more than {100 * ratio.max():.2g} % of its largest force: {cure}"]
    return []


def _steps(robot: Robot, statistics: LogStatistics, joints: list[int]) -> list[str]:
    """Report joints that turn by half a turn or more from one sample to the next."""
    return [
        f"the angle of joint `{robot.joint_names[j]}` jumps by {statistics.largest_step[j]:.3g} "
        "rad from one sample to the next: undo the wrapping at a full turn before the log is "
        "filtered."
        for j in joints
        if robot.revolute[j] and statistics.largest_step[j] > np.pi
    ]


def _velocities(robot: Robot, statistics: LogStatistics, joints: list[int]) -> list[str]:
    """Report measured velocities that are not the derivatives of the angles."""
    ratio = statistics.velocity_ratio
    return [
        f"the measured velocities of joint `{robot.joint_names[j]}` are {ratio[j]:.3g} times the "
        "derivatives of its angles: check `recording.velocity_unit` and the order of the columns."
        for j in joints
        if abs(ratio[j] - 1.0) > 0.2
    ]
