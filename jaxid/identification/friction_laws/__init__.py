"""Constants of friction laws: shapes, presliding lengths, rates with temperature."""

from .nonlinear_friction import (
    HeldOutErrors as HeldOutErrors,
    NonlinearFit as NonlinearFit,
    identify_nonlinear_friction as identify_nonlinear_friction,
)
from .presliding_lengths import identify_presliding as identify_presliding
from .temperature_law import (
    TemperatureLaw as TemperatureLaw,
    temperature_law as temperature_law,
)
