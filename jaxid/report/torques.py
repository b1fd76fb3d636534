"""Measured and predicted forces over time, joint by joint (Figs. 6, 7 and 9 of the paper)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.report.style import (
    ERROR,
    GREEN,
    GREY,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
)
from jaxid.robot.robot import Robot
from jaxid.table import percent, shortened, significant
from jaxid.validation import TorqueErrors


def torque_figure(
    errors: TorqueErrors,
    robot: Robot,
    title: str | None = None,
    joints: Sequence[int] | None = None,
    beside: Sequence[tuple[str, TorqueErrors]] = (),
) -> Figure:
    """Draw measured and predicted forces of every joint, and their difference below.

    Rows at both ends that count for no joint are left out; where a row within does not count for
    a joint, the difference is left blank.

    Args:
        errors: Errors on one recording.
        robot: Robot of the recording.
        title: Title of the figure; the recording's name if None.
        joints: Indices of the joints to show, from 0; all if None.
        beside: Other predictions of the same recording, with their names.

    Raises:
        InputError: If the numbers of joints differ, there is no such joint, or no row counts.
    """
    colours = dict(zip((GREEN, ORANGE, PURPLE), beside, strict=False))
    if len(colours) < len(beside):
        raise InputError(f"`beside` must hold 3 predictions at most, but holds {len(beside)}.")
    for one in (errors, *(other for _, other in beside)):
        require_joints(one, robot)
    shown = range(robot.joints) if joints is None else tuple(joints)
    if not shown or not set(shown) <= set(range(robot.joints)):
        raise InputError(
            f"`joints` must hold numbers from 0 to {robot.joints - 1}, but is {joints}."
        )
    counted = np.flatnonzero(np.asarray(errors.counted).any(axis=1))
    if not len(counted):
        raise InputError(
            f"no row of `{errors.name}` counts for any joint: there is nothing to draw."
        )
    window = slice(counted[0], counted[-1] + 1)
    columns = 1 if len(shown) <= 2 else 2 if len(shown) <= 16 else 3
    rows = math.ceil(len(shown) / columns)
    with house_style():
        figure = new_figure(WIDTH if columns < 3 else 15.0, 0.95 + 2.15 * rows, gap=0.045)
        grid = figure.add_gridspec(rows, columns)
        panels = []
        for place, j in enumerate(shown):
            # The third part is empty: it separates the joints.
            cell = grid[divmod(place, columns)].subgridspec(3, 1, height_ratios=(3, 1, 0.22))
            upper = figure.add_subplot(cell[0])
            lower = figure.add_subplot(cell[1], sharex=upper)
            panels.append((upper, lower))
            for colour, (_, other) in colours.items():
                _draw_line(upper, other, other.predicted, j, window, color=colour, lw=0.8)
                _draw_line(lower, other, other.errors, j, window, color=colour, lw=0.6)
            _draw_joint(upper, lower, errors, robot, j, window)
            _scale(lower, [one.errors[window, j] for one in (errors, *(e for _, e in beside))])
            if place + columns >= len(shown):
                lower.set_xlabel("time [s]")
        for column in range(columns):
            figure.align_ylabels([axes for pair in panels[column::columns] for axes in pair])
        name = shortened(errors.name if title is None else title, 40)
        heading(figure, f"{name}: relative error {percent(errors.relative)} %")
        entries = [
            (MEASURED, "measured"),
            (PREDICTED, "predicted"),
            *((colour, name) for colour, (name, _) in colours.items()),
            (ERROR, "predicted - measured, on a scale of its own"),
        ]
        handles = [Line2D([], [], color=colour, lw=1.6, label=name) for colour, name in entries]
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))
    return figure


def _draw_line(
    axes: Axes, errors: TorqueErrors, values: AnyArray, j: int, window: slice, **style: Any
) -> None:
    time, column = np.asarray(errors.time)[window], np.asarray(values)[window, j]
    axes.plot(*decimate(time, column, bins=700), **style)


def _draw_joint(
    upper: Axes, lower: Axes, errors: TorqueErrors, robot: Robot, j: int, window: slice
) -> None:
    unit = robot.force_unit(j)
    time = np.asarray(errors.time)[window]
    _draw_line(upper, errors, errors.measured, j, window, color=MEASURED, lw=1.9)
    _draw_line(upper, errors, errors.predicted, j, window, color=PREDICTED, lw=0.8)
    _draw_line(lower, errors, errors.errors, j, window, color=ERROR, lw=0.6)
    caption(upper, shortened(robot.joint_names[j], 26), _mean_error(errors, j, unit))
    upper.set_ylabel(f"{'torque' if robot.revolute[j] else 'force'} [{unit}]")
    lower.set_ylabel(f"[{unit}]")
    upper.tick_params(labelbottom=False)
    upper.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1.0)
    upper.yaxis.set_major_locator(MaxNLocator(5))
    lower.yaxis.set_major_locator(MaxNLocator(2, symmetric=True, min_n_ticks=3))
    lower.axhline(0.0, color=GREY, lw=0.5)


def _scale(axes: Axes, differences: Sequence[np.ndarray]) -> None:
    """Centre a panel at zero, with room for all differences."""
    sizes = np.abs(np.concatenate(differences))
    largest = np.nanmax(sizes) if np.isfinite(sizes).any() else 0.0
    axes.set_ylim(*np.array([-1.1, 1.1]) * (largest if largest > 0 else 1.0))


def _mean_error(errors: TorqueErrors, j: int, unit: str) -> str:
    if not np.asarray(errors.counted)[:, j].any():
        return "no row counts"
    mean, fraction = errors.mean[j], errors.mean_percent[j] / 100.0
    text = f"mean |e| {significant(mean, 2)} {unit}"
    return f"{text} = {percent(fraction)} % of max" if np.isfinite(fraction) else text


def require_joints(errors: TorqueErrors, robot: Robot) -> None:
    """Reject errors of another robot.

    Raises:
        InputError: If the numbers of joints differ.
    """
    if errors.measured.shape[1] != robot.joints:
        raise InputError(
            f"`errors` of `{errors.name}` belong to {errors.measured.shape[1]} joints, but the "
            f"robot `{robot.name}` has {robot.joints}."
        )


def decimate(
    time: Float[AnyArray, " rows"], values: Float[AnyArray, " rows"], bins: int
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return points of a line: all if they are few, else the least and largest of each bin.

    A peak of one sample stays visible however long the log is. Gaps in time become NaN, at which
    a line breaks; values that are NaN stay out of their bin.

    Args:
        time: Rising instants of the values [s].
        values: Values, NaN where there is none.
        bins: Number of intervals of equal duration, about one for each pixel.
    """
    t, y = np.asarray(time), np.asarray(values)
    if len(t) <= 2 * bins:
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1 if len(steps) else []
        return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)
    place = np.minimum((bins * ((t - t[0]) / (t[-1] - t[0]))).astype(int), bins - 1)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    last = np.append(first[1:], len(t)) - 1
    least, largest = np.fmin.reduceat(y, first), np.fmax.reduceat(y, first)
    rising = ~(y[last] < y[first])
    points = np.stack([np.where(rising, least, largest), np.where(rising, largest, least)], axis=1)
    times = np.stack([t[first], t[last]], axis=1)
    gaps = np.flatnonzero(np.diff(place[first]) > 1) + 1
    times, points = (np.insert(x, gaps, np.nan, axis=0) for x in (times, points))
    return times.ravel(), points.ravel()
