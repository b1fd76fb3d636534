"""Figures on paper and in notebooks: drawn by matplotlib, which only this module loads."""

import math
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import LogFormatter, MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from .figure import GREY, INK, VERMILION, Curve, Figure, Panel, Scene, decimate

STYLE = ["default", Path(__file__).with_name("figures.mplstyle")]
"""Settings of matplotlib, which stay within this module."""


def draw(figure: Figure) -> Drawing:
    """Return a figure as matplotlib draws it."""
    rows = math.ceil(len(figure.panels) / figure.columns) or 2
    with matplotlib.style.context(STYLE):
        # The figure belongs to no window and no list of figures.
        drawn = Drawing(
            figsize=(figure.width, 0.9 + figure.height * rows), layout="constrained"
        )
        FigureCanvasAgg(drawn)
        drawn.suptitle(figure.title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        if figure.scene is not None:
            _draw_scene(drawn, figure.scene)
            return drawn
        grid = drawn.add_gridspec(rows, figure.columns)
        for place, panel in enumerate(figure.panels):
            drawn.align_ylabels(
                _draw_stack(drawn, grid[divmod(place, figure.columns)], panel)
            )
        labelled = [axes.get_legend_handles_labels() for axes in drawn.axes]
        entries = {name: x for pair in labelled for x, name in zip(*pair, strict=True)}
        drawn.legend(
            [entries[name] for name, _ in figure.legend],
            [name for name, _ in figure.legend],
            loc="outside lower left",
            ncols=4,
        )
    return drawn


def save(figure: Figure, file: Any, suffix: str) -> None:
    """Write a figure as PNG, PDF or SVG, without time or version in the file."""
    unwanted = {"png": "Software", "pdf": "CreationDate"}.get(suffix, "Date")
    drawn = draw(figure)
    with matplotlib.style.context([*STYLE, {"svg.fonttype": "none"}]):
        drawn.savefig(file, format=suffix, dpi=130, metadata={unwanted: None})


def _draw_stack(drawn: Drawing, cell: Any, panel: Panel) -> list[Axes]:
    """Draw a panel and those below it, and return their axes."""
    shares = [part.share for part in panel.parts]
    stack = cell.subgridspec(len(shares), 1, height_ratios=shares)
    found: list[Axes] = []
    for k, part in enumerate(panel.parts):
        axes = drawn.add_subplot(stack[k], sharex=found[0] if found else None)
        _draw_panel(axes, part)
        last = k + 1 == len(shares)
        axes.tick_params(labelbottom=last)
        axes.set_xlabel(part.x if last else "")
        found.append(axes)
    return found


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for which in panel.log:
        getattr(axes, f"set_{which}scale")("log")
        getattr(axes, f"{which}axis").set_major_formatter(LogFormatter())
    for which, level, colour in panel.levels:
        line = axes.axvline if which == "x" else axes.axhline
        line(level, color=colour, lw=0.7, ls="--" if level else "-", zorder=1)
    for curve in panel.curves:
        _draw_curve(axes, curve, panel.in_time)
    axes.set_title(panel.title, loc="left", fontweight="bold")
    axes.set_title(panel.value, loc="right", color=GREY, fontsize=8)
    axes.set_ylabel(panel.y_label)
    axes.set_xlim(panel.x_range)
    axes.set_ylim(panel.y_range)
    if panel.share < 1.0:
        axes.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
    if panel.x_names:
        tilted = len(panel.x_names) > 10 or max(map(len, panel.x_names)) > 12
        turn = {"rotation": 35, "ha": "right"} if tilted else {}
        axes.set_xticks(np.arange(len(panel.x_names)), panel.x_names, **turn)
        axes.grid(visible=False, axis="x")
    if panel.y_names:
        axes.set_yticks(np.arange(len(panel.y_names)), panel.y_names)
        axes.set_ylim(len(panel.y_names) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        beside = {
            "transform": axes.get_yaxis_transform(),
            "va": "center",
            "fontsize": 7.5,
        }
        for place, text in enumerate(panel.beside):
            axes.text(1.03, float(place), text, color=GREY, **beside)


def _draw_curve(axes: Axes, curve: Curve, in_time: bool) -> None:
    look: dict[str, Any] = {"color": curve.colour, "label": curve.name or "_"}
    match curve.kind:
        case "band":
            axes.fill_between(curve.x, curve.low, curve.high, alpha=0.3, lw=0, **look)
        case "bars":
            bars = axes.bar(curve.x, curve.y, curve.width, **look)
            axes.bar_label(
                bars, curve.texts, label_type="center", fontsize=7.5, color=INK
            )
        case "intervals":
            axes.hlines(curve.y, curve.low, curve.high, color=curve.colour, lw=1.4)
            axes.scatter(curve.x, curve.y, s=16, zorder=3, **look)
        case "points":
            axes.scatter(curve.x, curve.y, s=16, zorder=3, **look)
        case _:
            # As many bins as a line has pixel columns.
            points = decimate(curve.x, curve.y, 700) if in_time else (curve.x, curve.y)
            look |= {
                "ls": "--" if curve.dashed else "-",
                "marker": "o" if curve.marker else "",
            }
            axes.plot(*points, lw=curve.width, ms=2.6, **look)


def _draw_scene(drawn: Drawing, scene: Scene) -> None:
    """Draw the robot in some poses, earlier ones paler, and the path of its end-effector."""
    axes: Any = drawn.add_subplot(
        projection="3d", proj_type="ortho", elev=22.0, azim=-62.0
    )
    tip = scene.points[:, -1]
    path = Line3DCollection(
        np.stack([tip[:-1], tip[1:]], axis=1), color=VERMILION, lw=1.2
    )
    if scene.values is not None:
        path = Line3DCollection(
            np.stack([tip[:-1], tip[1:]], axis=1), cmap="viridis", lw=1.4
        )
        path.set_array(scene.mean[:-1])
        drawn.colorbar(path, ax=axes, shrink=0.7, label=scene.label)
    axes.add_collection3d(path, autolim=False)
    poses = np.linspace(0, len(tip) - 1, min(scene.poses, len(tip))).round().astype(int)
    for place, k in enumerate(poses, 1):
        look = {"color": INK, "alpha": 0.16 + 0.84 * (place / len(poses)) ** 2}
        axes.add_collection3d(
            Line3DCollection(scene.bones[k], lw=2.4, **look), autolim=False
        )
        axes.scatter(*scene.points[k, :-1].T, s=18, **look)
    low, high = scene.bones.min(axis=(0, 1, 2)), scene.bones.max(axis=(0, 1, 2))
    axes.auto_scale_xyz(*np.stack([low, high], axis=1))
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
