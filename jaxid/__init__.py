"""Identification of the dynamic parameters of robots: the public API, in the order of the pipeline.

Everything else is in namespaces: `terms`, `filters`, `units`, `estimators`, `uncertainty`,
`consistency`, `criteria`, `constraints`, `trajectories`, `collision`, `simulation`, `devices`,
`export`; the built-in robots are in `robots`, the figures in `plot`.
"""

import typing as _typing

from jaxid import simulation as simulation
from jaxid import trajectory as trajectories  # noqa: F401
from jaxid.diagnosis import diagnose as diagnose
from jaxid.dynamics import terms as terms
from jaxid.dynamics.base import BaseParameters as BaseParameters
from jaxid.dynamics.base import base_parameters as base_parameters
from jaxid.dynamics.model import Model as Model
from jaxid.dynamics.motion import Motion as Motion
from jaxid.dynamics.terms import ConstantOffset as ConstantOffset
from jaxid.dynamics.terms import CoulombFriction as CoulombFriction
from jaxid.dynamics.terms import RigidBodies as RigidBodies
from jaxid.dynamics.terms import RotorInertia as RotorInertia
from jaxid.dynamics.terms import ViscousFriction as ViscousFriction
from jaxid.errors import InputError as InputError
from jaxid.excitation import constraints as constraints
from jaxid.excitation import criteria as criteria
from jaxid.excitation.design import design_excitation as design_excitation
from jaxid.excitation.plan import ExcitationPlan as ExcitationPlan
from jaxid.excitation.problem import ExcitationProblem as ExcitationProblem
from jaxid.export.c_code import export_c as export_c
from jaxid.export.mjcf import export_mjcf as export_mjcf
from jaxid.export.urdf import export_urdf as export_urdf
from jaxid.identification import consistency as consistency
from jaxid.identification import devices as devices
from jaxid.identification import estimators as estimators
from jaxid.identification import uncertainty as uncertainty
from jaxid.identification.batches import identify_batch as identify_batch
from jaxid.identification.choices import choose_filter as choose_filter
from jaxid.identification.choices import essential_parameters as essential_parameters
from jaxid.identification.combination import update as update
from jaxid.identification.comparison import compare as compare
from jaxid.identification.consistency import PhysicallyConsistent as PhysicallyConsistent
from jaxid.identification.delay import estimate_delay as estimate_delay
from jaxid.identification.drive_gains import identify_drive_gains as identify_drive_gains
from jaxid.identification.estimators import WeightedLeastSquares as WeightedLeastSquares
from jaxid.identification.fit import Fit as Fit
from jaxid.identification.fit import load as load
from jaxid.identification.identify import identify as identify
from jaxid.identification.nonlinear_friction import identify_nonlinear as identify_nonlinear
from jaxid.identification.nonlinear_friction import temperature_law as temperature_law
from jaxid.identification.payload import identify_payload as identify_payload
from jaxid.identification.problem import RegressionProblem as RegressionProblem
from jaxid.identification.states import identify_states as identify_states
from jaxid.identification.uncertainty.blocks import bootstrap as bootstrap
from jaxid.measurement import filters as filters
from jaxid.measurement import units as units
from jaxid.measurement.columns import Columns as Columns
from jaxid.measurement.decimation import Decimation as Decimation
from jaxid.measurement.decimation import Subsample as Subsample
from jaxid.measurement.filters import ZeroPhaseButterworth as ZeroPhaseButterworth
from jaxid.measurement.log_on_disk import scan_log as scan_log
from jaxid.measurement.observations import Observations as Observations
from jaxid.measurement.observations import observe as observe
from jaxid.measurement.recording import Recording as Recording
from jaxid.measurement.recording import read_recording as read_recording
from jaxid.program.cache import keep_compiled as keep_compiled
from jaxid.robot import collision as collision
from jaxid.robot import library as robots  # noqa: F401
from jaxid.robot.joints import Drives as Drives
from jaxid.robot.joints import Limits as Limits
from jaxid.robot.kinematics import inverse_kinematics as inverse_kinematics
from jaxid.robot.library import from_dh as from_dh
from jaxid.robot.robot import Robot as Robot
from jaxid.robot.robot import Tool as Tool
from jaxid.robot.urdf import load_urdf as load_urdf
from jaxid.robot.urdf import urdf_parameters as urdf_parameters
from jaxid.simulation.virtual import VirtualRobot as VirtualRobot
from jaxid.trajectory import random_fourier_series as random_fourier_series
from jaxid.validation import validate as validate

if _typing.TYPE_CHECKING:
    from jaxid.report import plot as plot


def __getattr__(name: str) -> _typing.Any:
    """Load the figures, and matplotlib, when `jid.plot` is first used."""
    if name == "plot":
        import jaxid.report.plot

        return jaxid.report.plot
    raise AttributeError(f"module `jaxid` has no attribute `{name}`.")
