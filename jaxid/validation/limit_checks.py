"""Extremes of a log, and comparison with the limits of its robot."""

from collections.abc import Collection, Iterator

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.dynamics.motion import Motion
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

from .torque_errors import REST_SHARE

MAX_LIMIT_RATIO = 1.1
"""Measured speed or force, relative to its limit, that noise and filters explain."""
LIMITED_SHARE = 0.9
"""Share of the samples whose forces must keep to a limit.

Peaks are often larger, by noise of the velocities in the controller: of 140 clean logs
6 % of the samples at most exceeded a limit by a tenth.
"""
MAX_REST = 0.5
"""Share of a log, in which all joints rest, that is better left out."""
MIN_SPAN = 0.02
"""Smallest range of a joint that is a motion [rad or m]."""


class LogStatistics:
    """Extremes of a log that is read in parts, joint by joint.

    Attributes:
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        speed: Largest speed of each joint [rad/s or m/s].
        force: Largest force of each joint [N m or N].
    """

    def __init__(self, joints: int, samples: int):
        self.lowest = np.full(joints, np.inf)
        self.highest = np.full(joints, -np.inf)
        self.speed = np.zeros(joints)
        self.force = np.zeros(joints)
        # Of velocities, derivatives of the angles, and derivatives of these: sums of
        # products.
        self._products = np.zeros((joints, 3, 3))
        # Of long logs every n-th sample tells how long joints stand or work.
        self._stride = -(-samples // 2**18)
        self._count = 0
        self._speeds: list[np.ndarray] = []
        self._forces: list[np.ndarray] = []

    def add(self, motion: Motion, forces: AnyArray, sample_time: float) -> None:
        """Take in the filtered motion and the forces of consecutive samples."""
        q = np.asarray(motion.q)
        qd = np.asarray(motion.qd)
        speeds = np.abs(qd)
        sizes = np.abs(np.asarray(forces))
        self.lowest = np.minimum(self.lowest, q.min(axis=0))
        self.highest = np.maximum(self.highest, q.max(axis=0))
        self.speed = np.maximum(self.speed, speeds.max(axis=0))
        self.force = np.maximum(self.force, sizes.max(axis=0))
        if len(q) > 1:
            derivative = np.gradient(q, sample_time, axis=0)
            second_derivative = np.gradient(derivative, sample_time, axis=0)
            columns = np.stack([derivative, second_derivative, qd], axis=2)
            self._products += np.einsum("tja,tjb->jab", columns, columns)
        first_sample = -self._count % self._stride
        self._speeds.append(speeds[first_sample :: self._stride])
        self._forces.append(sizes[first_sample :: self._stride])
        self._count += len(q)

    @property
    def stands(self) -> np.ndarray:
        """Whether each joint stands, at some of the samples."""
        return np.concatenate(self._speeds) < REST_SHARE * np.maximum(self.speed, 1e-12)

    @property
    def usual_force(self) -> np.ndarray:
        """Force of each joint that nine samples of ten do not exceed [N m or N]."""
        return np.quantile(np.concatenate(self._forces), LIMITED_SHARE, axis=0)

    def lateness(self, joint: int) -> float:
        """Return how much later measured velocities stand than those of the angles [s].

        It is zero where a shift does not explain most of the difference.
        """
        P = self._products[joint]
        if P[0, 0] <= 0 or P[1, 1] <= 0:
            return 0.0
        scale, lead = np.linalg.lstsq(P[:2, :2], P[:2, 2], rcond=1e-12)[0]
        is_explained = lead**2 * P[1, 1] > 0.5 * (P[2, 2] - 2 * P[0, 2] + P[0, 0])
        return float(-lead / scale) if scale and is_explained else 0.0


def limit_findings(
    robot: Robot,
    statistics: LogStatistics,
    faulty_joints: Collection[int],
    max_rest: float = MAX_REST,
) -> list[str]:
    """Compare a log with the limits of its robot: a wrong unit or sign shows here.

    Joints in `faulty_joints` have faults of single channels, which explain more.
    A larger share of the log than `max_rest`, in which all joints rest, is found.
    """
    spans = statistics.highest - statistics.lowest
    if spans.max() < MIN_SPAN:
        return [
            f"no joint moves by more than {spans.max():.2g} rad or m: name other "
            "columns, check `recording.angle_unit`, or leave this log out."
        ]
    findings = _common_force_findings(robot, statistics) if not faulty_joints else []
    if not findings:
        findings += _force_findings(robot, statistics, faulty_joints)
    findings += _motion_findings(robot, statistics, faulty_joints)
    share = float(statistics.stands.all(axis=1).mean())
    if share > max_rest:
        findings.append(
            f"the robot stands still for {100 * share:.0f} % of the log: crop it "
            "with `recording.start` and `recording.stop`."
        )
    return findings


def _motion_findings(
    robot: Robot, statistics: LogStatistics, faulty_joints: Collection[int]
) -> Iterator[str]:
    """Report joints that leave their ranges, are too fast, or hardly move."""
    limits = robot.limits
    lowest = statistics.lowest
    highest = statistics.highest
    lower_limits = np.asarray(limits.position_min)
    upper_limits = np.asarray(limits.position_max)
    ranges = upper_limits - lower_limits
    # Joints without limits have no range.
    slack = np.where(np.isfinite(ranges), 0.02 * ranges, 0.0)
    is_above = lowest >= lower_limits - slack
    is_inside = is_above & (highest <= upper_limits + slack)
    is_fast = statistics.speed > MAX_LIMIT_RATIO * np.asarray(limits.velocity)
    spans = highest - lowest
    excursions = []
    speeds = []
    rests = []
    for j, name in enumerate(robot.joint_names):
        unit = robot.joint_unit(j)
        if j in faulty_joints:
            continue
        if not is_inside[j]:
            excursions.append(
                f"`{name}` from {lowest[j]:.3g} to {highest[j]:.3g} in place of "
                f"{lower_limits[j]:.3g} to {upper_limits[j]:.3g} {unit}"
            )
        if is_fast[j]:
            limit = float(limits.velocity[j])
            speeds.append(f"`{name}` {statistics.speed[j]:.3g} of {limit:.3g} {unit}/s")
        if spans[j] < MIN_SPAN:
            rests.append(f"`{name}` by {spans[j]:.2g} {unit}")
    if excursions:
        yield (
            f"joints leave their ranges: {', '.join(excursions)}: check "
            "`recording.angle_unit`, `side` (with `drives.gear_ratios`), "
            "`angle_signs` and `angle_offsets`, or correct the ranges "
            "(`limits.position_min`, `position_max`)."
        )
    if speeds:
        yield (
            f"joints are faster than their limits: {', '.join(speeds)}: check the "
            "units, or lower the cut-off."
        )
    if rests:
        yield (
            f"joints hardly move: {', '.join(rests)}: are these the right columns and "
            "units?"
        )


def _force_findings(
    robot: Robot, statistics: LogStatistics, faulty_joints: Collection[int]
) -> list[str]:
    """Report joints whose forces exceed their limits for a tenth of the log."""
    max_forces = robot.known_max_forces
    is_exceeded = statistics.usual_force > MAX_LIMIT_RATIO * max_forces
    comparisons = [
        f"`{name}` {statistics.force[j]:.3g} of {max_forces[j]:.3g} "
        f"{robot.force_unit(j)}"
        for j, name in enumerate(robot.joint_names)
        if j not in faulty_joints and is_exceeded[j]
    ]
    if not comparisons:
        return []
    return [
        f"forces are larger than the robot's limits: {', '.join(comparisons)}: check "
        "`recording.force_unit` and `force_gains`, the gears and `limits.force`."
    ]


def _common_force_findings(robot: Robot, statistics: LogStatistics) -> list[str]:
    """Report forces that are all too large or too small: one unit or side is wrong."""
    ratios = statistics.force / robot.known_max_forces
    ratios = ratios[np.isfinite(robot.known_max_forces)]
    cure = (
        "check `recording.force_unit`, `torque_constants`, `forces_side` with "
        "`drives.gear_ratios`, and whether `limits.force` or the limits of the robot's "
        "file are real."
    )
    if ratios.size < 2:
        return []
    minimum = ratios.min()
    peak = ratios.max()
    if minimum > 1.2:
        text = (
            "all joints need more than their largest forces, "
            f"{significant(minimum, 2)} to {significant(peak, 2)} times"
        )
        return [f"{text} as much: {cure}"]
    if 0 < peak < 0.02:
        return [
            f"no joint needs more than {100 * peak:.2g} % of its largest force: {cure}"
        ]
    return []
