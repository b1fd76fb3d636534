"""Constants of friction laws: shapes, presliding lengths and transition speeds."""

from .friction_shapes import select_shapes as select_shapes
from .nonlinear_friction import (
    HeldOutErrors as HeldOutErrors,
    NonlinearFit as NonlinearFit,
    identify_nonlinear_friction as identify_nonlinear_friction,
)
from .presliding_lengths import identify_presliding as identify_presliding
from .transition_speeds import (
    identify_transition_speeds as identify_transition_speeds,
    minimum_place as minimum_place,
)
from .variable_projection import ShapeSearch as ShapeSearch
