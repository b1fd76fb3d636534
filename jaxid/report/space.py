"""Figures in space: the way of the end-effector, and the robot with its capsules on the way."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxid.arrays import AnyArray, Float, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints.tip import tip_motion
from jaxid.report.style import (
    BLUE,
    GREY,
    HEADING,
    INK,
    PALE,
    VERMILION,
    heading,
    house_style,
    new_figure,
)
from jaxid.robot.collision import GROUND, CollisionModel
from jaxid.robot.kinematics import placements, tip_placement
from jaxid.robot.robot import Robot

SIZE = 7.0
"""Width of a figure [inch]."""
AZIMUTH, ELEVATION = -62.0, 22.0
"""Where the reader stands [deg]."""
BAR = 1.05
"""Width that a scale of colours needs with its labels and the gap before it [inch]."""
MARGIN = 0.08
TALLEST = 5.0
"""Height of a box in space at most [inch]."""
POINTS = 1500
"""Points of a path at most."""
ROUND = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
FADED = 0.16
"""How much of the first of several poses is visible, of 1."""


def path_figure(
    robot: Robot,
    motion: Motion,
    time: Float[AnyArray, " samples"] | None = None,
    title: str | None = None,
) -> Figure:
    """The way of the end-effector in space, its colour the speed (Figs. 3, 8).

    Args:
        robot: Whose end-effector moves.
        motion: At some instants.
        time: Of the instants [s]; only for the title.
        title: Of the figure; the robot's name if None.
    """
    with double_precision():
        tip = tip_motion(robot, motion)
    every = slice(None, None, max(1, len(np.asarray(tip.position)) // POINTS))
    position, velocity = np.asarray(tip.position)[every], np.asarray(tip.velocity)[every]
    speed = np.linalg.norm(velocity, axis=1)
    with house_style():
        figure = new_figure(SIZE, SIZE)
        figure.set_layout_engine("none")
        axes = figure.add_subplot(projection="3d", proj_type="ortho")
        line = Line3DCollection(
            np.stack([position[:-1], position[1:]], axis=1), cmap="viridis", linewidth=1.6
        )
        line.set_array(0.5 * (speed[:-1] + speed[1:]))
        axes.add_collection3d(line, autolim=False)
        for point, marker in ((position[0], "o"), (position[-1], "s")):
            axes.plot(*point[:, None], marker=marker, color=INK, ms=4)
        low, high = position.min(axis=0), position.max(axis=0)
        middle, span = 0.5 * (low + high), np.maximum(high - low, 0.25 * np.max(high - low))
        half = 0.55 * np.where(span > 0, span, 0.1)
        for k, name in enumerate("xyz"):
            getattr(axes, f"set_{name}lim")(middle[k] - half[k], middle[k] + half[k])
            getattr(axes, f"set_{name}label")(f"{name} [m]")
            getattr(axes, f"{name}axis").set_pane_color((1.0, 1.0, 1.0, 0.0))
        axes.set_box_aspect(half)
        axes.locator_params(nbins=5)
        axes.view_init(ELEVATION, AZIMUTH)
        beside = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        bar = figure.colorbar(line, cax=beside)
        bar.set_label("speed [m/s]")
        bar.outline.set_visible(False)
        _fill(figure, axes, beside)
        duration = "" if time is None else f", {float(time[-1] - time[0]):.3g} s"
        name = f"{robot.name}: path of the end-effector" if title is None else title
        heading(figure, f"{name}{duration}; up to {speed.max():.3g} m/s")
    return figure


def pose_figure(
    robot: Robot,
    q: Float[AnyArray, "samples joints"],
    collision: CollisionModel | None = None,
    poses: int = 6,
    title: str | None = None,
) -> Figure:
    """The robot in some poses, as lines through its joints, with its capsules around them.

    Earlier poses are paler. The coloured line is the way of the end-effector.

    Args:
        robot: The robot.
        q: Joint coordinates along a motion [rad or m].
        collision: Whose capsules are drawn; none if None.
        poses: How many of them are drawn, evenly from the first to the last; all if there are
            fewer.
        title: Of the figure; the robot's name if None.
    """
    seen = _Seen.of(robot, np.atleast_2d(np.asarray(q, np.float64)), collision)
    samples = len(seen.tip)
    places = np.unique(np.linspace(0, samples - 1, min(poses, samples)).round().astype(int))
    with house_style():
        figure, axes = _stage(seen)
        axes.plot(*seen.tip.T, color=VERMILION, lw=1.0, zorder=1.5)
        for place, k in enumerate(places, 1):
            strength = FADED + (1.0 - FADED) * (place / len(places)) ** 2
            for artist in seen.artists(int(k), strength):
                axes.add_collection(artist)
        heading(figure, robot.name if title is None else title)
    return figure


def animation(
    path: Path,
    robot: Robot,
    time: Float[AnyArray, " samples"],
    q: Float[AnyArray, "samples joints"],
    collision: CollisionModel | None = None,
    frames: int = 60,
) -> None:
    """Writes a moving picture of the robot with its capsules, as a GIF that repeats.

    Args:
        path: Of the file.
        robot: The robot.
        time: Of the samples [s].
        q: Joint coordinates [rad or m].
        collision: Whose capsules are drawn; none if None.
        frames: Pictures in all.

    Raises:
        InputError: If there are fewer than two samples or pictures.
    """
    t, q = np.asarray(time, np.float64), np.asarray(q, np.float64)
    if len(t) < 2 or frames < 2:
        raise InputError(
            f"`time` and `frames` must give at least two pictures, but are {len(t)} samples and "
            f"{frames} pictures."
        )
    instants = np.linspace(t[0], t[-1], frames)
    shown = np.stack([np.interp(instants, t, column) for column in q.T], axis=1)
    seen = _Seen.of(robot, shown, collision)
    with house_style():
        figure, axes = _stage(seen)
        heading(figure, robot.name)
        axes.plot(*seen.tip.T, color=VERMILION, lw=0.8, alpha=0.5, zorder=1.5)
        said = axes.set_title("", loc="right", color=GREY)
        figure.canvas.draw()
        figure.set_layout_engine("none")
        rate = (frames - 1) / float(t[-1] - t[0])
        writer = PillowWriter(fps=rate)  # pyright: ignore[reportArgumentType]
        with writer.saving(figure, path, dpi=80):
            for k, instant in enumerate(instants):
                drawn = [axes.add_collection(artist) for artist in seen.artists(k, 1.0)]
                said.set_text(f"{instant - t[0]:.1f} s")
                writer.grab_frame()
                for artist in drawn:
                    artist.remove()


class _Seen(eqx.Module):
    """Poses of a robot, as a reader sees them: two coordinates and the distance towards him."""

    bones: Float[np.ndarray, "poses bones 2 3"]
    capsules: Float[np.ndarray, "poses capsules 2 3"]
    radii: Float[np.ndarray, " capsules"]
    still: tuple[bool, ...]
    tip: Float[np.ndarray, "poses 2"]
    floor: Float[np.ndarray, "lines 2 2"]
    turns: tuple[bool, ...]

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray, collision: CollisionModel | None) -> "_Seen":
        with double_precision():
            origins, tips, ends = (np.asarray(x) for x in _places(robot, collision, q))
        foot = np.zeros_like(tips)
        parents = [origins[:, p] if p >= 0 else foot for p in robot.parent]
        bones = [np.stack([p, origins[:, i]], axis=1) for i, p in enumerate(parents)]
        bones.append(np.stack([origins[:, robot.tip_body], tips], axis=1))
        camera = _camera()
        everything = np.stack(bones, axis=1)
        shapes = () if collision is None else collision.capsules
        return cls(
            everything @ camera.T,
            ends @ camera.T,
            np.array([float(c.radius) for c in shapes]),
            tuple(c.body == GROUND for c in shapes),
            (tips @ camera.T)[:, :2],
            _floor(everything.reshape(-1, 3)) @ camera.T[:, :2],
            robot.revolute,
        )

    def outline(self, k: int, capsule: int) -> Float[np.ndarray, "points 2"]:
        """Of a capsule in one pose."""
        return _stadium(self.capsules[k, capsule, :, :2], float(self.radii[capsule]))

    def artists(self, k: int, strength: float) -> Iterator[PolyCollection | LineCollection]:
        """One pose: its capsules, those in front last, and its lines and joints above them."""
        capsules = self.capsules[k]
        moving = [i for i, still in enumerate(self.still) if not still]
        order = sorted(moving, key=lambda i: capsules[i, :, 2].mean())
        shapes = [self.outline(k, i) for i in order]
        z = 2.0 + strength
        yield PolyCollection(
            shapes, facecolors=BLUE, edgecolors=BLUE, lw=0.6, alpha=0.28 * strength, zorder=z
        )
        lines = self.bones[k][..., :2]
        yield LineCollection(
            list(lines), colors=INK, lw=2.2, alpha=strength, capstyle="round", zorder=z + 0.1
        )
        size = 0.008 * np.ptp(self.floor[..., 0])
        joints = [_stadium(np.stack([line[1]] * 2), size) for line in lines[:-1]]
        faces = ["white" if turns else GREY for turns in self.turns]
        yield PolyCollection(
            joints, facecolors=faces, edgecolors=INK, lw=1.0, alpha=strength, zorder=z + 0.2
        )


@eqx.filter_jit
def _places(robot: Robot, collision: CollisionModel | None, q: Float[AnyArray, "poses joints"]):
    """Origins of all bodies, end-effectors, and ends of all capsules, in the ground's frame [m]."""

    def one(x):
        ends = np.zeros((0, 2, 3)) if collision is None else collision.ends(robot, x)
        return placements(robot, x)[1], tip_placement(robot, x)[1], ends

    return jax.vmap(one)(q)


def _camera() -> Float[np.ndarray, "3 3"]:
    """Rows: to the right, up, and towards the reader."""
    a, e = np.radians((AZIMUTH, ELEVATION))
    ahead = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(ahead, right), ahead])


def _floor(points: np.ndarray) -> Float[np.ndarray, "lines 2 3"]:
    """A net on the ground below all points."""
    reach = np.max(np.ptp(points, axis=0))
    step = 10.0 ** np.floor(np.log10(max(reach, 1e-3)))
    step *= 0.5 if reach > 4 * step else 0.25 if reach > 1.5 * step else 0.1
    low = np.floor(points.min(axis=0)[:2] / step - 1.0) * step
    high = np.ceil(points.max(axis=0)[:2] / step + 1.0) * step
    x, y = (np.arange(low[k], high[k] + 0.5 * step, step) for k in range(2))
    across = [[[u, low[1], 0.0], [u, high[1], 0.0]] for u in x]
    along = [[[low[0], v, 0.0], [high[0], v, 0.0]] for v in y]
    return np.array([*across, *along])


def _stadium(ends: Float[np.ndarray, "2 2"], radius: float) -> Float[np.ndarray, "points 2"]:
    """The outline of a capsule: a circle if it is seen from its end."""
    dx, dy = ends[1] - ends[0]
    turned = np.arctan2(dy, dx)
    arcs = [
        end + radius * np.stack([np.cos(turned + at), np.sin(turned + at)], axis=1)
        for end, at in ((ends[1], ROUND), (ends[0], ROUND + np.pi))
    ]
    return np.concatenate(arcs)


def _fill(figure: Figure, axes: Any, bar: Axes) -> None:
    """Gives a box in space the width of a figure, a bar the room beside it, and cuts what is left.

    Axes in space keep a square around the box in which it could turn: most of it is empty.
    """
    renderer = FigureCanvasAgg(figure).get_renderer()
    side, low, width, height = SIZE, np.zeros(2), SIZE, SIZE
    for _ in range(3):
        # Letters do not grow with the box: what fits is found step by step.
        axes.set_position((0.0, 0.0, side / SIZE, side / SIZE))
        figure.draw_without_rendering()
        ends = _drawn(axes, renderer) / figure.dpi
        width, height = np.ptp(ends, axis=0).tolist()
        fits = min((SIZE - BAR - 2 * MARGIN) / width, TALLEST / height)
        low, width, height, side = (fits * x for x in (ends[0], width, height, side))
    whole = height + HEADING + 2 * MARGIN
    figure.set_figheight(whole)
    left, foot = (MARGIN - low).tolist()
    axes.set_position((left / SIZE, foot / whole, side / SIZE, side / whole))
    share = 0.8 * min(height, 3.0)
    left, foot = 2 * MARGIN + width, MARGIN + 0.5 * (height - share)
    bar.set_position((left / SIZE, foot / whole, 0.16 / SIZE, share / whole))


def _drawn(axes: Any, renderer: Any) -> Float[np.ndarray, "2 2"]:
    """Lowest and highest point of a box in space with its labels, on the screen [dots]."""
    boxes = [axis.get_tightbbox(renderer) for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
    limits = (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())
    xs, ys, zs = np.array(list(itertools.product(*limits))).T
    x, y, _ = proj3d.proj_transform(xs, ys, zs, axes.get_proj())
    seen = axes.transData.transform(np.column_stack([x, y]))
    points = np.concatenate([seen, *(box.get_points() for box in boxes)])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _stage(seen: _Seen) -> tuple[Figure, Axes]:
    """An empty figure with the net on the ground, and room for all that moves."""
    moving = [i for i, stands in enumerate(seen.still) if not stands]
    reach = seen.radii[moving].max(initial=0.0)
    points = np.concatenate([seen.floor.reshape(-1, 2), seen.bones[..., :2].reshape(-1, 2)])
    shapes = seen.capsules[:, moving, :, :2].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    if len(shapes):
        low = np.minimum(low, shapes.min(axis=0) - reach)
        high = np.maximum(high, shapes.max(axis=0) + reach)
    width, height = high - low
    figure = new_figure(SIZE, max(2.5, min(SIZE * height / width + 0.5, 1.3 * SIZE)))
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    margin = 0.02 * width
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.add_collection(LineCollection(list(seen.floor), colors=PALE, lw=0.7, zorder=0.5))
    still = [seen.outline(0, i) for i, stands in enumerate(seen.still) if stands]
    axes.add_collection(PolyCollection(still, facecolors=PALE, edgecolors=GREY, lw=0.6, zorder=1))
    return figure, axes
