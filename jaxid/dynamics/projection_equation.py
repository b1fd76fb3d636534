r"""The Projection Equation for one sample, on 3-vectors (Eqs. 1-12), written once.

One recursion from the ground to the tips gives every body's angular velocity, angular
acceleration and the acceleration $a = \dot v_o + \tilde\omega v_o - g$ of its origin,
in the body's own frame. That is all that the regressor of a body needs (Eq. 10). The
velocity of the origin itself is never formed: the Jacobian that projects it into the
space of the joints (Eqs. 5-7) is carried from body to body like a velocity. The scopes
name what is equal for all bodies but for its numbers, see `program.equal_parts`.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bodies, JointMatrix, Joints, Matrix3, Vector3
from jaxid.robot.forward_kinematics import placements
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.joint_coordinates import (
    all_accelerations,
    all_coordinates,
    all_rates,
    at_sample,
    on_coordinates,
    placement_in_parent,
)
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import skew


def body_motions(
    robot: Robot, q: Joints, qd: Joints, qdd: Joints
) -> list[tuple[Vector3, Vector3, Vector3]]:
    r"""Return $(a, \omega, \dot\omega)$ of every body in its own frame (Eqs. 6, 8).

    Returns:
        For each body the acceleration of its origin less gravity [m/s²], its angular
        velocity [rad/s] and its angular acceleration [rad/s²].
    """
    qdd = all_accelerations(robot, q, qd, qdd)
    qd = all_rates(robot, q, qd)
    q = all_coordinates(robot, q)
    ground = (-robot.gravity, np.zeros(3), np.zeros(3))
    motions: list[tuple[Vector3, Vector3, Vector3]] = [ground] * robot.bodies
    for i in robot.order:
        parent = robot.parent[i]
        a, w, wd = motions[parent] if parent >= 0 else ground
        with jax.named_scope(f"motion_{i}"):
            R, r = placement_in_parent(robot, i, q[i])
            axis = robot.axis[i]
            # The parent carries the body ...
            w_cross = skew(w)
            accelerations = skew(wd) + w_cross @ w_cross
            a = R.T @ (a + accelerations @ r)
            w_parent = R.T @ w
            wd_parent = R.T @ wd
            if i in robot.rigid:
                motions[i] = (a, w_parent, wd_parent)
                continue
            # ... and the joint moves it relative to the parent.
            rate = axis * qdd[i]
            turned_rate = jnp.cross(w_parent, axis) * qd[i]
            w = w_parent
            wd = wd_parent
            if robot.turns[i]:
                w = w + axis * qd[i]
                wd = wd + rate + turned_rate
            else:
                a = a + rate + 2.0 * turned_rate
        motions[i] = (a, w, wd)
    return motions


def partial_velocities(robot: Robot, q: Joints) -> Iterator[tuple[int, int, AnyArray]]:
    r"""Yield $\partial (v_o, \omega)_i / \partial \dot q_j$, the rows of $F_{o,i}^T$.

    Yields:
        For each body and each joint that moves it their numbers and the row (Eqs. 5,
        7).
    """
    q = all_coordinates(robot, q)
    rows: list[dict[int, AnyArray]] = [{} for _ in range(robot.bodies)]
    for i in robot.order:
        with jax.named_scope(f"motion_{i}"):
            R, r = placement_in_parent(robot, i, q[i])
        parent = robot.parent[i]
        carried_rows = rows[parent] if parent >= 0 else {}
        for j, row in carried_rows.items():
            with jax.named_scope(f"row_{i}_{j}"):
                v = row[:3]
                w = row[3:]
                velocity = R.T @ (v + skew(w) @ r)
                rows[i][j] = jnp.concatenate([velocity, R.T @ w])
        axis = robot.axis[i]
        directions = [np.zeros(3), axis] if robot.turns[i] else [axis, np.zeros(3)]
        rows[i][i] = jnp.concatenate(directions)
        for j, row in rows[i].items():
            yield i, j, row


def momentum_matrix(w: Vector3) -> AnyArray:
    r"""Return $[\Omega\;|\;-\hat\Omega]$: $(A, ..., F) \to J^o\omega$ (Eq. 9)."""
    x, y, z = w
    o = 0.0 * x
    rows = [
        [x, o, o, o, -z, -y],
        [o, y, o, -z, o, -x],
        [o, o, z, -y, -x, o],
    ]
    return jnp.array(rows)


def body_regressor(a: Vector3, w: Vector3, wd: Vector3) -> AnyArray:
    r"""Return the regressor $\bar\Theta_i$ of one free body (Eq. 10).

    Multiplied with the body's parameters $p_i = (m, m r_c, A, B, C, D, E, F)$ it gives
    the force [N] and the moment [N m] that the motion asks for at the body's origin, in
    the body's frame.

    Args:
        a: Acceleration of the origin less gravity [m/s²].
        w: Angular velocity [rad/s].
        wd: Angular acceleration [rad/s²].
    """
    w_cross = skew(w)
    accelerations = skew(wd) + w_cross @ w_cross
    momentum_rates = momentum_matrix(wd) + w_cross @ momentum_matrix(w)
    force = [a[:, None], accelerations, np.zeros((3, 6))]
    moment = [np.zeros((3, 1)), -skew(a), momentum_rates]
    return jnp.block([force, moment])


def rigid_body_regressor(robot: Robot, q: Joints, qd: Joints, qdd: Joints) -> AnyArray:
    r"""Return $\Theta_i = F_{o,i}^T \bar\Theta_i$ of every body (Eq. 11).

    Returns:
        For each joint (first axis) the columns of each body (second axis).
    """
    n = robot.bodies
    bodies = []
    for i, motion in enumerate(body_motions(robot, q, qd, qdd)):
        with jax.named_scope(f"body_{i}"):
            bodies.append(body_regressor(*motion))
    columns: list[list] = [[jnp.zeros(10)] * n for _ in range(n)]
    for i, j, row in partial_velocities(robot, q):
        with jax.named_scope(f"columns_{i}_{j}"):
            columns[j][i] = row @ bodies[i]
    rows = jnp.stack([jnp.stack(blocks) for blocks in columns])
    return on_coordinates(robot, q, rows)


def rigid_body_forces(
    robot: Robot, p: Bodies, q: Joints, qd: Joints, qdd: Joints
) -> Joints:
    r"""Return the forces $\sum_i F_{o,i}^T \bar\Theta_i p_i$ [N m or N] (Eq. 11)."""
    wrenches = []
    for i, motion in enumerate(body_motions(robot, q, qd, qdd)):
        with jax.named_scope(f"wrench_{i}"):
            wrenches.append(body_regressor(*motion) @ p[i])
    return joint_forces(robot, wrenches, q)


def joint_forces(robot: Robot, wrenches: list[AnyArray], q: Joints) -> Joints:
    r"""Project force and moment of each body on the joints: $\sum_i F_{o,i}^T w_i$.

    A body passes its wrench on to its parent, and each joint feels what passes it.
    """
    robot, y = at_sample(robot, q)
    q = all_coordinates(robot, y)
    wrenches = list(wrenches)
    forces: list[Any] = [None] * robot.bodies
    for i in reversed(robot.order):
        with jax.named_scope(f"motion_{i}"):
            R, r = placement_in_parent(robot, i, q[i])
        with jax.named_scope(f"force_{i}"):
            force = wrenches[i][:3]
            moment = wrenches[i][3:]
            forces[i] = robot.axis[i] @ (moment if robot.turns[i] else force)
            parent = robot.parent[i]
            if parent < 0:
                continue
            force = R @ force
            moment = R @ moment + jnp.cross(r, force)
            wrench = jnp.concatenate([force, moment])
            wrenches[parent] = wrenches[parent] + wrench
    return on_coordinates(robot, y, jnp.stack(forces))


def rigid_body_mass_matrix(robot: Robot, p: Bodies, q: Joints) -> JointMatrix:
    r"""Return the mass matrix $\sum_i F_{o,i}^T M_i F_{o,i}$ (Eq. 38).

    All bodies beyond a joint move as one when that joint alone moves. Mass, first
    moment and inertia of these composite bodies are summed from the tips to the ground;
    the wrench that one of them needs for a unit acceleration of its joint is carried to
    the ground and felt by every joint on the way.
    """
    n = robot.bodies
    robot, y = at_sample(robot, q)
    q = all_coordinates(robot, y)
    frames = []
    for i in range(n):
        with jax.named_scope(f"frame_{i}"):
            frames.append(placement_in_parent(robot, i, q[i]))
    bodies = composite_bodies(robot, p, frames)
    zero = jnp.zeros(())
    M: list[list] = [[zero] * n for _ in range(n)]
    for i in reversed(range(n)):
        m, h, J = bodies[i]
        axis = robot.axis[i]
        with jax.named_scope(f"start_{i}"):
            if robot.turns[i]:
                force = -jnp.cross(h, axis)
                moment = J @ axis
            else:
                force = m * axis
                moment = jnp.cross(h, axis)
        # Every joint on the way to the ground feels the wrench.
        j = i
        while j >= 0:
            R, r = frames[j]
            with jax.named_scope(f"entry_{i}_{j}"):
                component = moment if robot.turns[j] else force
                M[i][j] = M[j][i] = jnp.dot(robot.axis[j], component)
                force = R @ force
                moment = R @ moment + jnp.cross(r, force)
            j = robot.parent[j]
    rows = on_coordinates(robot, y, jnp.stack([jnp.stack(row) for row in M]))
    return on_coordinates(robot, y, rows.T).T


def composite_bodies(
    robot: Robot, p: Bodies, frames: list[tuple]
) -> list[tuple[AnyArray | float, Vector3, Matrix3]]:
    """Return mass, first moment and inertia of all that each joint carries."""
    bodies = []
    for numbers in p:
        tensor = inertia_tensor(numbers[4:])
        bodies.append((numbers[0], numbers[1:4], tensor))
    for i in reversed(robot.order):
        parent = robot.parent[i]
        if parent < 0:
            continue
        m, h, J = bodies[i]
        R, r = frames[i]
        with jax.named_scope(f"composite_{i}"):
            h = R @ h
            # Steiner, with r x h terms since h is measured from the body's own origin.
            r_cross = skew(r)
            h_cross = skew(h)
            shift = r_cross @ h_cross + h_cross @ r_cross + m * (r_cross @ r_cross)
            J = R @ J @ R.T - shift
            h = h + m * r
            m_parent, h_parent, J_parent = bodies[parent]
            bodies[parent] = (m_parent + m, h_parent + h, J_parent + J)
    return bodies


def potential_energy_columns(robot: Robot, q: Joints) -> AnyArray:
    r"""Return the potential energy $-g^T (m r_o + R m r_c)$ of unit parameters [J]."""
    rotations, origins = placements(robot, q)
    mass = -origins @ robot.gravity
    moment = -jnp.einsum("bij,i->bj", rotations, jnp.asarray(robot.gravity))
    return jnp.concatenate(
        [mass[:, None], moment, jnp.zeros((robot.bodies, 6))], axis=1
    )


def solve_symmetric(A: JointMatrix, b: Joints) -> Joints:
    r"""Solve $A x = b$ by $A = L D L^T$, without square roots or pivoting.

    Only the lower triangle of A, which is definite, is read. A program has no loops.
    """
    n = b.shape[0]
    L, LD = {}, {}
    for j in range(n):
        for i in range(j, n):
            entry = A[i, j]
            for k in range(j):
                entry = entry - LD[i, k] * L[j, k]
            LD[i, j] = entry
            if i > j:
                L[i, j] = entry / LD[j, j]

    # L y = b, then D z = y, then L^T x = z.
    x = [b[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - L[i, k] * x[k]
    for i in range(n):
        x[i] = x[i] / LD[i, i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - L[k, i] * x[k]
    return jnp.stack(x)
