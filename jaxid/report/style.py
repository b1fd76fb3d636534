"""How figures look: one palette, one size of type, thin lines; nothing global is changed."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine, PlaceHolderLayoutEngine
from matplotlib.ticker import FuncFormatter

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE, ORANGE, VERMILION = "#0072B2", "#E69F00", "#D55E00"
GREEN, PURPLE = "#009E73", "#CC79A7"
INK, GREY, PALE = "#22262b", "#5f6b78", "#d5dae0"
MEASURED, PREDICTED, ERROR = "#9aa6b2", VERMILION, BLUE

DPI = 150
WIDTH = 11.0
"""Width of a figure [inch]."""
HEADING = 0.36
"""Height that a figure keeps for its title [inch]."""
WIDE = 15.0
"""Width of a figure of many panels [inch]."""
TITLE = "heading"
"""Name by which the title of a figure is known."""

_SETTINGS = {
    "figure.facecolor": "white",
    "font.size": 9,
    "text.color": INK,
    # Names of joints and files are no formulas, whatever signs they contain.
    "text.parse_math": False,
    "axes.titlesize": 9,
    "axes.titlepad": 5,
    "axes.labelsize": 8.5,
    "axes.labelcolor": GREY,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "legend.handlelength": 1.6,
    "lines.solid_joinstyle": "round",
    "agg.path.chunksize": 20000,
}
NARROW = 30.0
"""Ends of a logarithmic scale up to which labels stand between powers of ten too, as a ratio."""
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
LETTERS_AS_SHAPES = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "jaxid"}
"""Settings of files that look alike everywhere."""
LETTERS_AS_TEXT = {"svg.fonttype": "none", "svg.hashsalt": "jaxid"}
"""Settings of drawings in a page, in the page's letters."""


@contextlib.contextmanager
def house_style(files: Mapping[str, Any] = MappingProxyType({})) -> Iterator[None]:
    """The settings of matplotlib within a block; what the user has set is back afterwards.

    Args:
        files: Settings of what is written, besides.
    """
    with matplotlib.style.context(["default", {**_SETTINGS, **files}]):
        yield


def new_figure(width: float, height: float, gap: float = 0.06) -> Figure:
    """An empty figure that belongs to no window and no list of figures.

    Args:
        width: Of the figure [inch].
        height: Of the figure [inch].
        gap: Above and below each panel [inch].
    """
    below_heading = (0.0, 0.0, 1.0, 1.0 - HEADING / height)
    layout = ConstrainedLayoutEngine(h_pad=gap, w_pad=0.06, rect=below_heading)
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def heading(figure: Figure, text: str) -> None:
    """The title of a figure, at its left."""
    x, y = 0.11 / figure.get_figwidth(), 1.0 - 0.1 / figure.get_figheight()
    title = figure.text(x, y, text, va="top", fontsize=12, fontweight="bold", gid=TITLE)
    title.set_in_layout(False)


def heading_of(figure: Figure) -> str:
    """The title of a figure; empty if it has none."""
    return next((text.get_text() for text in figure.texts if text.get_gid() == TITLE), "")


def plain_powers(axis: Axis) -> None:
    """Labels of a logarithmic scale in plain letters: those of matplotlib are formulas."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))

    def between(value: float, _: int | None) -> str:
        low, high = sorted(axis.get_view_interval())
        first = f"{value:e}"[0]
        return plain_number(value) if first in "25" and high < NARROW * low else ""

    axis.set_minor_formatter(FuncFormatter(between))


def plain_number(value: float) -> str:
    """A number as a label: decimals where they are few, else a power of ten."""
    if 1e-3 < value < 1e5 or value <= 0:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    power = "10" + str(int(exponent)).translate(RAISED)
    return power if mantissa == "1" else f"{mantissa}·{power}"


def settle(figure: Figure) -> None:
    """Finds the layout of a figure, which takes longer than to draw it, once and for all."""
    engine = figure.get_layout_engine()
    if engine is not None and not isinstance(engine, PlaceHolderLayoutEngine):
        with house_style():
            engine.execute(figure)
        figure.set_layout_engine("none")


@contextlib.contextmanager
def as_it_was(figure: Figure) -> Iterator[None]:
    """Keeps canvas and resolution of a figure through a block that changes them."""
    canvas, dpi = figure.canvas, figure.dpi
    try:
        yield
    finally:
        figure.set_canvas(canvas)
        figure.set_dpi(dpi)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, PDF or SVG, without time or version in it.

    Args:
        figure: The figure.
        path: Of the file; its suffix says which.
    """
    settle(figure)
    with house_style(LETTERS_AS_SHAPES), as_it_was(figure):
        # `savefig` would draw everything twice.
        if path.suffix == ".pdf":
            FigureCanvasPdf(figure).print_pdf(path, metadata={"CreationDate": None})
        elif path.suffix == ".svg":
            FigureCanvasSVG(figure).print_svg(path, metadata={"Date": None})
        else:
            figure.set_dpi(DPI)
            FigureCanvasAgg(figure).print_png(path, metadata={"Software": None})


def caption(axes: Axes, left: str, right: str = "") -> None:
    """A title in bold at the left of a panel, and what was measured about it at the right."""
    axes.set_title(left, loc="left", fontweight="bold")
    axes.set_title(right, loc="right", color=GREY, fontsize=8)
