"""Rotations by angles, exact at quarter turns, and rounded quarter turns of files made exact.

A rounded quarter turn (1.5708 for pi/2) makes columns of the regressor that are only *nearly*
dependent: one base parameter too many, at a condition number of 1e7. Such angles become exact
("snapping"), and the robot's notes list them.
"""

import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, namespace
from jaxid.errors import InputError

SNAP_TOLERANCE = 1e-4
"""Default difference from a quarter turn that counts as rounding [rad]."""

Notes = tuple[str, ...]


def skew(a: Float[AnyArray, "3"]) -> Float[AnyArray, "3 3"]:
    r"""Return the matrix $\tilde a$ with $\tilde a b = a \times b$ (Eq. 3)."""
    x, y, z = a[0], a[1], a[2]
    o = 0.0 * x
    return namespace(a).array([[o, -z, y], [z, o, -x], [-y, x, o]])


def rotation_about(
    axis: Float[AnyArray, "3"], angle: Float[AnyArray, "*batch"]
) -> Float[AnyArray, "*batch 3 3"]:
    """Return the rotation about a unit vector by an angle [rad].

    The part of a vector along the axis stays and the rest turns: in this form a constant axis
    leaves the fewest operations.
    """
    xp = namespace(axis, angle)
    along = axis[:, None] * axis[None, :]
    cosine = xp.cos(angle)[..., None, None]
    sine = xp.sin(angle)[..., None, None]
    return along + cosine * (np.eye(3) - along) + sine * skew(axis)


def axis_rotation(axis: Numbers, angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about a unit vector by an angle [rad], exact for quarter turns."""
    R = rotation_about(np.asarray(axis, np.float64), np.asarray(angle))
    return _without_rounding(np.asarray(R))


def rpy_rotation(rpy: Numbers) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by roll, pitch and yaw [rad] about the fixed axes x, y, z, as in URDF."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    x, y, z = np.eye(3)
    return axis_rotation(z, yaw) @ axis_rotation(y, pitch) @ axis_rotation(x, roll)


def snap_angles(
    joint: str, names: tuple[str, ...], angles: Numbers, tolerance: float
) -> tuple[Float[np.ndarray, " angles"], Notes]:
    """Move angles [rad] within `tolerance` of a multiple of 90 degrees onto it; note each."""
    if not 0.0 <= tolerance < 0.1:
        raise InputError(
            f"`snap_tolerance` must be an angle from 0 (off) to 0.1 rad, but is {tolerance:g}."
        )
    angles = np.asarray(angles, dtype=np.float64)
    nearest = np.round(angles / (np.pi / 2)) * (np.pi / 2)
    snapped = np.where(np.abs(angles - nearest) <= max(tolerance, 1e-15), nearest, angles)
    notes = tuple(
        f"joint `{joint}`: {name} {old:.12g} rad snapped to {np.rad2deg(new):g} degrees."
        for name, old, new in zip(names, angles, snapped, strict=True)
        if abs(old - new) > 1e-12
    )
    return snapped, notes


def snap_directions(
    joint: str, name: str, values: Float[np.ndarray, "*shape 3"], tolerance: float
) -> tuple[Float[np.ndarray, "*shape 3"], Notes]:
    """Make a unit vector or a rotation exact if all entries are within `tolerance` of 0, 1, -1."""
    signs = np.round(values)
    change = float(np.abs(values - signs).max())
    if change > tolerance:
        return _without_rounding(values), ()
    note = f"joint `{joint}`: {name} snapped to the coordinate axes (by {change:.2g})."
    return signs + 0.0, (note,) if change > 1e-12 else ()


def _without_rounding(values: np.ndarray) -> np.ndarray:
    """Set entries to 0, 1 or -1 that differ only by rounding, like 6e-17 for cos(pi/2)."""
    nearest = np.clip(np.round(values), -1.0, 1.0)
    return np.where(np.abs(values - nearest) <= 1e-15, nearest, values) + 0.0
