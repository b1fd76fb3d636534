"""Public names of `jaxid`, in the order of the pipeline; the package loads them when used."""

from jaxid import (
    simulation as simulation,
    trajectory as trajectories,  # noqa: F401
)
from jaxid.diagnosis import diagnose as diagnose
from jaxid.dynamics import terms as terms
from jaxid.dynamics.base import BaseParameters as BaseParameters, base_parameters as base_parameters
from jaxid.dynamics.model import Model as Model
from jaxid.dynamics.motion import Motion as Motion
from jaxid.dynamics.terms import (
    ConstantOffset as ConstantOffset,
    CoulombFriction as CoulombFriction,
    RigidBodies as RigidBodies,
    RotorInertia as RotorInertia,
    ViscousFriction as ViscousFriction,
)
from jaxid.errors import InputError as InputError
from jaxid.excitation import constraints as constraints, criteria as criteria
from jaxid.excitation.design import design_excitation as design_excitation
from jaxid.excitation.plan import ExcitationPlan as ExcitationPlan
from jaxid.excitation.problem import ExcitationProblem as ExcitationProblem
from jaxid.export.c_code import export_c as export_c
from jaxid.export.simulators import export_mjcf as export_mjcf, export_urdf as export_urdf
from jaxid.identification import (
    consistency as consistency,
    devices as devices,
    estimators as estimators,
    uncertainty as uncertainty,
)
from jaxid.identification.batches import identify_batch as identify_batch
from jaxid.identification.choices import (
    choose_filter as choose_filter,
    essential_parameters as essential_parameters,
)
from jaxid.identification.combination import update as update
from jaxid.identification.comparison import compare as compare
from jaxid.identification.consistency import PhysicallyConsistent as PhysicallyConsistent
from jaxid.identification.delay import estimate_delay as estimate_delay
from jaxid.identification.drive_gains import identify_drive_gains as identify_drive_gains
from jaxid.identification.estimators import WeightedLeastSquares as WeightedLeastSquares
from jaxid.identification.fit import Fit as Fit, load as load
from jaxid.identification.identify import identify as identify
from jaxid.identification.nonlinear_friction import (
    identify_nonlinear as identify_nonlinear,
    temperature_law as temperature_law,
)
from jaxid.identification.payload import identify_payload as identify_payload
from jaxid.identification.problem import RegressionProblem as RegressionProblem
from jaxid.identification.states import identify_states as identify_states
from jaxid.identification.uncertainty.blocks import bootstrap as bootstrap
from jaxid.measurement import filters as filters, units as units
from jaxid.measurement.columns import Columns as Columns
from jaxid.measurement.filters import (
    Decimation as Decimation,
    Subsample as Subsample,
    ZeroPhaseButterworth as ZeroPhaseButterworth,
)
from jaxid.measurement.observations import Observations as Observations, observe as observe
from jaxid.measurement.reading import read_recording as read_recording, scan_log as scan_log
from jaxid.measurement.recording import Recording as Recording
from jaxid.program.cache import keep_compiled as keep_compiled
from jaxid.robot import (
    collision as collision,
    library as robots,  # noqa: F401
)
from jaxid.robot.joints import Drives as Drives, Limits as Limits
from jaxid.robot.kinematics import inverse_kinematics as inverse_kinematics
from jaxid.robot.library import from_dh as from_dh
from jaxid.robot.robot import Robot as Robot, Tool as Tool
from jaxid.robot.urdf import load_urdf as load_urdf, urdf_parameters as urdf_parameters
from jaxid.simulation.virtual import VirtualRobot as VirtualRobot
from jaxid.trajectory import random_fourier_series as random_fourier_series
from jaxid.validation import validate as validate
