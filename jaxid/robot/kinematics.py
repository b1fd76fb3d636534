"""Where the bodies are: the placement of every frame, for one set of joint coordinates.

Written on 3-vectors for one sample; batch with `jax.vmap`, differentiate with `jax.grad`.
"""

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.robot.robot import Robot


def skew(a: Float[AnyArray, "3"]) -> Float[AnyArray, "3 3"]:
    r"""The matrix $\tilde a$ with $\tilde a b = a \times b$ (Eq. 3)."""
    x, y, z = a[0], a[1], a[2]
    o = 0.0 * x
    return jnp.array([[o, -z, y], [z, o, -x], [-y, x, o]])


def turn(axis: Float[AnyArray, "3"], q: Float[AnyArray, ""]) -> Float[AnyArray, "3 3"]:
    """The rotation about a unit vector by an angle [rad].

    The part of a vector along the axis stays and the rest turns: in this wording a constant axis
    leaves the fewest operations.
    """
    along = axis[:, None] * axis[None, :]
    return along + jnp.cos(q) * (np.eye(3) - along) + jnp.sin(q) * skew(axis)


def placement_in_parent(
    robot: Robot, body: int, q: Float[AnyArray, ""]
) -> tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]:
    """Attitude and origin [m] of a body in its parent, moved by its joint's coordinate."""
    R, r, axis = robot.rotation[body], robot.offset[body], robot.axis[body]
    if robot.revolute[body]:
        return R @ turn(axis, q), r
    return R, r + R @ axis * q


def placements(
    robot: Robot, q: Float[AnyArray, " joints"]
) -> tuple[Float[AnyArray, "joints 3 3"], Float[AnyArray, "joints 3"]]:
    """Attitudes and origins [m] of all bodies in the frame of the ground."""
    q = jnp.asarray(q)
    rotations, origins = [], []
    for i, parent in enumerate(robot.parent):
        R, r = placement_in_parent(robot, i, q[i])
        if parent >= 0:
            R, r = rotations[parent] @ R, origins[parent] + rotations[parent] @ r
        rotations.append(R)
        origins.append(r)
    return jnp.stack(rotations), jnp.stack(origins)


def tip_placement(
    robot: Robot, q: Float[AnyArray, " joints"]
) -> tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]:
    """Attitude and position [m] of the end-effector in the frame of the ground."""
    rotations, origins = placements(robot, q)
    R = rotations[robot.tip_body]
    return R @ robot.tip_rotation, origins[robot.tip_body] + R @ robot.tip_offset
