r"""Dynamics of the bodies as few operations on whole arrays, whatever the number of joints.

The Projection Equation of `projection_equation` follows the tree body by body: traced into scalar
operations it is the fastest program for many samples, but a long one. Here the same equations stand
in spatial vectors $(\omega; v)$ about the origin of the ground, in its axes, where the recursions
are products with the matrix that tells which bodies a joint moves (Featherstone, Rigid Body
Dynamics Algorithms, Secs. 2, 5, 6). This form compiles soon, is differentiated fast, and takes the
geometry as an input.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Joints
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.robot import Robot


_TENSORS = np.moveaxis(inertia_tensor(np.eye(6)), 0, -1)
"""Inertia tensors of unit moments (A, B, C, D, E, F), which stand along the last axis."""

Bodies = Float[AnyArray, "joints 10"]
Spatial = tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]
"""Angular and linear part of a motion; moment and force of a wrench; about the ground's origin."""


class GroundMotion(NamedTuple):
    """Placement and motion of all bodies, and what the joints do to them.

    Attributes:
        attitudes: Attitudes of the bodies.
        origins: Origins of the bodies [m].
        joints: Motion of the bodies beyond a joint at unit speed.
        velocities: Velocity of each body.
        accelerations: Acceleration of each body less gravity.
    """

    attitudes: Float[Array, "joints 3 3"]
    origins: Float[Array, "joints 3"]
    joints: Spatial
    velocities: Spatial
    accelerations: Spatial


def moved_by(robot: Robot) -> Float[np.ndarray, "joints joints"]:
    """Return 1 where a body (row) is moved by a joint (column), else 0."""
    moved = np.zeros((robot.joints, robot.joints))
    for body, chain in enumerate(robot.ancestors):
        moved[body, list(chain)] = 1.0
    return moved


def skew_all(a: Float[AnyArray, "joints 3"]) -> Float[Array, "joints 3 3"]:
    r"""Return the matrices $\tilde a$ with $\tilde a b = a \times b$ (Eq. 3)."""
    return jnp.cross(a[:, :, None], jnp.eye(3, dtype=a.dtype)[None], axis=1)


def all_placements(robot: Robot, q: Joints) -> tuple[Array, Array]:
    """Return attitudes and origins [m] of all bodies in the frame of the ground.

    Each turn doubles the number of joints that a placement passes over.
    """
    turns, axis = np.asarray(robot.revolute), jnp.asarray(robot.axis, q.dtype)
    angle = jnp.where(turns, q, 0.0)[:, None, None]
    along = axis[:, :, None] * axis[:, None, :]
    turn = along + jnp.cos(angle) * (jnp.eye(3, dtype=q.dtype)[None] - along) + jnp.sin(angle) * skew_all(axis)
    rotation = jnp.asarray(robot.rotation, q.dtype)
    slide = jnp.where(turns, 0.0, q)[:, None] * axis
    origins = jnp.asarray(robot.offset, q.dtype) + (rotation @ slide[:, :, None])[:, :, 0]
    placed = jnp.concatenate([rotation @ turn, origins[:, :, None]], axis=2)
    ground = jnp.eye(3, 4, dtype=q.dtype)[None]
    placed = jnp.concatenate([placed, ground])
    above = np.array([*robot.parent, -1])
    while (above >= 0).any():
        outer = jnp.tensordot(np.eye(len(above))[above].astype(q.dtype), placed, 1)
        joined = outer[:, :, :3] @ placed
        placed = joined.at[:, :, 3].add(outer[:, :, 3])
        above = above[above]
    return placed[:-1, :, :3], placed[:-1, :, 3]


def ground_motion(robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> GroundMotion:
    """Return placements, velocities and accelerations of all bodies."""
    R, o = all_placements(robot, q)
    axes = (R @ jnp.asarray(robot.axis, q.dtype)[:, :, None])[:, :, 0]
    turns, moved = np.asarray(robot.revolute)[:, None], moved_by(robot).astype(q.dtype)
    turning = jnp.where(turns, axes, 0.0)
    sliding = jnp.where(turns, jnp.cross(o, axes), axes)
    w, v = (moved @ (x * qd[:, None]) for x in (turning, sliding))
    turning_rate = jnp.cross(w, turning)
    sliding_rate = jnp.cross(w, sliding) + jnp.cross(v, turning)
    wd = moved @ (turning * qdd[:, None] + turning_rate * qd[:, None])
    a = moved @ (sliding * qdd[:, None] + sliding_rate * qd[:, None])
    a = a - jnp.asarray(robot.gravity, q.dtype)[None]
    return GroundMotion(R, o, (turning, sliding), (w, v), (wd, a))


def ground_inertias(p: Bodies, R: Array, o: Array) -> tuple[Array, Array, Array]:
    """Return masses, first moments and inertias of the bodies about the origin of the ground."""
    m, h = p[:, 0], (R @ p[:, 1:4, None])[:, :, 0]
    r, arm = skew_all(o), skew_all(h)
    J = R @ inertia_tensor(p[:, 4:]) @ jnp.swapaxes(R, 1, 2)
    return m, h + m[:, None] * o, J - r @ arm - arm @ r - m[:, None, None] * (r @ r)


def momentum(inertias: tuple[Array, Array, Array], motion: Spatial) -> Spatial:
    """Return the momentum of bodies, or the wrench that accelerates them from rest."""
    (m, h, J), (w, v) = inertias, motion
    return (J @ w[:, :, None])[:, :, 0] + jnp.cross(h, v), m[:, None] * v + jnp.cross(w, h)


def spatial_forces(robot: Robot, p: Bodies, q: Joints, qd: Joints, qdd: Joints) -> Joints:
    """Return the generalised forces of all bodies [N m or N] (Eq. 11)."""
    x = ground_motion(robot, q, qd, qdd)
    inertias = ground_inertias(p, x.attitudes, x.origins)
    (w, v), (angular, linear) = x.velocities, momentum(inertias, x.velocities)
    moment, force = momentum(inertias, x.accelerations)
    moment = moment + jnp.cross(w, angular) + jnp.cross(v, linear)
    force = force + jnp.cross(w, linear)
    carried = moved_by(robot).astype(q.dtype).T
    turning, sliding = x.joints
    return jnp.sum(turning * (carried @ moment) + sliding * (carried @ force), axis=1)


def spatial_mass_matrix(
    robot: Robot, p: Bodies, q: Joints
) -> Float[Array, "joints joints"]:
    """Return the mass matrix of the bodies by composite bodies (Eq. 38)."""
    rest = jnp.zeros_like(q)
    x, moved = ground_motion(robot, q, rest, rest), moved_by(robot).astype(q.dtype)
    inertias = ground_inertias(p, x.attitudes, x.origins)
    composite: tuple = tuple(jnp.tensordot(moved.T, part, 1) for part in inertias)
    angular, linear = momentum(composite, x.joints)
    turning, sliding = x.joints
    M = moved * (angular @ turning.T + linear @ sliding.T)
    return M + (M * (1.0 - np.eye(robot.joints, dtype=q.dtype))).T


def spatial_regressor(
    robot: Robot, q: Joints, qd: Joints, qdd: Joints
) -> Float[Array, "joints joints 10"]:
    """Return the regressor of every body (Eq. 11): joints, then bodies and their columns."""
    x = ground_motion(robot, q, qd, qdd)
    (w, v), (wd, a), R, o = x.velocities, x.accelerations, x.attitudes, x.origins
    # Acceleration of the bodies' own origins, then everything in the bodies' own axes (Eq. 10).
    a = a + jnp.cross(wd, o) + jnp.cross(w, v + jnp.cross(w, o))
    a, w, wd = (jnp.einsum("bji,bj->bi", R, y) for y in (a, w, wd))
    turn, tensors = skew_all(w), jnp.asarray(_TENSORS, q.dtype)
    of_w, of_wd = (jnp.einsum("abk,nb->nak", tensors, y) for y in (w, wd))
    nothing = jnp.zeros((len(q), 3, 6), q.dtype)
    force = jnp.concatenate([a[:, :, None], skew_all(wd) + turn @ turn, nothing], axis=2)
    parts = [nothing[:, :, :1], -skew_all(a), of_wd + turn @ of_w]
    moment = jnp.concatenate(parts, axis=2)
    force = R @ force
    moment = R @ moment + skew_all(o) @ force
    turning, sliding = x.joints
    found = jnp.einsum("ji,bik->jbk", turning, moment) + jnp.einsum("ji,bik->jbk", sliding, force)
    return moved_by(robot).T.astype(q.dtype)[:, :, None] * found
