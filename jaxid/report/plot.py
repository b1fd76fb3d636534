"""Figures for notebooks and papers, as `jid.plot.torques(…)`: matplotlib is loaded when first used.

The figures of the paper: `path` (Figs. 3, 8), `joints` (Fig. 4), `filtered` (Fig. 5), `torques`
(Figs. 6, 7, 9), `errors` (Fig. 10). All return a `matplotlib.figure.Figure`, and `save` writes it.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxid.report.figures import animation as animation
    from jaxid.report.figures import autocorrelation as autocorrelation
    from jaxid.report.figures import bars as bars
    from jaxid.report.figures import comparison as comparison
    from jaxid.report.figures import end_effector as end_effector
    from jaxid.report.figures import errors as errors
    from jaxid.report.figures import filter_choice as filter_choice
    from jaxid.report.figures import filtered as filtered
    from jaxid.report.figures import joints as joints
    from jaxid.report.figures import parameters as parameters
    from jaxid.report.figures import path as path
    from jaxid.report.figures import poses as poses
    from jaxid.report.figures import residuals as residuals
    from jaxid.report.figures import save as save
    from jaxid.report.figures import torques as torques

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


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"`jaxid.plot` has no `{name}`: there are {', '.join(__all__)}.")
    return getattr(importlib.import_module("jaxid.report.figures"), name)


def __dir__() -> list[str]:
    return list(__all__)
