"""Filters: motion from measured angles, one low-pass for forces and columns, and decimation."""

from .decimation import (
    AbstractDecimation as AbstractDecimation,
    Decimation as Decimation,
    Subsample as Subsample,
)
from .filter import AbstractFilter as AbstractFilter, LowPass as LowPass
from .motion_filters import (
    PaperFilter as PaperFilter,
    PeriodicFourier as PeriodicFourier,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
)
