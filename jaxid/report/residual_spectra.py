"""Figure of the spectra of residuals, beside those of white noise."""

import numpy as np

from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.result_table import percent
from jaxid.robot.robot import Robot

from .figure import Figure
from .figure_elements import GREY, Curve, Panel

MIN_GAIN = 1e-2
"""Gain of the filters below which a spectrum is not shown."""


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
    title = f"{robot.name}: errors of {count} of {robot.joints} joints are random"
    columns = min(2, len(panels))
    return Figure(title, panels, columns, width=5.5 * columns)


def _spectrum_panel(spectra: ResidualSpectra, robot: Robot, j: int) -> Panel:
    """Return the spectrum of a joint, and that of white noise behind the filters."""
    frequency = spectra.frequency
    gain = spectra.gain
    is_shown = (frequency > 0) & (gain > MIN_GAIN)
    frequency = frequency[is_shown]
    white_density = gain[is_shown] ** 2
    density = spectra.density[j, is_shown]
    white_level = np.sum(density) / np.sum(white_density)

    white_name = "random errors after the filters"
    verdict = "random" if spectra.white[j] else "not random"
    low_share = percent(float(spectra.low_frequency[j]))
    low_band = f"below {0.1 * spectra.band:.2g} Hz"
    return Panel(
        [
            Curve(frequency, density, "residuals", width=1.2),
            Curve(
                frequency, white_level * white_density, white_name, GREY, dashed=True
            ),
        ],
        title=robot.joint_names[j],
        value=f"{verdict}: {low_share} % of power {low_band}",
        x="frequency [Hz]",
        unit="(N m)²/Hz" if robot.force_unit(j) == "N m" else "N²/Hz",
        log="xy" if np.any(density > 0) else "x",
    )
