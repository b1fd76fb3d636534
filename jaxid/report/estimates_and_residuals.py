"""Figures of a fit: its estimates, its residuals, the choice of its filter, a second fit beside."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy.signal import fftconvolve

from jaxid.arrays import Float
from jaxid.identification.filter_and_parameter_selection import FilterChoice
from jaxid.identification.fit_result import DOUBTFUL, TRUSTED, Fit
from jaxid.identification.parameter_changes import Comparison, Verdict
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.model_validation import TorqueErrors
from jaxid.result_table import Status, percent, shortened, significant, with_deviations
from jaxid.robot.robot import Robot

from .style import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    VERMILION,
    WIDTH,
    add_legend,
    caption,
    drawing,
    logarithmic,
)
from .torques import require_joints

_DOTS = {"marker": "o", "ms": 5, "lw": 1.4}


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
    title = f"{name}: {good} of {len(relative)} base parameters are known to 10 %"
    with drawing(title) as figure:
        for axes, shown in _list_panels(figure, order, 0.19, 1.35):
            _draw_deviations(axes, fit, relative, shown, low)
        add_legend(
            figure,
            (f"up to {100 * TRUSTED:g} %: trusted", {"color": BLUE, **_DOTS}),
            (f"up to {100 * DOUBTFUL:g} %: doubtful", {"color": ORANGE, **_DOTS}),
            ("above: small, or not excited", {"color": VERMILION, **_DOTS}),
        )
    return figure


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that what is known
    to lie away from zero stands there. Names of parameters that have changed are bold.

    Args:
        comparison: Comparison of two fits.
    """
    first, second = comparison.first, comparison.second
    changed = comparison.verdicts.count(Verdict.CHANGED)
    size = len(comparison.indices)
    title = f"{changed} of {size} parameters have changed"
    with drawing(title) as figure:
        for axes, shown in _list_panels(figure, np.arange(size), 0.21, 1.5):
            _draw_intervals(axes, comparison, shown)
        add_legend(
            figure,
            (first.name, {"color": BLUE, **_DOTS}),
            (second.name, {"color": VERMILION, **_DOTS}),
        )
    return figure


def _list_panels(
    figure: Figure, order: np.ndarray, line: float, margin: float
) -> Iterator[tuple[Axes, np.ndarray]]:
    """Yield panels with a line for each parameter, and the parameters of each panel."""
    columns = math.ceil(len(order) / 40)
    rows = math.ceil(len(order) / columns)
    figure.set_size_inches(max(7.5, WIDTH / 2 * columns), margin + line * rows)
    # Texts are wider at the resolution of files than at that of the layout.
    figure.set_layout_engine("constrained", w_pad=0.16)
    grid = figure.add_gridspec(1, columns, wspace=0.06)
    for column in range(columns):
        axes = figure.add_subplot(grid[column])
        axes.set_ylim(rows - 0.4, -0.6)
        axes.tick_params(axis="y", length=0, labelcolor="black")
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_color(PALE)
        yield axes, order[column * rows : (column + 1) * rows]


def _label_rows(
    axes: Axes, names: Sequence[str], texts: Sequence[str], bold: Sequence[bool]
) -> None:
    """Write the names of parameters to the left of their lines, and texts to the right."""
    axes.set_yticks(np.arange(len(names)), names)
    beside = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 7.5}
    labels = axes.get_yticklabels()
    for place, (label, text, strong) in enumerate(zip(labels, texts, bold, strict=True)):
        label.set_fontweight("bold" if strong else "normal")
        axes.text(1.03, float(place), text, color="black" if strong else GREY, **beside)


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
        dots = {"s": 20, "c": colours[where], "marker": marker, "zorder": 3, "clip_on": False}
        axes.scatter(deviations[where], places[where], **dots)
    axes.set_xscale("log")
    axes.set_xlim(low, ceiling)
    for limit in (TRUSTED, DOUBTFUL):
        axes.axvline(limit, color=GREY, lw=0.7, linestyle=(0, (4, 3)), zorder=1)
    axes.xaxis.set_major_locator(LogLocator(10.0, numticks=12))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: significant(100.0 * value, 1)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("standard deviation / |estimate| [%]")
    numbers = with_deviations(np.asarray(fit.parameters)[shown], fit.standard_deviations[shown])
    units = [fit.base.units[k] for k in shown]
    texts = [f"{a} ± {b} {unit}" for a, b, unit in zip(*numbers, units, strict=True)]
    _label_rows(axes, [fit.base.names[k] for k in shown], texts, [False] * len(texts))


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
    axes.set_xlabel("estimate / farthest end of both intervals")
    verdicts = comparison.verdicts
    difference = np.asarray(comparison.difference)
    numbers = with_deviations(difference[shown], comparison.half_widths[shown])
    units = [comparison.units[i] for i in shown]
    texts = [
        f"{'' if a.startswith('-') else '+'}{a} ± {b} {unit}"
        for a, b, unit in zip(*numbers, units, strict=True)
    ]
    changed = [verdicts[i] is Verdict.CHANGED for i in shown]
    _label_rows(axes, [comparison.names[i] for i in shown], texts, changed)


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
    with drawing("Choice of the filter") as figure:
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
        caption(left, f"chosen: {best:.3g} Hz")
        right.set_ylabel("correlation of neighbouring residuals [1]")
        caption(right, "zero where rows are independent")
    return figure


def residual_figure(spectra: ResidualSpectra, robot: Robot) -> Figure:
    """Draw the power of each joint's residuals against frequency, beside that of white noise.

    The dashed line is the spectrum that white noise of the same power would have behind the
    filters.

    Args:
        spectra: Spectra of the residuals of a fit.
        robot: Robot of the fit.
    """
    n = robot.joints
    title = f"{robot.name}: residuals of {sum(spectra.white)} of {n} joints are white"
    with drawing(title) as figure:
        for j, axes in enumerate(_joint_panels(figure, n, 1.9)):
            _draw_spectrum(axes, spectra, j, robot)
        white = "white noise behind the filters (10 % of its power there)"
        add_legend(
            figure,
            ("residuals", {"color": BLUE, "lw": 1.2}),
            (white, {"color": GREY, "lw": 1.0, "ls": "--"}),
        )
    return figure


def _joint_panels(figure: Figure, n: int, height: float) -> list[Axes]:
    """Return a panel for each of n joints, two beside each other."""
    columns = min(2, n)
    rows = math.ceil(n / columns)
    figure.set_size_inches(WIDTH * columns / 2, 1.1 + height * rows)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[n:]:
        axes.set_axis_off()
    return panels[:n]


def _draw_spectrum(axes: Axes, spectra: ResidualSpectra, j: int, robot: Robot) -> None:
    frequency = np.asarray(spectra.frequency)
    density = np.asarray(spectra.density)[j]
    gain = np.asarray(spectra.gain) ** 2
    shown = (frequency > 0) & (gain > 1e-4)
    level = np.sum(density[shown]) / np.sum(gain[shown])
    axes.plot(frequency[shown], density[shown], color=BLUE, lw=1.2)
    axes.plot(frequency[shown], level * gain[shown], color=GREY, lw=1.0, ls="--")
    logarithmic(axes, "x")
    if np.any(density[shown] > 0):
        logarithmic(axes, "y")
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("(N m)²/Hz" if robot.force_unit(j) == "N m" else "N²/Hz")
    verdict = "white" if spectra.white[j] else "not white"
    low = float(spectra.low_frequency[j])
    text = f"{verdict}: {percent(low)} % of the power below {0.1 * spectra.band:.2g} Hz"
    caption(axes, shortened(robot.joint_names[j], 24), text)


def autocorrelation_figure(
    errors: TorqueErrors, robot: Robot, spectra: ResidualSpectra | None = None
) -> Figure:
    """Draw the autocorrelation of each joint's residuals, with the 95 % band of white noise.

    Args:
        errors: Errors on one recording.
        robot: Robot of the recording.
        spectra: Spectra with the gain of the filters: the dashed line is the autocorrelation of
            white noise behind them.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    time = np.asarray(errors.time)
    count = min(50, len(time) // 2) + 1
    lags = float(np.median(np.diff(time))) * np.arange(count)
    values = autocorrelation(errors, count)
    limits = 1.96 / np.sqrt(np.maximum(np.asarray(errors.counted).sum(axis=0), 1))
    dashed = {"color": INK, "lw": 1.0, "ls": "--"}
    title = f"{shortened(errors.name, 40)}: autocorrelation of the residuals"
    with drawing(title) as figure:
        panels = _joint_panels(figure, robot.joints, 1.7)
        for j, axes in enumerate(panels):
            axes.axhspan(-limits[j], limits[j], color=PALE, lw=0, zorder=0.5)
            axes.axhline(0.0, color=GREY, lw=0.5)
            axes.vlines(lags, 0.0, values[:, j], color=BLUE, lw=0.8)
            axes.plot(lags, values[:, j], color=BLUE, lw=0.0, marker="o", ms=2.6)
            axes.set_xlim(-0.5 * lags[1], lags[-1] + 0.5 * lags[1])
            axes.set_ylim(min(-0.25, 1.1 * float(np.nanmin(values[:, j]))), 1.05)
            axes.set_xlabel("lag [s]")
            next_row = significant(float(values[1, j]), 2)
            caption(axes, shortened(robot.joint_names[j], 24), f"next row: {next_row}")
        entries = [
            ("residuals", {"color": BLUE, "marker": "o", "ms": 3, "lw": 1.2}),
            Patch(color=PALE, label="white residuals: 95 % within"),
        ]
        if spectra is not None:
            # Autocorrelation of white noise behind the filters.
            f = np.asarray(spectra.frequency)
            power = np.asarray(spectra.gain) ** 2
            weights = np.gradient(f) * power
            filtered = np.cos(2.0 * np.pi * np.outer(lags, f)) @ weights / weights.sum()
            for axes in panels:
                axes.plot(lags, filtered, **dashed)
            entries.append(("white noise behind the filters", dashed))
        add_legend(figure, *entries)
    return figure


def autocorrelation(errors: TorqueErrors, lags: int) -> Float[np.ndarray, "lags joints"]:
    """Return the correlation of residuals with those some rows later, for lags from 0.

    Rows that do not count for a joint are left out; NaN where no pair of rows counts.
    """
    e = errors.errors
    e = e - np.nanmean(e, axis=0)
    counted = np.isfinite(e).astype(float)
    e = np.nan_to_num(e)

    def correlate(x: np.ndarray) -> np.ndarray:
        return fftconvolve(x, x[::-1], axes=0)[len(x) - 1 :][:lags]

    pairs = np.round(correlate(counted))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(pairs > 0, correlate(e) / pairs, np.nan)
        return mean / mean[0]
