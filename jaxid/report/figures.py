"""All figures under the names that notebooks use."""

from jaxid.report.autocorrelation import autocorrelation_figure as autocorrelation
from jaxid.report.bars import bar_figure as bars
from jaxid.report.bars import error_figure as errors
from jaxid.report.compared import comparison_figure as comparison
from jaxid.report.estimates import parameter_figure as parameters
from jaxid.report.filters import filter_figure as filter_choice
from jaxid.report.motion_figures import filtered_figure as filtered
from jaxid.report.motion_figures import joint_figure as joints
from jaxid.report.motion_figures import tip_figure as end_effector
from jaxid.report.residuals import residual_figure as residuals
from jaxid.report.space import animation as animation
from jaxid.report.space import path_figure as path
from jaxid.report.space import pose_figure as poses
from jaxid.report.style import save as save
from jaxid.report.torques import torque_figure as torques

__all__ = (
    "animation",
    "autocorrelation",
    "bars",
    "comparison",
    "end_effector",
    "errors",
    "filter_choice",
    "filtered",
    "joints",
    "parameters",
    "path",
    "poses",
    "residuals",
    "save",
    "torques",
)
