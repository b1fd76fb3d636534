"""How figures look: one palette, one size of type, thin lines; nothing global is changed."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE, ORANGE, VERMILION = "#0072B2", "#E69F00", "#D55E00"
INK, GREY, PALE = "#22262b", "#5f6b78", "#d5dae0"
MEASURED, PREDICTED, ERROR = "#9aa6b2", VERMILION, BLUE

DPI = 150
WIDTH = 11.0
"""Width of a figure [inch]."""
HEADING = 0.36
"""Height that a figure keeps for its title [inch]."""
WIDE = 15.0
"""Width of a figure of many panels [inch]."""

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


@contextlib.contextmanager
def house_style() -> Iterator[None]:
    """The settings of matplotlib within a block; what the user has set is back afterwards."""
    with matplotlib.style.context(["default", _SETTINGS]):
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
    figure.text(x, y, text, va="top", fontsize=12, fontweight="bold").set_in_layout(False)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, without time or version in it."""
    with house_style():
        figure.savefig(path, dpi=DPI, format="png", metadata={"Software": None})


def caption(axes: Axes, left: str, right: str = "") -> None:
    """A title in bold at the left of a panel, and what was measured about it at the right."""
    axes.set_title(left, loc="left", fontweight="bold")
    axes.set_title(right, loc="right", color=GREY, fontsize=8)
