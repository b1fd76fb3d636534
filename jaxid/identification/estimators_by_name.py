"""Estimators by the names that experiment files, tables and tests use."""

import functools
from collections.abc import Callable

from .consistency import PhysicallyConsistent
from .estimators import (
    AbstractEstimator,
    AbstractLoss,
    Huber,
    InstrumentalVariables,
    IterativelyReweighted,
    LeastSquares,
    Tukey,
    WeightedLeastSquares,
)

LOSSES: dict[str, type[AbstractLoss]] = {"huber": Huber, "tukey": Tukey}
"""Losses of robust estimators."""
ESTIMATORS: dict[str, Callable[..., AbstractEstimator]] = {
    "weighted": WeightedLeastSquares,
    "least_squares": LeastSquares,
    "huber": functools.partial(IterativelyReweighted, loss=Huber()),
    "tukey": functools.partial(IterativelyReweighted, loss=Tukey()),
    "instrumental": InstrumentalVariables,
    "consistent": PhysicallyConsistent,
}
"""Estimators of one regression problem; arguments are settings like `weights`."""
