"""Frames in space: products, inverses, and small corrections."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Matrix3, Vector3, namespace
from jaxid.robot.rotations import skew

Correction = Float[AnyArray, "6"]
"""Shift [m] and turn [rad] of a frame, along its own axes before the correction."""
SHIFT = (0, 1, 2)
TURN = (3, 4, 5)


class Frame(NamedTuple):
    """Attitude and origin of a frame in another one, with any leading axes."""

    rotation: AnyArray  # columns are the axes of the frame
    position: AnyArray  # origin [m]

    def __matmul__(self, other: "Frame") -> "Frame":
        """Return the placement of what is placed in this frame."""
        position = self.position + self.turned(other.position)
        return Frame(self.rotation @ other.rotation, position)

    def turned(self, vectors: AnyArray) -> AnyArray:
        """Return vectors of this frame along the axes of the other one."""
        return (self.rotation @ vectors[..., None])[..., 0]

    @property
    def inverse(self) -> "Frame":
        """The other frame in this one."""
        xp = namespace(self.rotation)
        rotation = xp.swapaxes(self.rotation, -1, -2)
        turned_position = rotation @ self.position[..., None]
        return Frame(rotation, -turned_position[..., 0])

    def corrected(self, correction: Correction) -> "Frame":
        """Return the frame after a shift and a turn along its own axes."""
        shift, turn = jnp.split(correction, 2)
        return self @ Frame(small_rotation(turn), shift)


def small_rotation(turn: Vector3) -> Matrix3:
    r"""Return the rotation by a small vector, an angle of $2 \arctan(|w| / 2)$.

    Unlike the rotation by $|w|$ it is a rational function, with derivatives at zero.
    """
    w = skew(turn)
    square = jnp.sum(turn * turn)
    return np.eye(3) + (w + 0.5 * w @ w) / (1.0 + 0.25 * square)


def rotation_errors(rotation: Matrix3) -> Vector3:
    """Return the axis of a rotation times the sine of its angle."""
    antisymmetric_part = 0.5 * (rotation - rotation.T)
    return jnp.stack(
        [
            antisymmetric_part[2, 1],
            antisymmetric_part[0, 2],
            antisymmetric_part[1, 0],
        ]
    )


def stacked(frames: list[Frame]) -> Frame:
    """Return frames as one with a leading axis."""
    return jax.tree.map(lambda *parts: np.stack(parts), *frames)
