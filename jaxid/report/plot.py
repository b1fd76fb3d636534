# ruff: noqa: F401
"""Figures for notebooks and papers, as `jid.plot.torques(…)`.

The figures of the paper: `poses` (Figs. 3, 8), `joints` (Fig. 4), `torques` (Figs. 6,
7, 9), `bars` (Fig. 10). Their method `save` writes `.html` to
explore, or `.png`, `.pdf` or `.svg`; `matplotlib()` returns a
`matplotlib.figure.Figure`; notebooks show a picture.
"""

from .comparison_figure import comparison_figure as comparison
from .friction_figures import friction_figure as friction
from .motion_figures import (
    joint_figure as joints,
    pose_figure as poses,
)
from .residual_spectra import residual_figure as residuals
from .torques import bar_figure as bars, torque_figure as torques
