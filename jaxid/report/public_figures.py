# ruff: noqa: F401
"""Figures for notebooks and papers, as `jid.plot.torques(…)`.

The figures of the paper: `poses` (Figs. 3, 8), `joints` (Fig. 4), `filtered` (Fig. 5),
`torques` (Figs. 6, 7, 9), `errors` (Fig. 10). Their method `save` writes `.html` to
explore, or `.png`, `.pdf` or `.svg`; `matplotlib()` returns a
`matplotlib.figure.Figure`; notebooks show a picture.
"""

from .estimates import comparison_figure as comparison, parameter_figure as parameters
from .motion import (
    filtered_figure as filtered,
    joint_figure as joints,
    pose_figure as poses,
    tip_figure as end_effector,
)
from .physics import friction_figure as friction, gravity_figure as gravity
from .residuals import (
    autocorrelation_figure as autocorrelation,
    filter_figure as filter_choice,
    residual_figure as residuals,
)
from .torques import (
    bar_figure as bars,
    error_figure as errors,
    torque_figure as torques,
)
