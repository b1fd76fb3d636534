"""Figures of estimates with their intervals: of one fit, and of two side by side."""

import math
from collections.abc import Sequence

import numpy as np

from jaxid.identification.fit_result import DOUBT_LIMIT, TRUST_LIMIT, Fit
from jaxid.identification.parameter_changes import Comparison, Verdict
from jaxid.result_table import Status, significant, with_deviations

from .figure import Figure
from .figure_elements import BLUE, GREY, ORANGE, VERMILION, Curve, Panel

MAX_PERCENT = 1000.0
"""Largest relative standard deviation that is shown [%]."""
ROWS_PER_PANEL = 40
"""Largest number of parameters below each other."""
OFFSET = 0.17
"""Distance of the two intervals of one parameter from the middle of its row."""
GRADES = (
    (Status.GOOD, f"up to {100 * TRUST_LIMIT:g} %: trusted", BLUE),
    (Status.DOUBTFUL, f"up to {100 * DOUBT_LIMIT:g} %: doubtful", ORANGE),
    (Status.BAD, "above: small, or not excited", VERMILION),
)
"""Judgements of a relative standard deviation, with their names and colours."""


def parameter_figure(fit: Fit) -> Figure:
    """Return the relative standard deviations of all estimates, smallest ones first.

    Beside them stand the estimates with their standard deviations. Values above 1000 %
    are drawn at the edge.

    Args:
        fit: Identified parameters.
    """
    percents = 100.0 * np.asarray(fit.relative_standard_deviations)
    percents[np.isnan(percents)] = np.inf
    min_percent = np.min(percents[percents > 0], initial=10.0)
    low = 10.0 ** math.floor(math.log10(max(min_percent, 1e-3)) - 0.1)
    order = np.argsort(percents, kind="stable")
    panels = [
        _parameter_panel(fit, rows, np.clip(percents[rows], low, MAX_PERCENT), low)
        for rows in _split(order)
    ]
    name = fit.base.model.robot.name
    count = fit.trust.count(Status.GOOD)
    return _listing(
        f"{name}: {count} of {len(percents)} base parameters are known to 10 %",
        panels,
    )


def _parameter_panel(
    fit: Fit, shown: np.ndarray, percents: np.ndarray, low: float
) -> Panel:
    """Return a row for each parameter: an interval from the left to its percents."""
    names = [fit.base.names[k] for k in shown]
    values = np.asarray(fit.parameters)[shown]
    estimates, deviations = with_deviations(values, fit.standard_deviations[shown])
    texts = [
        f"{estimate} ± {deviation} {fit.base.units[k]}"
        for k, estimate, deviation in zip(shown, estimates, deviations, strict=True)
    ]
    curves = []
    for status, legend, colour in GRADES:
        rows = [row for row, k in enumerate(shown) if fit.trust[k] is status]
        curves.append(
            Curve(
                percents[rows],
                rows,
                legend,
                colour,
                "intervals",
                low=np.full(len(rows), low),
                high=percents[rows],
                texts=[f"{names[row]}: {texts[row]}" for row in rows],
            )
        )
    return Panel(
        curves,
        x="standard deviation / |estimate| [%]",
        log="x",
        x_range=(low, MAX_PERCENT),
        y_names=names,
        beside=texts,
        levels=[("x", 100.0 * limit, GREY) for limit in (TRUST_LIMIT, DOUBT_LIMIT)],
    )


def comparison_figure(comparison: Comparison) -> Figure:
    """Return both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that
    an interval that excludes zero is seen to do so. A star marks the names of
    parameters that have changed.

    Args:
        comparison: Comparison of two fits.
    """
    count = len(comparison.indices)
    panels = [_comparison_panel(comparison, rows) for rows in _split(np.arange(count))]
    changes = comparison.verdicts.count(Verdict.CHANGED)
    return _listing(f"{changes} of {count} parameters have changed", panels)


def _comparison_panel(comparison: Comparison, shown: np.ndarray) -> Panel:
    """Return a row with two intervals for each parameter."""
    fits = (comparison.first, comparison.second)
    indices = np.array(comparison.indices)[shown]
    estimates = np.stack([np.asarray(fit.parameters)[indices] for fit in fits])
    half_widths = np.stack([fit.uncertainty.half_widths()[indices] for fit in fits])
    sizes = np.abs(estimates) + half_widths
    # An end at infinity is off the axis, whatever the scale.
    ends = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    scale = np.where(ends > 0, ends, 1.0)

    names = [comparison.names[k] for k in shown]
    curves = []
    for fit, estimate, half_width, colour, offset in zip(
        fits, estimates, half_widths, (BLUE, VERMILION), (-OFFSET, OFFSET), strict=True
    ):
        curves.append(
            Curve(
                estimate / scale,
                np.arange(len(shown)) + offset,
                fit.name,
                colour,
                "intervals",
                low=np.clip((estimate - half_width) / scale, -2.0, 2.0),
                high=np.clip((estimate + half_width) / scale, -2.0, 2.0),
                texts=[
                    f"{name}: {significant(float(value), 4)}"
                    for name, value in zip(names, estimate, strict=True)
                ],
            )
        )
    is_changed = [comparison.verdicts[k] is Verdict.CHANGED for k in shown]
    return Panel(
        curves,
        x="estimate / farthest end of both intervals",
        x_range=(-1.08, 1.08),
        y_names=[
            name + " *" * mark for name, mark in zip(names, is_changed, strict=True)
        ],
        beside=_difference_texts(comparison, shown),
        levels=[("x", 0.0, GREY)],
    )


def _difference_texts(comparison: Comparison, shown: np.ndarray) -> list[str]:
    """Return the differences of estimates with sign, interval and unit."""
    differences, half_widths = with_deviations(
        np.asarray(comparison.difference)[shown], comparison.half_widths[shown]
    )
    texts = []
    for k, difference, half_width in zip(shown, differences, half_widths, strict=True):
        sign = "" if difference.startswith("-") else "+"
        texts.append(f"{sign}{difference} ± {half_width} {comparison.units[k]}")
    return texts


def _split(order: np.ndarray) -> list[np.ndarray]:
    """Return parameters in lists that fit into a panel, of about the same length."""
    return np.array_split(order, math.ceil(len(order) / ROWS_PER_PANEL))


def _listing(title: str, panels: Sequence[Panel]) -> Figure:
    """Return a figure with a row for each parameter."""
    rows = max(len(panel.y_names) for panel in panels)
    columns = len(panels)
    width = max(7.5, 5.5 * columns)
    return Figure(title, panels, columns, height=0.7 + 0.2 * rows, width=width)
