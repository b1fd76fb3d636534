"""Frames in space: products, inverses, small corrections, and how they move points."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.robot.rotations import Rotations, Vectors

Corrections = Float[np.ndarray, "*batch 6"]
"""Shift [m] and turn [rad] of a frame, along its own axes before the correction."""
Motions = Float[np.ndarray, "*batch 6 6"]
"""Velocity and angular velocity of a point (rows) by six numbers (columns)."""
SHIFT = (0, 1, 2)
TURN = (3, 4, 5)


class Frame(NamedTuple):
    """Attitude and origin of a frame in another one, with any leading axes."""

    rotation: Rotations  # columns are the axes of the frame
    position: Vectors  # origin [m]

    def __matmul__(self, other: "Frame") -> "Frame":
        """Return the placement of what is placed in this frame."""
        turned_position = (self.rotation @ other.position[..., None])[..., 0]
        rotation = self.rotation @ other.rotation
        return Frame(rotation, self.position + turned_position)

    def at(self, index: np.ndarray) -> "Frame":
        """Return some of several frames."""
        return Frame(self.rotation[index], self.position[index])

    @property
    def inverse(self) -> "Frame":
        """The other frame in this one."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return Frame(rotation, -(rotation @ self.position[..., None])[..., 0])

    def corrected(self, corrections: Corrections) -> "Frame":
        """Return the frame after corrections."""
        shifts, turns = np.split(corrections, 2, axis=-1)
        return self @ Frame(small_rotations(turns), shifts)


ORIGIN = Frame(np.eye(3), np.zeros(3))
"""A frame that has not moved."""


def small_rotations(turns: Vectors) -> Rotations:
    r"""Return rotations by small vectors, by angles of $2 \arctan(|w| / 2)$.

    Unlike rotations by $|w|$ they are rational functions, with derivatives at zero.
    """
    w = cross_matrices(turns)
    return np.eye(3) + (w + 0.5 * w @ w) / _denominators(turns)


def cross_matrices(vectors: Vectors) -> Rotations:
    """Return the matrices that multiply vectors from the left as cross products do."""
    return np.cross(np.eye(3), vectors[..., None, :])


def _denominators(turns: Vectors) -> np.ndarray:
    squares = np.sum(turns**2, axis=-1)
    return 1.0 + 0.25 * squares[..., None, None]


def correction_rates(corrections: Corrections) -> Motions:
    """Return shifts and turns along a corrected frame's axes by changes of corrections.

    A correction is a sum: its shift is along the axes before the turn.
    """
    _, turns = np.split(corrections, 2, axis=-1)
    shifts_of_axes = np.swapaxes(small_rotations(turns), -1, -2)
    spins = (np.eye(3) - 0.5 * cross_matrices(turns)) / _denominators(turns)
    zeros = np.zeros_like(spins)
    return np.block([[shifts_of_axes, zeros], [zeros, spins]])


def rigid_motions(rotations: Rotations, levers: Vectors) -> Motions:
    """Return how a point moves by shifts along a frame's axes and turns about them.

    Args:
        rotations: Attitudes of the frames.
        levers: Vectors from their origins to the points [m].
    """
    arms = np.cross(rotations, levers[..., None], axis=-2)
    return np.block([[rotations, arms], [np.zeros_like(arms), rotations]])


def rotation_errors(rotations: Rotations) -> Vectors:
    """Return the axes of rotations times the sines of their angles."""
    differences = 0.5 * (rotations - np.swapaxes(rotations, -1, -2))
    return differences[..., (2, 0, 1), (1, 2, 0)]
