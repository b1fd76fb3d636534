"""Figures of a motion (Figs. 3, 4, 5 and 8): joints, end-effector, and the robot in space."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from jaxid.arrays import AnyArray, Float, double_precision
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints import tip_motion
from jaxid.robot.collision import GROUND, Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.forward_and_inverse_kinematics import placements, tip_placement
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot

from .figure import Figure
from .figure_elements import (
    CYCLE,
    MEASURED,
    PREDICTED,
    VERMILION,
    Curve,
    Panel,
    Scene,
    Solids,
)

SPREAD = 40
"""Points on the ball at each end of a capsule."""
_SQUARE = np.array([[0, 1, 2], [1, 2, 3]])
"""Triangles of a square whose corners are listed row by row."""


def joint_figure(
    robot: Robot, limits: Limits, time: Float[AnyArray, " samples"], motion: Motion
) -> Figure:
    """Return position, velocity and acceleration of every joint between their limits (Fig. 4).

    Args:
        robot: Robot that moves.
        limits: Limits, drawn as lines where they are finite.
        time: Instants of the samples [s].
        motion: Motion at the samples.
    """
    speed, acceleration = np.asarray(limits.velocity), np.asarray(limits.acceleration)
    kinds = (
        ("position", "", motion.q, limits.position_min, limits.position_max),
        ("velocity", "/s", motion.qd, -speed, speed),
        ("acceleration", "/s²", motion.qdd, -acceleration, acceleration),
    )

    def panel(j: int) -> Panel:
        first, *below = (
            Panel(
                [Curve(time, np.asarray(values)[:, j], name, colour)],
                title="" if rate else robot.joint_names[j],
                y=f"{robot.joint_unit(j)}{rate}",
                levels=[
                    ("y", float(x[j]), VERMILION)
                    for x in ends
                    if np.isfinite(float(x[j]))
                ],
            )
            for (name, rate, values, *ends), colour in zip(kinds, CYCLE, strict=False)
        )
        return dataclasses.replace(
            first, below=below, x_range=(float(time[0]), float(time[-1]))
        )

    title = f"{robot.name}: motion of the joints (dashed: limits)"
    panels = [panel(j) for j in range(robot.joints)]
    return Figure(title, panels, columns=min(3, robot.joints), height=3.2)


def tip_figure(
    robot: Robot, time: Float[AnyArray, " samples"], motion: Motion
) -> Figure:
    """Return position, speed and acceleration of the end-effector (Sec. 4).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        motion: Motion of the joints at the samples.
    """
    with double_precision():
        position, *rates = (np.asarray(x) for x in tip_motion(robot, motion))
    axes = [Curve(time, position[:, k], "xyz"[k], CYCLE[k]) for k in range(3)]
    panels = [Panel(axes, title="position", unit="m")]
    for vectors, name, unit in zip(
        rates, ("speed", "acceleration"), ("m/s", "m/s²"), strict=True
    ):
        values = np.linalg.norm(vectors, axis=1)
        most = f"up to {values.max():.3g} {unit}"
        panels.append(Panel([Curve(time, values)], title=name, value=most, unit=unit))
    return Figure(f"{robot.name}: motion of the end-effector", panels, columns=3)


def filtered_figure(
    robot: Robot,
    time: Float[AnyArray, " samples"],
    desired: Motion,
    filtered: Motion,
    joint: int,
) -> Figure:
    """Return velocity and acceleration of a joint: as desired, and behind a filter (Fig. 5).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        desired: Desired motion at the samples.
        filtered: Motion that the filter makes of measured positions.
        joint: Index of the joint, from 0.
    """
    panels = []
    for name, rate, *pair in (
        ("velocity", "/s", desired.qd, filtered.qd),
        ("acceleration", "/s²", desired.qdd, filtered.qdd),
    ):
        unit = f"{robot.joint_unit(joint)}{rate}"
        wanted, measured = (np.asarray(x)[:, joint] for x in pair)
        rms = float(np.sqrt(np.mean((measured - wanted) ** 2)))
        curves = [
            Curve(time, wanted, "desired", MEASURED, width=2.4),
            Curve(time, measured, "filtered", PREDICTED),
        ]
        said = f"RMS difference {rms:.3g} {unit}"
        panels.append(Panel(curves, title=name, value=said, unit=unit))
    title = f"{robot.name}: {robot.joint_names[joint]}, desired and filtered"
    return Figure(title, panels)


def pose_figure(
    robot: Robot,
    q: Float[AnyArray, "samples joints"],
    time: Float[AnyArray, " samples"] | None = None,
    values: Float[AnyArray, "samples joints"] | None = None,
    label: str = "",
    poses: int = 6,
    title: str | None = None,
    shapes: CollisionModel | None = None,
) -> Figure:
    """Return the robot along a motion: moving on a page, in some poses on paper (Figs. 3, 8).

    Args:
        robot: Robot to draw.
        q: Joint coordinates along a motion [rad or m].
        time: Instants of the samples [s]; without them the page counts samples.
        values: Values of the joints that colour their links, and on average the path of
            the end-effector, such as torque errors.
        label: Name of these values, with their unit.
        poses: Number of poses on paper, evenly spaced from the first to the last.
        title: Title of the figure; the robot's name if None.
        shapes: Shapes of robot and surroundings that the page shows.
    """
    q = np.atleast_2d(np.asarray(q, np.float64))
    path = np.unique(np.linspace(0, len(q) - 1, min(1500, len(q))).round().astype(int))
    shown = np.linspace(0, len(path) - 1, min(150, len(path))).round().astype(int)
    if values is not None:
        # Each point stands for all samples up to the next.
        sizes = np.nan_to_num(np.abs(np.asarray(values, np.float64)))
        values = np.maximum.reduceat(sizes, path, axis=0)

    def place(x):
        return jnp.concatenate(
            [placements(robot, x)[1], tip_placement(robot, x)[1][None]]
        )

    with double_precision():
        points = in_numpy(robot, place, q[path])
    scene = Scene(
        time=np.asarray(np.arange(len(q)) if time is None else time)[path],
        points=points,
        links=(*robot.parent, robot.tip_body),
        frames=np.unique(shown),
        poses=poses,
        values=values,
        label=label,
        solids=None
        if shapes is None
        else _solids(robot, shapes, q[path][np.unique(shown)]),
    )
    return Figure(
        robot.name if title is None else title, height=2.6, width=7.5, scene=scene
    )


def _solids(
    robot: Robot, shapes: CollisionModel, q: Float[np.ndarray, "frames joints"]
) -> Solids:
    """Return the surfaces of all shapes, and the places of the bodies in some poses."""

    def body_places(x):
        rotations, origins = placements(robot, x)
        return jnp.concatenate([rotations, origins[:, :, None]], axis=2)

    with double_precision():
        places = in_numpy(robot, body_places, q)
    size = 0.7 * float(np.linalg.norm(places[..., 3], axis=2).max())
    clouds = [(c.body, _capsule_points(c)) for c in shapes.capsules]
    clouds += [(GROUND, _obstacle_points(x, size)) for x in shapes.obstacles]
    vertices, bodies, faces = [], [], []
    for body, points in clouds:
        hull = ConvexHull(points) if len(points) > 4 else None
        faces.append(
            (_SQUARE if hull is None else hull.simplices) + sum(map(len, vertices))
        )
        vertices.append(points)
        bodies.append(np.full(len(points), body))
    return Solids(
        np.concatenate(vertices), np.concatenate(bodies), np.concatenate(faces), places
    )


def _capsule_points(capsule: Capsule) -> Float[np.ndarray, "points 3"]:
    """Return points on two spheres at the ends of a capsule, spread by the golden angle."""
    turn, z = (
        np.pi * (3 - 5**0.5) * np.arange(SPREAD),
        1 - (2 * np.arange(SPREAD) + 1) / SPREAD,
    )
    ring = np.sqrt(1 - z**2)
    ball = float(capsule.radius) * np.stack(
        [ring * np.cos(turn), ring * np.sin(turn), z], axis=1
    )
    ends = np.unique(np.stack([capsule.start, capsule.end]), axis=0)
    return (ends[:, None] + ball).reshape(-1, 3)


def _obstacle_points(
    obstacle: HalfSpace | Box, size: float
) -> Float[np.ndarray, "points 3"]:
    """Return the corners of a box, or of a square in a plane around the ground's origin."""
    signs = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    if isinstance(obstacle, Box):
        corners = 0.5 * signs * np.asarray(obstacle.size)
        return np.asarray(obstacle.centre) + corners @ np.asarray(obstacle.rotation).T
    # The other two axes of a frame whose first one is the normal.
    normal = np.asarray(obstacle.normal)
    axes = np.linalg.svd(normal[None])[2][1:]
    return normal * np.asarray(obstacle.height) + size * signs[::2, :2] @ axes
