"""Two runs beside each other: a table like that of the paper's Sec. 6, and a figure."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.table import Table
from rich.text import Text

from jaxid.identification.runs.comparison import Comparison, Verdict
from jaxid.report.numbers import aligned, significant, with_deviation
from jaxid.report.style import (
    BLUE,
    GREY,
    PALE,
    VERMILION,
    WIDTH,
    heading,
    house_style,
    new_figure,
)
from jaxid.report.tables import plain_table

STYLES = {
    Verdict.CHANGED: "bold yellow",
    Verdict.PERHAPS: "yellow",
    Verdict.UNCHANGED: "",
    Verdict.UNKNOWN: "dim",
}
LINE = 0.21
LONGEST_COLUMN = 40
REACH = 1.08
"""Limit of a figure's axis."""
APART = 0.17
"""Distance of the two runs from the middle of a parameter's line."""


def comparison_table(comparison: Comparison) -> Table:
    """Every parameter in both runs, its difference with its interval, and what that means (Sec. 6).

    Differences stand with the digits that their uncertainty leaves meaningful, estimates alike.

    Args:
        comparison: Of two runs.
    """
    first, second = comparison.first, comparison.second
    table = plain_table(f"{first.label} and {second.label}: {len(first.names)} base parameters")
    table.add_column("#", justify="right", style="dim")
    table.add_column("parameter", overflow="fold")
    table.add_column("unit", no_wrap=True)
    rows = [numbers(comparison, k) for k in range(len(first.names))]
    cells = [aligned(column) for column in zip(*rows, strict=True)]
    percent = f"{100 * comparison.level:g}"
    for title in (first.label, second.label, "difference", f"± ({percent} %)"):
        table.add_column(Text(title), justify="right", overflow="fold")
    table.add_column("verdict")
    groups, verdicts = first.groups, comparison.verdicts
    for k, name in enumerate(first.names):
        if k and groups[k] != groups[k - 1]:
            table.add_section()
        table.add_row(
            str(k + 1),
            Text(name),
            first.units[k],
            *(column[k] for column in cells),
            Text(verdicts[k].value, style=STYLES[verdicts[k]]),
        )
    return table


def group_table(comparison: Comparison) -> Table:
    """The joint test of each kind of parameter.

    Args:
        comparison: Of two runs.
    """
    table = plain_table("all parameters of a kind at once")
    table.add_column("kind")
    table.add_column("parameters", justify="right")
    table.add_column("statistic", justify="right")
    table.add_column("chance\nwithout a change", justify="right")
    table.add_column("verdict")
    for group in comparison.groups:
        verdict = Verdict.CHANGED if group.changed else Verdict.UNCHANGED
        table.add_row(
            group.name,
            str(group.size),
            significant(group.statistic),
            chance(group.p_value),
            Text(verdict.value, style=STYLES[verdict]),
        )
    return table


def numbers(comparison: Comparison, k: int) -> tuple[str, str, str, str]:
    """Both estimates, the difference and its half interval, with the digits that mean something."""
    half = float(comparison.half_widths[k])
    values = (
        comparison.first.parameters[k],
        comparison.second.parameters[k],
        comparison.difference[k],
    )
    a, b, change = (with_deviation(float(x), half)[0] for x in values)
    sign = "" if change.startswith("-") else "+"
    return a, b, sign + change, with_deviation(0.0, half)[1]


def chance(p: float) -> str:
    """A probability of 1; below a millionth nobody cares how much."""
    return "< 1e-6" if p < 1e-6 else significant(p, 2)


def comparison_figure(comparison: Comparison) -> Figure:
    """Draws both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that what is known
    to lie away from zero stands there. Names of parameters that have changed are bold.

    Args:
        comparison: Of two runs.
    """
    first, second = comparison.first, comparison.second
    size = len(first.names)
    columns = math.ceil(size / LONGEST_COLUMN)
    rows = math.ceil(size / columns)
    with house_style():
        figure = new_figure(max(7.5, WIDTH / 2 * columns), 1.5 + LINE * rows)
        grid = figure.add_gridspec(1, columns, wspace=0.06)
        for c in range(columns):
            shown = np.arange(c * rows, min((c + 1) * rows, size))
            _column(figure.add_subplot(grid[c]), comparison, shown, rows)
        changed = comparison.verdicts.count(Verdict.CHANGED)
        heading(figure, f"{changed} of {size} parameters have changed")
        figure.legend(
            handles=[
                Line2D([], [], color=colour, marker="o", ms=5, lw=1.2, label=label)
                for colour, label in ((BLUE, first.label), (VERMILION, second.label))
            ],
            loc="outside lower left",
            ncols=2,
        )
    return figure


def _column(axes: Axes, comparison: Comparison, shown: np.ndarray, rows: int) -> None:
    first, second = comparison.first, comparison.second
    halves = [e.half_widths(comparison.level) for e in (first, second)]
    sizes = [np.abs(e.parameters) + h for e, h in zip((first, second), halves, strict=True)]
    # An end at infinity is off the axis, whatever the scale.
    ends = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    scale = np.where(ends > 0, ends, 1.0)[shown]
    places = np.arange(len(shown))
    styles = ((first, BLUE, -APART), (second, VERMILION, APART))
    for (estimates, colour, shift), half in zip(styles, halves, strict=True):
        share = np.asarray(estimates.parameters)[shown] / scale
        low, high = (np.clip(share + s * half[shown] / scale, -2.0, 2.0) for s in (-1.0, 1.0))
        axes.hlines(places + shift, low, high, color=colour, lw=1.2)
        axes.scatter(share, places + shift, s=14, c=colour, zorder=3)
    axes.axvline(0.0, color=GREY, lw=0.7, zorder=1)
    axes.set_xlim(-REACH, REACH)
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_yticks(places, [first.names[k] for k in shown])
    axes.tick_params(axis="y", length=0, labelcolor="black")
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("estimate / farthest end of both intervals")
    verdicts = comparison.verdicts
    beside = axes.get_yaxis_transform()
    for place, label, k in zip(places, axes.get_yticklabels(), shown, strict=True):
        changed = verdicts[k] is Verdict.CHANGED
        if changed:
            label.set_fontweight("bold")
        _, _, difference, half = numbers(comparison, int(k))
        axes.text(
            1.03,
            float(place),
            f"{difference} ± {half} {first.units[k]}",
            transform=beside,
            va="center",
            fontsize=7.5,
            color="black" if changed else GREY,
        )
    axes.spines["left"].set_color(PALE)
