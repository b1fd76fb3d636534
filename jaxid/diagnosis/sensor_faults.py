"""Faults of single sensors: held, spiky, wrapped, constant and cut-off channels."""

from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxid.arrays import Float
from jaxid.diagnosis.limits import STANDING
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot


class Fault(NamedTuple):
    """Fault of one channel.

    Attributes:
        joint: Joint of the channel.
        text: Description, as a sentence.
    """

    joint: int
    text: str


def channel_faults(robot: Robot, recording: Recording) -> list[Fault]:
    """Look for channels that are held, spiky or wrapped, and report each with its times.

    Args:
        robot: Robot of the log.
        recording: Recording, unfiltered.
    """
    angles, forces = np.asarray(recording.angles), np.asarray(recording.forces)
    time, faults = np.asarray(recording.time), []
    owner = "the motor of joint" if recording.angles_on_motor_side else "joint"
    for j, name in enumerate(robot.joint_names):
        angle, force = f"the angle of {owner} `{name}`", f"the forces of joint `{name}`"
        x = angles[:, j]
        texts = _wrapped(angle, x, time) if robot.revolute[j] else []
        texts = texts or _spikes(angle, x, time, recording.segments)
        if not texts:
            texts = _held_angles(angle, angles, j, time, recording.segments)
        texts += _held_forces(force, forces[:, j], x, time, recording.segments)
        faults += [Fault(j, text) for text in texts]
    return faults


def _wrapped(channel: str, x: Float[np.ndarray, " samples"], time: np.ndarray) -> list[str]:
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
            return [
                f"{channel} jumps by a full turn ({turn:.4g}) {times}, first at "
                f"{time[at[0] + 1]:.6g} s: undo the wrapping (`numpy.unwrap`) before the log is "
                "read."
            ]
    return []


def _spikes(
    channel: str,
    x: Float[np.ndarray, " samples"],
    time: np.ndarray,
    segments: tuple[tuple[int, int], ...],
) -> list[str]:
    """Report jumps there and back within some samples, faster than the joint ever moves."""
    spikes = []
    for a, b in segments:
        smooth = ndimage.median_filter(x[a:b], 7, mode="nearest")
        off = np.abs(x[a:b] - smooth)
        fastest = np.abs(np.diff(smooth)).max(initial=0.0)
        least = max(1.5 * fastest, 10.0 * float(np.quantile(off, 0.99)))
        spikes += [(a + int(k), float(off[k])) for k in np.flatnonzero(off > least)]
    if not spikes or any(not size > 0 for _, size in spikes):
        return []
    places = [k for k, _ in spikes]
    others = int(np.count_nonzero(np.diff(places) > 1))
    more = f", and {others} more" if others else ""
    return [
        f"{channel} jumps by {spikes[0][1]:.3g} and back at {time[places[0]]:.6g} s{more}: no "
        "robot moves like that; repair or remove such rows."
    ]


def _held_angles(
    channel: str,
    angles: Float[np.ndarray, "samples joints"],
    j: int,
    time: np.ndarray,
    segments: tuple[tuple[int, int], ...],
) -> list[str]:
    """Report an angle that stops or starts with a kink while other joints move."""
    others = np.delete(angles, j, axis=1)
    for a, b in segments:
        x, rest, usual = angles[a:b, j], others[a:b], None
        speed = np.abs(np.diff(rest, axis=0))
        moving = (speed > STANDING * speed.max(axis=0, initial=0.0)).any(axis=1)
        for first, last in _runs(x, _shortest(b - a)):
            if np.mean(moving[first:last]) <= 0.5:
                continue
            usual = _usual_bends(x) if usual is None else usual
            if _is_hard(x, first, last, usual):
                return [_held_text(channel, x[first], time[a + first], time[a + last])]
    return []


def _is_hard(
    x: Float[np.ndarray, " samples"], first: int, last: int, usual: dict[int, float]
) -> bool:
    """Return whether a channel enters or leaves a constant stretch with a kink."""
    for width, bend in usual.items():
        kinks = [abs(x[first] - x[first - width])] if first >= width else []
        kinks += [abs(x[last + width] - x[last])] if last + width < len(x) else []
        if max(kinks, default=0.0) > 3.0 * bend > 0:
            return True
    return False


def _usual_bends(x: Float[np.ndarray, " samples"]) -> dict[int, float]:
    """Return the largest bend over some samples, where a channel does not stay at one value."""
    usual = {}
    ends = np.array(list(_runs(x, 20)), int).reshape(-1, 2)
    for width in (1, 3, 10, 30):
        bends = np.abs(x[2 * width :] - 2 * x[width:-width] + x[: -2 * width])
        covered = np.zeros(len(x) + 1, int)
        np.add.at(covered, np.maximum(0, ends - 2 * width), 1)
        np.add.at(covered, ends + 1, -1)
        usual[width] = float(bends[np.cumsum(covered)[: len(bends)] == 0].max(initial=0.0))
    return usual


def _held_forces(
    channel: str,
    forces: Float[np.ndarray, " samples"],
    angles: Float[np.ndarray, " samples"],
    time: np.ndarray,
    segments: tuple[tuple[int, int], ...],
) -> list[str]:
    """Report forces that stay constant for long although the speed of their joint varies."""
    if np.all(forces == forces[0]):
        return []
    lowest, highest = float(forces.min()), float(forces.max())
    for a, b in segments:
        f, speed = forces[a:b], np.abs(np.gradient(angles[a:b]))
        ends = np.flatnonzero(np.append(np.diff(f) != 0, True)) + 1
        lengths = np.diff(ends, prepend=0)
        fastest = speed.max(initial=0.0)
        moving = speed > STANDING * fastest
        usual = float(np.median(np.repeat(lengths, lengths)[moving])) if moving.any() else np.inf
        # Where most of a log is held, the number of values tells the usual length instead.
        usual = min(usual, (b - a) / len(ends))
        for first, last in _runs(f, max(_shortest(b - a), int(30 * usual))):
            held = slice(first, last + 1)
            if np.mean(moving[held]) < 0.5 or np.std(speed[held]) < 0.05 * fastest:
                continue
            # A drive reaches or leaves its limit without a jump.
            step = float(np.quantile(np.abs(np.diff(f)), 0.99))
            jumps = [abs(f[first] - f[first - 1])] if first else []
            jumps += [abs(f[last + 1] - f[last])] if last + 1 < len(f) else []
            if f[first] in (lowest, highest) and min(jumps, default=0.0) <= 2 * step:
                continue
            return [_held_text(channel, f[first], time[a + first], time[a + last])]
    return []


def _shortest(samples: int) -> int:
    """Return the number of equal values from which a channel may be held."""
    return max(20, int(0.01 * samples))


def _runs(x: Float[np.ndarray, " samples"], least: int) -> Iterator[tuple[int, int]]:
    """Yield first and last sample of stretches of one value, from `least` samples on."""
    ends = np.flatnonzero(np.append(np.diff(x) != 0, True))
    starts = np.append(0, ends[:-1] + 1)
    for k in np.flatnonzero(ends - starts + 1 >= least):
        yield int(starts[k]), int(ends[k])


def _held_text(channel: str, value: float, start: float, stop: float) -> str:
    return (
        f"{channel} stay{'' if 'forces' in channel else 's'} at {value:.3g} from {start:.6g} s to "
        f"{stop:.6g} s, though the robot moves: a sensor or the logger held the last value; leave "
        "that part out (`recording.start`, `recording.stop`)."
    )


def stuck_findings(robot: Robot, recording: Recording, faulty: Collection[int] = ()) -> list[str]:
    """Look for forces that are constant, or cut off at their largest value.

    Forces are cut off if many samples lie on the largest value, and few on the values beside it.

    Args:
        robot: Robot of the log.
        recording: Recording, unfiltered.
        faulty: Joints with known faults, which are left out.
    """
    forces, angles = np.asarray(recording.forces), np.asarray(recording.angles)
    findings = []
    for j, name in enumerate(robot.joint_names):
        if j in faulty:
            continue
        f, speed = forces[:, j], np.abs(np.gradient(angles[:, j]))
        low, high = float(f.min()), float(f.max())
        if low == high:
            if high != 0.0:
                findings.append(
                    f"the forces of joint `{name}` are {high:.3g} throughout: is it the right "
                    "column?"
                )
            continue
        moving = f[speed > STANDING * speed.max(initial=0.0)]
        band = 0.02 * (high - low)
        for end, near in ((high, moving > high - band), (low, moving < low + band)):
            values, counts = np.unique(moving[near], return_counts=True)
            nearest = np.argsort(np.abs(values - end))
            on, beside = int(np.count_nonzero(moving == end)), counts[nearest][1:4]
            if on > 0.005 * len(f) and on > 3.0 * beside.sum():
                findings.append(
                    f"the forces of joint `{name}` stay at {end:.3g} in {on} samples in which it "
                    "moves: a drive or a sensor is at its limit there; leave that part out "
                    "(`recording.start`, `recording.stop`), or move more gently."
                )
    return findings
