"""Motions of a robot on its feet: phases from standstill to standstill.

In the first phase all feet stand and the trunk moves. In each of the others the trunk
leans over all feet but one, which is lifted and moves in the air. Coordinates follow
Fourier series that rest at both ends; feet that stand stay where they are by inverse
kinematics.
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
    standing_pose,
)
from jaxid.robot.virtual_joints import GROUP
from jaxid.trajectory.fourier import RestToRestBasis
from jaxid.trajectory.motion_on_feet import MotionOnFeet
from jaxid.trajectory.spline import (
    PiecewisePolynomial,
    interpolate_at_rest,
    spline_polynomials,
)

from .ground_forces import distance_inside, ground_forces, measured_motion

NODE_STEP = 0.025
"""Largest time between two poses of the inverse kinematics [s]."""
LIFT_SHARE = 0.1
"""Part of a phase in which a foot is lifted after that, and in which it is lowered."""
SLOPES = (0.5, 2.0)
"""Exponents of the velocity's amplitudes as powers of the harmonic's number."""
CENTRING_STEPS = 3
"""Steps in which the zero-moment point of the standing robot is shifted."""


class Sizes(NamedTuple):
    """Largest sizes of random motions, before they are made smaller to keep limits.

    Lengths are fractions of the height of the trunk above the ground.

    Attributes:
        trunk: Shift along x, y, z, and turn about these axes [rad].
        trunk_on_fewer_feet: Size where a foot is lifted, relative to that on all feet.
        other_joints: Size of joints of no leg [rad or m].
        foot: Shift and turn of a foot in the air [rad].
        lift: Its mean height.
        lean: Part of a phase in which the trunk leans over the other feet, and of its
            way back.
    """

    trunk: tuple[float, ...]
    trunk_on_fewer_feet: float
    other_joints: float
    foot: tuple[float, ...]
    lift: float
    lean: float


SIZES = {
    3: Sizes(
        (0.1, 0.1, 0.1, 0.2, 0.2, 0.25), 0.3, 0.2, (0.25, 0.2, 0.15) * 2, 0.25, 0.15
    ),
    6: Sizes(
        (0.06, 0.06, 0.05, 0.2, 0.2, 0.2), 0.3, 0.2, (0.1, 0.05, 0.05) * 2, 0.1, 0.27
    ),
}
"""Sizes for robots with ball feet and with soles, by the coordinates of a foot."""


class Standing(NamedTuple):
    """How a robot stands, and what keeps it from falling.

    Attributes:
        parameters: Nominal values of the base parameters, which tell its weight.
        pose: Angles of the joints whose names contain a word, like `{"knee": 0.9}`;
            None for a pose with bent knees above the feet.
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
        coefficients: Numbers from which it is made.
        spline: Motion of trunk and joints on the ground; None if a leg cannot reach.
        foot: Foot that is lifted; None if all stand.
        lift: Times between which it is in the air [s].
    """

    coefficients: np.ndarray
    spline: Any
    foot: int | None
    lift: tuple[float, float]

    def motion(self, times: AnyArray) -> Motion:
        """Return the motion of trunk and joints at times from its start [s]."""
        return Motion(*(self.spline(times, order) for order in range(3)))

    def stands(self, times: AnyArray, feet: int) -> np.ndarray:
        """Return whether each foot stands at times from its start [samples feet]."""
        flags = np.ones((len(times), feet), bool)
        if self.foot is not None:
            start, stop = self.lift
            flags[:, self.foot] = (times <= start) | (times >= stop)
        return flags


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
        InputError: If the robot cannot stand so that each foot can be lifted.
    """

    def __init__(
        self, base: BaseParameters, standing: Standing, harmonics: int, omega: float
    ):
        self.base = base
        self.standing = standing
        self.robot = base.model.robot
        self.legs = find_legs(self.robot)
        self.pose = standing_pose(self.robot, self.legs, standing.pose)
        self.phases = 1 + len(self.legs)
        self.sizes = SIZES[self.legs[0].directions]
        self.home = foot_places(self.legs, self.pose[None])
        leg_joints = [joint for leg in self.legs for joint in leg.joints]
        is_of_leg = np.isin(self.robot.driven, leg_joints)
        self.other_joints = np.array(self.robot.driven)[~is_of_leg]
        basis = RestToRestBasis(harmonics, omega)
        self.duration = float(basis.duration)
        count = int(np.ceil(self.duration / NODE_STEP))
        self.times = np.linspace(0.0, self.duration, count + 1)
        # Without the constant, and from zero to zero.
        rows = np.asarray(basis.rows(self.times)[0])[:, 1:]
        self.rows = rows - rows[0]
        self.directions = basis.directions[1:, 1:]
        self.shifts = self._shifts()

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients of a phase: trunk, other joints, foot."""
        return 2 * GROUP + len(self.other_joints), self.rows.shape[1]

    def support(self, points: np.ndarray, stands: AnyArray) -> np.ndarray:
        """Return how far points are inside the border of feet that stand.

        It is 1 for the middle of these feet, and 0 on their border.
        """
        is_sole = self.legs[0].directions > 3
        radius = self.standing.sole_radius if is_sole else 0.0
        feet = self.home.positions[0, np.asarray(stands, bool), :2]
        middle = feet.mean(axis=0, keepdims=True)
        room = distance_inside(middle, feet) + radius
        return (distance_inside(points, feet) + radius) / room

    def _shifts(self) -> list[np.ndarray]:
        """Return the shift of the trunk in each phase [m], from a centred pose."""
        feet = self.home.positions[0, :, :2]
        if self.standing.pose is None:
            self.pose = self._leaning(feet.mean(axis=0), self.home)
        shifts = [np.zeros(2)]
        for foot in range(len(feet)):
            # On the way up, its leg moves the weight.
            places = FootPlaces(self.home.positions.copy(), self.home.rotations)
            places.positions[0, foot, 2] += 0.5 * self.sizes.lift * self.pose[2]
            others = np.delete(feet, foot, axis=0)
            pose = self._leaning(others.mean(axis=0), places)
            shifts.append(pose[:2] - self.pose[:2])
        return shifts

    def _leaning(self, point: np.ndarray, places: FootPlaces) -> np.ndarray:
        """Return a pose with feet at their places and the weight above a point."""
        pose = self.pose
        for _ in range(CENTRING_STEPS):
            shifted = pose.copy()
            shifted[:2] += point - self._rest_point(pose)
            pose = place_feet(self.legs, shifted[None], places)[0]
            if np.isnan(pose).any():
                raise InputError(
                    f"`{self.robot.name}` cannot lean so far that another foot can be "
                    "lifted: give a lower `pose`, with knees bent more."
                )
        return pose

    def _rest_point(self, pose: np.ndarray) -> np.ndarray:
        """Return the point at which the weight acts in a pose [m]."""
        q = pose[None]
        trunk = measured_motion(self.robot, Motion(q, 0.0 * q, 0.0 * q))
        stands = np.ones((1, len(self.legs)), bool)
        forces = ground_forces(self.base, self.standing.parameters, trunk, stands)
        return forces.zero_moment_point[0]

    def random(self, phase: int, random: np.random.Generator) -> np.ndarray:
        """Draw the coefficients of a phase."""
        height = self.pose[2]
        lengths = np.array([height, height, height, 1.0, 1.0, 1.0])
        trunk_size = self.sizes.trunk_on_fewer_feet if phase else 1.0
        sizes = [
            lengths * self.sizes.trunk * trunk_size,
            np.full(len(self.other_joints), self.sizes.other_joints),
            lengths * self.sizes.foot,
        ]
        # Slow coordinates and fast ones, small and large ones.
        orders = np.arange(1.0, len(self.directions) // 2 + 1.0)
        slopes = random.uniform(*SLOPES, (self.shape[0], 1))
        amplitudes = np.tile(orders**slopes, 2)
        amplitudes *= random.standard_normal(amplitudes.shape)
        coefficients = amplitudes @ self.directions
        peaks = np.abs(self.rows @ coefficients.T).max(axis=0)
        scale = np.concatenate(sizes) * random.uniform(0.2, 1.0, len(peaks)) / peaks
        return coefficients * scale[:, None]

    def phase(self, number: int, coefficients: np.ndarray) -> Phase:
        """Return the motion of a phase: all feet stand in that of number 0."""
        foot = number - 1 if number else None
        waves = self.rows @ coefficients.T
        q = self._swaying(waves, self.shifts[number])
        places = self._foot_places(waves[:, -GROUP:], foot)
        q = place_feet(self.legs, q, places)
        spline = None
        if not np.isnan(q).any():
            spline = interpolate_at_rest(self.times, q)
        lean = self.sizes.lean * self.duration
        return Phase(coefficients, spline, foot, (lean, self.duration - lean))

    @property
    def _share(self) -> np.ndarray:
        """Distance of each instant from the nearer end of a phase, over its length."""
        share = self.times / self.duration
        return np.minimum(share, 1.0 - share)

    def _swaying(self, waves: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the coordinates of trunk and other joints, legs as in the pose."""
        lean = smooth_step(self._share / self.sizes.lean)
        q = np.tile(self.pose, (len(lean), 1))
        q[:, :GROUP] += waves[:, :GROUP]
        q[:, :2] += lean[:, None] * shift
        q[:, self.other_joints] += waves[:, GROUP:-GROUP]
        return q

    def _foot_places(self, waves: np.ndarray, foot: int | None) -> FootPlaces:
        """Return where all feet are; one of them follows waves in the air."""
        count = len(waves)
        places = FootPlaces(*(np.repeat(x, count, axis=0) for x in self.home))
        if foot is None:
            return places
        lift = smooth_step((self._share - self.sizes.lean) / LIFT_SHARE)
        wave = lift[:, None] * waves
        wave[:, 2] += lift * self.sizes.lift * self.pose[2]
        turns = scipy.spatial.transform.Rotation.from_rotvec(wave[:, 3:])
        places.positions[:, foot] += wave[:, :3]
        places.rotations[:, foot] = turns.as_matrix() @ places.rotations[:, foot]
        return places

    def trajectory(self, phases: Sequence[Phase]) -> MotionOnFeet:
        """Return the motion of all phases in turn."""
        knots = []
        polynomials = []
        lifts = np.zeros((len(self.legs), 2))
        for number, phase in enumerate(phases):
            start = number * self.duration
            knots.append(start + self.times[:-1])
            polynomials.append(spline_polynomials(phase.spline))
            if phase.foot is not None:
                lifts[phase.foot] = start + np.array(phase.lift)
        knots.append(np.array([len(phases) * self.duration]))
        path = PiecewisePolynomial(
            np.concatenate(knots), np.concatenate(polynomials, axis=1)
        )
        coefficients = np.stack([phase.coefficients for phase in phases])
        names = tuple(leg.name for leg in self.legs)
        return MotionOnFeet(path, names, lifts, coefficients)
