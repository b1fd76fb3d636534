"""Quarter turns that a file rounded (1.5708 for pi/2) become exact again, and say so.

A rounded quarter turn makes columns of the regressor that are only *nearly* dependent: one base
parameter too many, at a condition number of 1e7. What is snapped stands in the robot's notes.
"""

import numpy as np

from jaxid.arrays import Float, Numbers
from jaxid.errors import InputError

SNAP_TOLERANCE = 1e-4
_QUARTER = np.pi / 2
_ROUNDING = 1e-15
_WORTH_A_NOTE = 1e-12
_X, _Y, _Z = np.eye(3)


def check_tolerance(tolerance: float) -> float:
    """Returns the tolerance [rad] itself if it makes sense.

    Raises:
        InputError: If it is negative, or so large that it would change the robot.
    """
    if not 0.0 <= tolerance < 0.1:
        raise InputError(
            f"`snap_tolerance` must be an angle from 0 (off) to 0.1 rad, but is {tolerance:g}."
        )
    return float(tolerance)


def snap_angles(angles: Numbers, tolerance: float) -> Float[np.ndarray, "..."]:
    """Moves angles [rad] within `tolerance` of a multiple of 90 degrees onto it."""
    angles = np.asarray(angles, dtype=np.float64)
    nearest = np.round(angles / _QUARTER) * _QUARTER
    return np.where(np.abs(angles - nearest) <= max(tolerance, _ROUNDING), nearest, angles)


def snap_axis(axis: Numbers, tolerance: float) -> Float[np.ndarray, "3"]:
    """Turns a direction within `tolerance` [rad] of a coordinate axis onto it; unit length."""
    axis = np.asarray(axis, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    signs = np.round(axis)
    if np.linalg.norm(axis - signs) <= tolerance:
        return signs + 0.0
    return clean(axis)


def snap_rotation(rotation: Numbers, tolerance: float) -> Float[np.ndarray, "3 3"]:
    """Makes a rotation exact if all its entries are within `tolerance` of 0, 1 or -1."""
    rotation = np.asarray(rotation, dtype=np.float64)
    signs = np.round(rotation)
    if np.abs(rotation - signs).max() <= tolerance:
        return signs + 0.0
    return clean(rotation)


def clean(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Rounds to 0, 1 or -1 what differs from it by rounding alone, like 6e-17 for cos(pi/2)."""
    nearest = np.clip(np.round(values), -1.0, 1.0)
    return np.where(np.abs(values - nearest) <= _ROUNDING, nearest, values) + 0.0


def axis_rotation(axis: Numbers, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about a unit vector by an angle [rad]; exact for quarter turns about x, y, z."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return clean(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def rpy_rotation(rpy: Numbers) -> Float[np.ndarray, "3 3"]:
    """Rotation of URDF's roll, pitch and yaw [rad]: about the fixed x, then y, then z axis."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    return axis_rotation(_Z, yaw) @ axis_rotation(_Y, pitch) @ axis_rotation(_X, roll)


def angle_notes(
    joint: str, names: tuple[str, ...], before: Numbers, after: Numbers
) -> tuple[str, ...]:
    """One sentence for each angle that snapping changed."""
    return tuple(
        f"joint `{joint}`: {name} {old:.12g} rad snapped to {_in_words(new)} ({new:.12g})."
        for name, old, new in zip(names, np.ravel(before), np.ravel(after), strict=True)
        if abs(old - new) > _WORTH_A_NOTE
    )


def array_notes(
    joint: str, what: str, before: Float[np.ndarray, "..."], after: Float[np.ndarray, "..."]
) -> tuple[str, ...]:
    """One sentence if snapping changed an axis or an attitude."""
    change = float(np.abs(np.asarray(before) - after).max())
    if change <= _WORTH_A_NOTE:
        return ()
    return (f"joint `{joint}`: {what} snapped to the coordinate axes (by {change:.2g}).",)


def _in_words(angle: float) -> str:
    quarters = round(angle / _QUARTER)
    whole, half = divmod(abs(quarters), 2)
    number = "pi/2" if half and not whole else f"{abs(quarters)} pi/2" if half else f"{whole} pi"
    number = "0" if not quarters else "pi" if number == "1 pi" else number
    return f"-{number}" if quarters < 0 else number
