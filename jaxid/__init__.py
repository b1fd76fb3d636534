"""Identification of the dynamic parameters of robots, in the order of the pipeline.

Everything else is in namespaces: `program`, `dynamics`, `terms`, `filters`, `units`,
`estimators`, `friction_laws`, `uncertainty`, `consistency`, `excitation`, `criteria`,
`constraints`, `trajectories`, `collision`, `simulation`, `export`, `workflow`,
`experiment`; the built-in robots are in `robots`, the figures in `plot`.
"""

import importlib as _importlib
import importlib.metadata as _metadata
import typing as _typing

try:
    __version__ = _metadata.version("jaxid-robotics")
except _metadata.PackageNotFoundError:
    __version__ = "not installed"

if _typing.TYPE_CHECKING:
    from jaxid.api import *  # noqa: F403
    from jaxid.report import plot  # noqa: F401
else:
    # These load without the others: commands start sooner, and JAX without matplotlib.
    _ALONE = {"plot": "report.plot", "experiment": "experiment", "workflow": "workflow"}

    def __getattr__(name):
        """Load the public names when one is first used."""
        if name in _ALONE:
            return _importlib.import_module(f"jaxid.{_ALONE[name]}")
        if not name.startswith("_"):
            api = vars(_importlib.import_module("jaxid.api"))
            globals().update({k: v for k, v in api.items() if not k.startswith("_")})
        if name in globals():
            return globals()[name]
        raise AttributeError(f"module `jaxid` has no attribute `{name}`.")

    def __dir__():
        api = _importlib.import_module("jaxid.api")
        return [*(name for name in vars(api) if not name.startswith("_")), "plot"]
