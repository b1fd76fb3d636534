"""Style of all figures: one palette, one size of type, thin lines; nothing global is changed."""

import contextlib
import io
import weakref
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine, PlaceHolderLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

# The palette of Okabe and Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, VERMILION = "#0072B2", "#E69F00", "#D55E00"
GREEN, PURPLE = "#009E73", "#CC79A7"
INK, GREY, PALE = "#22262b", "#5f6b78", "#d5dae0"
MEASURED, PREDICTED, ERROR = "#9aa6b2", VERMILION, BLUE

WIDTH = 11.0
"""Width of a figure [inch]."""

_SVG: weakref.WeakKeyDictionary[Figure, str] = weakref.WeakKeyDictionary()
_STYLE = Path(__file__).with_name("figures.mplstyle")


def house_style(**settings: Any) -> contextlib.AbstractContextManager[None]:
    """Return a context with the settings of matplotlib, and further ones (`_` for the dots)."""
    further = {key.replace("_", "."): value for key, value in settings.items()}
    return matplotlib.style.context(["default", _STYLE, further])


@contextlib.contextmanager
def drawing(
    title: str, width: float = WIDTH, height: float = 4.2, gap: float = 0.06
) -> Iterator[Figure]:
    """Yield an empty figure [inch] with a title, and apply the house style to the block."""
    with house_style():
        layout = ConstrainedLayoutEngine(h_pad=gap, w_pad=0.06)
        # The figure belongs to no window and no list of figures.
        figure = Figure(figsize=(width, height), layout=layout)
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        yield figure


def add_legend(figure: Figure, *entries: tuple[str, Mapping[str, Any]] | Artist) -> None:
    """Add a legend below all panels: labels with the properties of their lines, or artists."""
    handles = [
        entry if isinstance(entry, Artist) else Line2D([], [], label=entry[0], **entry[1])
        for entry in entries
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))


def label_time(panels: Iterable[Axes], time: np.ndarray) -> None:
    """Label the axis of time of the lowest panels, and limit it to the samples."""
    for axes in panels:
        axes.set_xlabel("time [s]")
        axes.set_xlim(float(time[0]), float(time[-1]))


def caption(axes: Axes, left: str, right: str = "") -> None:
    """Write a bold title at the left of a panel, and a measured value at the right."""
    axes.set_title(left, loc="left", fontweight="bold")
    axes.set_title(right, loc="right", color=GREY, fontsize=8)


def logarithmic(axes: Axes, which: str) -> None:
    """Make the axis `x` or `y` logarithmic, with labels in plain letters."""
    getattr(axes, f"set_{which}scale")("log")
    axis: Axis = getattr(axes, f"{which}axis")
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))

    def label_between(value: float, _: int | None) -> str:
        low, high = sorted(axis.get_view_interval())
        return plain_number(value) if high < 30.0 * low else ""

    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_minor_formatter(FuncFormatter(label_between))


def plain_number(value: float) -> str:
    """Return a number as a label: decimals where they are few, else a power of ten."""
    if 1e-3 < value < 1e5 or value <= 0:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    power = "10" + str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return power if mantissa == "1" else f"{mantissa}·{power}"


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, without time or version in the file.

    Args:
        figure: Figure to write.
        path: Path of the file, whose suffix tells the format.
    """
    unwanted = {".png": "Software", ".pdf": "CreationDate"}.get(Path(path).suffix, "Date")
    with house_style():
        _lay_out(figure)
        figure.savefig(path, dpi=150, metadata={unwanted: None})


def svg_text(figure: Figure) -> str:
    """Return a finished figure as SVG with text as letters; it is drawn once."""
    if figure not in _SVG:
        file = io.StringIO()
        with house_style(svg_fonttype="none", svg_hashsalt=figure.get_suptitle()):
            _lay_out(figure)
            # Unlike `savefig`, which draws twice.
            canvas = figure.canvas
            FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
            figure.set_canvas(canvas)
        _SVG[figure] = file.getvalue()
    return _SVG[figure]


def write_figures(folder: Path, figures: Mapping[str, Figure], suffix: str = "svg") -> list[str]:
    """Write finished figures, and return the names of their files.

    Args:
        folder: Folder of the files.
        figures: Figures by the names of their files, without suffix.
        suffix: Format: `svg`, in which pages show figures, `png` or `pdf`.
    """
    for stem, figure in figures.items():
        path = folder / f"{stem}.{suffix}"
        if suffix == "svg":
            path.write_text(svg_text(figure), encoding="utf-8")
        else:
            save(figure, path)
    return [f"{stem}.{suffix}" for stem in figures]


def _lay_out(figure: Figure) -> None:
    """Find the layout of a figure once: it takes longer than to draw."""
    engine = figure.get_layout_engine()
    if engine is not None and not isinstance(engine, PlaceHolderLayoutEngine):
        engine.execute(figure)
        figure.set_layout_engine("none")
