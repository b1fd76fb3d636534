"""The end-effector's placement, its Jacobian and curvature for many poses at once, in NumPy.

For solvers that look at few poses many times, where compiling would take longer than computing.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.robot.robot import Robot


class TipJacobian(NamedTuple):
    """Where the end-effector is and how joints move it, on the ground.

    Attributes:
        rotation: Attitude of the end-effector.
        position: Its origin [m].
        turn: Angular velocity by the rate of each joint, zero of a sliding one [rad/rad].
        shift: Velocity of the origin by the rate of each joint [m/rad or m/m].
    """

    rotation: Float[np.ndarray, "poses 3 3"]
    position: Float[np.ndarray, "poses 3"]
    turn: Float[np.ndarray, "poses joints 3"]
    shift: Float[np.ndarray, "poses joints 3"]

    def curvature(
        self, force: Float[np.ndarray, "poses 3"], moment: Float[np.ndarray, "poses 3"]
    ) -> Float[np.ndarray, "poses joints joints"]:
        """Second derivatives of placement by joints, times a force and a moment.

        Attitudes count by the rotation vector from where the end-effector is.

        Args:
            force: By which displacements of the origin count.
            moment: By which rotations count.
        """
        # An earlier joint carries the later ones with it; of two turns, half of their bracket.
        by_shift = np.einsum("pik,pjk->pij", np.cross(force[:, None], self.turn), self.shift)
        by_turn = np.einsum("pik,pjk->pij", np.cross(moment[:, None], self.turn), self.turn) / 2
        upper = np.triu(by_shift + by_turn)
        return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


def tip_jacobian(robot: Robot, q: Float[AnyArray, "poses joints"]) -> TipJacobian:
    """Placement and Jacobian of the end-effector.

    Args:
        robot: Whose end-effector it is.
        q: Joint coordinates, one row for each pose [rad or m].
    """
    q = np.asarray(q)
    poses, n = q.shape
    R, r = np.broadcast_to(np.eye(3), (poses, 3, 3)), np.zeros((poses, 3))
    turn, slide, origin = (np.zeros((poses, n, 3)) for _ in range(3))
    chain = robot.ancestors[robot.tip_body]
    offset, rotation, axes = (np.asarray(x) for x in (robot.offset, robot.rotation, robot.axis))
    for i in chain:
        r = r + R @ offset[i]
        R = R @ rotation[i]
        along = R @ axes[i]
        origin[:, i] = r
        if robot.revolute[i]:
            turn[:, i] = along
            R = R @ _turns(axes[i], q[:, i])
        else:
            slide[:, i] = along
            r = r + along * q[:, i, None]
    tip = r + R @ np.asarray(robot.tip_offset)
    shift = slide + np.cross(turn, tip[:, None] - origin)
    return TipJacobian(R @ np.asarray(robot.tip_rotation), tip, turn, shift)


def rotation_vectors(R: Float[np.ndarray, "poses 3 3"]) -> Float[np.ndarray, "poses 3"]:
    """Axis times angle of rotations, the shorter way round [rad]."""
    twist = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine, cosine = np.linalg.norm(twist, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    # Half a turn has no twist: any direction leads away from it.
    lost = (sine < 1e-7) & (cosine < 0)
    factor = np.where(sine < 1e-7, 0.5, angle / np.where(sine < 1e-7, 1.0, 2 * sine))
    return np.where(lost[:, None], [np.pi, 0.0, 0.0], twist * factor[:, None])


def _turns(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)
