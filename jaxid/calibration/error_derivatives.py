"""Errors of observations in many poses, and their derivatives by all unknowns.

Whatever moves a joint's origin moves all beyond it as one rigid body. So derivatives by
the origins follow from the placements, as those of a robot's end-effector by its joints
do; through JAX alone they take ten times as long, and their program ten times as long
to compile.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.robot.forward_kinematics import placements
from jaxid.robot.joint_coordinates import linear_ratios
from jaxid.robot.robot import Robot

from .frames import Frame, small_rotation
from .observations import ORIGIN, AbstractObservation

Kind = type[AbstractObservation]


class Unknowns(NamedTuple):
    """Values of all unknowns."""

    origins: Float[AnyArray, "bodies 6"]  # shifts [m] and turns [rad] of the joints
    compliances: Float[AnyArray, " joints"]  # [rad/(N m) or m/N]
    frames: Float[AnyArray, "frames 6"]  # corrections of the first estimates

    @property
    def vector(self) -> np.ndarray:
        """All numbers in one row."""
        return np.concatenate([np.ravel(part) for part in self])

    def of(self, vector: np.ndarray) -> "Unknowns":
        """Return unknowns of the same shapes."""
        sizes = [np.size(part) for part in self]
        parts = np.split(vector, np.cumsum(sizes)[:-1])
        pairs = zip(parts, self, strict=True)
        return Unknowns(*(part.reshape(np.shape(like)) for part, like in pairs))


class Poses(NamedTuple):
    """Poses of all observations of one kind, and what was measured in them."""

    q: AnyArray  # joint coordinates [rad or m]
    torques: AnyArray  # torques of gravity on the joints [N m or N]
    measured: AnyArray  # measured numbers
    deviations: AnyArray  # standard deviations of the errors
    tool: AnyArray  # indices of the frames of the tools
    place: AnyArray  # indices of the frames of the places
    session: AnyArray  # indices of the sessions
    number: AnyArray  # numbers of the poses in their observations, from 1


class PoseErrors(NamedTuple):
    """Errors of poses in units of their deviations, and their derivatives."""

    values: Float[AnyArray, "poses errors"]
    by_origins: Float[AnyArray, "poses errors bodies 6"]
    by_compliances: Float[AnyArray, "poses errors joints"]
    by_tool: Float[AnyArray, "poses errors 6"]
    by_place: Float[AnyArray, "poses errors 6"]


class CarrierMotion(NamedTuple):
    """Placement of the end-effector in one pose, and how unknowns move it.

    Attributes:
        carrier: End-effector on the ground.
        by_origins: Velocity and angular velocity by shifts and turns of the origins.
        by_compliances: The same by the compliances.
    """

    carrier: Frame
    by_origins: Float[AnyArray, "bodies 6 6"]
    by_compliances: Float[AnyArray, "joints 6"]


def corrected_robot(robot: Robot, origins: AnyArray) -> Robot:
    """Return the robot with shifted and turned origins of its joints."""
    shifts, turns = jnp.split(jnp.asarray(origins), 2, axis=1)
    rotations = jnp.asarray(robot.rotation)
    shifts_in_parents = jnp.einsum("bij,bj->bi", rotations, shifts)
    return robot.replace(
        offset=robot.offset + shifts_in_parents,
        rotation=rotations @ jax.vmap(small_rotation)(turns),
    )


@eqx.filter_jit
def pose_errors(
    kind: Kind, robot: Robot, unknowns: Unknowns, starts: Frame, poses: Poses
) -> PoseErrors:
    """Return errors of poses of one kind and their derivatives.

    Args:
        kind: Kind of the observations.
        robot: Nominal robot.
        unknowns: Unknowns.
        starts: First estimates of the frames.
        poses: Poses.
    """
    correct = corrected_robot(robot, unknowns.origins)
    axes = _correction_axes(robot, unknowns.origins)

    def of_pose(pose, tool, place, tool_start, place_start):
        motion = _carrier_motion(correct, axes, unknowns.compliances, pose)
        if not kind.has_poses:
            motion = jax.tree.map(jnp.zeros_like, motion)._replace(carrier=ORIGIN)

        def errors(velocity, turn, tool, place):
            R, position = motion.carrier
            carrier = Frame(small_rotation(turn) @ R, position + velocity)
            moved_tool = carrier @ tool_start.corrected(tool)
            moved_place = place_start.corrected(place)
            values = kind.errors(moved_tool, moved_place, pose.measured)
            return values / pose.deviations, values / pose.deviations

        rest = jnp.zeros(3)
        derivatives = jax.jacrev(errors, (0, 1, 2, 3), has_aux=True)
        (by_velocity, by_turn, by_tool, by_place), values = derivatives(
            rest, rest, tool, place
        )
        by_motion = jnp.concatenate([by_velocity, by_turn], axis=1)
        return PoseErrors(
            values,
            jnp.einsum("em,bcm->ebc", by_motion, motion.by_origins),
            by_motion @ motion.by_compliances.T,
            by_tool,
            by_place,
        )

    return jax.vmap(of_pose)(
        poses,
        unknowns.frames[poses.tool],
        unknowns.frames[poses.place],
        jax.tree.map(lambda x: x[poses.tool], starts),
        jax.tree.map(lambda x: x[poses.place], starts),
    )


def _correction_axes(robot: Robot, origins: AnyArray) -> tuple[Array, Array]:
    """Return directions of shifts and turns of the origins, along the parents' axes.

    A correction is a sum: the turn that is added acts after those that are there.
    """

    def turn_axes(turn):
        rotation = small_rotation(turn)
        slopes = jax.jacfwd(small_rotation)(turn)
        spins = jnp.einsum("ijk,lj->ilk", slopes, rotation)
        return jnp.stack([spins[2, 1], spins[0, 2], spins[1, 0]])

    rotations = jnp.asarray(robot.rotation)
    turns = jnp.asarray(origins)[:, 3:]
    return rotations, rotations @ jax.vmap(turn_axes)(turns)


def _carrier_motion(
    robot: Robot, axes: tuple[Array, Array], compliances: AnyArray, pose: Poses
) -> CarrierMotion:
    """Return where the end-effector is and how origins and compliances move it."""
    q = pose.q + compliances * pose.torques
    rotations, origins = placements(robot, q)
    tip = robot.tip_body
    carrier = Frame(rotations[tip], origins[tip]) @ Frame(
        robot.tip_rotation, robot.tip_offset
    )
    # The ground is the last frame.
    parents = np.array(robot.parent)
    parent_rotations = jnp.concatenate([rotations, np.eye(3)[None]])[parents]
    parent_origins = jnp.concatenate([origins, np.zeros((1, 3))])[parents]
    offsets = jnp.einsum("bij,bj->bi", parent_rotations, robot.offset)
    levers = carrier.position[None] - parent_origins - offsets
    is_in_chain = np.isin(np.arange(robot.bodies), robot.ancestors[tip]) + 0.0

    shift_axes, turn_axes = (parent_rotations @ x for x in axes)
    shifts = jnp.swapaxes(shift_axes, 1, 2)
    turns = jnp.swapaxes(turn_axes, 1, 2)
    by_shifts = jnp.concatenate([shifts, jnp.zeros_like(shifts)], axis=2)
    by_turns = _turn_motion(turns, levers[:, None])
    by_origins = jnp.concatenate([by_shifts, by_turns], axis=1)

    directions = jnp.einsum("bij,bj->bi", rotations, robot.axis)
    slides = jnp.concatenate([directions, jnp.zeros_like(directions)], axis=1)
    turns_or_not = np.array(robot.turns)[:, None]
    by_joints = jnp.where(turns_or_not, _turn_motion(directions, levers), slides)
    by_joints = by_joints * is_in_chain[:, None]
    ratios = linear_ratios(robot.followers, robot.joints)
    by_coordinates = ratios.T @ by_joints
    return CarrierMotion(
        carrier,
        by_origins * is_in_chain[:, None, None],
        by_coordinates * pose.torques[:, None],
    )


def _turn_motion(turns: AnyArray, levers: AnyArray) -> Array:
    """Return velocity and angular velocity of a point at a lever that turns."""
    return jnp.concatenate([jnp.cross(turns, levers), turns], axis=-1)
