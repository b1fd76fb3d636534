"""Descriptions of a robot with the same forces, of which one takes few operations.

Before the forces of a controller are traced, a description is chosen that leaves few of
them:

* matter on a joint's axis moves alike with the bodies on both sides of it, so that it
  is carried inward until nothing is left of it: what remains are the base parameters;
* the origin of a frame may lie anywhere on its joint's axis (where axes meet, forces
  vanish);
* the frame of the last body may be turned about its joint so that a first moment
  vanishes.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float, Joints, Vector3
from jaxid.dynamics import projection_equation
from jaxid.identification.consistency.pseudo_inertia import (
    inertial_parameters,
    pseudo_inertia,
)
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot

MIN_DISTANCE = 1e-9
"""Distance that is more than rounding [m]."""


@dataclasses.dataclass(frozen=True)
class Description:
    """One of many descriptions of the same robot, with the same forces.

    Attributes:
        robot: Joints and frames.
        bodies: Pseudo-inertias.
        zeros: Angles that are added to those of the joints [rad].
    """

    robot: Robot
    bodies: Float[np.ndarray, "joints 4 4"]
    zeros: Joints

    @property
    def cost(self) -> int:
        """Estimate of the operations: weighted numbers that are not zero."""
        robot = self.robot
        has_length = np.abs(np.asarray(robot.offset)) > 1e-12
        total = np.count_nonzero(self.bodies)
        for body, (*ancestors, _) in enumerate(robot.ancestors):
            # A length counts only in a frame that turns.
            if any(robot.revolute[ancestor] for ancestor in ancestors):
                total += 4 * has_length[body].any() + 6 * has_length[body].sum()
        return int(total)

    def forces(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> Joints:
        """Return the forces of the bodies at one sample [N m or N] (Eq. 11)."""
        p = inertial_parameters(_with_44_bits(self.bodies))
        angles = q + self.zeros
        return projection_equation.rigid_body_forces(self.robot, p, angles, qd, qdd)

    def carry_inward(self) -> "Description":
        """Move what moves like the parent to the parent: base parameters (Eq. 22).

        For a revolute joint that is matter on the axis (mass, first and second moment
        along it), for a prismatic one the second moments.
        """
        robot = self.robot
        bodies = self.bodies.copy()
        for body in reversed(range(robot.joints)):
            inertia = bodies[body]
            if robot.revolute[body]:
                shared = _on_axis(inertia, np.asarray(robot.axis[body]))
            else:
                shared = np.zeros((4, 4))
                shared[:3, :3] = inertia[:3, :3]
            bodies[body] = _without_rounding(inertia - shared, inertia)
            if robot.parent[body] >= 0:
                T = _transform(robot.rotation[body], robot.offset[body])
                bodies[robot.parent[body]] += T @ shared @ T.T
        return dataclasses.replace(self, bodies=bodies)

    def slide(self, body: int, distance: float) -> "Description":
        """Move the origin of a frame along its joint's axis by a distance [m].

        The bodies beyond stay where they are, and so does the matter of the body.
        """
        robot = self.robot
        shift = np.asarray(robot.axis[body]) * distance
        offset = np.array(robot.offset)
        offset[body] += np.asarray(robot.rotation[body]) @ shift
        for child, parent in enumerate(robot.parent):
            if parent == body:
                offset[child] -= shift
        bodies = self.bodies.copy()
        T = _transform(np.eye(3), -shift)
        bodies[body] = T @ bodies[body] @ T.T
        moved = robot.replace(offset=_without_rounding(offset, offset))
        return dataclasses.replace(self, robot=moved, bodies=bodies)

    def turn_last(self, body: int) -> "Description":
        """Turn the frame of a last body about its axis until a first moment is zero."""
        axis = np.asarray(self.robot.axis[body])
        inertia = self.bodies[body]
        moment = _across(axis, inertia[:3, 3])
        if np.linalg.norm(moment) == 0.0:
            return self
        # The moment is turned into the plane of the axis and of the coordinate axis
        # that is nearly at a right angle to it.
        coordinate = np.eye(3)[np.argmin(np.abs(axis))]
        direction = _across(axis, coordinate)
        direction /= np.linalg.norm(direction)
        sine = axis @ np.cross(direction, moment)
        angle = float(np.arctan2(sine, direction @ moment))

        T = _transform(Rotation.from_rotvec(-angle * axis).as_matrix(), np.zeros(3))
        bodies = self.bodies.copy()
        bodies[body] = _without_rounding(T @ inertia @ T.T, inertia)
        zeros = self.zeros.copy()
        zeros[body] += angle
        return dataclasses.replace(self, bodies=bodies, zeros=zeros)


def simplest_description(robot: Robot, parameters: BodyParameters) -> Description:
    """Return a description of a robot and its bodies that takes few operations."""
    inertias = np.asarray(pseudo_inertia(parameters))
    frames = Description(robot, inertias, np.zeros(robot.joints))
    description = frames.carry_inward()
    for body in range(robot.joints):
        for distance in _distances_to_neighbours(frames.robot, body):
            candidate = frames.slide(body, distance)
            if candidate.carry_inward().cost < description.cost:
                frames = candidate
                description = candidate.carry_inward()
    for body in set(range(robot.joints)) - set(robot.parent):
        if robot.revolute[body]:
            description = min(
                description, description.turn_last(body), key=lambda x: x.cost
            )
    return description


def _distances_to_neighbours(robot: Robot, body: int) -> list[float]:
    """Return the distances along the axis to the origins of parent and children."""
    if not robot.revolute[body]:
        return []
    offset = np.asarray(robot.offset)
    axis = np.asarray(robot.axis[body])
    axis_in_parent = np.asarray(robot.rotation[body]) @ axis
    distances = [-float(axis_in_parent @ offset[body])]
    for child, parent in enumerate(robot.parent):
        if parent == body:
            distances.append(float(axis @ offset[child]))
    distances = dict.fromkeys(distances)
    return [distance for distance in distances if abs(distance) > MIN_DISTANCE]


def _on_axis(
    inertia: Float[np.ndarray, "4 4"], axis: Vector3
) -> Float[np.ndarray, "4 4"]:
    """Return the part of a pseudo-inertia that a turn about an axis does not change."""
    part = np.zeros((4, 4))
    part[3, 3] = inertia[3, 3]
    part[:3, 3] = (axis @ inertia[:3, 3]) * axis
    part[3, :3] = part[:3, 3]
    part[:3, :3] = (axis @ inertia[:3, :3] @ axis) * np.outer(axis, axis)
    return part


def _across(axis: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the part of a vector at a right angle to a unit vector."""
    return vector - (axis @ vector) * axis


def _transform(rotation: AnyArray, position: AnyArray) -> Float[np.ndarray, "4 4"]:
    """Return the homogeneous matrix of a placement."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def _without_rounding(x: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Set to zero what is a rounding error of a difference of terms."""
    return np.where(np.abs(x) < 1e-13 * np.abs(terms).max(), 0.0, x)


def _with_44_bits(x: np.ndarray) -> np.ndarray:
    """Round numbers so that their sums are exact, and equal ones are found equal."""
    mantissa, exponent = np.frexp(x)
    return np.ldexp(np.round(mantissa * 2.0**44), exponent - 44)
