"""Faults of single channels: values that are held, spikes, and turns that start again at zero."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxid.arrays import Float
from jaxid.experiment.channels import STANDING
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot

FEWEST, SHARE = 20, 0.01
"""Samples, and share of the log's, for which a held channel keeps one value at least."""
LONGER = 30
"""Times as long as usual that forces keep one value if they are held, not coarse."""
VARIES = 0.05
"""Spread of a joint's speed, of its largest, from which its forces cannot stay as they are."""
SCALES = (1, 3, 10, 30)
"""Samples before and after a stop over which it is judged how hard it is."""
HARDER = 3.0
"""Times as hard as anything else in the log that a stop is in which the channel was held."""
WINDOW = 7
"""Samples of the median filter that takes spikes away, of half its length at most."""
FASTER, ROUGHER = 1.5, 10.0
"""Size of a spike over the largest step without spikes, and over what the median usually moves."""
TURNS = (2 * np.pi, 360.0)
"""What an encoder jumps by at a full turn, in radians or in degrees that are taken for them."""
SMOOTHER = 0.01
"""Part of the squared bends that is left where wrapping is undone."""


class Fault(NamedTuple):
    """What is wrong with one channel.

    Attributes:
        joint: Whose channel it is.
        said: What is wrong with it, as a sentence.
    """

    joint: int
    said: str


def channel_faults(robot: Robot, recording: Recording) -> list[Fault]:
    """Channels that are held, spiky or wrapped, each with its times.

    Args:
        robot: Whose log it is.
        recording: As it was read.
    """
    angles, forces = np.asarray(recording.angles), np.asarray(recording.forces)
    time, found = np.asarray(recording.time), []
    owner = "the motor of joint" if recording.angles_on_motor_side else "joint"
    for j, name in enumerate(robot.joint_names):
        angle, force = f"the angle of {owner} `{name}`", f"the forces of joint `{name}`"
        x = angles[:, j]
        said = _wrapped(angle, x, time) if robot.revolute[j] else []
        said = said or _spikes(angle, x, time, recording.segments)
        if not said:
            said = _held_angles(angle, angles, j, time, recording.segments)
        said += _held_forces(force, forces[:, j], x, time, recording.segments)
        found += [Fault(j, one) for one in said]
    return found


def _wrapped(channel: str, x: Float[np.ndarray, " samples"], time: np.ndarray) -> list[str]:
    """Jumps at full turns, without which the angle would go on smoothly."""
    step = np.diff(x)
    for turn in TURNS:
        if not 0.5 * turn < np.abs(step).max(initial=0.0) < 1.5 * turn:
            continue
        at = np.flatnonzero(np.abs(step[1:]) > 0.5 * turn) + 1
        undone = np.diff(np.unwrap(x, period=turn))
        bends = np.sum((step[at] - step[at - 1]) ** 2)
        if at.size and np.sum((undone[at] - undone[at - 1]) ** 2) < SMOOTHER * bends:
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
    """Jumps there and back within some samples, faster than the joint ever moves."""
    found = []
    for a, b in segments:
        smooth = ndimage.median_filter(x[a:b], WINDOW, mode="nearest")
        off = np.abs(x[a:b] - smooth)
        fastest = np.abs(np.diff(smooth)).max(initial=0.0)
        least = max(FASTER * fastest, ROUGHER * float(np.quantile(off, 0.99)))
        found += [(a + int(k), float(off[k])) for k in np.flatnonzero(off > least)]
    if not found or any(not size > 0 for _, size in found):
        return []
    places = [k for k, _ in found]
    spikes = 1 + int(np.count_nonzero(np.diff(places) > 1))
    more = f", and {spikes - 1} more" if spikes > 1 else ""
    return [
        f"{channel} jumps by {found[0][1]:.3g} and back at {time[places[0]]:.6g} s{more}: no robot "
        "moves like that; repair or remove such rows."
    ]


def _held_angles(
    channel: str,
    angles: Float[np.ndarray, "samples joints"],
    j: int,
    time: np.ndarray,
    segments: tuple[tuple[int, int], ...],
) -> list[str]:
    """An angle that stops or starts harder than anything else does, while other joints move."""
    others = np.delete(angles, j, axis=1)
    for a, b in segments:
        x, rest, usual = angles[a:b, j], others[a:b], None
        speed = np.abs(np.diff(rest, axis=0))
        moving = (speed > STANDING * speed.max(axis=0, initial=0.0)).any(axis=1)
        for first, last in _runs(x, max(FEWEST, int(SHARE * (b - a)))):
            if np.mean(moving[first:last]) <= 0.5:
                continue
            usual = _usual_bends(x) if usual is None else usual
            if _is_hard(x, first, last, usual):
                return [_said_held(channel, x[first], time[a + first], time[a + last])]
    return []


def _is_hard(
    x: Float[np.ndarray, " samples"], first: int, last: int, usual: dict[int, float]
) -> bool:
    """Whether a channel enters or leaves a constant stretch with a kink."""
    for width, bend in usual.items():
        kinks = [abs(x[first] - x[first - width])] if first >= width else []
        kinks += [abs(x[last + width] - x[last])] if last + width < len(x) else []
        if max(kinks, default=0.0) > HARDER * bend > 0:
            return True
    return False


def _usual_bends(x: Float[np.ndarray, " samples"]) -> dict[int, float]:
    """How hard a channel bends over some samples, where it does not stay at one value."""
    found = {}
    ends = np.array(list(_runs(x, FEWEST)), int).reshape(-1, 2)
    for width in SCALES:
        bends = np.abs(x[2 * width :] - 2 * x[width:-width] + x[: -2 * width])
        taken = np.zeros(len(x) + 1, int)
        np.add.at(taken, np.maximum(0, ends - 2 * width), 1)
        np.add.at(taken, ends + 1, -1)
        found[width] = float(bends[np.cumsum(taken)[: len(bends)] == 0].max(initial=0.0))
    return found


def _held_forces(
    channel: str,
    forces: Float[np.ndarray, " samples"],
    angles: Float[np.ndarray, " samples"],
    time: np.ndarray,
    segments: tuple[tuple[int, int], ...],
) -> list[str]:
    """Forces that stay as they are for long, although their joint moves, faster and slower."""
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
        # Where most of a log is held, what is usual is told by the number of values instead.
        usual = min(usual, (b - a) / len(ends))
        for first, last in _runs(f, max(FEWEST, int(SHARE * (b - a)), int(LONGER * usual))):
            own = slice(first, last + 1)
            if np.mean(moving[own]) < 0.5 or np.std(speed[own]) < VARIES * fastest:
                continue
            # At its limit a drive gets there or leaves it without a jump.
            step = float(np.quantile(np.abs(np.diff(f)), 0.99))
            jumps = [abs(f[first] - f[first - 1])] if first else []
            jumps += [abs(f[last + 1] - f[last])] if last + 1 < len(f) else []
            if f[first] in (lowest, highest) and min(jumps, default=0.0) <= 2 * step:
                continue
            return [_said_held(channel, f[first], time[a + first], time[a + last])]
    return []


def _runs(x: Float[np.ndarray, " samples"], least: int) -> Iterator[tuple[int, int]]:
    """First and last sample of stretches of one value, from `least` samples on."""
    ends = np.flatnonzero(np.append(np.diff(x) != 0, True))
    starts = np.append(0, ends[:-1] + 1)
    for k in np.flatnonzero(ends - starts + 1 >= least):
        yield int(starts[k]), int(ends[k])


def _said_held(channel: str, value: float, start: float, stop: float) -> str:
    return (
        f"{channel} stay{'' if 'forces' in channel else 's'} at {value:.3g} from {start:.6g} s to "
        f"{stop:.6g} s, though the robot moves: a sensor or the logger held the last value; leave "
        "that part out (`recording.start`, `recording.stop`)."
    )
