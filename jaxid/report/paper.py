"""Figures on paper: drawn by matplotlib, which is loaded here only, in a style of its own."""

import contextlib
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.layout_engine import ConstrainedLayoutEngine, PlaceHolderLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from .figure import GREY, INK, Curve, Figure, Panel, decimate

BINS = 700
"""Pixel columns of a line on paper."""

_STYLE = Path(__file__).with_name("figures.mplstyle")


def house_style(**settings: Any) -> contextlib.AbstractContextManager[None]:
    """Return a context with the settings of matplotlib, and further ones (`_` for the dots)."""
    further = {key.replace("_", "."): value for key, value in settings.items()}
    return matplotlib.style.context(["default", _STYLE, further])


@contextlib.contextmanager
def drawing(title: str, width: float = 11.0, height: float = 4.2) -> Iterator[Drawing]:
    """Yield an empty figure [inch] with a title, and apply the house style to the block."""
    with house_style():
        # The figure belongs to no window and no list of figures.
        layout = ConstrainedLayoutEngine(h_pad=0.05, w_pad=0.08)
        figure = Drawing(figsize=(width, height), layout=layout)
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        yield figure


def draw_panels(figure: Figure) -> Drawing:
    """Return a figure of panels as matplotlib draws it."""
    rows = math.ceil(len(figure.panels) / figure.columns)
    height = 0.9 + figure.height * rows
    with drawing(figure.title, figure.width, height) as drawn:
        grid = drawn.add_gridspec(rows, figure.columns)
        for place, panel in enumerate(figure.panels):
            _draw_stack(drawn, grid[divmod(place, figure.columns)], panel)
        drawn.align_ylabels()
        handles = [_handle(name, curve) for name, curve in figure.legend]
        if handles:
            drawn.legend(handles=handles, loc="outside lower left", ncols=min(4, len(handles)))
    return drawn


def _draw_stack(drawn: Drawing, cell: Any, panel: Panel) -> None:
    """Draw a panel and those below it, with a gap to the next ones."""
    shares = [part.share for part in panel.parts]
    stack = cell.subgridspec(len(shares), 1, height_ratios=shares)
    above: Axes | None = None
    for k, part in enumerate(panel.parts):
        axes = drawn.add_subplot(stack[k], sharex=above)
        _draw_panel(axes, part)
        last = k + 1 == len(shares)
        axes.tick_params(labelbottom=last)
        axes.set_xlabel(part.x if last else "")
        above = above or axes


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for which in panel.log:
        _make_logarithmic(axes, which)
    for which, level, colour in panel.levels:
        line = axes.axvline if which == "x" else axes.axhline
        line(level, color=colour, lw=0.7, ls="--" if level else "-", zorder=1)
    for curve in panel.curves:
        _draw_curve(axes, curve, panel.in_time)
    axes.set_title(panel.title, loc="left", fontweight="bold")
    axes.set_title(panel.value, loc="right", color=GREY, fontsize=8)
    axes.set_ylabel(panel.y_label)
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    if panel.share < 1.0:
        axes.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
    if panel.x_names:
        tilted = len(panel.x_names) > 10 or max(map(len, panel.x_names)) > 12
        turn = {"rotation": 35, "ha": "right"} if tilted else {}
        axes.set_xticks(np.arange(len(panel.x_names)), panel.x_names, **turn)
        axes.grid(visible=False, axis="x")
    if panel.y_names:
        _name_rows(axes, panel)


def _name_rows(axes: Axes, panel: Panel) -> None:
    """Write names to the left of the rows, and texts to the right."""
    axes.set_yticks(np.arange(len(panel.y_names)), panel.y_names)
    axes.set_ylim(len(panel.y_names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0, labelcolor="black")
    axes.grid(visible=False, axis="y")
    beside = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 7.5}
    for place, text in enumerate(panel.beside):
        axes.text(1.03, float(place), text, color=GREY, **beside)
    for label, bold in zip(axes.get_yticklabels(), panel.bold, strict=False):
        label.set_fontweight("bold" if bold else "normal")


def _draw_curve(axes: Axes, curve: Curve, in_time: bool) -> None:
    look: dict[str, Any] = {"color": curve.colour, "lw": curve.width}
    if curve.kind == "band":
        axes.fill_between(curve.x, curve.low, curve.high, color=curve.colour, alpha=0.3, lw=0)
    elif curve.kind == "bars":
        bars = axes.bar(curve.x, curve.y, curve.width, color=curve.colour)
        axes.bar_label(bars, curve.texts, label_type="center", fontsize=7.5, color=INK)
    elif curve.kind == "intervals":
        axes.hlines(curve.y, curve.low, curve.high, color=curve.colour, lw=1.4)
        axes.scatter(curve.x, curve.y, s=16, c=curve.colour, zorder=3)
    elif curve.kind == "points":
        axes.scatter(curve.x, curve.y, s=16, c="white", edgecolors=curve.colour, zorder=3)
    else:
        look |= {"ls": "--" if curve.dashed else "-", "marker": "o" if curve.marker else ""}
        points = decimate(curve.x, curve.y, BINS) if in_time else (curve.x, curve.y)
        axes.plot(*points, ms=2.6, **look)


def _handle(name: str, curve: Curve) -> Any:
    """Return the sample of a curve in the legend."""
    colour = curve.colour
    if curve.kind in ("bars", "band"):
        return Patch(color=colour, label=name, alpha=0.3 if curve.kind == "band" else 1.0)
    dots = {"marker": "o" if curve.marker or curve.kind != "line" else "", "ms": 4}
    line = "none" if curve.kind == "points" else "--" if curve.dashed else "-"
    return Line2D([], [], color=colour, ls=line, lw=1.4, label=name, **dots)


def _make_logarithmic(axes: Axes, which: str) -> None:
    """Make the axis `x` or `y` logarithmic, with labels in plain letters."""
    getattr(axes, f"set_{which}scale")("log")
    axis: Axis = getattr(axes, f"{which}axis")
    axis.set_major_formatter(FuncFormatter(lambda value, _: _plain_number(value)))

    def label_between(value: float, _: int | None) -> str:
        low, high = sorted(axis.get_view_interval())
        return _plain_number(value) if high < 30.0 * low else ""

    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_minor_formatter(FuncFormatter(label_between))


def _plain_number(value: float) -> str:
    """Return a number as a label: decimals where they are few, else a power of ten."""
    if 1e-3 < value < 1e5 or value <= 0:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    power = "10" + str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return power if mantissa == "1" else f"{mantissa}·{power}"


def save(drawn: Drawing, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, without time or version in the file."""
    unwanted = {".png": "Software", ".pdf": "CreationDate"}.get(Path(path).suffix, "Date")
    with house_style(svg_fonttype="none"):
        _lay_out(drawn)
        drawn.savefig(path, dpi=150, metadata={unwanted: None})


def png(drawn: Drawing) -> bytes:
    """Return a figure as PNG, as notebooks show it."""
    file = io.BytesIO()
    with house_style():
        _lay_out(drawn)
        drawn.savefig(file, dpi=110)
    return file.getvalue()


def _lay_out(figure: Drawing) -> None:
    """Find the layout of a figure once: it takes longer than to draw."""
    engine = figure.get_layout_engine()
    if engine is not None and not isinstance(engine, PlaceHolderLayoutEngine):
        engine.execute(figure)
        figure.set_layout_engine("none")
