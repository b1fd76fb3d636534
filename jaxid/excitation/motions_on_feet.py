"""Motions of a robot on its feet: phases from standstill to standstill.

In the first phase all feet stand and the trunk moves. In each of the others the trunk
leans over all feet but one, which is lifted and moves in the air. Fourier series, which
fade in and out, tell the path of the zero-moment point, and the motion of the trunk, of
a foot in the air and of other joints. Feet that stand stay where they are by inverse
kinematics, and the trunk is shifted so that the zero-moment point follows its path.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.leg_kinematics import (
    FootPlaces,
    find_legs,
    foot_places,
    place_feet,
    pose_joints,
    standing_pose,
)
from jaxid.robot.virtual_joints import GROUP
from jaxid.trajectory.motion_on_feet import MotionOnFeet
from jaxid.trajectory.spline import (
    PiecewisePolynomial,
    interpolate_at_rest,
    spline_polynomials,
)

from .ground_forces import (
    GroundForces,
    distance_inside,
    ground_forces,
    measured_motion,
)

NODE_STEP = 0.04
"""Largest time between two poses of the inverse kinematics [s]."""
REST_SHARE = 0.05
"""Part of a phase at either end in which the robot hardly moves."""
LEAN_SHARE = 0.2
"""Part of a phase after which the weight is on the other feet, and before its way back.
"""
LIFT_SHARE = 0.1
"""Part of a phase in which a foot is lifted after that, and in which it is lowered."""
SLOPES = (0.5, 2.0)
"""Exponents of the velocity's amplitudes as powers of the harmonic's number."""
BALANCING_STEPS = 3
"""Shifts of the trunk after which the zero-moment point follows its path."""
CENTRING_STEPS = 3
"""Shifts of the trunk after which the standing robot is above the middle of its feet.
"""
STANDARD_GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""


class Sizes(NamedTuple):
    """Largest sizes of random motions, before they are made smaller to keep limits.

    Lengths of trunk and feet are fractions of the height of the trunk.

    Attributes:
        path: Shift of the zero-moment point, relative to its distance from the border
            of the feet.
        trunk: Shift of the trunk along z, and turn about x, y, z [rad].
        trunk_on_fewer_feet: Size where a foot is lifted, relative to that on all feet.
        other_joints: Size of joints of no leg [rad or m].
        foot: Shift of a foot in the air along x and y, the logarithm of its height over
            the mean one, and its turn [rad].
        lift: Mean height of a foot in the air.
    """

    path: float = 0.5
    trunk: tuple[float, ...] = (0.1, 0.2, 0.2, 0.25)
    trunk_on_fewer_feet: float = 0.5
    other_joints: float = 0.4
    foot: tuple[float, ...] = (0.3, 0.25, 0.5, 0.3, 0.3, 0.3)
    lift: float = 0.25


SIZES = {3: Sizes(), 6: Sizes(foot=(0.12, 0.06, 0.5, 0.2, 0.2, 0.2), lift=0.1)}
"""Sizes for robots with ball feet and with soles, by the coordinates of a foot."""


class Standing(NamedTuple):
    """How a robot stands, and what keeps it from falling.

    Attributes:
        parameters: Nominal values of the base parameters, which tell its weight.
        pose: Angles of the joints whose names contain a word, like `{"knee": 0.9}`.
            Where it names no joint of a leg, the knees are bent above the feet.
        friction: Coefficient of friction between feet and ground.
        margin: Least distance of the zero-moment point from the border of the feet that
            stand, relative to that of their middle.
        sole_radius: Radius of a circle about the point of a sole that surely touches
            the ground [m].
        force_margin: Share of the largest forces to keep free.
    """

    parameters: AnyArray
    pose: Mapping[str, float] | None = None
    friction: float = 0.5
    margin: float = 0.35
    sole_radius: float = 0.03
    force_margin: float = 0.0


class Phase(NamedTuple):
    """Motion of one phase.

    Attributes:
        number: 0 where all feet stand; else the number of the foot in the air, from 1.
        coefficients: Numbers from which it is made.
        spline: Motion of trunk and joints on the ground; None if a leg cannot reach.
    """

    number: int
    coefficients: np.ndarray
    spline: Any

    def motion(self, times: AnyArray) -> Motion:
        """Return the motion of trunk and joints at times from its start [s]."""
        return Motion(*(self.spline(times, order) for order in range(3)))


def smooth_step(x: AnyArray) -> np.ndarray:
    """Return a step from 0 to 1 between 0 and 1, at rest at both ends."""
    u = np.clip(x, 0.0, 1.0)
    return 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5


class MotionsOnFeet:
    """All motions from which a design chooses.

    Args:
        base: Base parameters of the robot.
        standing: How it stands.
        harmonics: Number of harmonics of the series.
        omega: Ground frequency of the series: a phase takes one period [rad/s].

    Attributes:
        legs: Legs of the robot.
        pose: Standing pose.
        phases: Number of phases.
        sizes: Largest sizes of random motions.

    Raises:
        InputError: If the robot cannot stand.
    """

    def __init__(
        self, base: BaseParameters, standing: Standing, harmonics: int, omega: float
    ):
        self.base = base
        self.standing = standing
        self.robot = base.model.robot
        self.legs = find_legs(self.robot)
        self.phases = 1 + len(self.legs)
        self.sizes = SIZES[self.legs[0].directions]
        self.duration = 2.0 * np.pi / omega
        count = int(np.ceil(self.duration / NODE_STEP))
        self.times = np.linspace(0.0, self.duration, count + 1)
        self.orders = np.arange(1.0, harmonics + 1.0)
        angles = omega * np.outer(self.times, self.orders)
        waves = np.concatenate([np.sin(angles), np.cos(angles)], axis=1)
        self.rows = self.lean(self.times)[:, None] * waves
        self.pose = standing_pose(self.robot, self.legs, standing.pose)
        self.home = foot_places(self.legs, self.pose[None])
        self.feet = self.home.positions[0, :, :2]
        leg_joints = {joint for leg in self.legs for joint in leg.joints}
        self.other_joints = sorted({*self.robot.driven} - leg_joints)
        # A pose of the legs is the user's; others are centred above the feet.
        if not leg_joints & {*pose_joints(self.robot, standing.pose)}:
            self._centre()
        self.rest_point = self._rest_point()
        self.balance = self._balance()

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients of a phase: path, trunk, other joints, foot."""
        return 2 * GROUP + len(self.other_joints), self.rows.shape[1]

    def share(self, times: AnyArray) -> np.ndarray:
        """Return the times from the nearer end of a phase, over its length."""
        share = np.asarray(times) / self.duration
        return np.minimum(share, 1.0 - share)

    def lean(self, times: AnyArray) -> np.ndarray:
        """Return how far the weight is moved, from 0 at both ends of a phase to 1."""
        duration = LEAN_SHARE - REST_SHARE
        return smooth_step((self.share(times) - REST_SHARE) / duration)

    def loads(self, number: int, times: AnyArray) -> np.ndarray:
        """Return how much weight feet are to carry, from 0 to 1 [samples feet]."""
        loads = np.ones((len(times), len(self.legs)))
        if number:
            loads[:, number - 1] -= self.lean(times)
        return loads

    def forces(self, motion: Motion, loads: np.ndarray) -> GroundForces:
        """Return the forces of the ground and of the joints."""
        trunk = measured_motion(self.robot, motion)
        parameters = self.standing.parameters
        return ground_forces(self.base, parameters, trunk, loads, self.feet)

    def support(self, points: np.ndarray, stands: np.ndarray) -> np.ndarray:
        """Return how far points are inside the border of feet that stand.

        It is 1 for the middle of these feet, and 0 on their border.
        """
        feet = self.feet[stands]
        room = self._room(feet.mean(axis=0, keepdims=True), feet)
        return self._room(points, feet) / room

    def _room(self, points: np.ndarray, feet: np.ndarray) -> np.ndarray:
        """Return the distances of points from the border of feet [m]."""
        is_sole = self.legs[0].directions > 3
        radius = self.standing.sole_radius if is_sole else 0.0
        return distance_inside(points, feet) + radius

    def _rest_point(self) -> np.ndarray:
        """Return the point at which the weight acts in the standing pose [m]."""
        q = self.pose[None]
        loads = np.ones((1, len(self.legs)))
        rest = Motion(q, 0.0 * q, 0.0 * q)
        return self.forces(rest, loads).zero_moment_point[0]

    def _centre(self) -> None:
        """Shift the trunk so that its weight acts in the middle of the feet.

        Raises:
            InputError: If the legs do not reach so far.
        """
        for _ in range(CENTRING_STEPS):
            pose = self.pose.copy()
            pose[:2] += self.feet.mean(axis=0) - self._rest_point()
            self.pose = place_feet(self.legs, pose[None], self.home)[0]
            if np.isnan(self.pose).any():
                raise InputError(
                    f"`{self.robot.name}` cannot stand with its weight above the "
                    "middle of its feet: give a `pose` with knees bent more."
                )

    def _balance(self) -> np.ndarray:
        r"""Return the shifts of the trunk by unit errors of the zero-moment point.

        A mass at the height $h$ that is shifted by $x$ shifts the zero-moment point by
        $x - h \ddot x / g$. At both ends of a phase the trunk stays at rest.
        """
        step = self.times[1]
        stiffness = self.pose[2] / STANDARD_GRAVITY / step**2
        count = len(self.times)
        effects = (1.0 + 2.0 * stiffness) * np.eye(count)
        effects -= stiffness * (np.eye(count, k=1) + np.eye(count, k=-1))
        weights = smooth_step(self.share(self.times) / REST_SHARE)
        return weights[:, None] * np.linalg.inv(effects)

    def _largest(self, number: int) -> np.ndarray:
        """Return the largest size of each coordinate of a phase."""
        height = self.pose[2]
        feet = self.feet[self.loads(number, self.times).min(axis=0) > 0.0]
        room = self._room(feet.mean(axis=0, keepdims=True), feet)
        trunk = np.array(self.sizes.trunk) * [height, 1.0, 1.0, 1.0]
        sizes = [
            np.tile(self.sizes.path * room, 2),
            self.sizes.trunk_on_fewer_feet * trunk if number else trunk,
            np.full(len(self.other_joints), self.sizes.other_joints),
            self.sizes.foot * np.array([height, height, *np.ones(4)]),
        ]
        return np.concatenate(sizes)

    def random(self, random: np.random.Generator) -> np.ndarray:
        """Draw the coefficients of a phase."""
        # Slow coordinates and fast ones, small and large ones.
        slopes = random.uniform(*SLOPES, (self.shape[0], 1))
        amplitudes = np.tile(self.orders ** (slopes - 1.0), 2)
        coefficients = amplitudes * random.standard_normal(self.shape)
        sizes = random.uniform(0.2, 1.0, (self.shape[0], 1))
        return sizes * coefficients / self._peaks(coefficients)

    def bounded(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients that are made smaller where a wave exceeds its size."""
        return coefficients / np.maximum(self._peaks(coefficients), 1.0)

    def _peaks(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the peak of each coordinate, relative to its largest size."""
        return np.abs(coefficients @ self.rows.T).max(axis=1, keepdims=True)

    def phase(self, number: int, coefficients: np.ndarray) -> Phase:
        """Return the motion of a phase whose zero-moment point follows its path."""
        waves = self._largest(number) * (self.rows @ coefficients.T)
        loads = self.loads(number, self.times)
        path = self._path(loads) + waves[:, :2]
        q = np.tile(self.pose, (len(waves), 1))
        q[:, :2] += path - self.rest_point
        moving_joints = [*range(2, GROUP), *self.other_joints]
        q[:, moving_joints] += waves[:, 2:-GROUP]
        places = self._foot_places(waves[:, -GROUP:], number)
        for _ in range(BALANCING_STEPS):
            phase = self._on_feet(number, coefficients, q, places)
            if phase.spline is None:
                return phase
            forces = self.forces(phase.motion(self.times), loads)
            q = phase.spline(self.times)
            q[:, :2] += self.balance @ (path - forces.zero_moment_point)
        return self._on_feet(number, coefficients, q, places)

    def _on_feet(
        self, number: int, coefficients: np.ndarray, q: np.ndarray, places: FootPlaces
    ) -> Phase:
        """Return a phase whose legs are moved so that all feet are at their places."""
        q = place_feet(self.legs, q, places)
        is_reached = not np.isnan(q).any()
        spline = interpolate_at_rest(self.times, q) if is_reached else None
        return Phase(number, coefficients, spline)

    def _path(self, loads: np.ndarray) -> np.ndarray:
        """Return the path of the zero-moment point: it starts where the pose has it."""
        lean = self.lean(self.times)[:, None]
        middle = loads @ self.feet / loads.sum(axis=1, keepdims=True)
        start = self.rest_point - self.feet.mean(axis=0)
        return middle + (1.0 - lean) * start

    def _foot_places(self, waves: np.ndarray, number: int) -> FootPlaces:
        """Return where all feet are; one of them follows waves in the air."""
        count = len(waves)
        places = FootPlaces(*(np.repeat(x, count, axis=0) for x in self.home))
        if not number:
            return places
        foot = number - 1
        lift = smooth_step((self.share(self.times) - LEAN_SHARE) / LIFT_SHARE)
        height = self.sizes.lift * self.pose[2]
        shift = waves.copy()
        shift[:, 2] = height * np.exp(waves[:, 2])
        shift *= lift[:, None]
        turns = scipy.spatial.transform.Rotation.from_rotvec(shift[:, 3:])
        places.positions[:, foot] += shift[:, :3]
        places.rotations[:, foot] = turns.as_matrix() @ places.rotations[:, foot]
        return places

    def trajectory(self, phases: Sequence[Phase]) -> MotionOnFeet:
        """Return the motion of all phases in turn."""
        knots = []
        polynomials = []
        forces = []
        lifts = np.zeros((len(self.legs), 2))
        for number, phase in enumerate(phases):
            start = number * self.duration
            knots.append(start + self.times[:-1])
            polynomials.append(spline_polynomials(phase.spline))
            loads = self.loads(number, self.times)
            joint_forces = self.forces(phase.motion(self.times), loads).joint_forces
            forces.append(joint_forces[:-1, GROUP:])
            if number:
                ends = np.array([LEAN_SHARE, 1.0 - LEAN_SHARE])
                lifts[number - 1] = start + ends * self.duration
        knots.append(np.array([len(phases) * self.duration]))
        # It ends in the pose in which it begins.
        forces.append(forces[0][:1])
        path = PiecewisePolynomial(
            np.concatenate(knots), np.concatenate(polynomials, axis=1)
        )
        coefficients = np.stack([phase.coefficients for phase in phases])
        names = tuple(leg.name for leg in self.legs)
        return MotionOnFeet(path, names, lifts, coefficients, np.concatenate(forces))
