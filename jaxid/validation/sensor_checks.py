"""Signs of mistakes that a log shows without a model: faults of sensors and clocks."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from scipy import ndimage

from jaxid.measurement.recording import Recording, unlike_derivatives
from jaxid.measurement.time_grid import MAX_JITTER
from jaxid.robot.robot import Robot

from .limit_checks import LogStatistics
from .torque_errors import REST_SHARE

Findings = list[tuple[int, str]]
"""Sentences about faults, each with the index of its joint."""

MAX_LAG = 1.5
"""Samples by which velocities may stand later than the derivatives of the angles."""
JUMP = 15.0
"""Steps of an angle, in units of their noise, that no noise makes."""


def channel_findings(
    robot: Robot, recording: Recording, statistics: LogStatistics | None = None
) -> Findings:
    """Look for held, spiky, wrapped and late channels.

    Return the joint and a sentence of each.
    """
    owner = "the motor of joint" if recording.angles_on_motor_side else "joint"
    findings = _position_and_force_findings(robot, recording, owner)
    if statistics is not None and recording.velocities is not None:
        findings += _velocity_findings(robot, recording, owner, statistics)
    return findings


def _position_and_force_findings(
    robot: Robot, recording: Recording, owner: str
) -> Findings:
    """Look for wrapped, spiky and held angles, and for held forces."""
    findings = []
    angles = np.asarray(recording.angles)
    forces = np.asarray(recording.forces)
    time = np.asarray(recording.time)
    segments = recording.segments
    for j, name in enumerate(robot.joint_names):
        x = angles[:, j]
        other_angles = np.delete(angles, j, 1)
        text = _wrap_text(x, time) if robot.revolute[j] else ""
        text = text or _spike_text(x, time, segments)
        text = text or _held_angle_text(x, other_angles, time, segments)
        if text:
            findings.append((j, f"the angle of {owner} `{name}` {text}"))
        hold = _held_force_text(forces[:, j], x, time, segments)
        if hold:
            findings.append((j, f"the forces of joint `{name}` {hold}"))
    return findings


def _velocity_findings(
    robot: Robot, recording: Recording, owner: str, statistics: LogStatistics
) -> Findings:
    """Compare measured velocities with the derivatives of the angles."""
    # One cause is one sentence for all joints that it concerns.
    causes: dict[str, list[int]] = {}
    for j, ratio in unlike_derivatives(recording).items():
        text = (
            f"are {ratio:.3g} times the derivatives of the angles: check "
            "`recording.velocity_unit` and the order of the columns."
        )
        causes.setdefault(text, []).append(j)
    lags = np.array([statistics.lateness(j) for j in range(robot.joints)])
    for direction, delays in (("later", lags), ("earlier", -lags)):
        joints = np.flatnonzero(delays > MAX_LAG * recording.sample_time).tolist()
        if joints:
            delay = 1e3 * np.median(delays[joints])
            text = (
                f"stand {delay:.2g} ms {direction} in the log than the derivatives of "
                "the angles: leave `recording.velocities` out."
            )
            causes[text] = joints
    findings = []
    for text, joints in causes.items():
        names = "`, `".join(robot.joint_names[j] for j in joints)
        findings += [(j, f"the velocities of {owner} `{names}` {text}") for j in joints]
    return findings


def clock_findings(recording: Recording) -> list[str]:
    """Look for lost or repeated rows: all joints jump, or stand, for one sample.

    Uneven stamps tell lost rows by themselves. If only they are late, the samples that
    were interpolated at them jump, but no row is lost.
    """
    deviation = recording.stamp_deviation
    if deviation is not None and deviation > MAX_JITTER:
        return []
    cure = "name the column of times (`recording.time`), or record again"
    if deviation is not None:
        cure = "the stamps do not show it, so record again"
    instants: dict[str, list[float]] = {"lost": [], "repeated": []}
    time = np.asarray(recording.time)
    angles = np.asarray(recording.angles)
    rounding = 1e-9 * np.abs(angles).max(axis=0)
    for a, b in recording.segments:
        inner_times = time[a + 2 : b - 1]
        steps = np.diff(angles[a:b], axis=0)
        if len(steps) >= 100:
            is_lost, is_repeated = _lost_and_repeated(steps, rounding)
            instants["lost"] += inner_times[is_lost].tolist()
            instants["repeated"] += inner_times[is_repeated].tolist()
    findings = []
    for problem, times in instants.items():
        if times:
            places = f"{len(times)} instant{'' if len(times) == 1 else 's'}"
            findings.append(
                f"rows seem to be {problem} at {places}, first at {times[0]:.6g} s: "
                f"{cure}."
            )
    return findings


def _lost_and_repeated(
    steps: np.ndarray, rounding: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return at which inner steps rows seem to be lost, or repeated.

    Args:
        steps: Steps of all joints' angles [samples, joints].
        rounding: Size of steps that are rounding errors of numbers [joints].
    """
    inner_steps = steps[1:-1]
    previous_steps = steps[:-2]
    next_steps = steps[2:]
    mean_steps = 0.5 * (previous_steps + next_steps)
    sizes = np.abs(steps)
    # Encoders round to half an increment; smaller differences are those of rounded
    # numbers.
    increment = np.where(sizes > rounding, sizes, np.inf).min(axis=0)
    noise = 1.4826 * np.median(np.abs(inner_steps - mean_steps), axis=0)
    # The noise of a joint that never moves is infinite, and it has no say.
    noise = np.maximum(noise, 0.5 * increment)
    bends = np.abs(next_steps - previous_steps) / noise
    inner_steps = inner_steps / noise
    mean_steps = mean_steps / noise
    gaps = np.abs(inner_steps - mean_steps)
    # All joints go on by the same number of steps, as far as noise lets see.
    speed = np.sum(mean_steps**2, axis=1)
    count = np.sum(inner_steps * mean_steps, axis=1) / np.maximum(speed, 1.0)
    common_gap = np.abs(count - 1)[:, None] * np.abs(mean_steps)
    is_far = gaps > JUMP
    is_shared = (is_far | (common_gap < 2 * JUMP)).all(axis=1)
    residuals = inner_steps - count[:, None] * mean_steps
    is_explained = np.sum(residuals**2, axis=1) < 0.1 * np.sum(gaps**2, axis=1)
    is_jump = is_far.any(axis=1) & is_shared & is_explained
    is_jump &= speed > 9.0
    is_jump &= bends.max(axis=1) < JUMP
    is_standing = (inner_steps == 0).all(axis=1)
    return is_jump & (count > 1.5), is_jump & is_standing


def _wrap_text(x: np.ndarray, time: np.ndarray) -> str:
    """Report jumps at full turns without which the angle would be smooth."""
    steps = np.diff(x)
    sizes = np.abs(steps)
    # In radians, or in degrees that are taken for radians.
    for turn in (2 * np.pi, 360.0):
        if not 0.5 * turn < sizes.max(initial=0.0) < 1.5 * turn:
            continue
        jumps = np.flatnonzero(sizes[1:] > 0.5 * turn) + 1
        unwrapped_steps = np.diff(np.unwrap(x, period=turn))
        bends = steps[jumps] - steps[jumps - 1]
        unwrapped_bends = unwrapped_steps[jumps] - unwrapped_steps[jumps - 1]
        is_smoother = np.sum(unwrapped_bends**2) < 0.01 * np.sum(bends**2)
        if jumps.size and is_smoother:
            count = "once" if jumps.size == 1 else f"{jumps.size} times"
            return (
                f"jumps by a full turn ({turn:.4g}) {count}, first at "
                f"{time[jumps[0] + 1]:.6g} s: undo the wrapping "
                "(`recording.unwrap = true`)."
            )
    return ""


def _spike_text(
    x: np.ndarray, time: np.ndarray, segments: Sequence[tuple[int, int]]
) -> str:
    """Report jumps there and back within some samples, faster than joints ever move."""
    places = []
    sizes = []
    for a, b in segments:
        median = ndimage.median_filter(x[a:b], 7, mode="nearest")
        gap = np.abs(x[a:b] - median)
        max_step = np.abs(np.diff(median)).max(initial=0.0)
        usual_gap = float(np.quantile(gap, 0.99))
        peaks = np.flatnonzero(gap > max(1.5 * max_step, 10.0 * usual_gap))
        places += (a + peaks).tolist()
        sizes += gap[peaks].tolist()
    if not places:
        return ""
    count = int(np.count_nonzero(np.diff(places) > 1))
    tail = f", and {count} more" if count else ""
    return (
        f"jumps by {sizes[0]:.3g} and back at {time[places[0]]:.6g} s{tail}: "
        "remove such rows."
    )


def _held_angle_text(
    x: np.ndarray,
    other_angles: np.ndarray,
    time: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> str:
    """Report an angle that stops or starts with a kink while other joints move."""
    for a, b in segments:
        part = x[a:b]
        speed = np.abs(np.diff(other_angles[a:b], axis=0))
        min_speed = REST_SHARE * speed.max(axis=0, initial=0.0)
        is_moving = (speed > min_speed).any(axis=1)
        runs = [
            (start, end)
            for start, end in _runs(part, _min_run_length(b - a))
            if np.mean(is_moving[start:end]) > 0.5
        ]
        max_bends = _max_bends(part) if runs else {}
        for start, end in runs:
            if _has_kink(part, start, end, max_bends):
                hold = _hold(part[start], time[a + start], time[a + end])
                return f"stays at {hold}"
    return ""


def _has_kink(x: np.ndarray, start: int, end: int, max_bends: dict[int, float]) -> bool:
    """Return whether a channel stops or starts more suddenly than it ever bends."""
    for lag, bend in max_bends.items():
        kink = 0.0
        if start >= lag:
            kink = abs(x[start] - x[start - lag])
        if end + lag < len(x):
            kink = max(kink, abs(x[end + lag] - x[end]))
        if kink > 3.0 * bend > 0:
            return True
    return False


def _max_bends(x: np.ndarray) -> dict[int, float]:
    """Return the largest bend over some samples where a channel changes its value."""
    max_bends = {}
    runs = list(_runs(x, 20))
    for width in (1, 3, 10, 30):
        span = 2 * width
        bends = np.abs(x[span:] - 2 * x[width:-width] + x[:-span])
        is_changing = np.ones(len(bends), bool)
        for start, end in runs:
            is_changing[max(0, start - span) : end + 1] = False
        max_bends[width] = float(bends[is_changing].max(initial=0.0))
    return max_bends


def _held_force_text(
    forces: np.ndarray,
    x: np.ndarray,
    time: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> str:
    """Report forces that stay constant for long while their joint's speed varies."""
    minimum = float(forces.min())
    maximum = float(forces.max())
    if minimum == maximum:
        return ""
    for a, b in segments:
        f = forces[a:b]
        changes = np.diff(f)
        speed = np.abs(np.gradient(x[a:b]))
        ends = np.flatnonzero(np.append(changes != 0, True)) + 1
        lengths = np.diff(ends, prepend=0)
        max_speed = speed.max(initial=0.0)
        is_moving = speed > REST_SHARE * max_speed
        usual_length = (
            float(np.median(np.repeat(lengths, lengths)[is_moving]))
            if is_moving.any()
            else np.inf
        )
        # Where most of a log is held, the number of values tells the usual length
        # instead.
        usual_length = min(usual_length, (b - a) / len(ends))
        # A drive reaches or leaves its limit without a jump.
        step = float(np.quantile(np.abs(changes), 0.99))
        equal_count = np.count_nonzero(changes == 0)
        min_length = max(_min_run_length(b - a), int(30 * usual_length))
        for start, end in _runs(f, min_length):
            run = slice(start, end + 1)
            # Forces of a robot may be constant at constant speed, but not if they are
            # noisy.
            is_noisy = equal_count - (end - start) < 0.01 * len(f)
            is_steady = np.std(speed[run]) < 0.05 * max_speed and not is_noisy
            if np.mean(is_moving[run]) < 0.5 or is_steady:
                continue
            jumps = [abs(f[start] - f[start - 1])] if start else []
            jumps += [abs(f[end + 1] - f[end])] if end + 1 < len(f) else []
            if f[start] not in (minimum, maximum) or min(jumps, default=0.0) > 2 * step:
                return f"stay at {_hold(f[start], time[a + start], time[a + end])}"
    return ""


def _min_run_length(samples: int) -> int:
    """Return the number of equal values from which a channel may be held."""
    return max(20, int(0.01 * samples))


def _runs(x: np.ndarray, min_length: int) -> Iterator[tuple[int, int]]:
    """Yield first and last sample of stretches of one value, `min_length` or longer."""
    ends = np.flatnonzero(np.append(np.diff(x) != 0, True))
    starts = np.append(0, ends[:-1] + 1)
    for k in np.flatnonzero(ends - starts + 1 >= min_length):
        yield int(starts[k]), int(ends[k])


def _hold(value: float, start: float, stop: float) -> str:
    return (
        f"{value:.3g} from {start:.6g} s to {stop:.6g} s, though the robot moves: a "
        "sensor or the logger held the last value; leave that part out "
        "(`recording.start`, `recording.stop`)."
    )


def stuck_findings(
    robot: Robot, recording: Recording, faulty_joints: Collection[int] = ()
) -> list[str]:
    """Look for forces that are constant, or cut off at their largest value.

    Forces are cut off if many samples lie on the largest value, and few on the three
    values beside it, which coarse steps would reach as often. Joints in `faulty_joints`
    have known faults, and are left out.
    """
    forces = np.asarray(recording.forces)
    angles = np.asarray(recording.angles)
    findings = []
    for j in (j for j in range(robot.joints) if j not in faulty_joints):
        name = robot.joint_names[j]
        f = forces[:, j]
        speed = np.abs(np.gradient(angles[:, j]))
        bottom = float(f.min())
        top = float(f.max())
        if bottom == top:
            findings.append(
                f"the forces of joint `{name}` are {top:.3g} throughout: is it the "
                "right column?"
            )
            continue
        subset = f[speed > REST_SHARE * speed.max(initial=0.0)]
        values, counts = np.unique(subset, return_counts=True)
        for end in (top, bottom):
            order = np.argsort(np.abs(values - end))
            hits = int(np.count_nonzero(subset == end))
            neighbours = counts[order][1:4]
            if hits > 0.005 * len(f) and hits > 3.0 * neighbours.sum():
                findings.append(
                    f"the forces of joint `{name}` stay at {end:.3g} in {hits} samples "
                    "in which it moves: a drive or sensor is at its limit "
                    "(`recording.stop` leaves that out)."
                )
    return findings
