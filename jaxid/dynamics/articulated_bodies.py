r"""Accelerations that forces cause, by articulated bodies, for one sample (Eq. 38).

The bodies beyond a joint answer a push as one body whose inertia has six rows: an
articulated body (Featherstone, Rigid Body Dynamics Algorithms, Sec. 7.3). One recursion
from the tips to the ground finds these inertias, one from the ground to the tips the
accelerations: no mass matrix is formed or factorised, and the number of operations is
proportional to that of the joints. As in `projection_equation`, all is in the frames of
the bodies, and the acceleration of an origin is $a = \dot v_o + \tilde\omega v_o - g$,
so that no velocity of an origin is needed. The scopes name what is equal for all bodies
but for its numbers, see `program.equal_parts`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bodies, Joints, Matrix3, Vector3
from jaxid.robot.forward_kinematics import placement_in_parent
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import skew


class RelativeMotion(NamedTuple):
    """Motion of a body relative to its parent, apart from its joint's acceleration.

    Attributes:
        R: Attitude in the parent.
        r: Origin in the parent [m].
        w: Angular velocity of the body [rad/s].
        a: Acceleration of the origin that speeds cause [m/s²].
        wd: Angular acceleration that speeds cause [rad/s²].
    """

    R: Matrix3
    r: Vector3
    w: Vector3
    a: Vector3
    wd: Vector3


class ArticulatedBody(NamedTuple):
    r"""Wrench for a motion: $(M a + L \dot\omega + f, L^T a + N \dot\omega + n)$.

    Attributes:
        M: Factor of the acceleration in the force [kg].
        L: Factor of the angular acceleration in the force [kg m].
        N: Factor of the angular acceleration in the moment [kg m²].
        f: Force without accelerations [N].
        n: Moment without accelerations [N m].
    """

    M: Matrix3
    L: Matrix3
    N: Matrix3
    f: Vector3
    n: Vector3


class JointAnswer(NamedTuple):
    r"""Acceleration of a joint: $\ddot q = e - k_a^T a - k_\omega^T \dot\omega$.

    Attributes:
        e: Acceleration by the forces alone [rad/s² or m/s²].
        k_a: Factor of the acceleration of the body, had the joint none.
        k_w: Factor of its angular acceleration.
    """

    e: AnyArray
    k_a: Vector3
    k_w: Vector3


def rigid_body_accelerations(
    robot: Robot, p: Bodies, rotors: Joints, q: Joints, qd: Joints, forces: Joints
) -> Joints:
    """Return the accelerations of the joints [rad/s² or m/s²] (Eq. 38).

    Args:
        robot: Robot without followers.
        p: Parameters of the bodies.
        rotors: Inertias of the joints themselves [kg m² or kg].
        q: Joint coordinates.
        qd: Joint velocities.
        forces: Generalised forces that act on the bodies and rotors [N m or N].
    """
    motions = relative_motions(robot, q, qd)
    loads: list = [None] * robot.bodies
    answers: list = [None] * robot.bodies
    for i in reversed(robot.order):
        with jax.named_scope(f"momentum_{i}"):
            body = _free_body(p[i], motions[i].w)
        with jax.named_scope(f"articulated_{i}"):
            body = _sum(body, loads[i])
            direction = _direction(robot, i)
            answers[i], body = _through_joint(
                body, motions[i], direction, rotors[i], forces[i]
            )
            parent = robot.parent[i]
            if parent >= 0:
                load = _in_parent(body, motions[i])
                loads[parent] = _sum(load, loads[parent])
    return _accelerations(robot, motions, answers)


def relative_motions(robot: Robot, q: Joints, qd: Joints) -> list[RelativeMotion]:
    """Return the motions of all bodies relative to their parents."""
    velocities: list = [np.zeros(3)] * robot.bodies
    motions: list = [None] * robot.bodies
    for i in robot.order:
        parent = robot.parent[i]
        w_parent = velocities[parent] if parent >= 0 else np.zeros(3)
        with jax.named_scope(f"motion_{i}"):
            R, r = placement_in_parent(robot, i, q[i])
            axis = robot.axis[i]
            a = R.T @ jnp.cross(w_parent, jnp.cross(w_parent, r))
            w = R.T @ w_parent
            wd = jnp.zeros(3)
            if i not in robot.rigid:
                turned_rate = jnp.cross(w, axis) * qd[i]
                if robot.turns[i]:
                    wd = turned_rate
                    w = w + axis * qd[i]
                else:
                    a = a + 2.0 * turned_rate
        velocities[i] = w
        motions[i] = RelativeMotion(R, r, w, a, wd)
    return motions


def _free_body(p: AnyArray, w: Vector3) -> ArticulatedBody:
    """Return a body whose joints are all free."""
    h = p[1:4]
    J = inertia_tensor(p[4:])
    force = jnp.cross(w, jnp.cross(w, h))
    moment = jnp.cross(w, J @ w)
    return ArticulatedBody(p[0] * np.eye(3), -skew(h), J, force, moment)


class Direction(NamedTuple):
    """Acceleration of a body for a unit acceleration of its joint.

    Attributes:
        a: Axis of a joint that slides, else zero.
        wd: Axis of a joint that turns, else zero.
    """

    a: Vector3
    wd: Vector3


def _direction(robot: Robot, i: int) -> Direction:
    """Return the direction of a joint."""
    axis = robot.axis[i]
    zero = np.zeros(3)
    return Direction(zero, axis) if robot.turns[i] else Direction(axis, zero)


def _through_joint(
    body: ArticulatedBody,
    motion: RelativeMotion,
    direction: Direction,
    rotor: AnyArray,
    joint_force: AnyArray,
) -> tuple[JointAnswer, ArticulatedBody]:
    """Return the answer of a joint, and the body as its parent feels it."""
    force, moment = _wrench(body, direction.a, direction.wd)
    inertia = _power(direction, force, moment) + rotor
    rest_force = _power(direction, body.f, body.n)
    answer = JointAnswer(
        e=(joint_force - rest_force) / inertia,
        k_a=force / inertia,
        k_w=moment / inertia,
    )
    # The joint gives way: it takes its direction out of the inertia.
    M_lost = _outer(force, answer.k_a)
    L_lost = _outer(force, answer.k_w)
    N_lost = _outer(moment, answer.k_w)
    remainder = ArticulatedBody(
        M=symmetric(body.M - M_lost),
        L=body.L - L_lost,
        N=symmetric(body.N - N_lost),
        f=body.f + force * answer.e,
        n=body.n + moment * answer.e,
    )
    # Speeds accelerate the body without its joint.
    speed_force, speed_moment = _wrench(remainder, motion.a, motion.wd)
    f = remainder.f + speed_force
    n = remainder.n + speed_moment
    return answer, remainder._replace(f=f, n=n)


def _wrench(body: ArticulatedBody, a: Vector3, wd: Vector3) -> tuple[Vector3, Vector3]:
    """Return force and moment that accelerations take, beside those without any."""
    force = body.M @ a + body.L @ wd
    moment = body.L.T @ a + body.N @ wd
    return force, moment


def _power(direction: Direction, force: Vector3, moment: Vector3) -> AnyArray:
    """Return the part of a force and a moment that a joint feels."""
    return direction.a @ force + direction.wd @ moment


def _in_parent(body: ArticulatedBody, motion: RelativeMotion) -> ArticulatedBody:
    """Return a body in the frame of its parent."""
    R = motion.R
    r = motion.r
    r_cross = skew(r)
    M = symmetric(R @ body.M @ R.T)
    L_turned = R @ body.L @ R.T
    L = L_turned - M @ r_cross
    N = R @ body.N @ R.T - L_turned.T @ r_cross + r_cross @ L
    f = R @ body.f
    n = R @ body.n + jnp.cross(r, f)
    return ArticulatedBody(M, L, symmetric(N), f, n)


def _sum(body: ArticulatedBody, load: ArticulatedBody | None) -> ArticulatedBody:
    """Return a body with what it carries as one."""
    return body if load is None else jax.tree.map(jnp.add, body, load)


def _accelerations(
    robot: Robot, motions: list[RelativeMotion], answers: list[JointAnswer]
) -> Joints:
    """Return the accelerations of the joints, from the ground to the tips."""
    ground = (-robot.gravity, np.zeros(3))
    body_accelerations: list = [ground] * robot.bodies
    accelerations: list = [None] * robot.bodies
    for i in robot.order:
        parent = robot.parent[i]
        a, wd = body_accelerations[parent] if parent >= 0 else ground
        R, r = motions[i].R, motions[i].r
        with jax.named_scope(f"acceleration_{i}"):
            a = R.T @ (a + jnp.cross(wd, r)) + motions[i].a
            wd = R.T @ wd + motions[i].wd
            e, k_a, k_w = answers[i]
            accelerations[i] = e - k_a @ a - k_w @ wd
            direction = _direction(robot, i)
            a = a + direction.a * accelerations[i]
            wd = wd + direction.wd * accelerations[i]
        body_accelerations[i] = (a, wd)
    return jnp.stack(accelerations)


def _outer(a: Vector3, b: Vector3) -> Matrix3:
    """Return the products of all entries of two vectors."""
    return a[:, None] * b[None]


def symmetric(A: Matrix3) -> Matrix3:
    """Return a matrix whose lower triangle is the upper one: half the operations."""
    upper_triangle = jnp.triu(A)
    return upper_triangle + jnp.triu(A, 1).T
