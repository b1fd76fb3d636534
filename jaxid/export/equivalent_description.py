"""Descriptions of a robot with the same forces, of which one takes few operations.

Before the forces of a controller are traced, a description is chosen that leaves few of
them:

* matter on a joint's axis moves alike with the bodies on both sides of it, so that it
  is carried inward until nothing is left of it: what remains are the base parameters;
* the origin of a frame may lie anywhere on its joint's axis (where axes meet, forces
  vanish).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints, Matrix, Vector, Vector3
from jaxid.dynamics import projection_equation
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import skew

MIN_DISTANCE = 1e-9
"""Distance that is more than rounding [m]."""


class Description(NamedTuple):
    """One of many descriptions of the same robot, with the same forces."""

    robot: Robot  # joints and frames
    bodies: Float[np.ndarray, "bodies 4 4"]  # pseudo-inertias

    @property
    def cost(self) -> int:
        """Estimate of the operations: weighted numbers that are not zero."""
        robot = self.robot
        lengths = np.count_nonzero(np.abs(np.asarray(robot.offset)) > 1e-12, axis=1)
        total = int(np.count_nonzero(self.bodies))
        for body, (*ancestors, _) in enumerate(robot.ancestors):
            # A length counts only in a frame that turns.
            is_turned = any(robot.turns[ancestor] for ancestor in ancestors)
            if is_turned and lengths[body]:
                total += 4 + 6 * int(lengths[body])
        return total

    def forces(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> Joints:
        """Return the forces of the bodies at one sample [N m or N] (Eq. 11)."""
        motions = projection_equation.body_motions(self.robot, q, qd, qdd)
        pairs = zip(self.bodies, motions, strict=True)
        wrenches = [_wrench(inertia, *motion) for inertia, motion in pairs]
        return projection_equation.joint_forces(self.robot, wrenches, q)

    def carry_inward(self) -> "Description":
        """Move what moves like the parent to the parent: base parameters (Eq. 22).

        For a revolute joint that is matter on the axis (mass, first and second moment
        along it), for a prismatic one the second moments.
        """
        robot = self.robot
        bodies = self.bodies.copy()
        for body in reversed(robot.order):
            inertia = bodies[body]
            passed_inertia = np.zeros((4, 4))
            if robot.turns[body]:
                passed_inertia = _on_axis(inertia, np.asarray(robot.axis[body]))
            else:
                passed_inertia[:3, :3] = inertia[:3, :3]
            bodies[body] = _without_rounding(inertia - passed_inertia, inertia)
            parent = robot.parent[body]
            if parent >= 0:
                T = _transform(robot.rotation[body], robot.offset[body])
                bodies[parent] += T @ passed_inertia @ T.T
        return Description(robot, bodies)

    def slide(self, body: int, distance: float) -> "Description":
        """Move the origin of a frame along its joint's axis by a distance [m].

        The bodies beyond stay where they are, and so does the matter of the body.
        """
        robot = self.robot
        shift = np.asarray(robot.axis[body]) * distance
        offset = np.array(robot.offset)
        offset[body] += np.asarray(robot.rotation[body]) @ shift
        is_child = np.array(robot.parent) == body
        offset[is_child] -= shift
        bodies = self.bodies.copy()
        T = _transform(np.eye(3), -shift)
        bodies[body] = T @ bodies[body] @ T.T
        return Description(
            robot.replace(offset=_without_rounding(offset, offset)), bodies
        )


def simplest_description(robot: Robot, parameters: BodyParameters) -> Description:
    """Return a description of a robot and its bodies that takes few operations."""
    frames = Description(robot, np.asarray(pseudo_inertia(parameters)))
    description = frames.carry_inward()
    for body in range(robot.bodies):
        for distance in _distances_to_neighbours(frames.robot, body):
            candidate = frames.slide(body, distance)
            if candidate.carry_inward().cost < description.cost:
                frames = candidate
                description = candidate.carry_inward()
    return description


def _distances_to_neighbours(robot: Robot, body: int) -> list[float]:
    """Return the distances along the axis to the origins of parent and children."""
    if not robot.turns[body]:
        return []
    offset = np.asarray(robot.offset)
    axis = np.asarray(robot.axis[body])
    rotation = np.asarray(robot.rotation[body])
    axis_in_parent = rotation @ axis
    is_child = np.array(robot.parent) == body
    child_distances = offset[is_child] @ axis
    parent_distance = -float(axis_in_parent @ offset[body])
    distances = dict.fromkeys([parent_distance, *child_distances.tolist()])
    return [distance for distance in distances if abs(distance) > MIN_DISTANCE]


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


def _transform(rotation: AnyArray, position: AnyArray) -> Matrix:
    """Return the homogeneous matrix of a placement."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def _without_rounding(x: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Set to zero what is a rounding error of a difference of terms."""
    return np.where(np.abs(x) < 1e-13 * np.abs(terms).max(), 0.0, x)
