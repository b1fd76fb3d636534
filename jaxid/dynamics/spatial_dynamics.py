r"""Dynamics of the bodies as few operations on whole arrays, whatever the number of joints.

The Projection Equation of `projection_equation` follows the tree body by body: traced
into scalar operations it is the fastest program for many samples, but a long one. Here
the same equations stand in spatial vectors $(\omega; v)$ about the origin of the
ground, in its axes, where the recursions are products with the matrix that tells which
bodies a joint moves (Featherstone, Rigid Body Dynamics Algorithms, Secs. 2, 5, 6). This
form compiles soon, is differentiated fast, and takes the geometry as an input.
"""

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Joints
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.robot import Robot

Bodies = Float[AnyArray, "joints 10"]
Spatial = Float[Array, "joints 6"]


def _constants() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cross products of vectors and of motions, and inertias of unit parameters."""
    skew = np.stack([np.cross(e, np.eye(3)).T for e in np.eye(3)], axis=-1)
    crossing = np.zeros((6, 6, 6))
    crossing[:3, :3, :3] = crossing[3:, :3, 3:] = crossing[3:, 3:, :3] = skew
    inertia = np.zeros((6, 6, 10))
    inertia[3:, 3:, 0] = np.eye(3)
    inertia[:3, 3:, 1:4] = skew
    inertia[3:, :3, 1:4] = -skew
    inertia[:3, :3, 4:] = np.moveaxis(np.asarray(inertia_tensor(np.eye(6))), 0, -1)
    return skew, crossing, inertia


SKEW, CROSS, INERTIA = _constants()
r"""$\tilde a$ of unit vectors, $v \times$ of unit motions, and spatial inertias of unit parameters
$(m, m r_c, A, B, C, D, E, F)$, which stand along the last axis."""


def _combine(matrices: np.ndarray, x: AnyArray) -> Array:
    """Return sums of constant matrices, weighted by the entries of each row of x."""
    return jnp.tensordot(x, jnp.asarray(matrices, x.dtype), (1, 2))


def _times(matrices: Array, x: Array) -> Array:
    """Multiply a matrix and a vector for each body."""
    return jnp.einsum("nij,nj->ni", matrices, x)


def moved_by(robot: Robot) -> Float[np.ndarray, "joints joints"]:
    """Return 1 where a body (row) is moved by a joint (column), else 0."""
    moved = np.zeros((robot.joints, robot.joints))
    for body, chain in enumerate(robot.ancestors):
        moved[body, list(chain)] = 1.0
    return moved


def all_placements(robot: Robot, q: Joints) -> Float[Array, "joints 4 4"]:
    """Return the homogeneous placements of all bodies in the frame of the ground.

    Each turn of the loop doubles the number of joints that a placement passes over.
    """
    kind, dtype = np.array(robot.revolute, float)[:, None, None], q.dtype
    axis, rotation, offset = (
        jnp.asarray(x, dtype) for x in (robot.axis, robot.rotation, robot.offset)
    )
    turns, slides = jnp.asarray(kind, dtype), jnp.asarray(1.0 - kind, dtype)
    along = axis[:, :, None] * axis[:, None, :]
    across = turns * (jnp.eye(3, dtype=dtype)[None] - along)
    angle = q[:, None, None]
    turn = jnp.eye(3, dtype=dtype)[None] + (jnp.cos(angle) - 1) * across
    turn = turn + turns * jnp.sin(angle) * _combine(SKEW, axis)
    moved = jnp.concatenate([turn, slides * angle * axis[:, :, None]], axis=2)
    placed = rotation @ moved + jnp.pad(offset[:, :, None], ((0, 0), (0, 0), (3, 0)))
    bottom = np.broadcast_to(np.eye(4)[3:], (robot.joints, 1, 4))
    placed = jnp.concatenate([placed, jnp.asarray(bottom, dtype)], axis=1)
    above = np.array(robot.parent)
    while (above >= 0).any():
        # The rows of parents; the ground's is one.
        outer = jnp.asarray(np.eye(len(above))[above] * (above >= 0)[:, None], dtype)
        ground = np.eye(4) * (above < 0)[:, None, None]
        placed = (jnp.tensordot(outer, placed, 1) + jnp.asarray(ground, dtype)) @ placed
        above = np.where(above >= 0, above[above], -1)
    return placed


GroundMotion = tuple[Float[Array, "joints 6 6"], Spatial, Spatial, Spatial]
"""Matrices that carry wrenches from the bodies' frames to the ground (transposed, motions back);
motion of what a joint moves at unit speed; velocities, and accelerations less
gravity."""


def ground_motion(robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> GroundMotion:
    """Return placements, velocities and accelerations of all bodies."""
    placed, dtype = all_placements(robot, q), q.dtype
    R = placed[:, :3, :3]
    arm = _combine(SKEW, placed[:, :3, 3]) @ R
    carry = jnp.concatenate(
        [
            jnp.concatenate([R, arm], axis=2),
            jnp.concatenate([jnp.zeros_like(R), R], axis=2),
        ],
        axis=1,
    )
    turns, axis = np.array(robot.revolute)[:, None], jnp.asarray(robot.axis, dtype)
    turning, sliding = jnp.where(turns, axis, 0.0), jnp.where(turns, 0.0, axis)
    linear = _times(arm, turning) + _times(R, sliding)
    joints = jnp.concatenate([_times(R, turning), linear], axis=1)
    moved = jnp.asarray(moved_by(robot), dtype)
    speeds = joints * qd[:, None]
    v = moved @ speeds
    a = moved @ (joints * qdd[:, None] + _times(_combine(CROSS, v), speeds))
    gravity = jnp.concatenate([jnp.zeros(3, dtype), jnp.asarray(robot.gravity, dtype)])
    return carry, joints, v, a - gravity[None]


def ground_inertias(p: Bodies, carry: Array) -> Float[Array, "joints 6 6"]:
    """Return the spatial inertias of the bodies about the origin of the ground."""
    return carry @ _combine(INERTIA, p) @ jnp.swapaxes(carry, 1, 2)


def spatial_forces(
    robot: Robot, p: Bodies, q: Joints, qd: Joints, qdd: Joints
) -> Joints:
    """Return the generalised forces of all bodies [N m or N] (Eq. 11)."""
    x = ground_motion(robot, q, qd, qdd)
    return _projected_wrenches(robot, ground_inertias(p, x[0]), x)


def spatial_mass_and_bias(
    robot: Robot, p: Bodies, q: Joints, qd: Joints
) -> tuple[Float[Array, "joints joints"], Joints]:
    """Return the mass matrix of the bodies by composite bodies, and the bias forces (Eq. 38)."""
    x = ground_motion(robot, q, qd, jnp.zeros_like(q))
    inertias, moved = ground_inertias(p, x[0]), jnp.asarray(moved_by(robot), q.dtype)
    composite = jnp.tensordot(moved.T, inertias, 1)
    M = moved * (_times(composite, x[1]) @ x[1].T)
    M = M + (M * jnp.asarray(1.0 - np.eye(len(q)), q.dtype)).T
    return M, _projected_wrenches(robot, inertias, x)


def _projected_wrenches(robot: Robot, inertias: Array, x: GroundMotion) -> Joints:
    _, joints, v, a = x
    rates = jnp.einsum("nji,nj->ni", _combine(CROSS, v), _times(inertias, v))
    wrenches = _times(inertias, a) - rates
    beyond = jnp.asarray(moved_by(robot).T, joints.dtype) @ wrenches
    return jnp.sum(joints * beyond, axis=1)


def spatial_regressor(
    robot: Robot, q: Joints, qd: Joints, qdd: Joints
) -> Float[Array, "joints joints 10"]:
    """Return the regressor of every body (Eq. 11): joints, then bodies and their columns."""
    carry, joints, v, a = ground_motion(robot, q, qd, qdd)
    v, a = (jnp.einsum("nji,nj->ni", carry, x) for x in (v, a))
    unit = jnp.asarray(INERTIA, q.dtype)
    momenta, rates = (jnp.einsum("ijk,nj->nik", unit, x) for x in (v, a))
    wrenches = rates - jnp.swapaxes(_combine(CROSS, v), 1, 2) @ momenta
    found = jnp.einsum("js,bsk->jbk", joints, carry @ wrenches)
    return jnp.asarray(moved_by(robot).T, q.dtype)[:, :, None] * found
