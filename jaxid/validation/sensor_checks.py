"""Signs of mistakes that a log shows without a model: units, limits, sensor faults."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from scipy import ndimage

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.measurement.recording import Recording, unlike_derivatives
from jaxid.robot.robot import Robot

from .torque_errors import STANDING

LATE = 1.5
"""Samples by which velocities may stand later than the derivatives of the angles."""
SURE = 15.0
"""Steps of an angle, in units of their noise, that no noise makes."""


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
        self.speed, self.force = np.zeros((2, joints))
        self._energies = np.zeros(3)
        # Of velocities, derivatives of the angles, and derivatives of these: sums of
        # products.
        self._products = np.zeros((joints, 3, 3))
        # Of long logs every n-th sample tells how long joints stand.
        self._every, self._seen = -(-samples // 2**18), 0
        self._speeds: list[np.ndarray] = []

    def add(self, motion: Motion, forces: AnyArray, sample_time: float) -> None:
        """Take in the filtered motion and the forces of consecutive samples."""
        q, qd, forces = (np.asarray(x) for x in (motion.q, motion.qd, forces))
        self.lowest = np.minimum(self.lowest, q.min(axis=0))
        self.highest = np.maximum(self.highest, q.max(axis=0))
        self.speed = np.maximum(self.speed, np.abs(qd).max(axis=0))
        self.force = np.maximum(self.force, np.abs(forces).max(axis=0))
        self._energies += [np.sum(forces * qd), np.sum(forces**2), np.sum(qd**2)]
        if len(q) > 1:
            derivative = np.gradient(q, sample_time, axis=0)
            second = np.gradient(derivative, sample_time, axis=0)
            x = np.stack([derivative, second, qd], axis=2)
            self._products += np.einsum("tja,tjb->jab", x, x)
        self._speeds.append(np.abs(qd[-self._seen % self._every :: self._every]))
        self._seen += len(q)

    @property
    def stands(self) -> np.ndarray:
        """Whether each joint stands, at some of the samples."""
        return np.concatenate(self._speeds) < STANDING * np.maximum(self.speed, 1e-12)

    @property
    def power(self) -> float:
        """Mean power over the product of the RMS forces and velocities."""
        power, forces, velocities = self._energies
        return (
            float(power / np.sqrt(forces * velocities))
            if forces * velocities > 0
            else 0.0
        )

    def lateness(self, joint: int) -> float:
        """Return how much later measured velocities stand than those of the angles [s].

        It is zero where a shift does not explain most of the difference.
        """
        P = self._products[joint]
        if P[0, 0] <= 0 or P[1, 1] <= 0:
            return 0.0
        scale, lead = np.linalg.lstsq(P[:2, :2], P[:2, 2], rcond=1e-12)[0]
        explained = lead**2 * P[1, 1] > 0.5 * (P[2, 2] - 2 * P[0, 2] + P[0, 0])
        return float(-lead / scale) if scale and explained else 0.0


def limit_findings(
    robot: Robot, log: Recording, statistics: LogStatistics, faulty: Collection[int]
) -> list[str]:
    """Compare a log with the limits of its robot: a wrong unit or sign shows here.

    Joints in `faulty` have faults of single channels, which explain more.
    """
    s = statistics
    angles = (
        []
        if faulty
        else unit_findings(robot, s.lowest, s.highest, log.angles_on_motor_side)
    )
    forces = [] if faulty else _force_findings(robot, s)
    findings = angles + forces
    for j in range(robot.joints):
        if j in faulty:
            continue
        findings += _joint_findings(robot, j, s, not angles)
    # Over a whole log, friction makes a robot consume energy.
    if not faulty and s.power < -0.05:
        findings.append(
            "the robot gives off energy: check `recording.angle_signs` and "
            "`force_signs`."
        )
    standing = float(s.stands.all(axis=1).mean())
    if standing > 0.5:
        findings.append(
            f"the robot stands still for {100 * standing:.0f} % of the log: crop it "
            "with `recording.start` and `recording.stop`."
        )
    return findings


def _joint_findings(
    robot: Robot, j: int, statistics: LogStatistics, with_range: bool
) -> Iterator[str]:
    """Compare the range and speed of a joint with its limits."""
    name = robot.joint_names[j]
    unit = robot.joint_unit(j)
    limits = robot.limits
    low = float(limits.position_min[j])
    high = float(limits.position_max[j])
    a = statistics.lowest[j]
    b = statistics.highest[j]
    force = statistics.force[j]
    slack = 0.02 * (high - low) if np.isfinite(high - low) else 0.0
    if with_range and not low - slack <= a <= b <= high + slack:
        yield (
            f"joint `{name}` moves from {a:.3g} to {b:.3g}, its range is {low:.3g} to "
            f"{high:.3g} {unit}: check `recording.angle_unit`, `side`, `angle_signs` "
            "and `angle_offsets`."
        )
    if statistics.speed[j] > 1.1 * limits.velocity[j]:
        yield (
            f"joint `{name}` reaches {statistics.speed[j]:.3g} {unit}/s, but its limit "
            f"is {float(limits.velocity[j]):.3g} {unit}/s: check the units, or lower "
            "the cut-off."
        )
    if b - a < 0.02:
        yield (
            f"joint `{name}` moves by {b - a:.2g} {unit} only: is it the right column "
            "and unit?"
        )
    if force == 0.0:
        yield (
            f"the forces of joint `{name}` are zero throughout: is it the right column?"
        )


def _force_findings(robot: Robot, statistics: LogStatistics) -> list[str]:
    """Report forces that are all too large or too small: one unit or side is wrong."""
    ratio = statistics.force / robot.known_max_forces
    ratio = ratio[np.isfinite(robot.known_max_forces)]
    cure = "check `recording.force_unit`, `forces_side` and `torque_constants`."
    if ratio.size < 2:
        return []
    low, high = ratio.min(), ratio.max()
    if low > 1.2:
        text = (
            f"all joints need more than their largest forces, {low:.2g} to "
            f"{high:.2g} times"
        )
        return [f"{text} as much: {cure}"]
    if 0 < high < 0.02:
        return [
            f"no joint needs more than {100 * high:.2g} % of its largest force: {cure}"
        ]
    return []


def unit_findings(
    robot: Robot,
    lowest: Float[np.ndarray, " joints"],
    highest: Float[np.ndarray, " joints"],
    on_motor_side: bool,
) -> list[str]:
    """Look for a unit or side that brings all joints' angles back into their ranges."""
    low = np.asarray(robot.limits.position_min)
    width = np.asarray(robot.limits.position_max) - low
    known = np.array(robot.revolute) & np.isfinite(width)
    if not known.any():
        return []
    low, width = low[known], width[known]

    def used_fraction(ends: np.ndarray) -> float:
        """Return the largest used fraction of a range; zero if some range is left."""
        a, b = np.sort(ends, axis=0)[:, known]
        inside = (a >= low - 0.02 * width) & (b <= low + 1.02 * width)
        return float(((b - a) / width).max()) if inside.all() else 0.0

    ends = np.stack([lowest, highest])
    if used_fraction(ends) > 0.02:
        return []
    degrees = 'degrees (`recording.angle_unit = "deg"`)'
    radians = "radians (`recording.angle_unit`"
    corrected = {
        degrees: np.where(known, np.deg2rad(ends), ends),
        f'{radians} is "deg")': np.where(known, np.rad2deg(ends), ends),
        f'{radians} is "rev")': np.where(known, ends / (2 * np.pi), ends),
    }
    if not on_motor_side and not robot.drives.is_direct:
        joints = np.asarray(robot.drives.joint_angles(ends))
        corrected['the motors\' (`recording.side = "motor"`)'] = joints
    cures = " or ".join(
        cure for cure, angles in corrected.items() if used_fraction(angles) > 0.1
    )
    text = (
        "the angles do not suit the ranges of the joints, but would if those in "
        "the log were "
    )
    return [f"{text}{cures}."] if cures else []


def channel_findings(
    robot: Robot, recording: Recording, statistics: LogStatistics | None = None
) -> list[tuple[int, str]]:
    """Look for held, spiky, wrapped and late channels.

    Return the joint and a sentence of each.
    """
    r, found = recording, []
    angles, forces, time = (np.asarray(x) for x in (r.angles, r.forces, r.time))
    owner = "the motor of joint" if r.angles_on_motor_side else "joint"
    for j, name in enumerate(robot.joint_names):
        angle = f"the angle of {owner} `{name}`"
        x = angles[:, j]
        others = np.delete(angles, j, 1)
        text = _wrapped(x, time) if robot.revolute[j] else ""
        text = (
            text
            or _spikes(x, time, r.segments)
            or _held_angles(x, others, time, r.segments)
        )
        held = _held_forces(forces[:, j], x, time, r.segments)
        found += [(j, angle, text), (j, f"the forces of joint `{name}`", held)]
    faults = [(j, f"{channel} {text}") for j, channel, text in found if text]
    if statistics is not None and r.velocities is not None:
        faults += [
            (
                j,
                f"the velocities of {owner} `{robot.joint_names[j]}` are {ratio:.3g} "
                "times the derivatives of its angles: check `recording.velocity_unit` "
                "and the order of the columns.",
            )
            for j, ratio in unlike_derivatives(r).items()
        ]
        for j, name in enumerate(robot.joint_names):
            late = statistics.lateness(j)
            if abs(late) > LATE * r.sample_time:
                text = (
                    f"the velocities of joint `{name}` stand {1e3 * abs(late):.3g} ms "
                    f"{'later' if late > 0 else 'earlier'} in the log than the "
                    "derivatives of its angles: leave `recording.velocities` out."
                )
                faults.append((j, text))
    return faults


def clock_findings(recording: Recording) -> list[str]:
    """Look for lost or repeated rows: all joints jump, or stand, for one sample."""
    lost, repeated, time = [], [], np.asarray(recording.time)
    for a, b in recording.segments:
        steps = np.diff(np.asarray(recording.angles)[a:b], axis=0)
        if len(steps) < 100:
            continue
        before, own, after = steps[:-2], steps[1:-1], steps[2:]
        usual = 0.5 * (before + after)
        noise = 1.4826 * np.median(np.abs(own - usual), axis=0)
        # Encoders round to half an increment; smaller differences are those of rounded
        # numbers.
        sizes, rounding = np.abs(steps), 1e-9 * np.abs(recording.angles).max(axis=0)
        increment = np.where(sizes > rounding, sizes, np.inf).min(axis=0)
        noise = np.maximum(noise, 0.5 * increment)
        moving = np.isfinite(noise)
        if not moving.any():
            continue
        usual, own, bend = (
            x[:, moving] / noise[moving] for x in (usual, own, after - before)
        )
        # All joints go on by the same number of steps, as far as noise lets see.
        speed = np.sum(usual**2, axis=1)
        count = np.sum(own * usual, axis=1) / np.maximum(speed, 1.0)
        off, expected = np.abs(own - usual), np.abs(usual) * np.abs(count - 1)[:, None]
        jumps = (
            (np.abs(bend).max(axis=1) < SURE) & (speed > 9.0) & (off > SURE).any(axis=1)
        )
        jumps &= ((off > SURE) | (expected < 2 * SURE)).all(axis=1)
        jumps &= np.sum((own - count[:, None] * usual) ** 2, axis=1) < 0.1 * np.sum(
            off**2, axis=1
        )
        inner = time[a + 2 : b - 1]
        lost += inner[jumps & (count > 1.5)].tolist()
        repeated += inner[jumps & (own == 0).all(axis=1)].tolist()
    cure = "name the column of times (`recording.time`), or record again"
    return [
        f"{what} at {len(at)} instant{'' if len(at) == 1 else 's'}, first at "
        f"{at[0]:.6g} s: {cure}."
        for what, at in (
            ("rows seem to be lost", lost),
            ("rows seem to be repeated", repeated),
        )
        if at
    ]


def _wrapped(x: np.ndarray, time: np.ndarray) -> str:
    """Report jumps at full turns without which the angle would be smooth."""
    step = np.diff(x)
    # In radians, or in degrees that are taken for radians.
    for turn in (2 * np.pi, 360.0):
        if not 0.5 * turn < np.abs(step).max(initial=0.0) < 1.5 * turn:
            continue
        at = np.flatnonzero(np.abs(step[1:]) > 0.5 * turn) + 1
        unwrapped = np.diff(np.unwrap(x, period=turn))
        bends = np.sum((step[at] - step[at - 1]) ** 2)
        if at.size and np.sum((unwrapped[at] - unwrapped[at - 1]) ** 2) < 0.01 * bends:
            times = "once" if at.size == 1 else f"{at.size} times"
            return (
                f"jumps by a full turn ({turn:.4g}) {times}, first at "
                f"{time[at[0] + 1]:.6g} s: undo the wrapping "
                "(`recording.unwrap = true`)."
            )
    return ""


def _spikes(
    x: np.ndarray, time: np.ndarray, segments: Sequence[tuple[int, int]]
) -> str:
    """Report jumps there and back within some samples, faster than joints ever move."""
    places, sizes = [], []
    for a, b in segments:
        smooth = ndimage.median_filter(x[a:b], 7, mode="nearest")
        off = np.abs(x[a:b] - smooth)
        fastest = np.abs(np.diff(smooth)).max(initial=0.0)
        high = np.flatnonzero(
            off > max(1.5 * fastest, 10.0 * float(np.quantile(off, 0.99)))
        )
        places += (a + high).tolist()
        sizes += off[high].tolist()
    if not places:
        return ""
    others = int(np.count_nonzero(np.diff(places) > 1))
    more = f", and {others} more" if others else ""
    return (
        f"jumps by {sizes[0]:.3g} and back at {time[places[0]]:.6g} s{more}: "
        "remove such rows."
    )


def _held_angles(
    x: np.ndarray,
    others: np.ndarray,
    time: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> str:
    """Report an angle that stops or starts with a kink while other joints move."""
    for a, b in segments:
        own, usual = x[a:b], None
        speed = np.abs(np.diff(others[a:b], axis=0))
        moving = (speed > STANDING * speed.max(axis=0, initial=0.0)).any(axis=1)
        for first, last in _runs(own, _shortest(b - a)):
            if np.mean(moving[first:last]) <= 0.5:
                continue
            usual = _usual_bends(own) if usual is None else usual
            for width, bend in usual.items():
                kinks = [abs(own[first] - own[first - width])] if first >= width else []
                kinks += (
                    [abs(own[last + width] - own[last])] if last + width < b - a else []
                )
                if max(kinks, default=0.0) > 3.0 * bend > 0:
                    return (
                        f"stays at {_held(own[first], time[a + first], time[a + last])}"
                    )
    return ""


def _usual_bends(x: np.ndarray) -> dict[int, float]:
    """Return the largest bend over some samples where a channel changes its value."""
    usual = {}
    ends = np.array(list(_runs(x, 20)), int).reshape(-1, 2)
    for width in (1, 3, 10, 30):
        bends = np.abs(x[2 * width :] - 2 * x[width:-width] + x[: -2 * width])
        covered = np.zeros(len(x) + 1, int)
        np.add.at(covered, np.maximum(0, ends - 2 * width), 1)
        np.add.at(covered, ends + 1, -1)
        usual[width] = float(
            bends[np.cumsum(covered)[: len(bends)] == 0].max(initial=0.0)
        )
    return usual


def _held_forces(
    forces: np.ndarray,
    x: np.ndarray,
    time: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> str:
    """Report forces that stay constant for long while their joint's speed varies."""
    lowest, highest = float(forces.min()), float(forces.max())
    if lowest == highest:
        return ""
    for a, b in segments:
        f, speed = forces[a:b], np.abs(np.gradient(x[a:b]))
        ends = np.flatnonzero(np.append(np.diff(f) != 0, True)) + 1
        lengths = np.diff(ends, prepend=0)
        fastest = speed.max(initial=0.0)
        moving = speed > STANDING * fastest
        usual = (
            float(np.median(np.repeat(lengths, lengths)[moving]))
            if moving.any()
            else np.inf
        )
        # Where most of a log is held, the number of values tells the usual length
        # instead.
        usual = min(usual, (b - a) / len(ends))
        # A drive reaches or leaves its limit without a jump.
        step = float(np.quantile(np.abs(np.diff(f)), 0.99))
        for first, last in _runs(f, max(_shortest(b - a), int(30 * usual))):
            held = slice(first, last + 1)
            # Forces of a robot may be constant at constant speed, but not if they are
            # noisy.
            noisy = np.count_nonzero(np.diff(f) == 0) - (last - first) < 0.01 * len(f)
            steady = np.std(speed[held]) < 0.05 * fastest and not noisy
            if np.mean(moving[held]) < 0.5 or steady:
                continue
            jumps = [abs(f[first] - f[first - 1])] if first else []
            jumps += [abs(f[last + 1] - f[last])] if last + 1 < len(f) else []
            if f[first] not in (lowest, highest) or min(jumps, default=0.0) > 2 * step:
                return f"stay at {_held(f[first], time[a + first], time[a + last])}"
    return ""


def _shortest(samples: int) -> int:
    """Return the number of equal values from which a channel may be held."""
    return max(20, int(0.01 * samples))


def _runs(x: np.ndarray, least: int) -> Iterator[tuple[int, int]]:
    """Yield first and last sample of stretches of one value, `least` or longer."""
    ends = np.flatnonzero(np.append(np.diff(x) != 0, True))
    starts = np.append(0, ends[:-1] + 1)
    for k in np.flatnonzero(ends - starts + 1 >= least):
        yield int(starts[k]), int(ends[k])


def _held(value: float, start: float, stop: float) -> str:
    return (
        f"{value:.3g} from {start:.6g} s to {stop:.6g} s, though the robot moves: a "
        "sensor or the logger held the last value; leave that part out "
        "(`recording.start`, `recording.stop`)."
    )


def stuck_findings(
    robot: Robot, recording: Recording, faulty: Collection[int] = ()
) -> list[str]:
    """Look for forces that are constant, or cut off at their largest value.

    Forces are cut off if many samples lie on the largest value, and few on the values
    beside it. Joints in `faulty` have known faults, and are left out.
    """
    forces = np.asarray(recording.forces)
    angles = np.asarray(recording.angles)
    findings = []
    for j in (j for j in range(robot.joints) if j not in faulty):
        name = robot.joint_names[j]
        f = forces[:, j]
        speed = np.abs(np.gradient(angles[:, j]))
        low, high = float(f.min()), float(f.max())
        if low == high != 0.0:
            findings.append(
                f"the forces of joint `{name}` are {high:.3g} throughout: is it the "
                "right column?"
            )
        if low == high:
            continue
        moving = f[speed > STANDING * speed.max(initial=0.0)]
        band = 0.02 * (high - low)
        for end, near in ((high, moving > high - band), (low, moving < low + band)):
            values, counts = np.unique(moving[near], return_counts=True)
            nearest = np.argsort(np.abs(values - end))
            on = int(np.count_nonzero(moving == end))
            beside = counts[nearest][1:4]
            if on > 0.005 * len(f) and on > 3.0 * beside.sum():
                findings.append(
                    f"the forces of joint `{name}` stay at {end:.3g} in {on} samples "
                    "in which it moves: a drive or sensor is at its limit "
                    "(`recording.stop` leaves that out)."
                )
    return findings
