r"""Eq. 39 in factored form: the torques by a recursion on base parameters, with few operations.

The regressor is never formed: accelerations go from the ground to the tips, wrenches come back.
What the robot *is* leaves freedom in how it is described, and a description is chosen in which the
recursion has the fewest operations:

* matter on a joint's axis moves alike with the bodies on both sides of it, so that it is carried
  inward until nothing is left of it: what remains are the base parameters;
* the origin of a frame may lie anywhere on its joint's axis (where axes meet, forces vanish);
* the frame of the last body may be turned about its joint so that a first moment vanishes;
* in a well chosen unit of length, lengths are one.

A body is its pseudo-inertia, the second moments $\Sigma = \int r r^T dm$ bordered by $m r_c$ and
$m$. With $U = \tilde{\dot\omega} + \tilde\omega \tilde\omega$ it asks for the force $m a + U m r_c$
and for the moment whose skew matrix is $U \Sigma - \Sigma U^T$ plus $m r_c \times a$, which equals
Eq. 10 and shares $U$ with the kinematics.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxid.arrays import Float
from jaxid.identification.consistency import pseudo_inertia
from jaxid.program import program_of_scalars
from jaxid.program.operation import Operation
from jaxid.program.scalar import apply
from jaxid.robot.robot import Robot

Entries = Any
"""A NumPy array of scalars of a program, or of numbers."""
_NOTHING = 1e-13
"""Of the largest entry of a body: what is smaller comes from rounding."""


@dataclasses.dataclass(frozen=True)
class Description:
    """One of many ways to describe the same robot; torques are the same in all.

    Attributes:
        robot: Joints and frames, in the unit of length.
        bodies: Pseudo-inertias.
        turned: What is added to each joint's angle [rad].
        unit: Unit of length [m].
    """

    robot: Robot
    bodies: Float[np.ndarray, "joints 4 4"]
    turned: Float[np.ndarray, " joints"]
    unit: float = 1.0

    @classmethod
    def of(cls, robot: Robot, parameters: Float[np.ndarray, "joints 10"]) -> "Description":
        """A robot as it is, with ten parameters for each body in the paper's order."""
        return cls(robot, pseudo_inertia(parameters), np.zeros(len(parameters)))

    @functools.cached_property
    def operations(self) -> int:
        """How many operations the recursion has in this description."""
        n = (self.robot.joints,)
        return program_of_scalars(self.torques, n, n, n).counts.total

    def torques(self, q: Entries, qd: Entries, qdd: Entries) -> Entries:
        """The generalized forces of the bodies at one sample [N m or N] (Eq. 39)."""
        robot, n = self.robot, self.robot.joints
        accelerations: list[Entries] = []
        spins: list[tuple[Entries, Entries, Entries]] = []
        places: list[tuple[Entries, Entries]] = []
        still = np.zeros(3)
        for i, parent in enumerate(robot.parent):
            a = accelerations[parent] if parent >= 0 else -np.asarray(robot.gravity)
            w, wd, U = spins[parent] if parent >= 0 else (still, still, np.zeros((3, 3)))
            R, r = self._placement(i, q[i])
            axis = np.asarray(robot.axis[i])
            a = R.T @ (a + U @ r)
            w, wd = R.T @ w, R.T @ wd
            if robot.revolute[i]:
                wd = wd + axis * qdd[i] + _cross(w, axis) * qd[i]
                w = w + axis * qd[i]
            else:
                speed, acceleration = self._scaled(qd[i]), self._scaled(qdd[i])
                a = a + axis * acceleration + 2.0 * _cross(w, axis) * speed
            W = _skew(w)
            accelerations.append(a)
            spins.append((w, wd, _skew(wd) + W @ W))
            places.append((R, r))
        wrenches = [
            self._wrench(i, a, w, U)
            for i, (a, (w, _, U)) in enumerate(zip(accelerations, spins, strict=True))
        ]
        torques = np.empty(n, object)
        for i in reversed(range(n)):
            force, moment = wrenches[i]
            axis, parent = np.asarray(robot.axis[i]), robot.parent[i]
            along = axis @ (moment if robot.revolute[i] else force)
            torques[i] = along if robot.revolute[i] else self._scaled(along)
            if parent >= 0:
                R, r = places[i]
                force = R @ force
                carried = R @ moment + _cross(r, force)
                wrenches[parent] = (wrenches[parent][0] + force, wrenches[parent][1] + carried)
        return torques

    def _scaled(self, x: Any) -> Any:
        return x if self.unit == 1.0 else x * (1.0 / self.unit)

    def _placement(self, body: int, q: Any) -> tuple[Entries, Entries]:
        robot = self.robot
        R, r, axis = (np.asarray(x[body]) for x in (robot.rotation, robot.offset, robot.axis))
        if not robot.revolute[body]:
            return R, r + R @ axis * self._scaled(q)
        angle = q if self.turned[body] == 0 else q + float(self.turned[body])
        along = axis[:, None] * axis[None, :]
        cosine, sine = apply(Operation.COSINE, angle), apply(Operation.SINE, angle)
        return R @ (along + (np.eye(3) - along) * cosine + _skew(axis) * sine), r

    def _wrench(self, body: int, a: Entries, w: Entries, U: Entries) -> tuple[Entries, Entries]:
        P = self.bodies[body]
        S, h, m = P[:3, :3], P[:3, 3], P[3, 3]
        squares = w * w
        moment = _cross(h, a).astype(object)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            moment[i] = (
                moment[i]
                + (U[k, j] * S[j, j] - U[j, k] * S[k, k])
                # U[k, k] - U[j, j] without the squares that cancel.
                + (squares[k] - squares[j]) * S[j, k]
                + (U[k, i] * S[i, j] - U[j, i] * S[i, k])
            )
        return a * m + U @ h, moment

    def carried_inward(self) -> "Description":
        """What moves alike with the parent belongs to the parent: the base parameters (Eq. 22).

        Of a body that turns that is matter on the axis (mass, first and second moment along it), of
        one that slides it is the second moments.
        """
        bodies, robot = self.bodies.copy(), self.robot
        for i in reversed(range(robot.joints)):
            axis, P, L = np.asarray(robot.axis[i]), bodies[i], np.zeros((4, 4))
            if robot.revolute[i]:
                L[3, 3] = P[3, 3]
                L[:3, 3] = L[3, :3] = (axis @ P[:3, 3]) * axis
                L[:3, :3] = (axis @ P[:3, :3] @ axis) * axis[:, None] * axis
            else:
                L[:3, :3] = P[:3, :3]
            largest = np.abs(P).max()
            bodies[i] = _without_rounding(P - L, largest)
            if robot.parent[i] >= 0:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = robot.rotation[i], robot.offset[i]
                bodies[robot.parent[i]] += T @ L @ T.T
        return dataclasses.replace(self, bodies=bodies)

    def slid(self, body: int, distance: float) -> "Description":
        """The origin of a frame moved along its joint's axis."""
        robot = self.robot
        axis, R = np.asarray(robot.axis[body]), np.asarray(robot.rotation[body])
        offset = np.array(robot.offset)
        offset[body] += R @ axis * distance
        for child, parent in enumerate(robot.parent):
            if parent == body:
                offset[child] -= axis * distance
        # What cancels must be zero, not 1e-17.
        offset = np.where(np.abs(offset) < 1e-14 * np.abs(offset).max(), 0.0, offset)
        bodies = self.bodies.copy()
        T = np.eye(4)
        T[:3, 3] = -axis * distance
        bodies[body] = T @ bodies[body] @ T.T
        return dataclasses.replace(self, robot=robot.replace(offset=offset), bodies=bodies)

    def with_last_turned(self, body: int) -> "Description":
        """The frame of a last body turned about its joint until a first moment is zero."""
        axis, P = np.asarray(self.robot.axis[body]), self.bodies[body]
        h = P[:3, 3] - (axis @ P[:3, 3]) * axis
        if np.linalg.norm(h) == 0.0:
            return self
        k = int(np.argmin(np.abs(axis)))
        wanted = np.eye(3)[k] - axis[k] * axis
        wanted /= np.linalg.norm(wanted)
        angle = float(np.arctan2(axis @ np.cross(wanted, h), wanted @ h))
        W = _skew(axis)
        T = np.eye(4)
        T[:3, :3] = np.eye(3) - np.sin(angle) * W + (1.0 - np.cos(angle)) * W @ W
        bodies, turned = self.bodies.copy(), self.turned.copy()
        bodies[body] = _without_rounding(T @ P @ T.T, np.abs(P).max())
        turned[body] += angle
        return dataclasses.replace(self, bodies=bodies, turned=turned)

    def in_unit(self, unit: float) -> "Description":
        """The same with another unit of length [m]; moments keep theirs."""
        robot, D = self.robot, np.diag([1.0, 1.0, 1.0, unit])
        offset, gravity = np.asarray(robot.offset) / unit, np.asarray(robot.gravity) / unit
        return dataclasses.replace(
            self,
            robot=robot.replace(offset=offset, gravity=gravity),
            bodies=D @ self.bodies @ D,
            unit=self.unit * unit,
        )


def simplest(description: Description) -> Description:
    """A description of the same robot in which the recursion has few operations."""
    best, base = description, description.carried_inward()
    base = base if base.operations <= best.operations else best
    for body in range(best.robot.joints):
        for distance in _distances(best.robot, body):
            other = best.slid(body, distance)
            carried = other.carried_inward()
            if carried.operations < base.operations:
                best, base = other, carried
    parents = set(base.robot.parent)
    for body in range(base.robot.joints):
        if body not in parents and base.robot.revolute[body]:
            other = base.with_last_turned(body)
            base = other if other.operations < base.operations else base
    for unit in _units(base.robot):
        other = base.in_unit(unit)
        base = other if other.operations < base.operations else base
    return base


def _distances(robot: Robot, body: int) -> Iterator[float]:
    """Where the origin comes nearest to that of the parent, or of a child."""
    if not robot.revolute[body]:
        return
    axis, R = np.asarray(robot.axis[body]), np.asarray(robot.rotation[body])
    found = [-float((R @ axis) @ robot.offset[body])]
    found += [float(axis @ robot.offset[c]) for c, p in enumerate(robot.parent) if p == body]
    yield from (x for x in dict.fromkeys(found) if abs(x) > 1e-9)


def _units(robot: Robot) -> list[float]:
    """The three lengths that come most often."""
    lengths = [round(float(abs(x)), 12) for x in np.ravel(robot.offset) if abs(x) > 1e-9]
    return sorted(set(lengths), key=lambda x: -lengths.count(x))[:3]


def _without_rounding(P: np.ndarray, largest: float) -> np.ndarray:
    return np.where(np.abs(P) < _NOTHING * largest, 0.0, P)


def _skew(a: Entries) -> Entries:
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _cross(a: Entries, b: Entries) -> Entries:
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
