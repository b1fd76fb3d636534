"""Figures of estimates: their uncertainty, two fits beside each other, the choice of a filter."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxid.identification.choices import FilterChoice
from jaxid.identification.comparison import Comparison, Verdict
from jaxid.identification.fit import DOUBTFUL, TRUSTED, Fit
from jaxid.report.style import (
    BLUE,
    GREY,
    ORANGE,
    PALE,
    VERMILION,
    WIDTH,
    heading,
    house_style,
    logarithmic,
    new_figure,
)
from jaxid.table import Status, significant, with_deviation


def parameter_figure(fit: Fit) -> Figure:
    """Draw the relative standard deviations of all estimates, the best known ones first.

    Beside them stand the estimates with their standard deviations. Values above 1000 % are drawn
    as arrows at the edge.

    Args:
        fit: Identified parameters.
    """
    relative = np.asarray(fit.relative_standard_deviations)
    order = np.argsort(np.where(np.isnan(relative), np.inf, relative), kind="stable")
    finite = relative[np.isfinite(relative) & (relative > 0)]
    least = max(1e-5, float(finite.min())) if len(finite) else 1e-2
    low = min(10.0 ** math.floor(math.log10(least) - 0.1), 1e-2)
    good = fit.trust.count(Status.GOOD)
    name = fit.base.model.robot.name
    with house_style():
        figure, panels = _long_list(order, 0.19, 1.35)
        for axes, shown in panels:
            _draw_deviations(axes, fit, relative, shown, low)
        heading(figure, f"{name}: {good} of {len(relative)} base parameters are known to 10 %")
        labels = (
            (BLUE, f"up to {100 * TRUSTED:g} %: trusted"),
            (ORANGE, f"up to {100 * DOUBTFUL:g} %: doubtful"),
            (VERMILION, "above: small, or not excited"),
        )
        _add_legend(figure, labels)
    return figure


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that what is known
    to lie away from zero stands there. Names of parameters that have changed are bold.

    Args:
        comparison: Comparison of two fits.
    """
    first, second, count = comparison.first, comparison.second, len(comparison.indices)
    with house_style():
        figure, panels = _long_list(np.arange(count), 0.21, 1.5)
        for axes, shown in panels:
            _draw_intervals(axes, comparison, shown)
        changed = comparison.verdicts.count(Verdict.CHANGED)
        heading(figure, f"{changed} of {count} parameters have changed")
        _add_legend(figure, ((BLUE, first.name), (VERMILION, second.name)))
    return figure


def _long_list(order: np.ndarray, line: float, margin: float) -> tuple[Figure, list]:
    """Return a figure whose panels have a line for each parameter, and the parameters of each."""
    columns = math.ceil(len(order) / 40)
    rows = math.ceil(len(order) / columns)
    figure = new_figure(max(7.5, WIDTH / 2 * columns), margin + line * rows)
    grid = figure.add_gridspec(1, columns, wspace=0.06)
    panels = []
    for column in range(columns):
        axes = figure.add_subplot(grid[column])
        axes.set_ylim(rows - 0.4, -0.6)
        axes.tick_params(axis="y", length=0, labelcolor="black")
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_color(PALE)
        panels.append((axes, order[column * rows : (column + 1) * rows]))
    return figure, panels


def _add_legend(figure: Figure, labels: Sequence[tuple[str, str]]) -> None:
    handles = [
        Line2D([], [], color=colour, marker="o", ms=5, lw=1.4, label=label)
        for colour, label in labels
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=len(labels))


def _write_beside(axes: Axes, texts: Sequence[str], dark: Sequence[bool]) -> None:
    for place, (text, strong) in enumerate(zip(texts, dark, strict=True)):
        axes.text(
            1.03,
            float(place),
            text,
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=7.5,
            color="black" if strong else GREY,
        )


def _draw_deviations(
    axes: Axes, fit: Fit, relative: np.ndarray, shown: np.ndarray, low: float
) -> None:
    ceiling = 10.0
    trust = {Status.GOOD: BLUE, Status.DOUBTFUL: ORANGE, Status.BAD: VERMILION}
    colours = np.array([trust[fit.trust[k]] for k in shown])
    places = np.arange(len(shown))
    deviations = np.nan_to_num(relative[shown], nan=np.inf, posinf=ceiling)
    deviations = np.clip(deviations, low, ceiling)
    axes.hlines(places, low, deviations, color=colours, lw=1.6)
    beyond = ~(relative[shown] <= ceiling)
    for marker, where in (("o", ~beyond), (">", beyond)):
        axes.scatter(
            deviations[where],
            places[where],
            s=20,
            c=colours[where],
            marker=marker,
            zorder=3,
            clip_on=False,
        )
    axes.set_xscale("log")
    axes.set_xlim(low, ceiling)
    axes.set_yticks(places, [fit.base.names[k] for k in shown])
    for limit in (TRUSTED, DOUBTFUL):
        axes.axvline(limit, color=GREY, lw=0.7, linestyle=(0, (4, 3)), zorder=1)
    axes.xaxis.set_major_locator(LogLocator(10.0, numticks=12))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: significant(100.0 * value, 1)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("standard deviation / |estimate| [%]")
    pairs = [
        with_deviation(float(fit.parameters[k]), float(fit.standard_deviations[k])) for k in shown
    ]
    texts = [f"{a} ± {b} {fit.base.units[k]}" for (a, b), k in zip(pairs, shown, strict=True)]
    _write_beside(axes, texts, [False] * len(texts))


def _draw_intervals(axes: Axes, comparison: Comparison, shown: np.ndarray) -> None:
    fits = comparison.first, comparison.second
    k = list(comparison.indices)
    estimates = [np.asarray(fit.parameters)[k] for fit in fits]
    halves = [fit.uncertainty.half_widths(comparison.level)[k] for fit in fits]
    sizes = [np.abs(p) + half for p, half in zip(estimates, halves, strict=True)]
    # An end at infinity is off the axis, whatever the scale.
    ends = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    scale = np.where(ends > 0, ends, 1.0)[shown]
    places = np.arange(len(shown))
    for p, half, colour, shift in zip(
        estimates, halves, (BLUE, VERMILION), (-0.17, 0.17), strict=True
    ):
        values = p[shown] / scale
        low, high = (np.clip(values + s * half[shown] / scale, -2.0, 2.0) for s in (-1.0, 1.0))
        axes.hlines(places + shift, low, high, color=colour, lw=1.2)
        axes.scatter(values, places + shift, s=14, c=colour, zorder=3)
    axes.axvline(0.0, color=GREY, lw=0.7, zorder=1)
    axes.set_xlim(-1.08, 1.08)
    axes.set_yticks(places, [comparison.names[i] for i in shown])
    axes.set_xlabel("estimate / farthest end of both intervals")
    verdicts = comparison.verdicts
    changed = [verdicts[i] is Verdict.CHANGED for i in shown]
    for label, bold in zip(axes.get_yticklabels(), changed, strict=True):
        label.set_fontweight("bold" if bold else "normal")
    difference, half = comparison.difference, comparison.half_widths
    pairs = [with_deviation(float(difference[i]), float(half[i])) for i in shown]
    texts = [
        f"{'' if a.startswith('-') else '+'}{a} ± {b} {comparison.units[i]}"
        for (a, b), i in zip(pairs, shown, strict=True)
    ]
    _write_beside(axes, texts, changed)


def filter_figure(choice: FilterChoice) -> Figure:
    """Draw the held-out errors of all candidates, and the correlation of neighbouring residuals.

    Thin lines are single parts of the log. Too low a cut-off removes motion that moves the robot,
    too high a one lets noise into the accelerations.

    Args:
        choice: Choice of a filter with all its candidates.
    """
    order = np.argsort(np.asarray(choice.cutoffs))
    cutoffs = np.asarray(choice.cutoffs)[order]
    errors = 100 * np.asarray(choice.errors)[order]
    best = float(np.asarray(choice.cutoffs)[choice.best])
    dots = {"marker": "o", "markersize": 4}
    with house_style():
        figure = new_figure(WIDTH, 4.2)
        heading(figure, "Choice of the filter")
        left, right = figure.subplots(1, 2)
        left.plot(cutoffs, errors, color=PALE, linewidth=0.8)
        left.plot(cutoffs, 100 * choice.curve[order], color=BLUE, **dots)
        right.plot(cutoffs, np.asarray(choice.correlations)[order], color=GREY, **dots)
        for axes in (left, right):
            axes.axvline(best, color=ORANGE, linewidth=1.0)
            logarithmic(axes, "x")
            axes.set_xlabel("cut-off of forces and columns [Hz]")
        logarithmic(left, "y")
        left.set_ylabel("error on unseen parts [% of the forces]")
        left.set_title(f"chosen: {best:.3g} Hz", loc="left", fontweight="bold")
        right.set_ylabel("correlation of neighbouring residuals [1]")
        right.set_title("zero where rows are independent", loc="left", fontweight="bold")
    return figure
