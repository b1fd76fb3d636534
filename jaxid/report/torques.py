"""Measured and predicted forces over time, and their errors (Figs. 6, 7, 9 and 10 of the paper)."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.model_validation import TorqueErrors
from jaxid.result_table import percent, shortened, significant
from jaxid.robot.robot import Robot

from .style import (
    BLUE,
    ERROR,
    GREEN,
    GREY,
    INK,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    WIDTH,
    add_legend,
    caption,
    drawing,
)


def torque_figure(
    errors: TorqueErrors,
    robot: Robot,
    title: str | None = None,
    joints: Sequence[int] | None = None,
) -> Figure:
    """Draw measured and predicted forces of every joint, and their difference below.

    Rows at both ends that count for no joint are left out; where a row within does not count for
    a joint, the difference is left blank.

    Args:
        errors: Errors on one recording.
        robot: Robot of the recording.
        title: Title of the figure; the recording's name if None.
        joints: Indices of the joints to show, from 0; all if None.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    shown = range(robot.joints) if joints is None else tuple(joints)
    counted = np.flatnonzero(np.asarray(errors.counted).any(axis=1))
    window = slice(counted[0], counted[-1] + 1)
    columns = 1 if len(shown) <= 2 else 2 if len(shown) <= 16 else 3
    rows = math.ceil(len(shown) / columns)
    name = shortened(errors.name if title is None else title, 40)
    title = f"{name}: relative error {percent(errors.relative)} %"
    with drawing(title, WIDTH if columns < 3 else 15.0, 0.95 + 2.15 * rows, 0.045) as figure:
        grid = figure.add_gridspec(rows, columns)
        panels = []
        for place, j in enumerate(shown):
            # The third part is empty: it separates the joints.
            cell = grid[divmod(place, columns)].subgridspec(3, 1, height_ratios=(3, 1, 0.22))
            upper = figure.add_subplot(cell[0])
            lower = figure.add_subplot(cell[1], sharex=upper)
            _draw_joint(upper, lower, errors, robot, j, window)
            panels.append((upper, lower))
            if place + columns >= len(shown):
                lower.set_xlabel("time [s]")
        for column in range(columns):
            figure.align_ylabels([axes for pair in panels[column::columns] for axes in pair])
        add_legend(
            figure,
            ("measured", {"color": MEASURED, "lw": 1.6}),
            ("predicted", {"color": PREDICTED, "lw": 1.6}),
            ("predicted - measured, on a scale of its own", {"color": ERROR, "lw": 1.6}),
        )
    return figure


def _draw_joint(
    upper: Axes, lower: Axes, errors: TorqueErrors, robot: Robot, j: int, window: slice
) -> None:
    unit = robot.force_unit(j)
    time = np.asarray(errors.time)[window]
    difference = errors.errors[window, j]
    for axes, values, colour, width in (
        (upper, np.asarray(errors.measured)[window, j], MEASURED, 1.9),
        (upper, np.asarray(errors.predicted)[window, j], PREDICTED, 0.8),
        (lower, difference, ERROR, 0.6),
    ):
        axes.plot(*decimate(time, values, bins=700), color=colour, lw=width)
    text = "no row counts"
    if np.isfinite(difference).any():
        fraction = errors.mean_percent[j] / 100.0
        text = f"mean |e| {significant(errors.mean[j], 2)} {unit}"
        text += f" = {percent(fraction)} % of max" if np.isfinite(fraction) else ""
    caption(upper, shortened(robot.joint_names[j], 26), text)
    upper.set_ylabel(f"{'torque' if robot.revolute[j] else 'force'} [{unit}]")
    lower.set_ylabel(f"[{unit}]")
    upper.tick_params(labelbottom=False)
    upper.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1.0)
    upper.yaxis.set_major_locator(MaxNLocator(5))
    lower.yaxis.set_major_locator(MaxNLocator(2, symmetric=True, min_n_ticks=3))
    lower.axhline(0.0, color=GREY, lw=0.5)
    largest = float(np.fmax.reduce(np.abs(difference), initial=0.0))
    lower.set_ylim(*np.array([-1.1, 1.1]) * (largest if largest > 0 else 1.0))


def require_joints(errors: TorqueErrors, robot: Robot) -> None:
    """Reject errors of another robot."""
    if errors.measured.shape[1] != robot.joints:
        raise InputError(
            f"`errors` of `{errors.name}` must be of the {robot.joints} joints of `{robot.name}`."
        )


def decimate(
    time: Float[AnyArray, " rows"], values: Float[AnyArray, " rows"], bins: int
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return points of a line: all if they are few, else the least and largest of each bin.

    A peak of one sample stays visible however long the log is. Gaps in time become NaN, at which
    a line breaks; values that are NaN stay out of their bin.
    """
    t, y = np.asarray(time), np.asarray(values)
    if len(t) <= 2 * bins:
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1 if len(steps) else []
        return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)
    place = np.minimum((bins * ((t - t[0]) / (t[-1] - t[0]))).astype(int), bins - 1)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    last = np.append(first[1:], len(t)) - 1
    least = np.fmin.reduceat(y, first)
    largest = np.fmax.reduceat(y, first)
    rising = ~(y[last] < y[first])
    points = np.stack([np.where(rising, least, largest), np.where(rising, largest, least)], axis=1)
    times = np.stack([t[first], t[last]], axis=1)
    gaps = np.flatnonzero(np.diff(place[first]) > 1) + 1
    times, points = (np.insert(x, gaps, np.nan, axis=0) for x in (times, points))
    return times.ravel(), points.ravel()


def error_figure(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors], robot: Robot
) -> Figure:
    """Draw mean absolute errors as bars and RMS errors as marks (Eq. 37, Fig. 10).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Several recordings count as one.

    Args:
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen; may be empty.
        robot: Robot of the recordings.

    Raises:
        InputError: If there is no recording at all, or the numbers of joints differ.
    """
    groups = (("identification", identification), ("verification", verification))
    return bar_figure(groups, robot)


def bar_figure(groups: Sequence[tuple[str, Sequence[TorqueErrors]]], robot: Robot) -> Figure:
    """Draw mean absolute errors as bars and RMS errors as marks, for several groups (Eq. 37).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Recordings of one group count as one.

    Args:
        groups: Names, and errors on some recordings, like those of one estimator; groups without
            recordings are left out.
        robot: Robot of the recordings.

    Raises:
        InputError: If there is no recording at all, there are too many groups, or the numbers of
            joints differ.
    """
    colours = (BLUE, ORANGE, GREEN, PURPLE)
    filled = [(name, recordings) for name, recordings in groups if recordings]
    if not 0 < len(filled) <= len(colours):
        raise InputError(
            f"`groups` must hold 1 to {len(colours)} groups with errors, but holds {len(filled)}."
        )
    everything = [errors for _, recordings in filled for errors in recordings]
    for errors in everything:
        require_joints(errors, robot)
    largest = np.asarray(everything[0].max_forces)
    n = robot.joints
    known = bool(np.isfinite(largest).all())
    width = min(0.36, 0.72 / len(filled))
    figure_width = max(7.6, min(2.0 + 1.1 * n, 1.4 * WIDTH))
    with drawing(f"{robot.name}: torque errors", figure_width, 4.4) as figure:
        axes = figure.add_subplot()
        for k, (colour, (label, recordings)) in enumerate(zip(colours, filled, strict=False)):
            mean, rms, force_rms = _pool(recordings)
            scale = 100.0 / (largest if known else np.maximum(force_rms, 1e-300))
            place = np.arange(n) + (k - 0.5 * (len(filled) - 1)) * (width + 0.02)
            average = percent(float(np.mean(mean * scale)) / 100.0)
            label = f"{label}, mean |e|: {average} % on average"
            bars = axes.bar(place, mean * scale, width, color=colour, label=label)
            if n * len(filled) <= 20:
                texts = [percent(x / 100.0) for x in mean * scale]
                ink = "white" if colour == BLUE else INK
                axes.bar_label(bars, texts, label_type="center", fontsize=7.5, color=ink)
            marks = {"marker": "D", "ms": 4.5 if n <= 10 else 3.0, "mew": 0.9, "mec": INK}
            last = "RMS" if k == len(filled) - 1 else "_"
            axes.plot(place, rms * scale, ls="none", mfc="white", label=last, **marks)
        names = [shortened(name, 20) for name in robot.joint_names]
        tilted = n > 10 or max(map(len, names)) > 12
        turn = {"rotation": 35, "ha": "right"} if tilted else {}
        axes.set_xticks(np.arange(n), names, **turn)
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        margin = 0.6 + 0.5 * max(0, 4 - n)
        axes.set_xlim(-margin, n - 1 + margin)
        axes.set_ylabel(f"error [% of {'the largest force' if known else 'RMS force'}]")
        handles, _ = axes.get_legend_handles_labels()
        bars_first = sorted(handles, key=lambda handle: handle.get_label() == "RMS")
        figure.legend(handles=bars_first, loc="outside lower left", ncols=3)
    return figure


def _pool(recordings: Sequence[TorqueErrors]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and RMS of the errors, and RMS of the forces, as if all were one recording."""
    e = np.concatenate([r.errors for r in recordings])
    counted = np.concatenate([np.asarray(r.counted) for r in recordings])
    forces = np.concatenate([np.asarray(r.measured) for r in recordings])
    rows = np.maximum(counted.sum(axis=0), 1)
    e = np.where(counted, e, 0.0)
    forces = np.where(counted, forces, 0.0)
    mean = np.abs(e).sum(axis=0) / rows
    rms, force_rms = (np.sqrt((x**2).sum(axis=0) / rows) for x in (e, forces))
    return mean, rms, force_rms
