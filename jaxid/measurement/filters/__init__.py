"""Filters: motion from measured angles, one low-pass for forces and columns, and decimation."""

from .filter import (
    AbstractDecimation as AbstractDecimation,
    AbstractFilter as AbstractFilter,
    Decimation as Decimation,
    LowPass as LowPass,
    Subsample as Subsample,
)
from .motion_filters import (
    PaperFilter as PaperFilter,
    PeriodicFourier as PeriodicFourier,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
)
