"""Figures on paper and in notebooks, by matplotlib, which only this module loads."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from .figure_elements import (
    GREY,
    INK,
    VERMILION,
    Curve,
    Drawing,
    Panel,
    Scene,
    decimate,
)

STYLE = ["default", Path(__file__).with_name("figures.mplstyle")]
"""Settings of matplotlib, which stay within this module."""
TITLE_HEIGHT = 0.9
"""Height of title and legend [inch]."""
SMALL_SIZE = 7.5
"""Size of the texts on bars [pt]."""
TITLE_LENGTH = 70
"""Largest number of letters in a line of a figure's title."""
PANEL_TITLE_LENGTH = 26
"""Largest number of letters in a line of a panel's title, beside its value."""
TICK_LENGTH = 20
"""Largest number of letters in a line of a name on an axis."""
POSES_ON_PAPER = 6
"""Poses of a robot, evenly spaced from the first to the last of a motion."""
DATED_ENTRIES = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}
"""Entry of a file that differs from day to day, or with the version of matplotlib."""


def draw(drawing: Drawing) -> Figure:
    """Return a figure as matplotlib draws it."""
    # A scene is as high as two rows of panels.
    rows = math.ceil(len(drawing.panels) / drawing.columns) or 2
    size = (drawing.width, TITLE_HEIGHT + drawing.height * rows)
    with matplotlib.style.context(STYLE):
        # The figure belongs to no window and no list of figures.
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        title = textwrap.fill(drawing.title, TITLE_LENGTH)
        figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        if drawing.scene is not None:
            _draw_scene(figure, drawing.scene)
            return figure
        grid = figure.add_gridspec(rows, drawing.columns)
        for number, panel in enumerate(drawing.panels):
            cell = grid[divmod(number, drawing.columns)]
            figure.align_ylabels(_draw_stack(figure, cell, panel))
        _draw_legend(figure, drawing)
    return figure


def save(drawing: Drawing, file: Any, suffix: str) -> None:
    """Write a figure as PNG, PDF or SVG, without time or version in the file."""
    figure = draw(drawing)
    metadata = {DATED_ENTRIES.get(suffix, "Date"): None}
    with matplotlib.style.context([*STYLE, {"svg.fonttype": "none"}]):
        figure.savefig(file, format=suffix, dpi=130, metadata=metadata)


def _draw_legend(figure: Figure, drawing: Drawing) -> None:
    """Draw one legend for all panels."""
    handles = {}
    for axes in figure.axes:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    names = [curve.name for curve in drawing.legend]
    figure.legend(
        [handles[name] for name in names], names, loc="outside lower left", ncols=4
    )


def _draw_stack(figure: Figure, cell: Any, panel: Panel) -> list[Axes]:
    """Draw a panel and those below it, and return their axes."""
    shares = [part.share for part in panel.parts]
    grid = cell.subgridspec(len(shares), 1, height_ratios=shares)
    stack: list[Axes] = []
    for number, part in enumerate(panel.parts):
        axes = figure.add_subplot(grid[number], sharex=stack[0] if stack else None)
        _draw_panel(axes, part)
        axes.tick_params(labelbottom=False)
        stack.append(axes)
    stack[-1].tick_params(labelbottom=True)
    stack[-1].set_xlabel(panel.parts[-1].x)
    return stack


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for letter in panel.log:
        axes.set(**{f"{letter}scale": "log"})
        getattr(axes, f"{letter}axis").set_major_formatter(LogFormatter())
    for direction, value, colour in panel.levels:
        line = axes.axvline if direction == "x" else axes.axhline
        line(value, color=colour, lw=0.7, ls="--" if value else "-", zorder=1)
    for curve in panel.curves:
        _draw_curve(axes, curve, panel.in_time)
    title = textwrap.fill(panel.title, PANEL_TITLE_LENGTH)
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_title(panel.value, loc="right", color=GREY, fontsize=8)
    axes.set_ylabel(panel.y_label)
    axes.set_xlim(panel.x_range)
    if panel.share < 1.0:
        axes.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
    if panel.x_names:
        _name_abscissas(axes, panel.x_names)
    if panel.y_names:
        _name_ordinates(axes, panel.y_names)


def _name_abscissas(axes: Axes, names: Sequence[str]) -> None:
    """Write names instead of numbers, tilted where they are many or long."""
    axes.set_xticks(np.arange(len(names)), _folded_names(names))
    if len(names) > 10 or max(map(len, names)) > 12:
        axes.tick_params("x", labelrotation=35)
        for label in axes.get_xticklabels():
            label.set_horizontalalignment("right")
    axes.grid(visible=False, axis="x")


def _name_ordinates(axes: Axes, names: Sequence[str]) -> None:
    """Write names instead of numbers, from the top."""
    axes.set_yticks(np.arange(len(names)), _folded_names(names))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def _folded_names(names: Sequence[str]) -> list[str]:
    return [textwrap.fill(name, TICK_LENGTH) for name in names]


def _draw_curve(axes: Axes, curve: Curve, in_time: bool) -> None:
    x = curve.x
    y = curve.y
    style: dict[str, Any] = {"color": curve.colour, "label": curve.name or "_"}
    match curve.kind:
        case "band":
            axes.fill_between(x, curve.low, curve.high, alpha=0.3, lw=0, **style)
        case "bars":
            bars = axes.bar(x, y, curve.width, **style)
            axes.bar_label(
                bars, curve.texts, label_type="center", fontsize=SMALL_SIZE, color=INK
            )
        case "intervals":
            axes.hlines(y, curve.low, curve.high, color=curve.colour, lw=1.4)
            axes.scatter(x, y, s=16, zorder=3, **style)
        case "points":
            axes.scatter(x, y, s=16, zorder=3, **style)
        case "line":
            if in_time:
                x, y = decimate(x, y)
            dashes = "--" if curve.dashed else "-"
            marker = "o" if curve.marker else ""
            axes.plot(x, y, lw=curve.width, ls=dashes, marker=marker, ms=2.6, **style)


def _draw_scene(figure: Figure, scene: Scene) -> None:
    """Draw the robot in some poses, and the path of its end-effector."""
    axes: Any = figure.add_subplot(
        projection="3d", proj_type="ortho", elev=22.0, azim=-62.0
    )
    _draw_path(figure, axes, scene)
    _draw_poses(axes, scene)
    low = scene.bones.min(axis=(0, 1, 2))
    high = scene.bones.max(axis=(0, 1, 2))
    axes.auto_scale_xyz(*np.stack([low, high], axis=1))
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")


def _draw_path(figure: Figure, axes: Any, scene: Scene) -> None:
    """Draw the path of the end-effector, coloured by the values along it."""
    tip = scene.points[:, -1]
    steps = np.stack([tip[:-1], tip[1:]], axis=1)
    if scene.values is None:
        path = Line3DCollection(steps, color=VERMILION, lw=1.2)
    else:
        path = Line3DCollection(steps, cmap="viridis", lw=1.4)
        path.set_array(scene.mean[:-1])
        if scene.label:
            figure.colorbar(path, ax=axes, shrink=0.7, label=scene.label)
    axes.add_collection3d(path, autolim=False)


def _draw_poses(axes: Any, scene: Scene) -> None:
    """Draw the robot in some poses, earlier ones paler."""
    samples = len(scene.points)
    count = min(POSES_ON_PAPER, samples)
    poses = np.linspace(0, samples - 1, count).round().astype(int)
    for number, pose in enumerate(poses, 1):
        opacity = 0.16 + 0.84 * (number / count) ** 2
        bones = Line3DCollection(scene.bones[pose], lw=2.4, color=INK, alpha=opacity)
        axes.add_collection3d(bones, autolim=False)
        joints = scene.points[pose, :-1]
        axes.scatter(*joints.T, s=18, color=INK, alpha=opacity)
