"""Legs of a robot on its feet: coordinates that put the feet at given places.

The six virtual joints of the base are moved here like any others: their coordinates are
the position of the trunk on the ground and its turns about x, y and z in a row.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError

from .contacts import legs_of
from .forward_kinematics import tip_jacobian
from .inverse_kinematics import pose_errors
from .limits_and_drives import complete_limits
from .robot import Robot
from .virtual_joints import GROUP

MAX_STEPS = 60
"""Newton steps from a standing pose at most."""
MAX_STEP = 0.2
"""Largest change of a joint in one of them [rad or m]."""
DAMPING = 1e-9
"""Square of the velocity [m/s] per rate below which a direction counts as singular."""
PLACE_TOLERANCE = 1e-8
"""Distance at which a foot is at its place [m, and rad]."""
KNEE_BEND = {3: 0.2, 6: 0.1}
"""Fraction by which legs of 3 and 6 joints are shorter than at zero angles."""
STANCE_WIDTH = {3: 1.0, 6: 0.75}
"""Distance of such feet from the trunk's middle, relative to that at zero angles."""
FIRST_BEND = 1.0
"""Angle of a knee whose range does not tell its direction, before the search [rad]."""
INNER_ROOM = 0.3
"""Distance of zero from the ends of a range from which a joint stands at zero [rad]."""
LEVEL_TOLERANCE = 0.01
"""Difference of the heights of feet that stand on one plane [m]."""


class Leg(NamedTuple):
    """A leg.

    Attributes:
        name: Name of its foot.
        foot: Robot with the foot as its end-effector.
        joints: np.ndarray of the leg, from the trunk.
        directions: Coordinates of the foot that its joints decide: 3 of a ball, 6 of a
            sole.
    """

    name: str
    foot: Robot
    joints: list[int]
    directions: int


class FootPlaces(NamedTuple):
    """Places of all feet on the ground, at samples.

    Attributes:
        positions: Centres of balls, points of soles [m].
        rotations: Attitudes of soles.
    """

    positions: Float[np.ndarray, "samples feet 3"]
    rotations: Float[np.ndarray, "samples feet 3 3"]


def find_legs(robot: Robot) -> list[Leg]:
    """Return the legs of a robot on its feet.

    Raises:
        InputError: If the joints of its legs do not decide the places of its feet.
    """
    if not robot.contacts:
        raise InputError(
            f"`{robot.name}` has no `contacts`: name the links of its feet."
        )
    legs_and_rows = legs_of(robot)
    if robot.loops or len(legs_and_rows.rows) > GROUP or len(robot.virtual) > GROUP:
        raise InputError(
            f"`{robot.name}` must have a leg of its own for each foot, without closed "
            "loops and force sensors, for motions on its feet to be designed."
        )
    legs = []
    for contact, joints in zip(robot.contacts, legs_and_rows.own_joints, strict=True):
        zeros = np.zeros((1, 1, 3))
        directions = contact.shape.jacobian(zeros, zeros, zeros[0]).shape[2]
        if len(joints) != directions:
            raise InputError(
                f"the leg of `{contact.name}` must have {directions} joints for a "
                "motion to be designed (3 for a ball foot, 6 for a sole), but has "
                f"{len(joints)}."
            )
        foot = robot.replace(
            tip_body=contact.body, tip_offset=contact.position, tip_rotation=None
        )
        legs.append(Leg(contact.name, foot, list(joints), directions))
    needed = 4 if legs[0].directions == 3 else 2
    are_alike = len({leg.directions for leg in legs}) == 1
    if len(legs) < needed or not are_alike:
        raise InputError(
            f"`{robot.name}` must have {needed} feet of one kind at least, so that it "
            f"can stand while one is lifted, but has {len(legs)} `contacts`."
        )
    return legs


def foot_places(legs: Sequence[Leg], q: np.ndarray) -> FootPlaces:
    """Return the places of all feet at coordinates [samples joints]."""
    tips = [tip_jacobian(leg.foot, q) for leg in legs]
    return FootPlaces(
        np.stack([tip.position for tip in tips], axis=1),
        np.stack([tip.rotation for tip in tips], axis=1),
    )


def place_feet(legs: Sequence[Leg], q: np.ndarray, places: FootPlaces) -> np.ndarray:
    """Return coordinates that put the feet at their places; NaN out of reach.

    Args:
        legs: Legs of the robot.
        q: Coordinates to begin with; those of the legs change [samples joints].
        places: Places of the feet.
    """
    q = q.copy()
    is_missed = np.zeros(len(q), bool)
    for number, leg in enumerate(legs):
        position = places.positions[:, number]
        rotation = places.rotations[:, number]
        joints = leg.joints
        distances = np.full(len(q), np.inf)
        for _ in range(MAX_STEPS):
            tip = tip_jacobian(leg.foot, q)
            errors = pose_errors(tip, position, rotation)[:, : leg.directions]
            distances = np.abs(errors).max(axis=1)
            if distances.max() < PLACE_TOLERANCE:
                break
            slopes = tip.slopes[:, joints, : leg.directions]
            square = slopes @ slopes.swapaxes(1, 2) + DAMPING * np.eye(len(joints))
            step = np.linalg.solve(square, slopes @ errors[..., None])[..., 0]
            q[:, joints] -= np.clip(step, -MAX_STEP, MAX_STEP)
        is_missed |= distances >= PLACE_TOLERANCE
    q[is_missed] = np.nan
    return q


def pose_joints(robot: Robot, angles: Mapping[str, float] | None) -> dict[int, float]:
    """Return the angles of the joints whose names contain a word.

    Raises:
        InputError: If a word fits no joint.
    """
    joints: dict[int, float] = {}
    for word, angle in (angles or {}).items():
        fitting = [j for j in robot.driven if word in robot.joint_names[j]]
        if not fitting:
            names = ", ".join(robot.joint_names[j] for j in robot.driven)
            raise InputError(
                f"`pose` must name joints, or parts of their names, but no joint "
                f"({names}) contains `{word}`."
            )
        joints |= dict.fromkeys(fitting, angle)
    return joints


def standing_pose(
    robot: Robot, legs: Sequence[Leg], angles: Mapping[str, float] | None = None
) -> np.ndarray:
    """Return coordinates with which a robot stands, its trunk level above its feet.

    Args:
        robot: The robot.
        legs: Its legs.
        angles: Angles of the joints whose names contain a word, like `{"knee": 0.9}`;
            all others are zero, or in the middle of a range that ends near zero. If
            they are of no leg, the feet are where they are at zero angles, and the
            trunk is lowered with bent knees.

    Raises:
        InputError: If a word fits no joint, the feet are not on one plane, or no pose
            is found.
    """
    limits = complete_limits(robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    is_near_end = np.minimum(-low, high) < INNER_ROOM
    q = np.where(is_near_end, 0.5 * (low + high), 0.0)
    joints = pose_joints(robot, angles)
    q[list(joints)] = list(joints.values())
    if not any(joint in joints for leg in legs for joint in leg.joints):
        q = _bent_pose(robot, legs, q)
    positions = foot_places(legs, q[None]).positions[0]
    radii = [getattr(c.shape, "radius", 0.0) for c in robot.contacts]
    heights = positions[:, 2] - radii
    if np.ptp(heights) > LEVEL_TOLERANCE:
        raise InputError(
            f"`pose` must put all feet on one plane below a level trunk, but their "
            f"heights differ by {np.ptp(heights):.3g} m."
        )
    q[2] -= heights.mean()
    return q


def _bent_pose(robot: Robot, legs: Sequence[Leg], q: np.ndarray) -> np.ndarray:
    """Return a pose with bent knees, the feet below where they are at zero angles."""
    places = foot_places(legs, np.zeros((1, robot.joints)))
    for number, leg in enumerate(legs):
        tip = tip_jacobian(leg.foot, np.zeros((1, robot.joints)))
        hip_height = tip.origins[0, leg.joints[0], 2]
        length = hip_height - places.positions[0, number, 2]
        places.positions[0, number, 2] += KNEE_BEND[leg.directions] * length
        knee = leg.joints[(len(leg.joints) + 1) // 2]
        if q[knee] == 0.0:
            q[knee] = FIRST_BEND
        places.positions[0, number, :2] *= STANCE_WIDTH[leg.directions]
    # All stand on one plane.
    places.positions[0, :, 2] = places.positions[0, :, 2].mean()
    pose = place_feet(legs, q[None], places)[0]
    if np.isnan(pose).any():
        raise InputError(
            f"no standing pose of `{robot.name}` was found: give the angles of its "
            "joints as `pose`."
        )
    return pose
