"""Forward kinematics: placements of all frames, and the Jacobian of the end-effector.

Placements are written on 3-vectors for one sample: batch with `jax.vmap`, differentiate with
`jax.grad`. The Jacobian is for solvers in NumPy that evaluate few poses many times, where compiling
would take longer than computing.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, namespace
from jaxid.robot.plausibility import remove_rounding
from jaxid.robot.robot import Robot


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
    cosine, sine = xp.cos(angle)[..., None, None], xp.sin(angle)[..., None, None]
    return along + cosine * (np.eye(3) - along) + sine * skew(axis)


def axis_rotation(axis: Numbers, angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about a unit vector by an angle [rad], exact for quarter turns."""
    R = rotation_about(np.asarray(axis, np.float64), np.asarray(angle))
    return remove_rounding(np.asarray(R))


def rpy_rotation(rpy: Numbers) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by roll, pitch and yaw [rad] about the fixed axes x, y, z, as in URDF."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    x, y, z = np.eye(3)
    return axis_rotation(z, yaw) @ axis_rotation(y, pitch) @ axis_rotation(x, roll)


def rotation_vectors(R: Float[np.ndarray, "poses 3 3"]) -> Float[np.ndarray, "poses 3"]:
    """Return axis times angle of rotations, the shorter way round [rad]."""
    twist = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine, cosine = np.linalg.norm(twist, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    # Half a turn has no twist: any direction leads away from it.
    half_turn = (sine < 1e-7) & (cosine < 0)
    factor = np.where(sine < 1e-7, 0.5, angle / np.where(sine < 1e-7, 1.0, 2 * sine))
    return np.where(half_turn[:, None], [np.pi, 0.0, 0.0], twist * factor[:, None])


def placement_in_parent(
    robot: Robot, body: int, q: Float[AnyArray, ""]
) -> tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]:
    """Return attitude and origin [m] of a body in its parent, moved by its joint's coordinate."""
    R, r, axis = robot.rotation[body], robot.offset[body], robot.axis[body]
    if robot.revolute[body]:
        return R @ rotation_about(axis, q), r
    return R, r + R @ axis * q


def placements(
    robot: Robot, q: Float[AnyArray, " joints"]
) -> tuple[Float[AnyArray, "joints 3 3"], Float[AnyArray, "joints 3"]]:
    """Return attitudes and origins [m] of all bodies in the frame of the ground."""
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
    """Return attitude and position [m] of the end-effector in the frame of the ground."""
    rotations, origins = placements(robot, q)
    R = rotations[robot.tip_body]
    return R @ robot.tip_rotation, origins[robot.tip_body] + R @ robot.tip_offset


class TipJacobian(NamedTuple):
    """Placements of the end-effector on the ground, and their derivatives by the joints.

    Attributes:
        rotation: Attitudes of the end-effector.
        position: Positions of its origin [m].
        turn: Angular velocities by the rates of the joints, zero of sliding ones [rad/rad].
        shift: Velocities of the origin by the rates of the joints [m/rad or m/m].
    """

    rotation: Float[np.ndarray, "poses 3 3"]
    position: Float[np.ndarray, "poses 3"]
    turn: Float[np.ndarray, "poses joints 3"]
    shift: Float[np.ndarray, "poses joints 3"]

    def curvature(
        self, force: Float[np.ndarray, "poses 3"], moment: Float[np.ndarray, "poses 3"]
    ) -> Float[np.ndarray, "poses joints joints"]:
        """Return the second derivatives of the placement by the joints, times force and moment.

        Attitudes count as rotation vectors from the attitude of the end-effector.

        Args:
            force: Weights of displacements of the origin.
            moment: Weights of rotations.
        """
        # An earlier joint carries the later ones with it; of two turns, half of their bracket.
        by_shift = np.einsum("pik,pjk->pij", np.cross(force[:, None], self.turn), self.shift)
        by_turn = np.einsum("pik,pjk->pij", np.cross(moment[:, None], self.turn), self.turn) / 2
        upper = np.triu(by_shift + by_turn)
        return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


def tip_jacobian(robot: Robot, q: Float[AnyArray, "poses joints"]) -> TipJacobian:
    """Return placements and Jacobians of the end-effector, in NumPy.

    Args:
        robot: Robot of the end-effector.
        q: Joint coordinates, one row for each pose [rad or m].
    """
    q = np.asarray(q)
    poses, n = q.shape
    R, r = np.broadcast_to(np.eye(3), (poses, 3, 3)), np.zeros((poses, 3))
    turn, slide, origin = (np.zeros((poses, n, 3)) for _ in range(3))
    offset, rotation, axes = (np.asarray(x) for x in (robot.offset, robot.rotation, robot.axis))
    for i in robot.ancestors[robot.tip_body]:
        r = r + R @ offset[i]
        R = R @ rotation[i]
        along = R @ axes[i]
        origin[:, i] = r
        if robot.revolute[i]:
            turn[:, i] = along
            R = R @ rotation_about(axes[i], q[:, i])
        else:
            slide[:, i] = along
            r = r + along * q[:, i, None]
    tip = r + R @ np.asarray(robot.tip_offset)
    shift = slide + np.cross(turn, tip[:, None] - origin)
    return TipJacobian(R @ np.asarray(robot.tip_rotation), tip, turn, shift)
