"""Rotations by angles, exact at quarter turns, and rounded quarter turns made exact.

A rounded quarter turn (1.5708 for pi/2) makes columns of the regressor that are only
*nearly* dependent: one base parameter too many, at a condition number of 1e7. So the
rank is decided with exact quarter turns ("snapping"); the robot itself keeps the angles
of its file.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Matrix3,
    Numbers,
    Vector3,
    as_finite_array,
    namespace,
)
from jaxid.errors import InputError

Vectors = Float[AnyArray, "*batch 3"]
"""Points or directions, with any leading axes."""
Rotations = Float[AnyArray, "*batch 3 3"]
"""Rotations, or inertia tensors, with any leading axes."""
SNAP_TOLERANCE = 1e-4
"""Default difference from a quarter turn that counts as rounding [rad]."""


def skew(a: Vector3) -> Matrix3:
    r"""Return the matrix $\tilde a$ with $\tilde a b = a \times b$ (Eq. 3)."""
    x = a[0]
    y = a[1]
    z = a[2]
    zero = 0.0 * x
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return namespace(a).array(rows)


def rotation_about(axis: Vector3, angle: AnyArray) -> Rotations:
    """Return the rotation about a unit vector by an angle [rad].

    The part of a vector along the axis stays and the rest turns: in this form a
    constant axis leaves the fewest operations.
    """
    xp = namespace(axis, angle)
    axial_part = axis[:, None] * axis[None, :]
    normal_part = np.eye(3, dtype=axial_part.dtype) - axial_part
    cosine = xp.cos(angle)[..., None, None]
    sine = xp.sin(angle)[..., None, None]
    return axial_part + cosine * normal_part + sine * skew(axis)


def axis_rotation(axis: Numbers, angle: float) -> Matrix3:
    """Return the rotation about a unit vector [rad], exact for quarter turns."""
    vector = np.asarray(axis, np.float64)
    return without_rounding(rotation_about(vector, np.asarray(angle)))


def rpy_rotation(rpy: Numbers) -> Matrix3:
    """Return the rotation by roll, pitch and yaw [rad] about x, y, z, as in URDF."""
    roll, pitch, yaw = map(axis_rotation, np.eye(3), np.asarray(rpy))
    return without_rounding(yaw @ pitch @ roll)


def rpy_angles(rotation: Matrix3) -> Vector3:
    """Return roll, pitch and yaw [rad], precise at a pitch of a quarter turn, too."""
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    R = np.asarray(rotation) @ axis_rotation((1.0, 0.0, 0.0), -roll)
    pitch = np.arctan2(-R[2, 0], R[2, 2])
    yaw = np.arctan2(-R[0, 1], R[1, 1])
    return np.array([roll, pitch, yaw])


def snapped(vectors: Vectors, tolerance: float) -> np.ndarray:
    """Return unit vectors whose entries within `tolerance` of zero are zero."""
    if not 0.0 <= tolerance < 0.1:
        raise InputError(
            "`snap_tolerance` must be an angle from 0 (off) to 0.1 rad, "
            f"but is {tolerance:g}."
        )
    entries = np.asarray(vectors, np.float64)
    entries = np.where(np.abs(entries) <= tolerance, 0.0, entries)
    lengths = np.linalg.norm(entries, axis=-1, keepdims=True)
    return without_rounding(entries / lengths)


def snapped_rotations(rotations: Rotations, tolerance: float) -> np.ndarray:
    """Return nearest rotations whose entries within `tolerance` of zero are zero."""
    R = np.asarray(rotations, np.float64)
    rows = snapped(rotations, tolerance)
    U, _, Vt = np.linalg.svd(rows)
    nearest_rotation = without_rounding(U @ Vt)
    differences = np.abs(R - rows)
    changes = differences.max(axis=(-2, -1), keepdims=True) > 1e-14
    return np.where(changes, nearest_rotation, R)


def without_rounding(values: AnyArray) -> np.ndarray:
    """Set entries to 0, 1 or -1 that differ only by rounding, like cos(pi/2)."""
    integers = np.clip(np.round(values), -1.0, 1.0)
    differences = np.abs(values - integers)
    entries = np.where(differences <= 1e-14, integers, values)
    return entries + 0.0  # makes -0.0 positive


class Placement(NamedTuple):
    """Attitude and origin of a link in the frame of the body that carries it.

    Attributes:
        body: Index of the body; -1 for the ground.
        rotation: Attitude; its columns are the axes of the link.
        position: Origin of the link [m].
    """

    body: int
    rotation: Matrix3
    position: Vector3

    def renumbered(self, numbers: Mapping[int, int]) -> "Placement":
        """Return the placement with another number of the body."""
        return self._replace(body=numbers[self.body])

    def of(self, rotation: Matrix3, position: Vector3) -> "Placement":
        """Return the placement on the body of what is placed on the link."""
        body, R, r = self
        return Placement(body, without_rounding(R @ rotation), r + R @ position)


def unit_axes(axes: AnyArray):
    """Return axes of length one; arrays of JAX are taken as they are."""
    if not isinstance(axes, np.ndarray):
        return axes
    length = np.linalg.norm(axes, axis=-1, keepdims=True)
    if (length < 1e-9).any():
        joint = int(length.argmin()) + 1
        raise InputError(
            f"`axis` of joint {joint} is the zero vector: give it a direction."
        )
    # A unit vector keeps its digits.
    return np.where(np.abs(length - 1.0) > 1e-15, axes / length, axes)


def as_rotations(name: str, value: Numbers, shape: tuple[int, ...]) -> AnyArray:
    """Return a copy as rotation matrices; a JAX array is taken as it is."""
    R = as_finite_array(name, value, shape)
    if isinstance(R, np.ndarray):
        products = np.swapaxes(R, -1, -2) @ R
        is_orthonormal = np.abs(products - np.eye(3)).max() < 1e-6
        if not is_orthonormal or (np.linalg.det(R) < 0).any():
            raise InputError(
                f"{name} must hold orthonormal, right-handed rotation matrices."
            )
    return R
