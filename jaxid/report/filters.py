"""Why a filter was chosen: errors on unseen parts of the log against the cut-off."""

import numpy as np
from matplotlib.figure import Figure

from jaxid.identification.filter_choice import FilterChoice
from jaxid.report.style import (
    BLUE,
    GREY,
    ORANGE,
    PALE,
    WIDTH,
    heading,
    house_style,
    new_figure,
    plain_powers,
)


def filter_figure(choice: FilterChoice) -> Figure:
    """Draws held-out errors of all candidates, and how alike neighbouring residuals are.

    Thin lines are single parts of the log. Too low a cut-off takes from the motion what moves the
    robot, too high a one lets noise into the accelerations.

    Args:
        choice: With all its candidates.
    """
    order = np.argsort(np.asarray(choice.cutoffs))
    cutoffs = np.asarray(choice.cutoffs)[order]
    errors = 100 * np.asarray(choice.errors)[order]
    with house_style():
        figure = new_figure(WIDTH, 4.2)
        heading(figure, "Choice of the filter")
        left, right = figure.subplots(1, 2)
        left.plot(cutoffs, errors, color=PALE, linewidth=0.8)
        left.plot(cutoffs, 100 * choice.curve[order], color=BLUE, marker="o", markersize=4)
        best = float(np.asarray(choice.cutoffs)[choice.best])
        for axes in (left, right):
            axes.axvline(best, color=ORANGE, linewidth=1.0)
            axes.set_xscale("log")
            plain_powers(axes.xaxis)
            axes.set_xlabel("cut-off of forces and columns [Hz]")
        left.set_yscale("log")
        plain_powers(left.yaxis)
        left.set_ylabel("error on unseen parts [% of the forces]")
        left.set_title(f"chosen: {best:.3g} Hz", loc="left", fontweight="bold")
        right.plot(
            cutoffs, np.asarray(choice.correlations)[order], color=GREY, marker="o", markersize=4
        )
        right.set_ylabel("correlation of neighbouring residuals [1]")
        right.set_title("zero where rows are independent", loc="left", fontweight="bold")
    return figure
