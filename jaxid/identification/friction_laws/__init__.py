"""Constants of friction laws: shapes of the laws, and presliding lengths."""

from .friction_shapes import select_shapes as select_shapes
from .nonlinear_friction import (
    HeldOutErrors as HeldOutErrors,
    NonlinearFit as NonlinearFit,
    identify_nonlinear_friction as identify_nonlinear_friction,
)
from .presliding_lengths import identify_presliding as identify_presliding
from .variable_projection import ShapeSearch as ShapeSearch
