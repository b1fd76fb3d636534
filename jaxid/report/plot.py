# ruff: noqa: F401
"""Figures for notebooks and papers, as `jid.plot.torques(…)`.

The figures of the paper: `path` (Figs. 3, 8), `joints` (Fig. 4), `filtered` (Fig. 5), `torques`
(Figs. 6, 7, 9), `errors` (Fig. 10). All return a `matplotlib.figure.Figure`, and `save` writes it.
`jaxid` loads this module, and matplotlib, when `jid.plot` is first used.
"""

from jaxid.report.fit import autocorrelation_figure as autocorrelation
from jaxid.report.fit import comparison_figure as comparison
from jaxid.report.fit import filter_figure as filter_choice
from jaxid.report.fit import parameter_figure as parameters
from jaxid.report.fit import residual_figure as residuals
from jaxid.report.motion import animation as animation
from jaxid.report.motion import filtered_figure as filtered
from jaxid.report.motion import joint_figure as joints
from jaxid.report.motion import path_figure as path
from jaxid.report.motion import pose_figure as poses
from jaxid.report.motion import tip_figure as end_effector
from jaxid.report.style import save as save
from jaxid.report.torques import bar_figure as bars
from jaxid.report.torques import error_figure as errors
from jaxid.report.torques import torque_figure as torques
