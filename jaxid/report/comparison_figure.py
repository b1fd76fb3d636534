"""Figure of the estimates of two fits side by side, with their intervals."""

import math

import numpy as np

from jaxid.identification.parameter_changes import Comparison, Verdict
from jaxid.result_table import significant

from .figure import Figure
from .figure_elements import BLUE, GREY, VERMILION, Curve, Panel

ROWS_PER_PANEL = 40
"""Largest number of parameters below each other."""
OFFSET = 0.17
"""Distance of the two intervals of one parameter from the middle of its row."""


def comparison_figure(comparison: Comparison) -> Figure:
    """Return both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that
    an interval that excludes zero is seen to do so. A star marks the names of
    parameters that have changed.

    Args:
        comparison: Comparison of two fits.
    """
    count = len(comparison.indices)
    columns = math.ceil(count / ROWS_PER_PANEL)
    parts = np.array_split(np.arange(count), columns)
    panels = [_comparison_panel(comparison, part) for part in parts]
    changes = comparison.verdicts.count(Verdict.CHANGED)
    return Figure(
        f"{changes} of {count} parameters have changed",
        panels,
        columns,
        height=0.7 + 0.2 * len(parts[0]),
        width=max(7.5, 5.5 * columns),
    )


def _comparison_panel(comparison: Comparison, shown: np.ndarray) -> Panel:
    """Return a row with two intervals for each parameter."""
    fits = (comparison.first, comparison.second)
    indices = np.array(comparison.indices)[shown]
    estimates = np.stack([fit.parameters[indices] for fit in fits])
    half_widths = np.stack([fit.uncertainty.half_widths()[indices] for fit in fits])
    sizes = np.abs(estimates) + half_widths
    # An end at infinity is off the axis, whatever the scale.
    ends = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    scale = np.where(ends > 0, ends, 1.0)

    # Without negative values half of the axis would be empty.
    min_value = -1.08 if np.any(estimates < half_widths) else -0.08

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
                    f"{name}: {significant(value, 4)}"
                    for name, value in zip(names, estimate, strict=True)
                ],
            )
        )
    is_changed = [comparison.verdicts[k] is Verdict.CHANGED for k in shown]
    return Panel(
        curves,
        x="estimate / largest end of its intervals",
        x_range=(min_value, 1.08),
        y_names=[
            name + " *" * mark for name, mark in zip(names, is_changed, strict=True)
        ],
        levels=[("x", 0.0, GREY)],
    )
