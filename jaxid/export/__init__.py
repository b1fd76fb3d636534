"""Export of an identified model: C for controllers, files for simulators."""

from .c_code import export_c as export_c
from .calibrated_origins import export_origins as export_origins
from .feed_forward import torque_program as torque_program
from .identified_urdf import export_urdf as export_urdf
from .jax_function import (
    export_jax as export_jax,
    exported_function as exported_function,
)
from .mujoco_model import as_mujoco as as_mujoco, export_mjcf as export_mjcf
from .pinocchio_model import (
    as_pinocchio as as_pinocchio,
    pinocchio_parameters as pinocchio_parameters,
)
from .servo_actuators import (
    export_servo_mjcf as export_servo_mjcf,
    simulator_table as simulator_table,
)
