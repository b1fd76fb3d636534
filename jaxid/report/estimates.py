"""How well each parameter is known: estimates sorted by their relative standard deviations."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxid.identification.fit import DOUBTFUL, TRUSTED, Fit, Trust
from jaxid.report.numbers import significant, with_deviation
from jaxid.report.style import (
    BLUE,
    GREY,
    ORANGE,
    PALE,
    VERMILION,
    WIDTH,
    heading,
    house_style,
    new_figure,
)

COLOURS = {Trust.GOOD: BLUE, Trust.DOUBTFUL: ORANGE, Trust.NONE: VERMILION}
LINE = 0.19
LONGEST_COLUMN = 40
FLOOR, CEILING = 1e-5, 10.0


def parameter_figure(fit: Fit) -> Figure:
    """Draws the relative standard deviations of all estimates, the best known ones first.

    Beside them stand the estimates with their standard deviations. Values above 1000 % are drawn
    as arrows at the edge.

    Args:
        fit: The estimates.
    """
    relative = np.asarray(fit.relative_standard_deviations)
    order = np.argsort(np.where(np.isnan(relative), np.inf, relative), kind="stable")
    columns = math.ceil(len(order) / LONGEST_COLUMN)
    rows = math.ceil(len(order) / columns)
    finite = relative[np.isfinite(relative) & (relative > 0)]
    least = max(FLOOR, float(finite.min())) if len(finite) else 1e-2
    low = min(10.0 ** math.floor(math.log10(least) - 0.1), 1e-2)
    with house_style():
        figure = new_figure(max(7.0, WIDTH / 2 * columns), 1.35 + LINE * rows)
        grid = figure.add_gridspec(1, columns, wspace=0.06)
        for c in range(columns):
            axes = figure.add_subplot(grid[c])
            axes.set_gid(f"column-{c}")
            _column(axes, fit, relative, order[c * rows : (c + 1) * rows], rows, low)
        heading(figure, _summary(fit, relative))
        figure.legend(
            handles=[
                Line2D([], [], color=colour, marker="o", ms=5, lw=1.6, label=label)
                for colour, label in (
                    (BLUE, f"up to {TRUSTED:.0%}: trusted".replace("%", " %")),
                    (ORANGE, f"up to {DOUBTFUL:.0%}: doubtful".replace("%", " %")),
                    (VERMILION, "above: small, or not excited"),
                )
            ],
            loc="outside lower left",
            ncols=3,
        )
    return figure


def _summary(fit: Fit, relative: np.ndarray) -> str:
    good = fit.trust.count(Trust.GOOD)
    robot = fit.base.model.robot
    return f"{robot.name}: {good} of {len(relative)} base parameters are known to 10 %"


def _column(
    axes: Axes, fit: Fit, relative: np.ndarray, order: np.ndarray, rows: int, low: float
) -> None:
    deviations, names, units = fit.standard_deviations, fit.base.names, fit.base.units
    places = np.arange(len(order))
    shares = np.clip(np.nan_to_num(relative[order], nan=np.inf, posinf=CEILING), low, CEILING)
    beyond = ~(relative[order] <= CEILING)
    colours = [COLOURS[fit.trust[k]] for k in order]
    axes.hlines(places, low, shares, color=colours, lw=1.6)
    for marker, where in (("o", ~beyond), (">", beyond)):
        axes.scatter(
            shares[where],
            places[where],
            s=20,
            c=np.array(colours)[where],
            marker=marker,
            zorder=3,
            clip_on=False,
        )
    axes.set_xscale("log")
    axes.set_xlim(low, CEILING)
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_yticks(places, [names[k] for k in order])
    axes.tick_params(axis="y", length=0, labelcolor="black")
    axes.grid(visible=False, axis="y")
    for limit in (TRUSTED, DOUBTFUL):
        axes.axvline(limit, color=GREY, lw=0.7, linestyle=(0, (4, 3)), zorder=1)
    axes.xaxis.set_major_locator(LogLocator(10.0, numticks=12))
    axes.xaxis.set_major_formatter(FuncFormatter(_tick))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("standard deviation / |estimate| [%]")
    beside = axes.get_yaxis_transform()
    for place, k in zip(places, order, strict=True):
        value, deviation = with_deviation(float(fit.parameters[k]), float(deviations[k]))
        text = f"{value} ± {deviation} {units[k]}"
        axes.text(1.03, float(place), text, transform=beside, va="center", fontsize=7.5, color=GREY)
    axes.spines["left"].set_color(PALE)


def _tick(value: float, _position: int) -> str:
    return significant(100.0 * value, 1)
