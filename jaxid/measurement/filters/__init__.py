"""Filters: motion from measured angles, low-pass for forces and columns, decimation."""

from .decimation import (
    AbstractDecimation as AbstractDecimation,
    Decimation as Decimation,
    Subsample as Subsample,
)
from .filter import AbstractFilter as AbstractFilter
from .low_pass import (
    AbstractLowPass as AbstractLowPass,
    Convolution as Convolution,
    RecursiveLowPass as RecursiveLowPass,
    weighted_mean as weighted_mean,
)
from .motion_filters import (
    PaperFilter as PaperFilter,
    PeriodicFourier as PeriodicFourier,
    SavitzkyGolay as SavitzkyGolay,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
    first_difference as first_difference,
    half_window as half_window,
    second_difference as second_difference,
)

FILTERS: dict[str, type[AbstractFilter]] = {
    "butterworth": ZeroPhaseButterworth,
    "savitzky_golay": SavitzkyGolay,
    "paper": PaperFilter,
    "periodic": PeriodicFourier,
}
"""Filters by the names that the experiment file has for them."""
