"""Forces of contacts with the ground: what they do to the joints, and rows without."""

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.robot.contacts import legs_of
from jaxid.robot.forward_kinematics import TipJacobian, tip_jacobian
from jaxid.robot.robot import Robot

from .motion import Motion


def contact_tips(robot: Robot, q: AnyArray) -> list[TipJacobian]:
    """Return placements of each contact, and their derivatives.

    Args:
        robot: Robot with contacts.
        q: Coordinates [samples joints].
    """
    feet = [
        robot.replace(tip_body=contact.body, tip_offset=contact.position)
        for contact in robot.contacts
    ]
    return [tip_jacobian(foot, np.asarray(q)) for foot in feet]


def contact_jacobians(
    robot: Robot, tips: list[TipJacobian], up: AnyArray
) -> list[np.ndarray]:
    """Return for each contact the motions on which its forces do work.

    Args:
        robot: Robot with contacts.
        tips: Placements of the contacts.
        up: Unit vector against gravity in the frame of the base [samples 3].

    Returns:
        Jacobians [samples joints forces].
    """
    # Joints in the order of their numbers.
    order = np.argsort(robot.order)
    jacobians = []
    for contact, tip in zip(robot.contacts, tips, strict=True):
        velocity = tip.velocity[:, order]
        turn = tip.turn[:, order]
        jacobians.append(contact.shape.jacobian(velocity, turn, up))
    return jacobians


def elimination(
    robot: Robot, q: AnyArray, up: AnyArray, stands: AnyArray
) -> np.ndarray:
    """Return $X$ of all legs at many samples, zero where a foot does not stand.

    Args:
        robot: Robot with contacts.
        q: Coordinates [samples joints].
        up: Unit vector against gravity in the frame of the base [samples 3].
        stands: Whether each contact stands [samples contacts].

    Returns:
        Entries of $X$, row by row [samples entries].
    """
    legs = legs_of(robot)
    matrices = []
    tips = contact_tips(robot, q)
    jacobians = contact_jacobians(robot, tips, up)
    for number, jacobian in enumerate(jacobians):
        own_joints = list(legs.own_joints[number])
        force_of_leg = np.linalg.pinv(jacobian[:, own_joints])
        X = jacobian[:, list(legs.rows)] @ force_of_leg
        matrices.append(np.where(stands[:, number, None, None], X, 0.0))
    return np.concatenate(matrices, axis=2).reshape(len(q), -1)


def contact_mask(robot: Robot, motion: Motion) -> np.ndarray:
    """Return the rows that count: not those of the joints of legs that stand."""
    mask = np.ones(motion.q.shape, bool)
    if motion.contacts is not None:
        legs = legs_of(robot)
        X = motion.contacts.reshape(len(mask), len(legs.rows), len(legs.joints))
        mask[:, list(legs.joints)] = (X == 0.0).all(axis=1)
    return mask
