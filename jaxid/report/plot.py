# ruff: noqa: F401
"""Figures for notebooks and papers, as `jid.plot.torques(…)`.

The figures of the paper: `poses` (Figs. 3, 8), `joints` (Fig. 4), `filtered` (Fig. 5),
`torques` (Figs. 6, 7, 9), `bars` (Fig. 10). Their method `save` writes `.html` to
explore, or `.png`, `.pdf` or `.svg`; `matplotlib()` returns a
`matplotlib.figure.Figure`; notebooks show a picture.
"""

from .estimates import comparison_figure as comparison, parameter_figure as parameters
from .friction_and_gravity import friction_figure as friction
from .motion_figures import (
    filtered_figure as filtered,
    joint_figure as joints,
    pose_figure as poses,
)
from .residuals import filter_figure as filter_choice, residual_figure as residuals
from .torques import bar_figure as bars, torque_figure as torques
