"""A robot in some poses, or as an animation, drawn by matplotlib in a parallel projection."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxid.arrays import Float

from .figure import BLUE, GREY, INK, PALE, VERMILION, Scene
from .paper import drawing

AZIMUTH, ELEVATION = -62.0, 22.0


def draw_poses(scene: Scene) -> Figure:
    """Return the robot in some poses, as lines through its joints with its capsules around them.

    Earlier poses are paler. The line is the path of the end-effector, coloured by the values.
    """
    view = _project(scene)
    samples = len(view.tip)
    places = np.unique(np.linspace(0, samples - 1, min(scene.poses, samples)).round().astype(int))
    with drawing(scene.title) as figure:
        axes = _draw_scene(figure, view)
        if scene.values is None:
            axes.plot(*view.tip.T, color=VERMILION, lw=1.0, zorder=1.5)
        else:
            pieces = np.stack([view.tip[:-1], view.tip[1:]], axis=1)
            path = LineCollection(list(pieces), cmap="viridis", lw=1.4, zorder=1.5)
            path.set_array(scene.mean[:-1])
            figure.colorbar(axes.add_collection(path), shrink=0.6, label=scene.label)
        for place, k in enumerate(places, 1):
            strength = 0.16 + 0.84 * (place / len(places)) ** 2
            for artist in _pose_artists(view, int(k), strength):
                axes.add_collection(artist)
    return figure


def write_animation(path: Path, scene: Scene) -> None:
    """Write all poses of a scene as a GIF that repeats."""
    view, time = _project(scene), scene.time
    with drawing(scene.title) as figure:
        axes = _draw_scene(figure, view)
        axes.plot(*view.tip.T, color=VERMILION, lw=0.8, alpha=0.5, zorder=1.5)
        clock = axes.set_title("", loc="right", color=GREY)
        figure.canvas.draw()
        figure.set_layout_engine("none")
        rate: Any = (len(time) - 1) / float(time[-1] - time[0])
        writer = PillowWriter(fps=rate)
        with writer.saving(figure, path, dpi=80):
            for k, instant in enumerate(time):
                drawn = [axes.add_collection(artist) for artist in _pose_artists(view, k, 1.0)]
                clock.set_text(f"{instant - time[0]:.1f} s")
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


def _project(scene: Scene) -> _View:
    """Return the poses of a scene as seen from `AZIMUTH` and `ELEVATION`."""
    points = scene.bones
    low, high = points.min(axis=(0, 1, 2)), points.max(axis=(0, 1, 2))
    margin = 0.1 * np.max(high - low)
    x, y = (MaxNLocator(12).tick_values(low[k] - margin, high[k] + margin) for k in range(2))
    across = [[[u, y[0], 0.0], [u, y[-1], 0.0]] for u in x]
    floor = np.array([*across, *([[x[0], v, 0.0], [x[-1], v, 0.0]] for v in y)])
    a, e = np.radians((AZIMUTH, ELEVATION))
    ahead = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    camera = np.stack([right, np.cross(ahead, right), ahead]).T
    seen, radii, moves = scene.ends @ camera, scene.radii, scene.moving
    return _View(
        points @ camera,
        (scene.points[:, -1] @ camera)[:, :2],
        floor @ camera[:, :2],
        seen[:, moves],
        radii[moves],
        [_outline(seen[0, i, :, :2], float(radii[i])) for i in np.flatnonzero(~moves)],
        scene.revolute,
    )


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
