"""Public names of `jaxid`, in the order of the pipeline; loaded when they are used."""

from . import (
    calibration as calibration,
    dynamics as dynamics,
    excitation as excitation,
    experiment as experiment,
    export as export,
    program as program,
    rollout as rollout,
    simulation as simulation,
    trajectory as trajectories,  # noqa: F401
    units as units,
    workflow as workflow,
)
from .calibration.calibrate import calibrate as calibrate
from .dynamics import terms as terms
from .dynamics.base import (
    BaseParameters as BaseParameters,
    base_parameters as base_parameters,
)
from .dynamics.model import Model as Model
from .dynamics.motion import Motion as Motion
from .dynamics.terms import (
    ConstantOffset as ConstantOffset,
    CoulombFriction as CoulombFriction,
    RigidBodies as RigidBodies,
    RotorInertia as RotorInertia,
    ViscousFriction as ViscousFriction,
)
from .errors import InputError as InputError
from .excitation import constraints as constraints, criteria as criteria
from .excitation.design import design_excitation as design_excitation
from .excitation.design_result import ExcitationPlan as ExcitationPlan
from .excitation.problem import ExcitationProblem as ExcitationProblem
from .export import (
    as_mujoco as as_mujoco,
    as_pinocchio as as_pinocchio,
    export_c as export_c,
    export_mjcf as export_mjcf,
    export_urdf as export_urdf,
)
from .identification import (
    consistency as consistency,
    estimators as estimators,
    friction_laws as friction_laws,
    uncertainty as uncertainty,
)
from .identification.agreement import agreement as agreement
from .identification.combination import combine_fits as combine_fits
from .identification.consistency import PhysicallyConsistent as PhysicallyConsistent
from .identification.delay import with_unknown_delay as with_unknown_delay
from .identification.drive_gains import identify_drive_gains as identify_drive_gains
from .identification.encoder_resolution import resolution_bias as resolution_bias
from .identification.estimators import WeightedLeastSquares as WeightedLeastSquares
from .identification.filter_selection import choose_filter as choose_filter
from .identification.fit_result import Fit as Fit
from .identification.force_sensor import (
    identify_sensor_rotation as identify_sensor_rotation,
)
from .identification.friction_laws import (
    identify_presliding as identify_presliding,
    identify_transition_speeds as identify_transition_speeds,
)
from .identification.identify import identify as identify
from .identification.many_data_sets import identify_batch as identify_batch
from .identification.model_file import load_fit as load_fit
from .identification.operating_states import identify_states as identify_states
from .identification.parameter_changes import compare as compare
from .identification.payload import identify_payload as identify_payload
from .identification.problem import RegressionProblem as RegressionProblem
from .measurement import filters as filters
from .measurement.columns import Columns as Columns
from .measurement.filters import (
    Subsample as Subsample,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
)
from .measurement.observations import Observations as Observations, observe as observe
from .measurement.reading import read_recording as read_recording, scan_log as scan_log
from .measurement.recording import (
    Recording as Recording,
    remove_delay as remove_delay,
)
from .program.jax_compilation_cache import (
    enable_compilation_cache as enable_compilation_cache,
)
from .robot import collision as collision, robots as robots
from .robot.contacts import (
    Contact as Contact,
    Imu as Imu,
    Sole as Sole,
    Sphere as Sphere,
)
from .robot.inertia import Tool as Tool
from .robot.library import from_dh as from_dh
from .robot.limits_and_drives import Drives as Drives, Limits as Limits
from .robot.robot import Robot as Robot
from .robot.urdf import load_mjcf as load_mjcf, load_urdf as load_urdf
from .rollout.identify import identify_rollout as identify_rollout
from .simulation.virtual import VirtualRobot as VirtualRobot
from .validation.common_delay import estimate_delay as estimate_delay
from .validation.diagnosis import diagnose as diagnose
from .validation.torque_errors import validate as validate
from .workflow.log_identification import identify_logs as identify_logs
from .workflow.setup import Setup as Setup
