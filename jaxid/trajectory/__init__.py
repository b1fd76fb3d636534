"""Trajectories: bases, splines, leads, paths of the end-effector, and their files."""

from jaxid.trajectory.files import joint_trajectory as joint_trajectory
from jaxid.trajectory.files import load_trajectory as load_trajectory
from jaxid.trajectory.files import save_trajectory as save_trajectory
from jaxid.trajectory.files import write_csv as write_csv
from jaxid.trajectory.files import write_ros as write_ros
from jaxid.trajectory.fourier import FourierBasis as FourierBasis
from jaxid.trajectory.fourier import RestToRestBasis as RestToRestBasis
from jaxid.trajectory.fourier import fourier_series as fourier_series
from jaxid.trajectory.fourier import random_fourier_series as random_fourier_series
from jaxid.trajectory.leads import LeadsBasis as LeadsBasis
from jaxid.trajectory.leads import WithLeads as WithLeads
from jaxid.trajectory.leads import with_leads as with_leads
from jaxid.trajectory.spline import PiecewisePolynomial as PiecewisePolynomial
from jaxid.trajectory.spline import RestToRestSplineBasis as RestToRestSplineBasis
from jaxid.trajectory.spline import spline_through as spline_through
from jaxid.trajectory.tip_path import Circle as Circle
from jaxid.trajectory.tip_path import Line as Line
from jaxid.trajectory.tip_path import TipPath as TipPath
from jaxid.trajectory.tip_path import iso9283_path as iso9283_path
from jaxid.trajectory.tip_path import joint_path as joint_path
from jaxid.trajectory.trajectory import AbstractBasis as AbstractBasis
from jaxid.trajectory.trajectory import AbstractTrajectory as AbstractTrajectory
from jaxid.trajectory.trajectory import LinearTrajectory as LinearTrajectory
from jaxid.trajectory.trajectory import PaddedToCycle as PaddedToCycle
from jaxid.trajectory.trajectory import Segments as Segments
