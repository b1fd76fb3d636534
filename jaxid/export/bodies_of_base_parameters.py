"""Bodies with the same forces as others, but with fewer numbers that are not zero.

Matter on a joint's axis moves alike with the bodies on both sides of it. It is carried
inward until nothing is left of it: what remains are the base parameters (Eq. 22), and
a program of the forces has few operations.
"""

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints, Matrix, Vector, Vector3
from jaxid.dynamics import projection_equation
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import skew

PseudoInertias = Float[np.ndarray, "bodies 4 4"]


def carry_inward(robot: Robot, parameters: BodyParameters) -> PseudoInertias:
    """Move what moves like the parent to the parent, from the tips to the ground.

    For a revolute joint that is matter on the axis (mass, first and second moment along
    it), for a prismatic one the second moments.
    """
    bodies = np.array(pseudo_inertia(parameters))
    for body in reversed(robot.order):
        inertia = bodies[body]
        passed_inertia = np.zeros((4, 4))
        if robot.turns[body]:
            passed_inertia = _on_axis(inertia, np.asarray(robot.axis[body]))
        else:
            passed_inertia[:3, :3] = inertia[:3, :3]
        remainder = inertia - passed_inertia
        rounding = 1e-13 * np.abs(inertia).max()
        bodies[body] = np.where(np.abs(remainder) < rounding, 0.0, remainder)
        parent = robot.parent[body]
        if parent >= 0:
            T = np.eye(4)
            T[:3, :3] = robot.rotation[body]
            T[:3, 3] = robot.offset[body]
            bodies[parent] += T @ passed_inertia @ T.T
    return bodies


def body_forces(
    robot: Robot, bodies: PseudoInertias, q: AnyArray, qd: AnyArray, qdd: AnyArray
) -> Joints:
    """Return the forces of the bodies at one sample [N m or N] (Eq. 11)."""
    motions = projection_equation.body_motions(robot, q, qd, qdd)
    pairs = zip(bodies, motions, strict=True)
    wrenches = [_wrench(inertia, *motion) for inertia, motion in pairs]
    return projection_equation.joint_forces(robot, wrenches, q)


def _wrench(inertia: Matrix, a: Vector3, w: Vector3, wd: Vector3) -> AnyArray:
    r"""Return force and moment at a body's origin, from its pseudo-inertia (Eq. 10).

    The moment is $\int r \times W r\,dm$ with $W = \hat{\dot\omega} + \omega \omega^T$,
    whose entries the force shares. That takes fewer operations than the regressor.

    Args:
        inertia: Pseudo-inertia, with zeros for what moves like the parent.
        a: Acceleration of the origin less gravity [m/s²].
        w: Angular velocity [rad/s].
        wd: Angular acceleration [rad/s²].
    """
    mass = inertia[3, 3]
    h = inertia[:3, 3]
    second_moments = inertia[:3, :3]
    accelerations = skew(wd) + skew(w) @ skew(w)
    force = mass * a + accelerations @ h

    # The diagonal counts by the differences of its entries only.
    off_diagonal_part = accelerations * (1.0 - np.eye(3))
    K = off_diagonal_part @ second_moments + jnp.outer(a, jnp.asarray(h))
    antisymmetric_difference = K - K.T
    squares = w * w
    # For each axis, the two axes that follow it.
    second_axes = np.array([1, 2, 0])
    third_axes = np.array([2, 0, 1])
    differences = squares[third_axes] - squares[second_axes]
    moment = antisymmetric_difference[third_axes, second_axes]
    moment = moment + second_moments[second_axes, third_axes] * differences
    return jnp.concatenate([force, moment])


def _on_axis(inertia: Matrix, axis: Vector) -> Matrix:
    """Return the part of a pseudo-inertia that a turn about an axis does not change."""
    # Mass, first and second moment along the axis stay where they are.
    basis = np.zeros((2, 4))
    basis[0, :3] = axis
    basis[1, 3] = 1.0
    moments = basis @ inertia @ basis.T
    return basis.T @ moments @ basis
