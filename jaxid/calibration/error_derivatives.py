"""Errors of observations in many poses, and their derivatives by all unknowns.

Whatever moves a joint's origin moves all beyond it as one rigid body. So derivatives by
the origins follow from the placements, as those of a robot's end-effector by its joints
do; through JAX they take ten times as long, and their program seconds to compile.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Vector
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.joint_coordinates import linear_ratios
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import Rotations

from .frames import (
    ORIGIN,
    Frame,
    correction_rates,
    rigid_motions,
    rotation_errors,
)


class Unknowns(NamedTuple):
    """Values of all unknowns."""

    origins: Float[np.ndarray, "bodies 6"]  # shifts [m] and turns [rad] of the joints
    compliances: Float[np.ndarray, " joints"]  # [rad/(N m) or m/N]
    frames: Float[np.ndarray, "frames 6"]  # corrections of the first estimates

    @property
    def vector(self) -> Vector:
        """All numbers in one row."""
        return np.concatenate([np.ravel(part) for part in self])

    def of(self, vector: Vector) -> "Unknowns":
        """Return unknowns of the same shapes."""
        sizes = [np.size(part) for part in self]
        parts = np.split(vector, np.cumsum(sizes)[:-1])
        pairs = zip(parts, self, strict=True)
        return Unknowns(*(part.reshape(np.shape(like)) for part, like in pairs))


@dataclasses.dataclass(frozen=True, eq=False)
class Poses:
    """Poses of all observations, with what was measured in them.

    Attributes:
        q: Joint coordinates [rad or m].
        torques: Torques of gravity on the joints [N m or N].
        measured: Measured poses of the tool in the place.
        deviations: Standard deviations of their numbers; infinite if not measured.
        is_distance: Whether the first number is the distance of tool and place.
        is_pose: Whether the robot takes part: not in a distance of two places.
        tool: Indices of the frames of the tools.
        place: Indices of the frames of the places.
        session: Indices of the sessions.
        number: Numbers of the poses in their observations, from 1.
    """

    q: Float[np.ndarray, "poses joints"]
    torques: Float[np.ndarray, "poses joints"]
    measured: Frame
    deviations: Float[np.ndarray, "poses 6"]
    is_distance: np.ndarray
    is_pose: np.ndarray
    tool: np.ndarray
    place: np.ndarray
    session: np.ndarray
    number: np.ndarray


class PoseErrors(NamedTuple):
    """Errors of poses in units of their deviations, and their derivatives.

    Numbers that are not measured have no errors.

    Attributes:
        values: Errors of positions, then of attitudes.
        by_geometry: Derivatives by origins, then by compliances.
        by_tool: Derivatives by the correction of the tool.
        by_place: Derivatives by the correction of the place.
    """

    values: Float[np.ndarray, "poses 6"]
    by_geometry: Float[np.ndarray, "poses 6 unknowns"]
    by_tool: Float[np.ndarray, "poses 6 6"]
    by_place: Float[np.ndarray, "poses 6 6"]


def corrected_robot(robot: Robot, origins: Float[np.ndarray, "bodies 6"]) -> Robot:
    """Return the robot with shifted and turned origins of its joints."""
    frames = Frame(robot.rotation, robot.offset)
    frames = frames.corrected(origins)
    return robot.replace(offset=frames.position, rotation=frames.rotation)


def pose_errors(
    robot: Robot, unknowns: Unknowns, starts: Frame, poses: Poses
) -> PoseErrors:
    """Return the errors of poses and their derivatives.

    Args:
        robot: Nominal robot.
        unknowns: Unknowns.
        starts: First estimates of the frames.
        poses: Poses.
    """
    frames = starts.corrected(unknowns.frames)
    rates = correction_rates(unknowns.frames)
    q = poses.q + unknowns.compliances * poses.torques
    tips = tip_jacobian(corrected_robot(robot, unknowns.origins), q)
    is_pose = poses.is_pose[:, None]
    # A distance between two places has no end-effector.
    carrier = Frame(
        np.where(is_pose[..., None], tips.rotation, ORIGIN.rotation),
        np.where(is_pose, tips.position, ORIGIN.position),
    )
    tool = carrier @ frames.at(poses.tool)
    place = frames.at(poses.place)
    rays = tool.position - place.position

    levers = tool.position[:, None] - tips.origins
    motions = rigid_motions(tips.frames, levers) * is_pose[..., None, None]
    by_bodies = motions @ _unknown_motions(robot, unknowns)
    by_origins = by_bodies[..., :6].swapaxes(1, 2).reshape(len(q), 6, -1)
    by_joints = by_bodies[..., 6].swapaxes(1, 2)
    ratios = linear_ratios(robot.followers, robot.joints)
    by_compliances = by_joints @ ratios * poses.torques[:, None]
    by_geometry = np.concatenate([by_origins, by_compliances], axis=2)
    by_tool = rigid_motions(tool.rotation, np.zeros_like(rays)) @ rates[poses.tool]
    by_place = rigid_motions(place.rotation, rays) @ rates[poses.place]

    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    directions = rays / np.maximum(lengths, np.finfo(float).tiny)
    # The first axis of a distance points to the tool; the others do not matter.
    axes = np.where(
        poses.is_distance[:, None, None],
        directions[..., None] * np.eye(3)[0],
        place.rotation,
    )
    seen = (Frame(axes, place.position)).inverse @ tool
    turns = seen.rotation @ poses.measured.rotation.swapaxes(1, 2)
    values = np.concatenate(
        [seen.position - poses.measured.position, rotation_errors(turns)], axis=1
    )
    slopes = _error_slopes(axes, turns) / poses.deviations[..., None]
    return PoseErrors(
        values / poses.deviations,
        slopes @ by_geometry,
        slopes @ by_tool,
        -slopes @ by_place,
    )


def _unknown_motions(
    robot: Robot, unknowns: Unknowns
) -> Float[np.ndarray, "bodies 6 7"]:
    """Return shifts and turns of bodies' frames by their corrections and joints."""
    axes = robot.axis
    turns = np.array(robot.turns)[:, None]
    screws = np.concatenate([np.where(turns, 0.0, axes), turns * axes], axis=1)
    rates = correction_rates(unknowns.origins)
    return np.concatenate([rates, screws[..., None]], axis=2)


def _error_slopes(axes: np.ndarray, turns: Rotations) -> np.ndarray:
    """Return errors by velocity and angular velocity of the tool on the ground.

    Args:
        axes: Axes of the places.
        turns: Rotations between measured and computed attitudes.
    """
    rotations = axes.swapaxes(1, 2)
    traces = np.trace(turns, axis1=1, axis2=2)[:, None, None]
    sines = 0.5 * (traces * np.eye(3) - turns) @ rotations
    zeros = np.zeros_like(sines)
    return np.block([[rotations, zeros], [zeros, sines]])
