"""Plausibility of a robot's numbers: units that were confused, quarter turns that were rounded.

A rounded quarter turn (1.5708 for pi/2) makes columns of the regressor that are only *nearly*
dependent: one base parameter too many, at a condition number of 1e7. Such angles become exact
("snapping"), and the robot's notes list them.
"""

import numpy as np

from jaxid.arrays import Float, Numbers
from jaxid.errors import InputError

LARGEST_ANGLE = 2 * np.pi + 0.01
"""Largest roll, pitch or yaw that can be in radians; a full turn may be rounded [rad]."""
FAR, FARTHEST = 10.0, 1000.0
"""Lengths that may be in millimetres, and that no robot has [m]."""
HEAVIEST = 1e5
"""Largest mass of a body of a robot [kg]."""
SNAP_TOLERANCE = 1e-4
"""Default difference from a quarter turn that counts as rounding [rad]."""
_QUARTER = np.pi / 2


def range_fault(low: float, high: float, revolute: bool) -> str:
    """Return why a joint cannot have such a range, as the predicate of a sentence; or "".

    Args:
        low: Lower end of the range, infinite if unknown [rad or m].
        high: Upper end of the range, infinite if unknown [rad or m].
        revolute: Whether the joint turns.
    """
    bound = 8 * np.pi if revolute else FARTHEST
    far = [x for x in (low, high) if np.isfinite(x) and abs(x) > bound]
    if not far:
        return ""
    if revolute:
        return f"ranges to {far[0]:g} rad, which is {abs(far[0]) / (2 * np.pi):.3g} turns"
    return f"ranges to {far[0]:g} m, which no robot does"


def far_notes(owner: str, lengths: Numbers) -> tuple[str, ...]:
    """Return a note if a length [m] may be in millimetres.

    Args:
        owner: Name of the quantity, as the subject of a sentence.
        lengths: Lengths, of which the largest counts [m].
    """
    sizes = np.abs(np.asarray(lengths, np.float64))
    far = sizes[np.isfinite(sizes) & (sizes > FAR)].tolist()
    return (f"{owner} is {max(far):g} m: is the length in millimetres?",) if far else ()


def fast_notes(joint: str, speed: float, revolute: bool) -> tuple[str, ...]:
    """Return a note if a velocity limit [rad/s] may be in degrees per second."""
    if not (revolute and 50.0 < speed < np.inf):
        return ()
    return (
        f"joint `{joint}`: a velocity of up to {speed:g} rad/s is "
        f"{30 * speed / np.pi:.4g} turns a minute: is the limit in degrees per second?",
    )


def check_name(owner: str, name: str) -> str:
    """Return a name if it can be printed on one line.

    Raises:
        InputError: If it holds control characters or line breaks.
    """
    if not name.isprintable():
        raise InputError(f"the name {name!r} of {owner} must be printable: remove the characters.")
    return name


def check_tolerance(tolerance: float) -> float:
    """Return the tolerance [rad] if it is reasonable.

    Raises:
        InputError: If it is negative, or so large that it would change the robot.
    """
    if not 0.0 <= tolerance < 0.1:
        raise InputError(
            f"`snap_tolerance` must be an angle from 0 (off) to 0.1 rad, but is {tolerance:g}."
        )
    return float(tolerance)


def snap_angles(angles: Numbers, tolerance: float) -> Float[np.ndarray, "..."]:
    """Move angles [rad] within `tolerance` of a multiple of 90 degrees onto it."""
    angles = np.asarray(angles, dtype=np.float64)
    nearest = np.round(angles / _QUARTER) * _QUARTER
    return np.where(np.abs(angles - nearest) <= max(tolerance, 1e-15), nearest, angles)


def snap_axis(axis: Numbers, tolerance: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector of a direction, turned onto a coordinate axis within `tolerance`."""
    axis = np.asarray(axis, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    signs = np.round(axis)
    if np.linalg.norm(axis - signs) <= tolerance:
        return signs + 0.0
    return remove_rounding(axis)


def snap_rotation(rotation: Numbers, tolerance: float) -> Float[np.ndarray, "3 3"]:
    """Make a rotation exact if all its entries are within `tolerance` of 0, 1 or -1."""
    rotation = np.asarray(rotation, dtype=np.float64)
    signs = np.round(rotation)
    if np.abs(rotation - signs).max() <= tolerance:
        return signs + 0.0
    return remove_rounding(rotation)


def remove_rounding(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Set entries to 0, 1 or -1 that differ only by rounding, like 6e-17 for cos(pi/2)."""
    nearest = np.clip(np.round(values), -1.0, 1.0)
    return np.where(np.abs(values - nearest) <= 1e-15, nearest, values) + 0.0


def angle_notes(
    joint: str, names: tuple[str, ...], before: Numbers, after: Numbers
) -> tuple[str, ...]:
    """Return a note for each angle that snapping changed."""
    return tuple(
        f"joint `{joint}`: {name} {old:.12g} rad snapped to {np.rad2deg(new):g} degrees."
        for name, old, new in zip(names, np.ravel(before), np.ravel(after), strict=True)
        if abs(old - new) > 1e-12
    )


def array_notes(
    joint: str, name: str, before: Float[np.ndarray, "..."], after: Float[np.ndarray, "..."]
) -> tuple[str, ...]:
    """Return a note if snapping changed an axis or an attitude."""
    change = float(np.abs(np.asarray(before) - after).max())
    if change <= 1e-12:
        return ()
    return (f"joint `{joint}`: {name} snapped to the coordinate axes (by {change:.2g}).",)
