"""How alike neighbouring residuals are: their autocorrelation, joint by joint."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.identification.uncertainty.residuals import ResidualSpectra
from jaxid.report.numbers import shortened, significant
from jaxid.report.style import (
    BLUE,
    GREY,
    INK,
    PALE,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
)
from jaxid.report.torques import require_joints
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors

COLUMNS = 2
HEIGHT = 1.7
"""Of a panel [inch]."""
LAGS = 50
"""Lags that are shown at most."""
WHITE = 1.96
"""Autocorrelation that white residuals exceed once in twenty, times the root of their number."""


def autocorrelation(errors: TorqueErrors, lags: int) -> Float[np.ndarray, "lags joints"]:
    """Correlation of residuals with those some rows later, for lags from 0, of 1.

    Rows that do not count for a joint are left out; NaN where no pair of rows counts.

    Args:
        errors: Of one recording.
        lags: How many, with the lag 0.
    """
    e = errors.errors
    e = e - np.nanmean(e, axis=0)
    counted, e = np.isfinite(e).astype(float), np.nan_to_num(e)
    length = 2 ** math.ceil(math.log2(len(e) + lags))

    def correlated(x: np.ndarray) -> np.ndarray:
        power = np.abs(np.fft.rfft(x, length, axis=0)) ** 2
        return np.fft.irfft(power, length, axis=0)[:lags]

    pairs = np.round(correlated(counted))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(pairs > 0, correlated(e) / pairs, np.nan)
        return mean / mean[0]


def autocorrelation_figure(
    errors: TorqueErrors, robot: Robot, spectra: ResidualSpectra | None = None
) -> Figure:
    """Draws the autocorrelation of each joint's residuals, beside what white ones stay within.

    Args:
        errors: Of one recording.
        robot: Whose joints they are.
        spectra: Whose filters shall be shown: the dashed line is what they make of white noise.

    Raises:
        InputError: If the numbers of joints differ, or there are fewer than three rows.
    """
    require_joints(errors, robot)
    time, n = np.asarray(errors.time), robot.joints
    if len(time) < 3:
        raise InputError(f"`{errors.name}` must have three rows at least, but has {len(time)}.")
    lags = min(LAGS, len(time) // 2) + 1
    step = float(np.median(np.diff(time)))
    values = autocorrelation(errors, lags)
    counts = np.maximum(np.asarray(errors.counted).sum(axis=0), 1)
    passed = None if spectra is None else _of_filters(spectra, step * np.arange(lags))
    columns = min(COLUMNS, n)
    rows = math.ceil(n / columns)
    with house_style():
        figure = new_figure(WIDTH * columns / COLUMNS, 1.1 + HEIGHT * rows)
        panels = figure.subplots(rows, columns, squeeze=False)
        for j, axes in enumerate(panels.flat):
            if j >= n:
                axes.set_axis_off()
                continue
            axes.set_gid(f"joint-{j}")
            _panel(axes, step, values[:, j], WHITE / math.sqrt(counts[j]), passed)
            at_one = significant(float(values[1, j]), 2)
            caption(axes, shortened(robot.joint_names[j], 24), f"next row: {at_one}")
            axes.set_xlabel("lag [s]")
        heading(figure, f"{shortened(errors.name, 40)}: autocorrelation of the residuals")
        handles: list = [
            Line2D([], [], color=BLUE, marker="o", ms=3, lw=1.2, label="residuals"),
            Patch(color=PALE, label="white residuals: 95 % within"),
        ]
        if passed is not None:
            label = "white noise behind the filters"
            handles.append(Line2D([], [], color=INK, lw=1.0, ls="--", label=label))
        figure.legend(handles=handles, loc="outside lower left", ncols=3)
    return figure


def _of_filters(spectra: ResidualSpectra, lags: np.ndarray) -> np.ndarray:
    """What the filters make of white noise: the transform of their gain's square, of 1."""
    f, power = np.asarray(spectra.frequency), np.asarray(spectra.gain) ** 2
    weights = np.gradient(f) * power
    return np.cos(2.0 * np.pi * np.outer(lags, f)) @ weights / weights.sum()


def _panel(
    axes: Axes, step: float, values: np.ndarray, limit: float, passed: np.ndarray | None
) -> None:
    lags = step * np.arange(len(values))
    axes.axhspan(-limit, limit, color=PALE, lw=0, zorder=0.5)
    axes.axhline(0.0, color=GREY, lw=0.5)
    axes.vlines(lags, 0.0, values, color=BLUE, lw=0.8)
    axes.plot(lags, values, color=BLUE, lw=0.0, marker="o", ms=2.6)
    if passed is not None:
        axes.plot(lags, passed, color=INK, lw=1.0, ls="--")
    axes.set_xlim(-0.5 * step, lags[-1] + 0.5 * step)
    axes.set_ylim(min(-0.25, 1.1 * float(np.nanmin(values))), 1.05)
