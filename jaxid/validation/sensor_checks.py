"""Signs of mistakes that a log shows without a model: faults of sensors and clocks."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import scipy

from jaxid.measurement.recording import Recording, unlike_derivatives
from jaxid.robot.robot import Robot

from .limit_checks import LogStatistics
from .torque_errors import REST_SHARE

Findings = list[tuple[int, str]]
"""Sentences about faults, each with the index of its joint."""

MAX_LAG = 1.5
"""Samples by which velocities may stand later than the derivatives of the angles."""
LAGS = (1, 3, 10, 30)
"""Samples over which a channel bends, or stops with a kink."""


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
    forces = recording.forces
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
        if forces is None:
            continue
        hold = _held_force_text(np.asarray(forces)[:, j], x, time, segments)
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
                f"are {delay:.2g} ms {direction} in the log than the derivatives of "
                "the angles: leave `recording.velocities` out."
            )
            causes[text] = joints
    findings = []
    for text, joints in causes.items():
        names = "`, `".join(robot.joint_names[j] for j in joints)
        findings += [(j, f"the velocities of {owner} `{names}` {text}") for j in joints]
    return findings


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
                f"{time[jumps[0] + 1]:.6g} s: set `recording.unwrap = true`."
            )
    return ""


def _spike_text(
    x: np.ndarray, time: np.ndarray, segments: Sequence[tuple[int, int]]
) -> str:
    """Report jumps there and back within some samples, faster than joints ever move."""
    places = []
    sizes = []
    for a, b in segments:
        median = scipy.ndimage.median_filter(x[a:b], 7, mode="nearest")
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
        for start, end in runs:
            if any(_has_kink(part, start, end, lag) for lag in LAGS):
                hold = _hold(part[start], time[a + start], time[a + end])
                return f"stays at {hold}"
    return ""


def _has_kink(x: np.ndarray, start: int, end: int, lag: int) -> bool:
    """Return whether a channel stops or starts more suddenly than it ever bends."""
    bends = np.abs(x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag])
    for run_start, run_end in _runs(x, 20):
        bends[max(0, run_start - 2 * lag) : run_end + 1] = 0.0
    stop_step = abs(x[start] - x[max(start - lag, 0)])
    start_step = abs(x[min(end + lag, len(x) - 1)] - x[end])
    return max(stop_step, start_step) > 3.0 * bends.max(initial=0.0) > 0


def _held_force_text(
    forces: np.ndarray,
    x: np.ndarray,
    time: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> str:
    """Report a force that stays constant for long, not at a limit, in a motion."""
    extremes = forces.min(), forces.max()
    for a, b in segments:
        part = forces[a:b]
        speed = np.abs(np.gradient(x[a:b]))
        is_moving = speed > REST_SHARE * speed.max(initial=0.0)
        usual_length = len(part) / (1 + np.count_nonzero(np.diff(part)))
        min_length = max(_min_run_length(b - a), int(30 * usual_length))
        for start, end in _runs(part, min_length):
            is_limit = part[start] in extremes
            if np.mean(is_moving[start : end + 1]) > 0.5 and not is_limit:
                hold = _hold(part[start], time[a + start], time[a + end])
                return f"stay at {hold}"
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


def constant_forces(robot: Robot, recording: Recording) -> list[str]:
    """Return a sentence about each joint whose forces are constant."""
    if recording.forces is None:
        return []
    forces = np.asarray(recording.forces)
    return [
        f"the forces of joint `{name}` are {channel[0]:.3g} throughout: is it the "
        "right column?"
        for name, channel in zip(robot.joint_names, forces.T, strict=True)
        if np.ptp(channel) == 0
    ]


def repeated_channels(robot: Robot, recording: Recording) -> list[str]:
    """Return a sentence about each two joints with the same angles, or forces."""
    texts = []
    channels = {"angles": recording.angles, "forces": recording.forces}
    for quantity, values in channels.items():
        if values is None:
            continue
        columns = np.asarray(values).T
        moving_joints = np.flatnonzero(np.ptp(columns, axis=1) > 0)
        texts += [
            f"the {quantity} of joints `{robot.joint_names[i]}` and "
            f"`{robot.joint_names[j]}` are the same column: check "
            f"`recording.{quantity}`."
            for i, j in itertools.combinations(moving_joints, 2)
            if np.array_equal(columns[i], columns[j])
        ]
    return texts
