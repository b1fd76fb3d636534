"""Figures of residuals: spectra, autocorrelation, and the choice of a filter."""

import numpy as np
from scipy.signal import fftconvolve

from jaxid.arrays import Float
from jaxid.identification.filter_selection import FilterChoice
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.result_table import percent, shortened, significant
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import GREY, MEASURED, ORANGE, PALE, Curve, Panel
from .torques import require_joints

MAX_LAGS = 50
"""Largest lag of an autocorrelation [rows]."""
MIN_GAIN = 1e-2
"""Gain of the filters below which a spectrum is not shown."""


def filter_figure(choice: FilterChoice) -> Figure:
    """Return held-out errors of all candidates, and correlations between neighbours.

    Thin lines are single parts of the log. Too low a cut-off removes motion that moves
    the robot, too high a one lets noise into the accelerations.

    Args:
        choice: Choice of a filter with all its candidates.
    """
    order = np.argsort(np.asarray(choice.cutoffs))
    cutoffs = np.asarray(choice.cutoffs)[order]
    errors = 100.0 * np.asarray(choice.errors)[order]
    best_cutoff = float(np.asarray(choice.cutoffs)[choice.best])
    label = "cut-off of forces and columns [Hz]"
    levels = [("x", best_cutoff, ORANGE)]
    parts = [Curve(cutoffs, part, "single parts", PALE, width=0.8) for part in errors.T]
    mean = Curve(cutoffs, 100.0 * choice.curve[order], "all parts", marker=True)
    correlation = Curve(cutoffs, np.asarray(choice.correlations)[order], marker=True)
    panels = [
        Panel(
            [*parts, mean],
            title=f"chosen: {best_cutoff:.3g} Hz",
            x=label,
            y="error on unseen parts",
            unit="% of the forces",
            log="xy",
            levels=levels,
        ),
        Panel(
            [correlation],
            title="zero where rows are independent",
            x=label,
            y="correlation of neighbouring residuals",
            unit="1",
            log="x",
            levels=levels,
        ),
    ]
    return Figure("Choice of the filter", panels, columns=2, height=3.2)


def residual_figure(spectra: ResidualSpectra, robot: Robot) -> Figure:
    """Return the power of each joint's residuals against frequency.

    The dashed line is the spectrum that white noise of the same power would have behind
    the filters.

    Args:
        spectra: Spectra of the residuals of a fit.
        robot: Robot of the fit.
    """
    panels = [_spectrum_panel(spectra, robot, j) for j in range(robot.joints)]
    count = sum(spectra.white)
    title = f"{robot.name}: residuals of {count} of {robot.joints} joints are white"
    columns = min(2, len(panels))
    return Figure(title, panels, columns, width=5.5 * columns)


def _spectrum_panel(spectra: ResidualSpectra, robot: Robot, j: int) -> Panel:
    """Return the spectrum of a joint, and that of white noise behind the filters."""
    frequency = np.asarray(spectra.frequency)
    gain = np.asarray(spectra.gain)
    is_shown = (frequency > 0) & (gain > MIN_GAIN)
    frequency = frequency[is_shown]
    white_density = gain[is_shown] ** 2
    density = np.asarray(spectra.density)[j, is_shown]
    level = np.sum(density) / np.sum(white_density)

    white_name = "white noise behind the filters (10 % of its power there)"
    verdict = "white" if spectra.white[j] else "not white"
    low_share = percent(float(spectra.low_frequency[j]))
    low_band = f"below {0.1 * spectra.band:.2g} Hz"
    return Panel(
        [
            Curve(frequency, density, "residuals", width=1.2),
            Curve(frequency, level * white_density, white_name, GREY, dashed=True),
        ],
        title=shortened(robot.joint_names[j], 24),
        value=f"{verdict}: {low_share} % of the power {low_band}",
        x="frequency [Hz]",
        unit="(N m)²/Hz" if robot.force_unit(j) == "N m" else "N²/Hz",
        log="xy" if np.any(density > 0) else "x",
    )


def autocorrelation_figure(
    errors: TorqueErrors, robot: Robot, spectra: ResidualSpectra | None = None
) -> Figure:
    """Return the autocorrelation of each joint's residuals.

    The band holds 95 % of the values that white noise has.

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
    count = min(MAX_LAGS, len(time) // 2) + 1
    lags = float(np.median(np.diff(time))) * np.arange(count)
    correlations = autocorrelation(errors, count)
    # Autocorrelations of white noise have the deviation 1 / sqrt(rows).
    rows = np.asarray(errors.counted).sum(axis=0)
    limits = 1.96 / np.sqrt(np.maximum(rows, 1))
    white_noise = [] if spectra is None else [_white_noise(spectra, lags)]
    panels = []
    for j, name in enumerate(robot.joint_names):
        correlation = correlations[:, j]
        limit = np.full(count, limits[j])
        legend = "white residuals: 95 % within"
        band = Curve(lags, lags, legend, MEASURED, "band", low=-limit, high=limit)
        curve = Curve(lags, correlation, "residuals", marker=True)
        neighbour_correlation = significant(float(correlation[1]), 2)
        half_lag = 0.5 * lags[1]
        minimum = 1.1 * float(np.nanmin(correlation))
        panel = Panel(
            [band, curve, *white_noise],
            title=shortened(name, 24),
            value=f"next row: {neighbour_correlation}",
            x="lag [s]",
            x_range=(-half_lag, lags[-1] + half_lag),
            y_range=(min(-0.25, minimum), 1.05),
            levels=[("y", 0.0, GREY)],
        )
        panels.append(panel)
    title = f"{shortened(errors.name, 40)}: autocorrelation of the residuals"
    columns = min(2, len(panels))
    return Figure(title, panels, columns, width=5.5 * columns)


def _white_noise(spectra: ResidualSpectra, lags: np.ndarray) -> Curve:
    """Return the autocorrelation of white noise behind the filters."""
    frequency = np.asarray(spectra.frequency)
    power = np.gradient(frequency) * np.asarray(spectra.gain) ** 2
    cosines = np.cos(2.0 * np.pi * np.outer(lags, frequency))
    correlation = cosines @ power / power.sum()
    name = "white noise behind the filters"
    return Curve(lags, correlation, name, GREY, dashed=True)


def autocorrelation(
    errors: TorqueErrors, lags: int
) -> Float[np.ndarray, "lags joints"]:
    """Return the correlation of residuals with those some rows later, for lags from 0.

    Rows that do not count for a joint are left out; NaN where no pair of rows counts.
    """
    residuals = errors.errors - np.nanmean(errors.errors, axis=0)
    is_counted = np.isfinite(residuals)
    # The sum over the pairs of rows that count, and the number of these pairs.
    sums = _correlate(np.where(is_counted, residuals, 0.0), lags)
    pairs = np.round(_correlate(is_counted.astype(float), lags))
    means = np.full_like(sums, np.nan)
    np.divide(sums, pairs, out=means, where=pairs > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return means / means[0]


def _correlate(values: np.ndarray, lags: int) -> np.ndarray:
    """Return the sum of products of rows with later rows, for lags from 0."""
    products = fftconvolve(values, values[::-1], axes=0)
    return products[len(values) - 1 :][:lags]
