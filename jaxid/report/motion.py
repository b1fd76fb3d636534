"""Figures of a motion (Figs. 3, 4, 5 and 8): joints, end-effector, its path, and the robot."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxid.arrays import AnyArray, Float, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints import tip_motion
from jaxid.robot.collision import GROUND, CollisionModel
from jaxid.robot.forward_and_inverse_kinematics import placements, tip_placement
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot

from .style import (
    BLUE,
    GREY,
    INK,
    MEASURED,
    PALE,
    PREDICTED,
    VERMILION,
    WIDTH,
    add_legend,
    caption,
    drawing,
    label_time,
)

AZIMUTH, ELEVATION = -62.0, 22.0


def joint_figure(
    robot: Robot, limits: Limits, time: Float[AnyArray, " samples"], motion: Motion
) -> Figure:
    """Draw position, velocity and acceleration of every joint between their limits (Fig. 4).

    Args:
        robot: Robot that moves.
        limits: Limits, drawn as lines where they are finite.
        time: Instants of the samples [s].
        motion: Motion at the samples.
    """
    speed = np.asarray(limits.velocity)
    acceleration = np.asarray(limits.acceleration)
    kinds = (
        ("", motion.q, limits.position_min, limits.position_max),
        ("/s", motion.qd, -speed, speed),
        ("/s²", motion.qdd, -acceleration, acceleration),
    )
    title = f"{robot.name}: motion of the joints (dashed: limits)"
    with drawing(title, WIDTH, 1.25 * robot.joints + 0.36) as figure:
        panels = figure.subplots(robot.joints, 3, sharex=True, squeeze=False)
        for j, row in enumerate(panels):
            for axes, (rate, values, low, high) in zip(row, kinds, strict=True):
                axes.plot(time, np.asarray(values)[:, j], color=BLUE, linewidth=1.0)
                for limit in (float(low[j]), float(high[j])):
                    if np.isfinite(limit):
                        axes.axhline(limit, color=VERMILION, linewidth=0.7, linestyle="--")
                name = robot.joint_names[j] if axes is row[0] else ""
                caption(axes, name, f"[{robot.joint_unit(j)}{rate}]")
        label_time(panels[-1], np.asarray(time))
    return figure


def tip_figure(robot: Robot, time: Float[AnyArray, " samples"], motion: Motion) -> Figure:
    """Draw position, speed and acceleration of the end-effector (Sec. 4).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        motion: Motion of the joints at the samples.
    """
    with double_precision():
        position, *rates = (np.asarray(x) for x in tip_motion(robot, motion))
    with drawing(f"{robot.name}: motion of the end-effector", WIDTH, 5.2) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for k, (name, color) in enumerate(zip("xyz", (BLUE, VERMILION, GREY), strict=True)):
            panels[0].plot(time, position[:, k], color=color, linewidth=1.0, label=name)
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3)
        caption(panels[0], "position [m]")
        quantities = (("speed", "m/s"), ("acceleration", "m/s²"))
        for axes, vectors, (name, unit) in zip(panels[1:], rates, quantities, strict=True):
            values = np.linalg.norm(vectors, axis=1)
            axes.plot(time, values, color=BLUE, linewidth=1.0)
            caption(axes, name, f"up to {values.max():.3g} {unit}")
        label_time(panels[-1:], np.asarray(time))
    return figure


def filtered_figure(
    robot: Robot,
    time: Float[AnyArray, " samples"],
    desired: Motion,
    filtered: Motion,
    joint: int,
) -> Figure:
    """Draw velocity and acceleration of a joint: as desired, and behind a filter (Fig. 5).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        desired: Desired motion at the samples.
        filtered: Motion that the filter makes of measured positions.
        joint: Index of the joint, from 0.
    """
    unit = robot.joint_unit(joint)
    title = f"{robot.name}: {robot.joint_names[joint]}"
    with drawing(f"{title}, desired and filtered", WIDTH, 4.5) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for axes, name, rate, *pair in (
            (panels[0], "velocity", "/s", desired.qd, filtered.qd),
            (panels[1], "acceleration", "/s²", desired.qdd, filtered.qdd),
        ):
            wanted, measured = (np.asarray(x)[:, joint] for x in pair)
            axes.plot(time, wanted, color=MEASURED, linewidth=2.4)
            axes.plot(time, measured, color=PREDICTED, linewidth=1.0)
            rms = float(np.sqrt(np.mean((measured - wanted) ** 2)))
            caption(axes, f"{name} [{unit}{rate}]", f"RMS difference {rms:.3g} {unit}{rate}")
        label_time(panels[-1:], np.asarray(time))
        lines = {"color": MEASURED, "lw": 2.4}, {"color": PREDICTED, "lw": 1.2}
        add_legend(figure, ("desired", lines[0]), ("filtered", lines[1]))
    return figure


def path_figure(
    robot: Robot,
    motion: Motion,
    time: Float[AnyArray, " samples"] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw the path of the end-effector in space, coloured by its speed (Figs. 3, 8).

    Args:
        robot: Robot that moves.
        motion: Motion of the joints at some instants.
        time: Instants [s]; only for the title.
        title: Title of the figure; the robot's name if None.
    """
    with double_precision():
        position, velocity, _ = (np.asarray(x) for x in tip_motion(robot, motion))
    step = slice(None, None, max(1, len(position) // 1500))
    position, velocity = position[step], velocity[step]
    speed = np.linalg.norm(velocity, axis=1)
    low, high = position.min(axis=0), position.max(axis=0)
    span = np.maximum(high - low, max(0.25 * np.max(high - low), 0.05))
    duration = "" if time is None else f", {float(time[-1] - time[0]):.3g} s"
    name = f"{robot.name}: path of the end-effector" if title is None else title
    with drawing(f"{name}{duration}; up to {speed.max():.3g} m/s", 7.0, 5.0) as figure:
        axes: Any = figure.add_subplot(projection="3d", proj_type="ortho")
        line = Line3DCollection(
            np.stack([position[:-1], position[1:]], axis=1), cmap="viridis", linewidth=1.6
        )
        line.set_array(0.5 * (speed[:-1] + speed[1:]))
        axes.add_collection3d(line, autolim=False)
        for point, marker in ((position[0], "o"), (position[-1], "s")):
            axes.plot(*point[:, None], marker=marker, color=INK, ms=4)
        for k, name in enumerate("xyz"):
            middle = 0.5 * (low[k] + high[k])
            getattr(axes, f"set_{name}lim")(middle - 0.55 * span[k], middle + 0.55 * span[k])
            getattr(axes, f"set_{name}label")(f"{name} [m]")
            getattr(axes, f"{name}axis").set_pane_color((1.0, 1.0, 1.0, 0.0))
        axes.set_box_aspect(span, zoom=1.1)
        axes.locator_params(nbins=5)
        axes.view_init(ELEVATION, AZIMUTH)
        bar = figure.colorbar(line, shrink=0.7, aspect=25, label="speed [m/s]")
        bar.outline.set_visible(False)
    return figure


def pose_figure(
    robot: Robot,
    q: Float[AnyArray, "samples joints"],
    collision: CollisionModel | None = None,
    poses: int = 6,
    title: str | None = None,
) -> Figure:
    """Draw the robot in some poses, as lines through its joints with its capsules around them.

    Earlier poses are paler. The coloured line is the path of the end-effector.

    Args:
        robot: Robot to draw.
        q: Joint coordinates along a motion [rad or m].
        collision: Collision model, whose capsules are drawn.
        poses: Number of poses, evenly spaced from the first to the last.
        title: Title of the figure; the robot's name if None.
    """
    view = _project(robot, np.atleast_2d(np.asarray(q, np.float64)), collision)
    samples = len(view.tip)
    places = np.unique(np.linspace(0, samples - 1, min(poses, samples)).round().astype(int))
    with drawing(robot.name if title is None else title) as figure:
        axes = _draw_scene(figure, view)
        axes.plot(*view.tip.T, color=VERMILION, lw=1.0, zorder=1.5)
        for place, k in enumerate(places, 1):
            strength = 0.16 + 0.84 * (place / len(places)) ** 2
            for artist in _pose_artists(view, int(k), strength):
                axes.add_collection(artist)
    return figure


def animation(
    path: Path,
    robot: Robot,
    time: Float[AnyArray, " samples"],
    q: Float[AnyArray, "samples joints"],
    collision: CollisionModel | None = None,
    frames: int = 60,
) -> None:
    """Write an animation of the robot with its capsules, as a GIF that repeats.

    Args:
        path: GIF file.
        robot: Robot to draw.
        time: Instants of the samples [s].
        q: Joint coordinates [rad or m].
        collision: Collision model, whose capsules are drawn.
        frames: Number of pictures, two at least.
    """
    t = np.asarray(time, np.float64)
    q = np.asarray(q, np.float64)
    instants = np.linspace(t[0], t[-1], frames)
    shown = np.stack([np.interp(instants, t, column) for column in q.T], axis=1)
    view = _project(robot, shown, collision)
    with drawing(robot.name) as figure:
        axes = _draw_scene(figure, view)
        axes.plot(*view.tip.T, color=VERMILION, lw=0.8, alpha=0.5, zorder=1.5)
        clock = axes.set_title("", loc="right", color=GREY)
        figure.canvas.draw()
        figure.set_layout_engine("none")
        rate: Any = (frames - 1) / float(t[-1] - t[0])
        writer = PillowWriter(fps=rate)
        with writer.saving(figure, path, dpi=80):
            for k, instant in enumerate(instants):
                drawn = [axes.add_collection(artist) for artist in _pose_artists(view, k, 1.0)]
                clock.set_text(f"{instant - t[0]:.1f} s")
                writer.grab_frame()
                for artist in drawn:
                    artist.remove()


class _View(NamedTuple):
    """Poses of a robot in a view: to the right, up, and towards the reader [m]."""

    bones: Float[np.ndarray, "poses bones 2 3"]
    tip: Float[np.ndarray, "poses 2"]
    floor: Float[np.ndarray, "lines 2 2"]
    moving: Float[np.ndarray, "poses capsules 2 3"]
    radii: Float[np.ndarray, " capsules"]
    fixed: list[Float[np.ndarray, "points 2"]]
    revolute: tuple[bool, ...]


def _project(robot: Robot, q: np.ndarray, collision: CollisionModel | None) -> _View:
    """Return the poses of a robot as seen from `AZIMUTH` and `ELEVATION`."""
    with double_precision():
        origins, tips, ends = (np.asarray(x) for x in _place_bodies(robot, collision, q))
    starts = [origins[:, p] if p >= 0 else np.zeros_like(tips) for p in robot.parent]
    bones = [np.stack([p, origins[:, i]], axis=1) for i, p in enumerate(starts)]
    bones.append(np.stack([origins[:, robot.tip_body], tips], axis=1))
    points = np.stack(bones, axis=1)
    low = points.min(axis=(0, 1, 2))
    high = points.max(axis=(0, 1, 2))
    margin = 0.1 * np.max(high - low)
    x, y = (MaxNLocator(12).tick_values(low[k] - margin, high[k] + margin) for k in range(2))
    across = [[[u, y[0], 0.0], [u, y[-1], 0.0]] for u in x]
    floor = np.array([*across, *([[x[0], v, 0.0], [x[-1], v, 0.0]] for v in y)])
    a, e = np.radians((AZIMUTH, ELEVATION))
    ahead = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    camera = np.stack([right, np.cross(ahead, right), ahead]).T
    capsules = () if collision is None else collision.capsules
    radii = np.array([float(c.radius) for c in capsules])
    moves = np.array([c.body != GROUND for c in capsules], bool)
    seen = ends @ camera
    return _View(
        points @ camera,
        (tips @ camera)[:, :2],
        floor @ camera[:, :2],
        seen[:, moves],
        radii[moves],
        [_outline(seen[0, i, :, :2], float(radii[i])) for i in np.flatnonzero(~moves)],
        robot.revolute,
    )


@eqx.filter_jit
def _place_bodies(robot: Robot, collision: CollisionModel | None, q: Float[AnyArray, "poses n"]):
    """Return origins of all bodies, end-effectors, and ends of all capsules in space [m]."""

    def place(x):
        ends = np.zeros((0, 2, 3)) if collision is None else collision.ends(robot, x)
        return placements(robot, x)[1], tip_placement(robot, x)[1], ends

    return jax.vmap(place)(q)


def _outline(ends: np.ndarray, radius: float) -> np.ndarray:
    """Return the outline of a capsule: a circle if it is seen from its end."""
    dx, dy = ends[1] - ends[0]
    half_turn = np.arctan2(dy, dx) + np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    arcs = [
        end + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        for end, angles in ((ends[1], half_turn), (ends[0], half_turn + np.pi))
    ]
    return np.concatenate(arcs)


def _pose_artists(
    view: _View, k: int, strength: float
) -> Iterator[PolyCollection | LineCollection]:
    """Yield one pose: its capsules, those in front last, then its lines and joints above them."""
    z = 2.0 + strength
    capsules = view.moving[k]
    lines = view.bones[k][..., :2]
    shapes = [
        _outline(capsules[i, :, :2], float(view.radii[i]))
        for i in np.argsort(capsules[:, :, 2].mean(axis=1), kind="stable")
    ]
    yield PolyCollection(
        shapes, facecolors=BLUE, edgecolors=BLUE, lw=0.6, alpha=0.28 * strength, zorder=z
    )
    yield LineCollection(
        list(lines), colors=INK, lw=2.2, alpha=strength, capstyle="round", zorder=z + 0.1
    )
    size = 0.008 * np.ptp(view.floor[..., 0])
    joints = [_outline(np.stack([line[1]] * 2), size) for line in lines[:-1]]
    faces = ["white" if revolute else GREY for revolute in view.revolute]
    yield PolyCollection(
        joints, facecolors=faces, edgecolors=INK, lw=1.0, alpha=strength, zorder=z + 0.2
    )


def _draw_scene(figure: Figure, view: _View) -> Axes:
    """Draw the grid on the ground and fixed capsules, with room for all poses."""
    shapes = view.moving[..., :2].reshape(-1, 2)
    reach = view.radii.max(initial=0.0)
    lines = view.floor.reshape(-1, 2), view.bones[..., :2].reshape(-1, 2)
    points = np.concatenate([*lines, shapes - reach, shapes + reach])
    low, (width, height) = points.min(axis=0), np.ptp(points, axis=0)
    figure.set_size_inches(7.0, max(2.5, min(7.0 * height / width + 0.5, 9.1)))
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(low[0] - 0.02 * width, low[0] + 1.02 * width)
    axes.set_ylim(low[1] - 0.02 * width, low[1] + height + 0.02 * width)
    axes.add_collection(LineCollection(list(view.floor), colors=PALE, lw=0.7, zorder=0.5))
    axes.add_collection(
        PolyCollection(view.fixed, facecolors=PALE, edgecolors=GREY, lw=0.6, zorder=1)
    )
    return axes
