"""What residuals look like: the spectrum of each joint's, and whether they are white."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxid.errors import InputError
from jaxid.identification.uncertainty.residuals import ResidualSpectra
from jaxid.report.numbers import percent, shortened
from jaxid.report.style import (
    BLUE,
    GREY,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
    plain_powers,
)
from jaxid.robot.robot import Robot

COLUMNS = 2
HEIGHT = 1.9
"""Of a panel [inch]."""
LONGEST_NAME = 24
"""Letters of a joint's name that are shown."""


def residual_figure(spectra: ResidualSpectra, robot: Robot) -> Figure:
    """Draws the power of each joint's residuals against frequency, beside white ones.

    The dashed line is what white noise of the same power within the band would leave behind the
    filters.

    Args:
        spectra: Of a fit.
        robot: Whose joints they are.

    Raises:
        InputError: If the numbers of joints differ.
    """
    n = robot.joints
    if len(spectra.density) != n:
        raise InputError(
            f"`spectra` must be those of the {n} joints of `{robot.name}`, but are of "
            f"{len(spectra.density)}."
        )
    columns = min(COLUMNS, n)
    rows = math.ceil(n / columns)
    with house_style():
        figure = new_figure(WIDTH * columns / COLUMNS, 1.1 + HEIGHT * rows)
        panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for j, axes in enumerate(panels.flat):
            if j < n:
                axes.set_gid(f"joint-{j}")
                axes.tick_params(labelbottom=True)
                _panel(axes, spectra, j, robot)
            else:
                axes.set_axis_off()
        for c in range(columns):
            last = panels[(n - 1 - c) // columns, c]
            last.set_xlabel("frequency [Hz]")
            last.tick_params(labelbottom=True)
        white = sum(spectra.white)
        heading(figure, f"{robot.name}: residuals of {white} of {n} joints are white")
        figure.legend(
            handles=[
                Line2D([], [], color=BLUE, lw=1.2, label="residuals"),
                Line2D(
                    [],
                    [],
                    color=GREY,
                    lw=1.0,
                    ls="--",
                    label="white noise behind the filters (10 % of its power there)",
                ),
            ],
            loc="outside lower left",
            ncols=2,
        )
    return figure


def _panel(axes: Axes, spectra: ResidualSpectra, j: int, robot: Robot) -> None:
    frequency, density = np.asarray(spectra.frequency), np.asarray(spectra.density)[j]
    gain = np.asarray(spectra.gain) ** 2
    shown = (frequency > 0) & (gain > 1e-4)
    level = np.sum(density[shown]) / np.sum(gain[shown])
    axes.plot(frequency[shown], density[shown], color=BLUE, lw=1.2)
    axes.plot(frequency[shown], level * gain[shown], color=GREY, lw=1.0, ls="--")
    axes.set_xscale("log")
    plain_powers(axes.xaxis)
    if np.any(density[shown] > 0):
        axes.set_yscale("log")
        plain_powers(axes.yaxis)
    unit = "(N m)²/Hz" if robot.force_unit(j) == "N m" else "N²/Hz"
    axes.set_ylabel(unit)
    verdict = "white" if spectra.white[j] else "not white"
    caption(
        axes,
        shortened(robot.joint_names[j], LONGEST_NAME),
        f"{verdict}: {percent(float(spectra.slow[j]), 2)} % of the power below "
        f"{0.1 * spectra.band:.2g} Hz",
    )
