"""Measured and predicted forces over time, joint by joint (Figs. 6, 7 and 9 of the paper)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxid.arrays import AnyArray
from jaxid.errors import InputError
from jaxid.report.lines import thinned
from jaxid.report.numbers import percent, shortened, significant
from jaxid.report.style import (
    ERROR,
    GREEN,
    GREY,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    WIDE,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
)
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors

OTHERS = (GREEN, ORANGE, PURPLE)
"""Colours of predictions beside the first."""
ROW = 2.15
HEADER = 0.95
BINS = 700
"""Bins of a line: about one for each pixel of a panel."""


def torque_figure(
    errors: TorqueErrors,
    robot: Robot,
    title: str | None = None,
    joints: Sequence[int] | None = None,
    beside: Sequence[tuple[str, TorqueErrors]] = (),
) -> Figure:
    """Draws measured and predicted forces of every joint, and their difference below.

    Rows at both ends that count for no joint are left out; where a row within does not count for
    a joint, the difference is left blank.

    Args:
        errors: Of one recording.
        robot: Whose joints they are.
        title: Of the figure; the recording's name if None.
        joints: Which ones to show, 0 is the first; all if None.
        beside: Other predictions of the same recording, with their names.

    Raises:
        InputError: If the numbers of joints differ, there is no such joint, or no row counts.
    """
    for one in (errors, *(other for _, other in beside)):
        require_joints(one, robot)
    if len(beside) > len(OTHERS):
        raise InputError(f"`beside` must hold {len(OTHERS)} at most, but holds {len(beside)}.")
    shown = range(robot.joints) if joints is None else tuple(joints)
    n = len(shown)
    if not n or not set(shown) <= set(range(robot.joints)):
        raise InputError(
            f"`joints` must hold numbers from 0 to {robot.joints - 1}, but is {joints}."
        )
    counts = np.flatnonzero(np.asarray(errors.counted).any(axis=1))
    if not len(counts):
        raise InputError(
            f"no row of `{errors.name}` counts for any joint: there is nothing to draw."
        )
    window = slice(counts[0], counts[-1] + 1)
    columns = 1 if n <= 2 else 2 if n <= 16 else 3
    rows = math.ceil(n / columns)
    with house_style():
        figure = new_figure(WIDTH if columns < 3 else WIDE, HEADER + ROW * rows, gap=0.02)
        grid = figure.add_gridspec(rows, columns)
        panels = []
        for place, j in enumerate(shown):
            # The third part is empty: it keeps the next joint off.
            cell = grid[divmod(place, columns)].subgridspec(3, 1, height_ratios=(3, 1, 0.22))
            upper = figure.add_subplot(cell[0])
            lower = figure.add_subplot(cell[1], sharex=upper)
            for axes in (upper, lower):
                axes.set_gid(f"joint-{j}")
            panels.append((upper, lower))
            for colour, (_, other) in zip(OTHERS, beside, strict=False):
                _line(upper, other, other.predicted, j, window, color=colour, lw=0.8)
                _line(lower, other, other.errors, j, window, color=colour, lw=0.6)
            _joint(upper, lower, errors, robot, j, window)
            _scale(lower, [one.errors[window, j] for one in (errors, *(e for _, e in beside))])
            if place + columns >= n:
                lower.set_xlabel("time [s]")
        for column in range(columns):
            figure.align_ylabels([axes for pair in panels[column::columns] for axes in pair])
        name = shortened(errors.name if title is None else title, 40)
        heading(figure, f"{name}: relative error {percent(errors.relative)} %")
        figure.legend(
            handles=[
                Line2D([], [], color=MEASURED, lw=2.4, label="measured"),
                Line2D([], [], color=PREDICTED, lw=1.2, label="predicted"),
                *(
                    Line2D([], [], color=colour, lw=1.2, label=name)
                    for colour, (name, _) in zip(OTHERS, beside, strict=False)
                ),
                Line2D(
                    [], [], color=ERROR, lw=1.2, label="predicted - measured, on a scale of its own"
                ),
            ],
            loc="outside lower left",
            ncols=3 + len(beside),
        )
    return figure


def _line(
    axes: Axes, errors: TorqueErrors, values: AnyArray, j: int, window: slice, **looks: Any
) -> None:
    """A column of a recording, thinned out."""
    time, column = np.asarray(errors.time)[window], np.asarray(values)[window, j]
    axes.plot(*thinned(time, column, BINS), **looks)


def _joint(
    upper: Axes, lower: Axes, errors: TorqueErrors, robot: Robot, j: int, window: slice
) -> None:
    unit = robot.force_unit(j)
    time = np.asarray(errors.time)[window]
    for values, colour, width in (
        (errors.measured, MEASURED, 1.9),
        (errors.predicted, PREDICTED, 0.8),
    ):
        _line(upper, errors, values, j, window, color=colour, lw=width)
    _line(lower, errors, errors.errors, j, window, color=ERROR, lw=0.6)
    caption(upper, shortened(robot.joint_names[j], 26), _mean_error(errors, j, unit))
    upper.set_ylabel(f"{'torque' if robot.revolute[j] else 'force'} [{unit}]")
    lower.set_ylabel(f"[{unit}]")
    upper.tick_params(labelbottom=False)
    upper.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1.0)
    upper.yaxis.set_major_locator(MaxNLocator(5))
    lower.yaxis.set_major_locator(MaxNLocator(2, symmetric=True, min_n_ticks=3))
    lower.axhline(0.0, color=GREY, lw=0.5)


def _scale(axes: Axes, differences: Sequence[np.ndarray]) -> None:
    """Zero in the middle, and room for all differences."""
    sizes = np.abs(np.concatenate(differences))
    largest = np.nanmax(sizes) if np.isfinite(sizes).any() else 0.0
    axes.set_ylim(*np.array([-1.1, 1.1]) * (largest if largest > 0 else 1.0))


def _mean_error(errors: TorqueErrors, j: int, unit: str) -> str:
    if not np.asarray(errors.counted)[:, j].any():
        return "no row counts"
    mean, share = errors.mean[j], errors.mean_percent[j] / 100.0
    text = f"mean |e| {significant(mean, 2)} {unit}"
    return f"{text} = {percent(share)} % of max" if np.isfinite(share) else text


def require_joints(errors: TorqueErrors, robot: Robot) -> None:
    """Refuses errors of another robot.

    Raises:
        InputError: If the numbers of joints differ.
    """
    if errors.measured.shape[1] != robot.joints:
        raise InputError(
            f"`errors` of `{errors.name}` belong to {errors.measured.shape[1]} joints, but the "
            f"robot `{robot.name}` has {robot.joints}."
        )
