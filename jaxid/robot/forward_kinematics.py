"""Forward kinematics: placements of all frames, and their derivatives by the joints.

Placements are written on 3-vectors for one sample: batch with `jax.vmap`, differentiate
with `jax.grad`. The Jacobian of the end-effector is in NumPy, for many poses at once,
where compiling would take longer than computing.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Joints, Matrix, Matrix3, Vector3
from jaxid.errors import InputError

from .joint_coordinates import (
    all_coordinates,
    linear_coordinates,
    linear_ratios,
    placement_in_parent,
)
from .robot import Robot
from .rotations import Rotations, Vectors, rotation_about


def placements(robot: Robot, q: Joints) -> tuple[Rotations, Vectors]:
    """Return attitudes and origins [m] of all bodies in the frame of the ground."""
    q = all_coordinates(robot, jnp.asarray(q))
    rotations: list[Any] = [None] * robot.bodies
    origins: list[Any] = [None] * robot.bodies
    for i in robot.order:
        R, r = placement_in_parent(robot, i, q[i])
        parent = robot.parent[i]
        if parent >= 0:
            R_parent = rotations[parent]
            R = R_parent @ R
            r = origins[parent] + R_parent @ r
        rotations[i] = R
        origins[i] = r
    return jnp.stack(rotations), jnp.stack(origins)


def tip_placement(robot: Robot, q: Joints) -> tuple[Matrix3, Vector3]:
    """Return attitude and position [m] of the end-effector on the ground."""
    rotations, origins = placements(robot, q)
    body = robot.tip_body
    R = rotations[body]
    position = origins[body] + R @ robot.tip_offset
    return R @ robot.tip_rotation, position


class TipJacobian(NamedTuple):
    """Placements of the end-effector, and their derivatives by all joints.

    Attributes:
        rotation: Attitudes on the ground [poses 3 3].
        position: Positions on the ground [m].
        velocity: Velocities of the origin by the rates of all joints in the order from
            the ground [poses bodies 3].
        turn: Angular velocities by the same rates [poses bodies 3].
        ratios: These rates by those of the coordinates [bodies joints].
        frames: Attitudes on the ground of the bodies at rest in their joints, whose
            axes they turn about or slide along; zero beside the end-effector's chain
            [poses bodies 3 3].
        origins: Origins of these frames [m].
    """

    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    turn: np.ndarray
    ratios: np.ndarray
    frames: np.ndarray
    origins: np.ndarray

    @property
    def slopes(self) -> np.ndarray:
        """Velocities and angular velocities by the coordinates [poses joints 6]."""
        return self.ratios.T @ np.concatenate([self.velocity, self.turn], axis=2)


def tip_jacobian(robot: Robot, q: Matrix) -> TipJacobian:
    """Return placements of the end-effector in many poses, and their derivatives.

    Raises:
        InputError: If the robot has closed loops.
    """
    if robot.loops:
        raise InputError(
            f"`{robot.name}` has closed loops, for which no poses of the end-effector "
            "are searched: give coordinates of the motors."
        )
    offset = np.asarray(robot.offset)
    rotation = np.asarray(robot.rotation)
    axis = np.asarray(robot.axis)

    poses = len(q)
    q = np.asarray(linear_coordinates(robot.followers, q))
    R = np.broadcast_to(np.eye(3), (poses, 3, 3))
    r = np.zeros((poses, 3))
    origin, turn, slide = np.zeros((3, *q.shape, 3))
    frames = np.zeros((*q.shape, 3, 3))
    for i in robot.ancestors[robot.tip_body]:
        r = r + R @ offset[i]
        R = R @ rotation[i]
        direction = R @ axis[i]
        frames[:, i] = R
        origin[:, i] = r
        if robot.turns[i]:
            turn[:, i] = direction
            R = R @ rotation_about(axis[i], q[:, i])
        else:
            slide[:, i] = direction
            r = r + direction * q[:, i, None]

    position = r + R @ np.asarray(robot.tip_offset)
    attitude = R @ np.asarray(robot.tip_rotation)
    lever = position[:, None] - origin
    velocity = slide + np.cross(turn, lever)
    order = list(robot.order)
    ratios = linear_ratios(robot.followers, robot.joints)
    return TipJacobian(
        attitude,
        position,
        velocity[:, order],
        turn[:, order],
        ratios[order],
        frames,
        origin,
    )


def tip_curvature(
    tip: TipJacobian,
    force: np.ndarray,
    moment: np.ndarray,
) -> np.ndarray:
    """Return second derivatives by the coordinates, times a force and a moment.

    Attitudes count as rotation vectors from the attitude of the end-effector.
    """
    # An earlier joint carries the later ones with it, so that half of the matrix is
    # enough. Two turns in a row differ from their sum by half of their bracket.
    force_arm = np.cross(force[:, None], tip.turn)
    moment_arm = np.cross(moment[:, None], tip.turn)
    position_part = np.einsum("pik,pjk->pij", force_arm, tip.velocity)
    attitude_part = np.einsum("pik,pjk->pij", moment_arm, tip.turn) / 2
    upper_triangle = np.triu(position_part + attitude_part)
    curvature = upper_triangle + np.swapaxes(np.triu(upper_triangle, 1), 1, 2)
    return tip.ratios.T @ curvature @ tip.ratios
