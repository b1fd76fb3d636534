"""Figures of residuals: their spectra, and the choice of a filter."""

import numpy as np

from jaxid.identification.filter_selection import FilterChoice
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.result_table import percent, shortened
from jaxid.robot.robot import Robot

from .figure import Figure
from .figure_elements import GREY, ORANGE, PALE, Curve, Panel

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
