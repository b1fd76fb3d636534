"""How far the end-effector is from where it should be, for several controllers."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.report.style import (
    BLUE,
    GREY,
    HEADING,
    VERMILION,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
    plain_powers,
)

COLOURS = (GREY, VERMILION, BLUE)
LEAST = 1e-2
"""Distance below which the scale ends [mm]."""


def following_figure(
    runs: Sequence[tuple[str, Float[AnyArray, " samples"], Float[AnyArray, " samples"]]],
    title: str = "distance of the end-effector from its path",
) -> Figure:
    """Distances along a path on a logarithmic scale, a line for each run.

    Args:
        runs: Names, times [s] and distances [m].
        title: Of the figure.

    Raises:
        InputError: If there is no run, or there are more than three.
    """
    if not 0 < len(runs) <= len(COLOURS):
        raise InputError(f"`runs` must hold 1 to {len(COLOURS)} runs, but holds {len(runs)}.")
    with house_style():
        figure = new_figure(WIDTH, 3.4 + HEADING)
        heading(figure, title)
        axes = figure.subplots()
        for (name, time, away), colour in zip(runs, COLOURS, strict=False):
            millimetres = 1e3 * np.asarray(away)
            rms = float(np.sqrt(np.mean(millimetres**2)))
            shown = np.maximum(millimetres, LEAST)
            label = f"{name}: RMS {rms:.3g} mm"
            axes.plot(np.asarray(time), shown, color=colour, linewidth=1.0, label=label)
        axes.set_yscale("log")
        plain_powers(axes.yaxis)
        axes.set_ylim(bottom=LEAST)
        axes.set_xlim(float(runs[0][1][0]), float(runs[0][1][-1]))
        axes.set_xlabel("time [s]")
        caption(axes, "distance [mm]")
        figure.legend(loc="outside lower left", ncols=len(runs))
    return figure
