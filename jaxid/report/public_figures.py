# ruff: noqa: F401
"""Figures for notebooks and papers, as `jid.plot.torques(…)`.

The figures of the paper: `path` (Figs. 3, 8), `joints` (Fig. 4), `filtered` (Fig. 5), `torques`
(Figs. 6, 7, 9), `errors` (Fig. 10). All return a `matplotlib.figure.Figure`, and `save` writes it.
`jaxid` loads this module, and matplotlib, when `jid.plot` is first used.
"""

from .estimates_and_residuals import (
    autocorrelation_figure as autocorrelation,
    comparison_figure as comparison,
    filter_figure as filter_choice,
    parameter_figure as parameters,
    residual_figure as residuals,
)
from .motion import (
    animation as animation,
    filtered_figure as filtered,
    joint_figure as joints,
    path_figure as path,
    pose_figure as poses,
    tip_figure as end_effector,
)
from .style import save as save
from .torques import (
    bar_figure as bars,
    error_figure as errors,
    torque_figure as torques,
)
