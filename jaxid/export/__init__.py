"""Export of an identified model: C for controllers, files for simulators, vectors for tools."""

from .c_code import export_c as export_c
from .simulators import (
    export_mjcf as export_mjcf,
    export_pinocchio as export_pinocchio,
    export_urdf as export_urdf,
    pinocchio_parameters as pinocchio_parameters,
)
from .torque_program import (
    export_jax as export_jax,
    exported_function as exported_function,
)
