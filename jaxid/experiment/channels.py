"""Signs that a key of the experiment file is wrong: units, sides, dead and cut channels."""

from collections.abc import Collection

import numpy as np

from jaxid.arrays import Float
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot

SLACK = 0.02
"""How far outside a range, relative to it, a log may reach without a word."""
SMALL = 0.02
"""Part of its range that a joint moves through at most if radians are taken for degrees."""
FILLED = 0.1
"""Part of its range that some joint moves through at least if a unit shall be guessed."""
SLOWEST, FASTEST = 5.0, 5e4
"""Samples in a second outside of which the unit of the time is doubtful [Hz]."""
STANDING = 0.01
"""Part of a joint's largest speed below which it stands."""
BAND, LEVELS, PILED, OFTEN = 0.02, 3, 3.0, 0.005
"""Forces are cut off where more than `PILED` times as many samples lie on the largest value as in
the `BAND` of the signal's range next to it, or on the next `LEVELS` values, and more than a share
`OFTEN` of all."""


def rate_doubts(sample_time: float) -> list[str]:
    """A number of samples in a second that no robot's log has."""
    rate = 1.0 / sample_time
    if SLOWEST <= rate <= FASTEST:
        return []
    return [
        f"the log has {rate:.3g} samples in a second: check `recording.time_unit` or `sample_time`."
    ]


def unit_doubts(
    robot: Robot,
    lowest: Float[np.ndarray, " joints"],
    highest: Float[np.ndarray, " joints"],
    on_motor_side: bool,
) -> list[str]:
    """One unit or side that would bring the angles of all joints back into their ranges.

    Args:
        robot: Whose log it is.
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        on_motor_side: Whether the log is taken for the motors' already.
    """
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    known = np.array(robot.revolute) & np.isfinite(high - low)
    if not known.any():
        return []
    low, width = low[known], (high - low)[known]

    def fills(ends: np.ndarray) -> float:
        """Largest part of a range that is used, of 1; zero if some range is left."""
        a, b = np.sort(ends, axis=0)[:, known]
        inside = (a >= low - SLACK * width) & (b <= low + width + SLACK * width)
        return float(((b - a) / width).max()) if inside.all() else 0.0

    ends = np.stack([lowest, highest])
    share = float(((highest - lowest)[known] / width).max())
    if share <= SMALL and fills(np.where(known, np.rad2deg(ends), ends)) > FILLED:
        return [
            f"no joint moves through more than {100 * share:.2g} % of its range: are the angles of "
            'the log in radians, though `recording.angle_unit` is "deg"?'
        ]
    if fills(ends):
        return []
    drives = robot.drives
    undone = {
        'degrees (`recording.angle_unit = "deg"`)': np.where(known, np.deg2rad(ends), ends),
        'radians (`recording.angle_unit` is "rev")': np.where(known, ends / (2 * np.pi), ends),
    }
    if not on_motor_side and not drives.is_direct:
        undone['the motors\' (`recording.side = "motor"`)'] = np.asarray(drives.joint_angles(ends))
    found = [cure for cure, angles in undone.items() if fills(angles) > FILLED]
    if not found:
        return []
    return [
        "the angles leave the ranges of the joints, but would not if those in the log were "
        f"{', or '.join(found)}."
    ]


def stuck_doubts(robot: Robot, recording: Recording, faulty: Collection[int] = ()) -> list[str]:
    """Forces that are one number throughout, or cut off at their largest value.

    Args:
        robot: Whose log it is.
        recording: As it was read.
        faulty: Joints of which more is known already.
    """
    forces, angles = np.asarray(recording.forces), np.asarray(recording.angles)
    said = []
    for j, name in enumerate(robot.joint_names):
        if j in faulty:
            continue
        f, speed = forces[:, j], np.abs(np.gradient(angles[:, j]))
        low, high = float(f.min()), float(f.max())
        if low == high:
            if high != 0.0:
                said.append(
                    f"the forces of joint `{name}` are {high:.3g} throughout: is it the right "
                    "column?"
                )
            continue
        moving = f[speed > STANDING * speed.max(initial=0.0)]
        band = BAND * (high - low)
        for end, near in ((high, moving > high - band), (low, moving < low + band)):
            values, counts = np.unique(moving[near], return_counts=True)
            nearest = np.argsort(np.abs(values - end))
            on, beside = int(np.count_nonzero(moving == end)), counts[nearest][1 : 1 + LEVELS]
            if on > OFTEN * len(f) and on > PILED * beside.sum():
                said.append(
                    f"the forces of joint `{name}` stay at {end:.3g} in {on} samples in which it "
                    "moves: a drive or a sensor is at its limit there; leave that part out "
                    "(`recording.start`, `recording.stop`), or move more gently."
                )
    return said
