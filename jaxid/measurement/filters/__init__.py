"""Filters: motion from measured angles, low-pass for forces and columns, rows."""

from .filter import AbstractFilter as AbstractFilter, Subsample as Subsample
from .low_pass import LowPass as LowPass
from .motion_filters import (
    PaperFilter as PaperFilter,
    PeriodicFourier as PeriodicFourier,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
    first_difference as first_difference,
    second_difference as second_difference,
)

FILTERS: dict[str, type[AbstractFilter]] = {
    "butterworth": ZeroPhaseButterworth,
    "paper": PaperFilter,
    "periodic": PeriodicFourier,
}
"""Filters by the names that the experiment file has for them."""
