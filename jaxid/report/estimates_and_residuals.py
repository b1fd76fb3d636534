"""Figures of a fit: its estimates, its residuals, the choice of its filter, a second fit beside."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import fftconvolve

from jaxid.arrays import Float
from jaxid.identification.filter_selection import FilterChoice
from jaxid.identification.fit_result import DOUBTFUL, TRUSTED, Fit
from jaxid.identification.parameter_changes import Comparison, Verdict
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.result_table import Status, percent, shortened, significant, with_deviations
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import BLUE, GREY, MEASURED, ORANGE, PALE, VERMILION, Curve, Panel
from .torques import require_joints

CEILING = 1000.0
"""Largest relative standard deviation that is shown [%]."""


def parameter_figure(fit: Fit) -> Figure:
    """Return the relative standard deviations of all estimates, the best known ones first.

    Beside them stand the estimates with their standard deviations. Values above 1000 %
    are drawn at the edge.

    Args:
        fit: Identified parameters.
    """
    relative = 100.0 * np.asarray(fit.relative_standard_deviations)
    order = np.argsort(np.where(np.isnan(relative), np.inf, relative), kind="stable")
    finite = relative[np.isfinite(relative) & (relative > 0)]
    least = max(1e-3, float(finite.min())) if len(finite) else 1.0
    low = min(10.0 ** math.floor(math.log10(least) - 0.1), 1.0)
    values = np.clip(np.nan_to_num(relative, nan=np.inf, posinf=CEILING), low, CEILING)
    grades = (
        (Status.GOOD, f"up to {100 * TRUSTED:g} %: trusted", BLUE),
        (Status.DOUBTFUL, f"up to {100 * DOUBTFUL:g} %: doubtful", ORANGE),
        (Status.BAD, "above: small, or not excited", VERMILION),
    )

    def panel(shown: np.ndarray) -> Panel:
        numbers = with_deviations(
            np.asarray(fit.parameters)[shown], fit.standard_deviations[shown]
        )
        units = [fit.base.units[k] for k in shown]
        texts = [
            f"{a} ± {b} {unit}" for a, b, unit in zip(*numbers, units, strict=True)
        ]
        curves = []
        for status, name, colour in grades:
            rows = [k for k, p in enumerate(shown) if fit.trust[p] is status]
            x = values[shown[rows]]
            said = [f"{fit.base.names[shown[k]]}: {texts[k]}" for k in rows]
            ends = {"low": np.full(len(x), low), "high": x, "texts": said}
            curves.append(Curve(x, rows, name, colour, "intervals", **ends))
        return Panel(
            curves,
            x="standard deviation / |estimate| [%]",
            log="x",
            x_range=(low, CEILING),
            y_names=[fit.base.names[k] for k in shown],
            beside=texts,
            levels=[("x", 100.0 * limit, GREY) for limit in (TRUSTED, DOUBTFUL)],
        )

    known = fit.trust.count(Status.GOOD)
    name = fit.base.model.robot.name
    return _listing(
        f"{name}: {known} of {len(relative)} base parameters are known to 10 %",
        [panel(shown) for shown in _columns(order)],
    )


def comparison_figure(comparison: Comparison) -> Figure:
    """Return both estimates of every parameter with their intervals.

    Each parameter is drawn relative to the farthest end of its two intervals, so that
    what is known to lie away from zero stands there. A star marks the names of
    parameters that have changed.

    Args:
        comparison: Comparison of two fits.
    """
    fits, k = (comparison.first, comparison.second), list(comparison.indices)
    estimates = [np.asarray(fit.parameters)[k] for fit in fits]
    halves = [fit.uncertainty.half_widths(comparison.level)[k] for fit in fits]
    sizes = [np.abs(p) + half for p, half in zip(estimates, halves, strict=True)]
    # An end at infinity is off the axis, whatever the scale.
    ends = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    scale = np.where(ends > 0, ends, 1.0)
    numbers = with_deviations(np.asarray(comparison.difference), comparison.half_widths)
    texts = [
        f"{'' if a.startswith('-') else '+'}{a} ± {b} {unit}"
        for a, b, unit in zip(*numbers, comparison.units, strict=True)
    ]

    def panel(shown: np.ndarray) -> Panel:
        curves = []
        for fit, p, half, colour, shift in zip(
            fits, estimates, halves, (BLUE, VERMILION), (-0.17, 0.17), strict=True
        ):
            x, width = p[shown] / scale[shown], half[shown] / scale[shown]
            low, high = np.clip(x - width, -2.0, 2.0), np.clip(x + width, -2.0, 2.0)
            said = [
                f"{comparison.names[i]}: {significant(float(p[i]), 4)}" for i in shown
            ]
            rows = np.arange(len(shown)) + shift
            ends = {"low": low, "high": high, "texts": said}
            curves.append(Curve(x, rows, fit.name, colour, "intervals", **ends))
        return Panel(
            curves,
            x="estimate / farthest end of both intervals",
            x_range=(-1.08, 1.08),
            y_names=[
                comparison.names[i] + " *" * (comparison.verdicts[i] is Verdict.CHANGED)
                for i in shown
            ],
            beside=[texts[i] for i in shown],
            levels=[("x", 0.0, GREY)],
        )

    changed = comparison.verdicts.count(Verdict.CHANGED)
    return _listing(
        f"{changed} of {len(k)} parameters have changed",
        [panel(shown) for shown in _columns(np.arange(len(k)))],
    )


def _columns(order: np.ndarray) -> list[np.ndarray]:
    """Return parameters in lists of 40 at most, of about the same length."""
    return np.array_split(order, math.ceil(len(order) / 40))


def _listing(title: str, panels: Sequence[Panel]) -> Figure:
    """Return a figure with a row for each parameter."""
    rows, columns = max(len(panel.y_names) for panel in panels), len(panels)
    width = max(7.5, 5.5 * columns)
    return Figure(title, panels, columns, height=0.7 + 0.2 * rows, width=width)


def filter_figure(choice: FilterChoice) -> Figure:
    """Return the held-out errors of all candidates, and the correlation of neighbouring residuals.

    Thin lines are single parts of the log. Too low a cut-off removes motion that moves
    the robot, too high a one lets noise into the accelerations.

    Args:
        choice: Choice of a filter with all its candidates.
    """
    order = np.argsort(np.asarray(choice.cutoffs))
    cutoffs = np.asarray(choice.cutoffs)[order]
    errors = 100 * np.asarray(choice.errors)[order]
    best = float(np.asarray(choice.cutoffs)[choice.best])
    parts = [Curve(cutoffs, part, "single parts", PALE, width=0.8) for part in errors.T]
    mean = Curve(cutoffs, 100 * choice.curve[order], "all parts", marker=True)
    correlation = Curve(cutoffs, np.asarray(choice.correlations)[order], marker=True)
    axis = {"x": "cut-off of forces and columns [Hz]", "levels": [("x", best, ORANGE)]}
    left = Panel(
        [*parts, mean],
        title=f"chosen: {best:.3g} Hz",
        y="error on unseen parts",
        unit="% of the forces",
        log="xy",
        **axis,
    )
    right = Panel(
        [correlation],
        title="zero where rows are independent",
        y="correlation of neighbouring residuals",
        unit="1",
        log="x",
        **axis,
    )
    return Figure("Choice of the filter", [left, right], columns=2, height=3.2)


def residual_figure(spectra: ResidualSpectra, robot: Robot) -> Figure:
    """Return the power of each joint's residuals against frequency, beside that of white noise.

    The dashed line is the spectrum that white noise of the same power would have behind
    the filters.

    Args:
        spectra: Spectra of the residuals of a fit.
        robot: Robot of the fit.
    """
    frequency, gain = np.asarray(spectra.frequency), np.asarray(spectra.gain) ** 2
    shown = (frequency > 0) & (gain > 1e-4)

    def panel(j: int) -> Panel:
        density = np.asarray(spectra.density)[j, shown]
        level = np.sum(density) / np.sum(gain[shown])
        white = "white noise behind the filters (10 % of its power there)"
        verdict = "white" if spectra.white[j] else "not white"
        low = percent(float(spectra.low_frequency[j]))
        return Panel(
            [
                Curve(frequency[shown], density, "residuals", width=1.2),
                Curve(frequency[shown], level * gain[shown], white, GREY, dashed=True),
            ],
            title=shortened(robot.joint_names[j], 24),
            value=f"{verdict}: {low} % of the power below {0.1 * spectra.band:.2g} Hz",
            x="frequency [Hz]",
            unit="(N m)²/Hz" if robot.force_unit(j) == "N m" else "N²/Hz",
            log="xy" if np.any(density > 0) else "x",
        )

    title = (
        f"{robot.name}: residuals of {sum(spectra.white)} of {robot.joints} "
        "joints are white"
    )
    return _joint_figure(title, [panel(j) for j in range(robot.joints)])


def _joint_figure(title: str, panels: Sequence[Panel]) -> Figure:
    """Return a panel for each joint, two beside each other."""
    columns = min(2, len(panels))
    return Figure(title, panels, columns, width=5.5 * columns)


def autocorrelation_figure(
    errors: TorqueErrors, robot: Robot, spectra: ResidualSpectra | None = None
) -> Figure:
    """Return the autocorrelation of each joint's residuals, with the 95 % band of white noise.

    Args:
        errors: Errors on one recording.
        robot: Robot of the recording.
        spectra: Spectra with the gain of the filters: the dashed line is the
            autocorrelation of white noise behind them.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    time = np.asarray(errors.time)
    count = min(50, len(time) // 2) + 1
    lags = float(np.median(np.diff(time))) * np.arange(count)
    values = autocorrelation(errors, count)
    limits = 1.96 / np.sqrt(np.maximum(np.asarray(errors.counted).sum(axis=0), 1))
    white = []
    if spectra is not None:
        # Autocorrelation of white noise behind the filters.
        f = np.asarray(spectra.frequency)
        weights = np.gradient(f) * np.asarray(spectra.gain) ** 2
        filtered = np.cos(2.0 * np.pi * np.outer(lags, f)) @ weights / weights.sum()
        white = [
            Curve(lags, filtered, "white noise behind the filters", GREY, dashed=True)
        ]

    def panel(j: int) -> Panel:
        limit, inside = np.full(count, limits[j]), "white residuals: 95 % within"
        return Panel(
            [
                Curve(lags, lags, inside, MEASURED, "band", low=-limit, high=limit),
                Curve(lags, values[:, j], "residuals", marker=True),
                *white,
            ],
            title=shortened(robot.joint_names[j], 24),
            value=f"next row: {significant(float(values[1, j]), 2)}",
            x="lag [s]",
            x_range=(-0.5 * lags[1], lags[-1] + 0.5 * lags[1]),
            y_range=(min(-0.25, 1.1 * float(np.nanmin(values[:, j]))), 1.05),
            levels=[("y", 0.0, GREY)],
        )

    title = f"{shortened(errors.name, 40)}: autocorrelation of the residuals"
    return _joint_figure(title, [panel(j) for j in range(robot.joints)])


def autocorrelation(
    errors: TorqueErrors, lags: int
) -> Float[np.ndarray, "lags joints"]:
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
