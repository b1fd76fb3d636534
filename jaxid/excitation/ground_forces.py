"""Forces between the feet of a robot and level ground, by nominal parameters.

Their sum follows from the motion. How the feet share it does not: the smallest forces
are taken, of which those of a foot count the more the less weight it is to carry.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.contact_elimination import contact_jacobians, contact_tips
from jaxid.dynamics.motion import Motion, floating_motion
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.robot import GRAVITY, Robot
from jaxid.robot.virtual_joints import GROUP

DIRECTIONS = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
"""Angles at which a point is compared with the feet, beside those of their edges."""
MOMENT_ARM = 0.05
"""Length by which a moment of a sole counts like a force [m]."""


class GroundForces(NamedTuple):
    """Forces of the ground, and those of the joints.

    Attributes:
        zero_moment_point: Point of the ground about which the forces of the ground have
            no horizontal moment [samples 2] [m].
        friction: Force along the ground, relative to that against it [samples].
        joint_forces: Forces of all joints, nearly zero for virtual ones [samples
            joints] [N m or N].
    """

    zero_moment_point: np.ndarray
    friction: np.ndarray
    joint_forces: np.ndarray


class BaseMotion(NamedTuple):
    """Motion of a robot whose trunk moves on the ground.

    Attributes:
        motion: Motion as an IMU in the origin of the trunk measures it.
        rotation: Attitudes of the trunk on the ground [samples 3 3].
    """

    motion: Motion
    rotation: np.ndarray

    @property
    def up(self) -> np.ndarray:
        """Vertical in the frame of the trunk [samples 3]."""
        return self.rotation[:, 2]


def measured_motion(robot: Robot, ground_motion: Motion) -> BaseMotion:
    """Return what sensors measure of a motion whose base moves on virtual joints."""
    q, qd, qdd = (
        np.asarray(x) for x in (ground_motion.q, ground_motion.qd, ground_motion.qdd)
    )
    base = robot.replace(tip_body=GROUP - 1, tip_offset=np.zeros(3), tip_rotation=None)
    tip = tip_jacobian(base, q)
    # Each of three turns carries the axes of the later ones with it.
    spin = np.zeros((len(q), 3))
    turning = np.zeros((len(q), 3))
    for joint in range(3, GROUP):
        axis = tip.turn[:, joint]
        rate = qd[:, joint, None] * axis
        turning += qdd[:, joint, None] * axis + np.cross(spin, rate)
        spin += rate
    vectors = np.stack([qdd[:, :3] - GRAVITY, spin, turning])
    along_trunk = np.einsum("nji,knj->kni", tip.rotation, vectors)
    joints = (x[:, GROUP:] for x in (q, qd, qdd))
    return BaseMotion(floating_motion(*joints, *along_trunk), tip.rotation)


def ground_forces(
    base: BaseParameters,
    parameters: AnyArray,
    trunk: BaseMotion,
    loads: Float[np.ndarray, "samples feet"],
    feet: Float[np.ndarray, "feet 2"],
) -> GroundForces:
    """Return the forces of a motion.

    Args:
        base: Base parameters.
        parameters: Their nominal values.
        trunk: Motion of the robot.
        loads: How much of the weight each foot is to carry, from 0 (in the air) to 1.
        feet: Places of the feet while they stand [m].
    """
    forces = base.forces_in_numpy(parameters, trunk.motion)
    robot = base.model.robot
    tips = contact_tips(robot, trunk.motion.q)
    jacobians = contact_jacobians(robot, tips, trunk.up)
    directions = jacobians[0].shape[2]
    scale = np.array([1.0, 1.0, 1.0, *[MOMENT_ARM] * 3])[:directions]
    weights = loads[:, :, None] * scale
    parts = [
        jacobian * weights[:, foot, None] for foot, jacobian in enumerate(jacobians)
    ]
    effects = np.concatenate(parts, axis=2)
    base_effects = effects[:, :GROUP]
    squares = base_effects @ base_effects.swapaxes(1, 2)
    multipliers = np.linalg.solve(squares, forces[:, :GROUP, None])
    shares = base_effects.swapaxes(1, 2) @ multipliers
    carried = (effects @ shares)[..., 0]

    along_trunk = shares.reshape(weights.shape) * weights
    vectors = along_trunk.reshape(*loads.shape, directions // 3, 3)
    contact_forces = np.einsum("nij,nfkj->nfki", trunk.rotation, vectors)
    along_x, along_y, vertical = np.moveaxis(contact_forces[:, :, 0], 2, 0)
    weight = vertical.sum(axis=1)
    moments = vertical @ feet
    if directions > 3:
        # A sole carries moments about its point, too.
        about_x, about_y, _ = contact_forces[:, :, 1].sum(axis=1).T
        moments += np.stack([-about_y, about_x], axis=1)
    along = np.hypot(along_x.sum(axis=1), along_y.sum(axis=1))
    return GroundForces(moments / weight[:, None], along / weight, forces - carried)


def distance_inside(points: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Return how far points are inside the polygon of feet, negative outside [m].

    Args:
        points: Points [samples 2] [m].
        feet: Feet that stand [feet 2] [m].
    """
    # Across the lines between any two feet, and all around.
    edges = (feet[:, None] - feet).reshape(-1, 2)
    edge_angles = np.arctan2(edges[:, 0], -edges[:, 1])
    angles = np.concatenate([DIRECTIONS, edge_angles])
    directions = np.stack([np.cos(angles), np.sin(angles)])
    border = (feet @ directions).max(axis=0)
    return (border - points @ directions).min(axis=1)
