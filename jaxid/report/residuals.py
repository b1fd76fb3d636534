"""Residuals of a fit: their spectra and autocorrelations, and whether they are white."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.report.style import (
    BLUE,
    GREY,
    INK,
    PALE,
    WIDTH,
    caption,
    heading,
    house_style,
    logarithmic,
    new_figure,
)
from jaxid.report.torques import require_joints
from jaxid.robot.robot import Robot
from jaxid.table import percent, shortened, significant
from jaxid.validation import TorqueErrors


def residual_figure(spectra: ResidualSpectra, robot: Robot) -> Figure:
    """Draw the power of each joint's residuals against frequency, beside that of white noise.

    The dashed line is the spectrum that white noise of the same power would have behind the
    filters.

    Args:
        spectra: Spectra of the residuals of a fit.
        robot: Robot of the fit.

    Raises:
        InputError: If the numbers of joints differ.
    """
    n = robot.joints
    if len(spectra.density) != n:
        raise InputError(
            f"`spectra` must be those of the {n} joints of `{robot.name}`, but are of "
            f"{len(spectra.density)}."
        )
    with house_style():
        figure, panels = _panels(n, 1.9)
        for j, axes in enumerate(panels):
            _draw_spectrum(axes, spectra, j, robot)
        heading(figure, f"{robot.name}: residuals of {sum(spectra.white)} of {n} joints are white")
        white = "white noise behind the filters (10 % of its power there)"
        handles = [
            Line2D([], [], color=BLUE, lw=1.2, label="residuals"),
            Line2D([], [], color=GREY, lw=1.0, ls="--", label=white),
        ]
        figure.legend(handles=handles, loc="outside lower left", ncols=2)
    return figure


def _panels(joints: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel for each joint, two beside each other."""
    columns = min(2, joints)
    rows = math.ceil(joints / columns)
    figure = new_figure(WIDTH * columns / 2, 1.1 + height * rows)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[joints:]:
        axes.set_axis_off()
    return figure, panels[:joints]


def _draw_spectrum(axes: Axes, spectra: ResidualSpectra, j: int, robot: Robot) -> None:
    frequency, density = np.asarray(spectra.frequency), np.asarray(spectra.density)[j]
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
    verdict, low = "white" if spectra.white[j] else "not white", float(spectra.low_frequency[j])
    caption(
        axes,
        shortened(robot.joint_names[j], 24),
        f"{verdict}: {percent(low)} % of the power below {0.1 * spectra.band:.2g} Hz",
    )


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
        InputError: If the numbers of joints differ, or there are fewer than three rows.
    """
    require_joints(errors, robot)
    time, n = np.asarray(errors.time), robot.joints
    if len(time) < 3:
        raise InputError(f"`{errors.name}` must have three rows at least, but has {len(time)}.")
    count = min(50, len(time) // 2) + 1
    lags = float(np.median(np.diff(time))) * np.arange(count)
    values = autocorrelation(errors, count)
    limits = 1.96 / np.sqrt(np.maximum(np.asarray(errors.counted).sum(axis=0), 1))
    filtered = None if spectra is None else _filtered_noise(spectra, lags)
    with house_style():
        figure, panels = _panels(n, 1.7)
        for j, axes in enumerate(panels):
            axes.axhspan(-limits[j], limits[j], color=PALE, lw=0, zorder=0.5)
            axes.axhline(0.0, color=GREY, lw=0.5)
            axes.vlines(lags, 0.0, values[:, j], color=BLUE, lw=0.8)
            axes.plot(lags, values[:, j], color=BLUE, lw=0.0, marker="o", ms=2.6)
            if filtered is not None:
                axes.plot(lags, filtered, color=INK, lw=1.0, ls="--")
            axes.set_xlim(-0.5 * lags[1], lags[-1] + 0.5 * lags[1])
            axes.set_ylim(min(-0.25, 1.1 * float(np.nanmin(values[:, j]))), 1.05)
            axes.set_xlabel("lag [s]")
            next_row = significant(float(values[1, j]), 2)
            caption(axes, shortened(robot.joint_names[j], 24), f"next row: {next_row}")
        heading(figure, f"{shortened(errors.name, 40)}: autocorrelation of the residuals")
        handles: list = [
            Line2D([], [], color=BLUE, marker="o", ms=3, lw=1.2, label="residuals"),
            Patch(color=PALE, label="white residuals: 95 % within"),
        ]
        if filtered is not None:
            label = "white noise behind the filters"
            handles.append(Line2D([], [], color=INK, lw=1.0, ls="--", label=label))
        figure.legend(handles=handles, loc="outside lower left", ncols=3)
    return figure


def autocorrelation(errors: TorqueErrors, lags: int) -> Float[np.ndarray, "lags joints"]:
    """Return the correlation of residuals with those some rows later, for lags from 0.

    Rows that do not count for a joint are left out; NaN where no pair of rows counts.

    Args:
        errors: Errors on one recording.
        lags: Number of lags, with the lag 0.
    """
    e = errors.errors
    e = e - np.nanmean(e, axis=0)
    counted, e = np.isfinite(e).astype(float), np.nan_to_num(e)
    length = 2 ** math.ceil(math.log2(len(e) + lags))

    def correlate(x: np.ndarray) -> np.ndarray:
        power = np.abs(np.fft.rfft(x, length, axis=0)) ** 2
        return np.fft.irfft(power, length, axis=0)[:lags]

    pairs = np.round(correlate(counted))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(pairs > 0, correlate(e) / pairs, np.nan)
        return mean / mean[0]


def _filtered_noise(spectra: ResidualSpectra, lags: np.ndarray) -> np.ndarray:
    """Return the autocorrelation of white noise behind the filters."""
    f, power = np.asarray(spectra.frequency), np.asarray(spectra.gain) ** 2
    weights = np.gradient(f) * power
    return np.cos(2.0 * np.pi * np.outer(lags, f)) @ weights / weights.sum()
