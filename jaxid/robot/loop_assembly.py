"""Closed loops of a robot: the joints that they move, and the pose that closes them."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Indices, Numbers, Texts, as_finite_array
from jaxid.errors import InputError
from jaxid.program import evaluate, trace

from .follower_joints import Follower, Loop, bodies_in_loop
from .joint_coordinates import (
    LAST_STEPS,
    linear_coordinates,
    linear_ratios,
    loop_gaps,
    newton_step,
    with_leader,
)
from .limits_and_drives import listed, of_joints
from .robot import Robot


class AssemblyThresholds(NamedTuple):
    """When a loop counts as closed in a description, and slopes as independent."""

    max_gap: float = 0.01  # between the points of a loop, which is then closed [m]
    min_independence: float = 1e-6  # of slopes, relative to the largest ones


THRESHOLDS = AssemblyThresholds()


def with_loops(
    robot: Robot,
    loops: Sequence[Loop],
    motors: Texts,
    pose: Numbers | None = None,
) -> Robot:
    """Return a robot whose loops are closed, in the coordinates of its motors.

    Joints of the loops without a motor follow: the bodies that they move come last, in
    the same order (`body_names`), and parameters are those of the bodies in the new
    order. Joints outside of the loops move alone, whether they are named or not.

    Args:
        robot: Open tree, as if one joint of each loop were cut.
        loops: Points that coincide, on bodies of this tree.
        motors: Names of the joints in the loops that have a motor.
        pose: Coordinates of all its joints in which the loops are closed; zero if None.

    Raises:
        InputError: If motors are not as many as the mechanism has freedoms, do not
            determine its pose, or the loops do not close in the pose.
    """
    if robot.followers:
        raise InputError(
            f"`{robot.name}` has joints that follow others already: describe its loops "
            "in an MJCF file."
        )
    _require_motors(robot, motors)
    bodies: set[int] = set()
    for loop in loops:
        bodies |= bodies_in_loop(robot.parent, loop.bodies)
    is_moved = [
        body in bodies and name not in motors
        for body, name in enumerate(robot.joint_names)
    ]
    alone = [joint for joint in range(robot.joints) if not is_moved[joint]]
    moved = [joint for joint in range(robot.joints) if is_moved[joint]]
    order = [*alone, *moved]
    coordinates = np.zeros(robot.bodies) if pose is None else pose
    coordinates = as_finite_array("`pose`", coordinates, (robot.bodies,))
    tree = _renumbered(robot, loops, alone, moved, order)
    return assembled(tree, [coordinates[order]])


def _require_motors(robot: Robot, motors: Texts):
    """Reject motors that are named twice, or that are no joints."""
    for motor in motors:
        if motor not in robot.joint_names:
            raise InputError(
                f"`motors` of `{robot.name}` must be joints, but `{motor}` is none of "
                f"{listed(robot.joint_names)}."
            )
        if list(motors).count(motor) > 1:
            raise InputError(
                f"`motors` of `{robot.name}` names joint `{motor}` twice: name each "
                "joint once."
            )


def _renumbered(
    robot: Robot,
    loops: Sequence[Loop],
    alone: list[int],
    moved: list[int],
    order: list[int],
):
    """Return the robot with its bodies in another order, and joints that loops move."""
    numbers = {body: place for place, body in enumerate(order)}
    numbers[-1] = -1
    followers = []
    for joint in moved:
        follower = Follower(
            robot.joint_names[joint],
            revolute=robot.revolute[joint],
            leader=None,
            position_min=robot.limits.position_min[joint],
            position_max=robot.limits.position_max[joint],
            velocity=robot.limits.velocity[joint],
        )
        followers.append(follower)
    renumbered_loops = [
        dataclasses.replace(loop, bodies=tuple(numbers[body] for body in loop.bodies))
        for loop in loops
    ]
    tool = robot.tool
    if tool is not None:
        tool = dataclasses.replace(tool, body=numbers[tool.body])
    return robot.replace(
        joint_names=tuple(robot.joint_names[joint] for joint in alone),
        revolute=tuple(robot.revolute[joint] for joint in alone),
        parent=tuple(numbers[robot.parent[body]] for body in order),
        axis=robot.axis[order],
        rotation=robot.rotation[order],
        offset=robot.offset[order],
        followers=tuple(followers),
        loops=tuple(renumbered_loops),
        limits=of_joints(robot.limits, alone),
        drives=of_joints(robot.drives, alone),
        tip_body=numbers[robot.tip_body],
        tool=tool,
    )


def assembled(robot: Robot, poses: Sequence[AnyArray]) -> Robot:
    """Return a robot whose loops close near a pose, by independent rows.

    Args:
        robot: Robot with loops, whose last followers are the joints that these move.
        poses: Coordinates of all its joints, of which the first ones count at which all
            loops are closed, or else those at which they are the least open.

    Raises:
        InputError: If the loops do not close, or the motors do not suit them.
    """
    moved = robot.bodies - robot.joints - len(with_leader(robot.followers))
    if not moved:
        # All joints of the loops follow others, so that they are closed.
        return robot.replace(loops=())
    robot, pose = _closed(robot, poses, moved)
    slopes = _of_pose(jax.jacfwd(lambda q: loop_gaps(robot, q)), pose)
    rows = _independent_rows(robot, slopes, moved)
    robot = robot.replace(loop_rows=rows, loop_pose=pose)
    change = functools.partial(newton_step, robot)
    for _ in range(LAST_STEPS):
        others, joints = np.split(pose, [-moved])
        pose = np.concatenate([others, joints + _of_pose(change, pose)])
    return robot.replace(loop_pose=pose)


def _closed(
    robot: Robot, poses: Sequence[AnyArray], moved: int
) -> tuple[Robot, AnyArray]:
    """Return the first pose that closes the loops, or one near the least open pose.

    Of the latter the robot has a note.

    Raises:
        InputError: If no pose near the best one closes the loops.
    """
    joints = robot.joints
    moves_itself = np.r_[:joints, robot.bodies - moved : robot.bodies]

    def gaps(values):
        leading = linear_coordinates(robot.followers, values[:joints])
        return loop_gaps(robot, jnp.concatenate([leading, values[joints:]]))

    shape = moves_itself.shape
    gap_program = trace(gaps, shape)
    slope_program = trace(jax.jacfwd(gaps), shape)

    def distances(values):
        return np.linalg.norm(evaluate(gap_program, values).reshape(-1, 3), axis=1)

    widest_gaps = [distances(pose[moves_itself]).max() for pose in poses]
    for pose, gap in zip(poses, widest_gaps, strict=True):
        if gap <= THRESHOLDS.max_gap:
            return robot, pose
    pose = poses[int(np.argmin(widest_gaps))]
    followers = robot.followers[-moved:]
    low = [*robot.limits.position_min, *(x.position_min for x in followers)]
    high = [*robot.limits.position_max, *(x.position_max for x in followers)]
    closing = scipy.optimize.least_squares(
        functools.partial(evaluate, gap_program),
        np.clip(pose[moves_itself], low, high),
        jac=functools.partial(evaluate, slope_program),
        bounds=(low, high),
    )
    _require_closed(robot, distances(closing.x))
    leading = linear_coordinates(robot.followers, closing.x[:joints])
    pose = np.concatenate([leading, closing.x[joints:]])
    return _with_note(robot, pose), pose


def _require_closed(robot: Robot, distances: np.ndarray) -> None:
    """Reject loops whose points do not meet near a pose."""
    if distances.max() > THRESHOLDS.max_gap:
        loop = robot.loops[int(distances.argmax())]
        raise InputError(
            f"loop `{loop.name}` of `{robot.name}` does not close: near its pose the "
            f"points that must coincide stay {distances.max():.3g} m apart; give a "
            "pose in which all loops close (a `<key>` in MJCF, `pose` in Python)."
        )


def _with_note(robot: Robot, pose: np.ndarray) -> Robot:
    """Return the robot with a note on a pose that its description does not state."""
    # Without the rounding of the search.
    coordinates = zip(robot.body_names, np.round(pose, 6) + 0.0, strict=True)
    places = ", ".join(f"`{name}` {value:.4g}" for name, value in coordinates)
    note = (
        "the loops are open in all poses of the description; they were closed from the "
        f"nearest one, at {places}: check the branch, such as elbows up, or give a "
        "pose in which they are closed (a `<key>`, `pose`)."
    )
    return robot.replace(notes=(*robot.notes, note))


def _of_pose(function: Callable, pose: AnyArray) -> np.ndarray:
    """Return a function of all coordinates at one pose, in float64."""
    return np.asarray(evaluate(trace(function, pose.shape), pose))


def _independent_rows(robot: Robot, slopes: np.ndarray, moved: int) -> Indices:
    """Return as many independent entries of the gaps as joints that loops move.

    The loop of a plane, which has three entries, leaves one of them out.
    """
    others = robot.bodies - moved
    free_slopes = slopes[:, :others] @ linear_ratios(robot.followers, robot.joints)
    moved_slopes = slopes[:, others:]
    rank = _rank(np.concatenate([free_slopes, moved_slopes], axis=1))
    is_motor = (np.abs(free_slopes) > 0).any(axis=0)
    motors = np.array(robot.joint_names)[is_motor].tolist()
    followers = listed(robot.body_names[others:])
    freedoms = len(motors) + moved - rank
    if len(motors) != freedoms:
        raise InputError(
            f"the loops of `{robot.name}` have {freedoms} freedom(s), but "
            f"{len(motors)} motor(s), at {listed(motors) or 'no joint'}, and without "
            f"one {followers}: name as many motors as freedoms (`<actuator>` in MJCF, "
            "`motors` in Python), or give a pose that is not singular."
        )
    if _rank(moved_slopes) < moved:
        raise InputError(
            f"joints {followers} of `{robot.name}` can move while its motors stand "
            "still: drive other joints, or give a pose that is not singular."
        )
    _, _, order = scipy.linalg.qr(moved_slopes.T, pivoting=True)
    return tuple(sorted(order[:moved].tolist()))


def _rank(matrix: np.ndarray):
    """Return the number of independent rows."""
    values = np.linalg.svd(matrix, compute_uv=False)
    threshold = THRESHOLDS.min_independence * values.max(initial=0.0)
    return int((values > threshold).sum())
