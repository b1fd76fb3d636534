"""Figures of a motion (Figs. 3, 4, 8): joints, and the robot in space."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.collision import GROUND, Box, CollisionModel, HalfSpace
from jaxid.robot.collision_geometry import Shape
from jaxid.robot.forward_kinematics import placements, tip_placement
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot

from .figure import Figure
from .figure_elements import (
    CYCLE,
    VERMILION,
    Curve,
    Panel,
    Scene,
    Solids,
)

Times = Float[AnyArray, " samples"]
"""Instants of the samples of a motion."""
Cloud = tuple[int, np.ndarray]
"""Body, and points in its frame [m]; body -1 is the ground."""
JointSamples = Float[AnyArray, "samples joints"]
"""A value of each joint at each sample."""
BALL_POINTS = 60
"""Points on the ball at each end of a capsule, and on the hull of a mesh at most."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Angle between neighbouring points of a ball that spreads them evenly [rad]."""
MAX_PATH_POINTS = 1000
"""Largest number of points of the path of an end-effector."""
MAX_FRAMES = 120
"""Largest number of poses of a robot on a page."""
PLANE_SIZE = 0.7
"""Half the side of the square that shows a plane, relative to the robot's reach."""
SQUARE_FACES = np.array([[0, 1, 2], [1, 2, 3]])
"""Triangles of a square whose corners are listed row by row."""


def joint_figure(robot: Robot, limits: Limits, time: Times, motion: Motion) -> Figure:
    """Return position, velocity and acceleration of all joints, with limits (Fig. 4).

    Args:
        robot: Robot that moves.
        limits: Limits, drawn as lines where they are finite.
        time: Instants of the samples [s].
        motion: Motion at the samples.
    """
    kinds = (
        ("position", "", motion.q, (limits.position_min, limits.position_max)),
        ("velocity", "/s", motion.qd, (-limits.velocity, limits.velocity)),
        (
            "acceleration",
            "/s²",
            motion.qdd,
            (-limits.acceleration, limits.acceleration),
        ),
    )
    panels = []
    for j, joint_name in enumerate(robot.joint_names):
        stack = []
        for (name, rate, values, bounds), colour in zip(kinds, CYCLE, strict=False):
            curve = Curve(time, np.asarray(values)[:, j], name, colour)
            unit = f"{robot.joint_unit(j)}{rate}"
            levels = _limit_lines(bound[j] for bound in bounds)
            stack.append(Panel([curve], y=unit, levels=levels))
        panels.append(
            dataclasses.replace(
                stack[0],
                title=joint_name,
                x_range=(float(time[0]), float(time[-1])),
                below=stack[1:],
            )
        )
    title = f"{robot.name}: motion of the joints (dashed: limits)"
    return Figure(title, panels, columns=min(3, robot.joints), height=3.2)


def _limit_lines(bounds: Iterable[Any]) -> list[tuple[str, float, str]]:
    """Return lines at the limits that are finite."""
    return [("y", float(bound), VERMILION) for bound in bounds if np.isfinite(bound)]


def pose_figure(
    robot: Robot,
    q: JointSamples,
    time: Times | None = None,
    values: JointSamples | None = None,
    label: str = "",
    title: str | None = None,
    shapes: CollisionModel | None = None,
    clouds: Sequence[Cloud] = (),
) -> Figure:
    """Return the robot along a motion: moving on a page, poses on paper (Figs. 3, 8).

    Args:
        robot: Robot to draw.
        q: Joint coordinates along a motion [rad or m].
        time: Instants of the samples [s]; without them the page counts samples.
        values: Values of the joints that colour their links, and on average the path of
            the end-effector, such as torque errors.
        label: Name of these values, with their unit.
        title: Title of the figure; the robot's name if None.
        shapes: Shapes of robot and surroundings that the page shows.
        clouds: Points of bodies whose convex hulls the page shows.
    """
    q = np.atleast_2d(np.asarray(q, np.float64))
    time = np.arange(len(q)) if time is None else np.asarray(time)
    rows = even_indices(len(q), MAX_PATH_POINTS)
    frames = even_indices(len(rows), MAX_FRAMES)
    if values is not None:
        # Each point has the largest value of all samples up to the next point.
        sizes = np.nan_to_num(np.abs(np.asarray(values, np.float64)))
        values = np.maximum.reduceat(sizes, rows, axis=0)
        # A follower's link has the colour of its leader's; all joints move the loops.
        largest = values.max(axis=1, keepdims=True)
        columns = [values]
        for follower in robot.followers:
            leader = follower.leader
            columns.append(largest if leader is None else values[:, [leader]])
        values = np.concatenate(columns, axis=1)
    places = _body_places(robot, q[rows])
    points = places[..., 3]
    solid_clouds = list(clouds)
    if shapes is not None:
        reach = float(np.linalg.norm(points, axis=2).max())
        solid_clouds += _collision_clouds(shapes, PLANE_SIZE * reach)
    solids = None
    if solid_clouds:
        solids = _solids(solid_clouds, places[frames, :-1])
    scene = Scene(
        time=time[rows],
        points=points,
        links=(*robot.parent, robot.tip_body),
        frames=frames,
        values=values,
        label=label,
        solids=solids,
    )
    title = robot.name if title is None else title
    return Figure(title, height=2.6, width=7.5, scene=scene)


def compared_poses(
    robot: Robot,
    time: Times,
    measured: JointSamples,
    simulated: JointSamples,
    title: str,
) -> Figure:
    """Return the robot twice in one view: as it was measured, and as simulated."""
    scenes = [pose_figure(robot, q, time).scene for q in (simulated, measured)]
    first, second = (scene for scene in scenes if scene is not None)
    count = len(first.links)
    # The ground, -1, is common to both.
    second_links = [link if link < 0 else link + count for link in second.links]
    colours = np.repeat([1.0, 0.0], count)
    scene = dataclasses.replace(
        first,
        points=np.concatenate([first.points, second.points], axis=1),
        links=(*first.links, *second_links),
        values=np.tile(colours, (len(first.time), 1)),
    )
    return Figure(title, height=2.6, width=7.5, scene=scene)


def speed_figure(
    robot: Robot,
    limits: Limits,
    time: np.ndarray,
    motion: Motion,
    shapes: CollisionModel | None = None,
) -> Figure:
    """Return the robot along a motion, coloured by the speeds of its joints."""
    speeds = np.abs(np.asarray(motion.qd))
    max_speeds = np.asarray(limits.velocity)
    scale = np.where(np.isfinite(max_speeds), max_speeds, np.max(speeds))
    return pose_figure(
        robot,
        motion.q,
        time=time,
        values=100.0 * speeds / scale,
        label="speed [% of the limit]",
        shapes=shapes,
    )


def even_indices(count: int, max_count: int) -> np.ndarray:
    """Return indices of at most `max_count` of `count` entries, including both ends."""
    places = np.linspace(0, count - 1, min(max_count, count))
    return np.unique(places.round().astype(int))


def _body_places(robot: Robot, q: Matrix) -> np.ndarray:
    """Return rotation and origin of each body and the tip as [R r].

    The axes are samples, bodies and the tip, 3, 4.
    """

    def body_places(sample):
        rotations, origins = placements(robot, sample)
        rotation, tip = tip_placement(robot, sample)
        rotations = jnp.concatenate([rotations, rotation[None]])
        origins = jnp.concatenate([origins, tip[None]])
        return jnp.concatenate([rotations, origins[:, :, None]], axis=2)

    with double_precision():
        return in_numpy(robot, body_places, q)


def _collision_clouds(shapes: CollisionModel, size: float) -> list[Cloud]:
    """Return points on all shapes; planes are shown as squares, as large as `size`."""
    clouds: list[Cloud] = []
    for capsule in shapes.capsules:
        # A ball is a capsule whose ends are one.
        ends = np.unique(np.stack([capsule.start, capsule.end]), axis=0)
        shape = Shape(ends, float(capsule.radius))
        clouds.append((capsule.body, surface_points(shape)))
    for obstacle in shapes.obstacles:
        clouds.append((GROUND, _obstacle_points(obstacle, size)))
    return clouds


def _solids(clouds: Sequence[Cloud], places: np.ndarray) -> Solids:
    """Return the convex hulls of points, and the places of the bodies in some poses."""
    faces = []
    first_vertex = 0
    for _, points in clouds:
        is_square = len(points) == 4
        hull = SQUARE_FACES
        if not is_square:
            # Joggled input: the points of a mesh may lie in a plane.
            hull = scipy.spatial.ConvexHull(points, qhull_options="QJ").simplices
        faces.append(hull + first_vertex)
        first_vertex += len(points)
    return Solids(
        vertices=np.concatenate([points for _, points in clouds]),
        bodies=np.concatenate([np.full(len(points), body) for body, points in clouds]),
        faces=np.concatenate(faces),
        places=places,
    )


def surface_points(shape: Shape) -> np.ndarray:
    """Return points on the hull of a shape: few, so that the page stays small.

    They are those that lie farthest in directions spread by the golden angle.
    """
    number = np.arange(BALL_POINTS)
    angle = GOLDEN_ANGLE * number
    z = 1.0 - (2.0 * number + 1.0) / BALL_POINTS
    ring = np.sqrt(1.0 - z**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    corners = np.asarray(shape.points)
    if shape.radius > 0.0:
        points = corners[:, None] + shape.radius * directions
        return points.reshape(-1, 3)
    farthest_points = np.argmax(corners @ directions.T, axis=0)
    return corners[np.unique(farthest_points)]


def _obstacle_points(obstacle: HalfSpace | Box, size: float) -> np.ndarray:
    """Return corners of a box, or of a square in a plane around the ground's origin."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    if isinstance(obstacle, Box):
        corners = 0.5 * signs * np.asarray(obstacle.size)
        return np.asarray(obstacle.centre) + corners @ np.asarray(obstacle.rotation).T
    normal = np.asarray(obstacle.normal)
    # The other two axes of a frame whose first one is the normal.
    axes = np.linalg.svd(normal[None])[2][1:]
    return normal * np.asarray(obstacle.height) + size * signs[::2, :2] @ axes
