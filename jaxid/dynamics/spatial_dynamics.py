r"""Dynamics of the bodies by spatial vectors: few operations on whole arrays.

The Projection Equation of `projection_equation` follows the tree body by body: traced
into scalar operations it is the fastest program for many samples, but a long one. Here
the same equations stand in spatial vectors $(\omega; v)$ about the origin of the
ground, in its axes, where the recursions are products with the matrix that tells which
bodies a joint moves (Featherstone, Rigid Body Dynamics Algorithms, Secs. 2, 5, 6). This
form compiles soon, is differentiated fast, and takes the geometry as an input.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bodies, Float, Indices, JointMatrix, Joints
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.joint_coordinates import (
    all_accelerations,
    all_coordinates,
    all_rates,
    at_sample,
    on_coordinates,
)
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rotation_about

Spatial = Float[Array, "bodies 6"]


def _motion_products(skew: np.ndarray):
    r"""Return the matrices $v \times$ of unit motions, along the last axis."""
    products = np.zeros((6, 6, 6))
    products[:3, :3, :3] = skew
    products[3:, :3, 3:] = skew
    products[3:, 3:, :3] = skew
    return products


def _unit_inertias(skew: np.ndarray):
    r"""Return the inertias of unit parameters $(m, m r_c, A, B, C, D, E, F)$."""
    inertias = np.zeros((6, 6, 10))
    inertias[3:, 3:, 0] = np.eye(3)
    inertias[:3, 3:, 1:4] = skew
    inertias[3:, :3, 1:4] = -skew
    moments = np.asarray(inertia_tensor(np.eye(6)))
    inertias[:3, :3, 4:] = np.moveaxis(moments, 0, -1)
    return inertias


SKEW = np.stack([np.cross(axis, np.eye(3)).T for axis in np.eye(3)], axis=-1)
r"""Matrices $\tilde a$ of unit vectors, along the last axis."""
CROSS = _motion_products(SKEW)
INERTIA = _unit_inertias(SKEW)


def _combine(matrices: np.ndarray, x: AnyArray):
    """Return sums of constant matrices, weighted by the entries of each row of x."""
    return jnp.tensordot(x, jnp.asarray(matrices, x.dtype), (1, 2))


def _times(matrices: Array, x: Array):
    """Multiply a matrix and a vector for each body."""
    return jnp.einsum("nij,nj->ni", matrices, x)


def moved_by(robot: Robot, dtype: Any) -> Array:
    """Return 1 where a body (row) is moved by a joint (column), else 0."""
    is_moved = np.zeros((robot.bodies, robot.bodies))
    for body, chain in enumerate(robot.ancestors):
        is_moved[body, list(chain)] = 1.0
    return jnp.asarray(is_moved, dtype)


def all_placements(robot: Robot, q: Joints) -> Array:
    """Return the homogeneous placements of all bodies in the frame of the ground.

    Each turn of the loop doubles the number of joints that a placement passes over.
    """
    dtype = q.dtype
    # First in the frame of the parent, then in that of a body further above.
    bottom_rows = np.broadcast_to(np.eye(4)[3:], (robot.bodies, 1, 4))
    placements = jnp.concatenate(
        [_relative_placements(robot, q), jnp.asarray(bottom_rows, dtype)], axis=1
    )
    ancestors = np.array(robot.parent)
    while (ancestors >= 0).any():
        # The placements of the bodies above, for each body; the ground's is one.
        has_body = ancestors >= 0
        choice = np.eye(robot.bodies)[ancestors] * has_body[:, None]
        ground = np.eye(4) * ~has_body[:, None, None]
        choice = jnp.asarray(choice, dtype)
        placements_above = jnp.tensordot(choice, placements, 1)
        placements_above = placements_above + jnp.asarray(ground, dtype)
        placements = placements_above @ placements
        ancestors = np.where(has_body, ancestors[ancestors], -1)
    return placements


def _relative_placements(robot: Robot, q: Joints):
    """Return rotation and position of each body in its parent's frame."""
    dtype = q.dtype
    axis = jnp.asarray(robot.axis, dtype)
    offset = jnp.asarray(robot.offset, dtype)
    rotation = jnp.asarray(robot.rotation, dtype)
    q = all_coordinates(robot, q)
    if robot.virtual:
        q = q * _zeros_at(robot.virtual, robot, dtype)
    is_turning = np.array(robot.turns)
    rest = jnp.zeros_like(q)
    turns = jax.vmap(rotation_about)(axis, jnp.where(is_turning, q, rest))
    shifts = axis * jnp.where(is_turning, rest, q)[:, None]
    motions = jnp.concatenate([turns, shifts[:, :, None]], axis=2)
    last_column = ((0, 0), (0, 0), (3, 0))
    return rotation @ motions + jnp.pad(offset[:, :, None], last_column)


def _zeros_at(joints: Indices, robot: Robot, dtype: Any):
    """Return zero for some joints and one for all others."""
    factors = np.ones(robot.bodies)
    factors[list(joints)] = 0.0
    return jnp.asarray(factors, dtype)


class GroundMotion(NamedTuple):
    """Motion of all bodies in spatial vectors about the origin of the ground."""

    carry: Float[Array, "bodies 6 6"]  # wrenches of the bodies' frames to the ground
    joints: Spatial  # motions of what the joints move, at unit speed
    v: Spatial  # velocities of the bodies
    a: Spatial  # accelerations of the bodies, less gravity


def ground_motion(robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> GroundMotion:
    """Return placements, velocities and accelerations of all bodies."""
    dtype = q.dtype
    placements = all_placements(robot, q)
    R = placements[:, :3, :3]
    origins = placements[:, :3, 3]
    arm = _combine(SKEW, origins) @ R
    upper_rows = jnp.concatenate([R, arm], axis=2)
    lower_rows = jnp.concatenate([jnp.zeros_like(R), R], axis=2)
    carry = jnp.concatenate([upper_rows, lower_rows], axis=1)

    is_revolute = np.array(robot.turns)[:, None]
    axis = jnp.asarray(robot.axis, dtype)
    turning_axes = jnp.where(is_revolute, axis, 0.0)
    sliding_axes = jnp.where(is_revolute, 0.0, axis)
    angular_velocities = _times(R, turning_axes)
    linear_velocities = _times(arm, turning_axes) + _times(R, sliding_axes)
    joints = jnp.concatenate([angular_velocities, linear_velocities], axis=1)

    is_moved = moved_by(robot, dtype)
    if robot.rigid:
        joints_at_rest = _zeros_at(robot.rigid, robot, dtype)[: robot.joints]
        qd = qd * joints_at_rest
        qdd = qdd * joints_at_rest
    speeds = joints * all_rates(robot, q, qd)[:, None]
    # Sums over all joints that move a body replace the recursion along the tree.
    v = is_moved @ speeds
    crosses = _combine(CROSS, v)
    rates = joints * all_accelerations(robot, q, qd, qdd)[:, None]
    rates = rates + _times(crosses, speeds)
    a = is_moved @ rates
    gravity = jnp.concatenate([jnp.zeros(3, dtype), jnp.asarray(robot.gravity, dtype)])
    return GroundMotion(carry, joints, v, a - gravity[None])


def ground_inertias(p: Bodies, carry: Array) -> Array:
    """Return the spatial inertias of the bodies about the origin of the ground."""
    inertias = _combine(INERTIA, p)
    return carry @ inertias @ jnp.swapaxes(carry, 1, 2)


def spatial_forces(
    robot: Robot, p: Bodies, q: Joints, qd: Joints, qdd: Joints
) -> Joints:
    """Return the generalised forces of all bodies [N m or N] (Eq. 11)."""
    carry, joints, v, a = ground_motion(robot, q, qd, qdd)
    inertias = ground_inertias(p, carry)
    # The cross product of wrenches is that of motions, transposed and negative.
    momenta = _times(inertias, v)
    rates = jnp.einsum("nji,nj->ni", _combine(CROSS, v), momenta)
    wrenches = _times(inertias, a) - rates
    # A joint feels the wrenches of all bodies that it moves (Newton and Euler).
    moved_wrenches = moved_by(robot, q.dtype).T @ wrenches
    joint_forces = jnp.sum(joints * moved_wrenches, axis=1)
    return on_coordinates(robot, q, joint_forces)


def spatial_mass_matrix(robot: Robot, p: Bodies, q: Joints) -> JointMatrix:
    """Return the mass matrix of the bodies (Eq. 38)."""
    robot, q = at_sample(robot, q)
    standstill = jnp.zeros_like(q)
    motion = ground_motion(robot, q, standstill, standstill)
    inertias = ground_inertias(p, motion.carry)
    is_moved = moved_by(robot, q.dtype)
    # All bodies beyond a joint move as one when that joint alone moves.
    composite = jnp.tensordot(is_moved.T, inertias, 1)
    momenta = _times(composite, motion.joints)
    # A joint feels the momenta of those that it carries; the matrix is symmetric.
    products = momenta @ motion.joints.T
    lower_triangle = is_moved * products
    off_diagonal_mask = jnp.asarray(1.0 - np.eye(robot.bodies), q.dtype)
    matrix = lower_triangle + (lower_triangle * off_diagonal_mask).T
    rows = on_coordinates(robot, q, matrix)
    return on_coordinates(robot, q, rows.T).T


def spatial_regressor(robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> Array:
    """Return the regressor of every body (Eq. 11)."""
    carry, joints, v, a = ground_motion(robot, q, qd, qdd)
    # In the frames of the bodies, where the parameters are constant.
    body_transforms = jnp.swapaxes(carry, 1, 2)
    v_body = _times(body_transforms, v)
    a_body = _times(body_transforms, a)
    unit_inertias = jnp.asarray(INERTIA, q.dtype)
    momenta = jnp.einsum("ijk,nj->nik", unit_inertias, v_body)
    rates = jnp.einsum("ijk,nj->nik", unit_inertias, a_body)
    crosses = jnp.swapaxes(_combine(CROSS, v_body), 1, 2)
    body_wrenches = rates - crosses @ momenta
    wrenches = carry @ body_wrenches
    columns = jnp.einsum("js,bsk->jbk", joints, wrenches)
    # A joint feels only the bodies that it moves.
    is_moved = moved_by(robot, q.dtype).T
    return on_coordinates(robot, q, is_moved[:, :, None] * columns)
