"""Trajectories: bases, splines, leads, paths of the end-effector, and their files."""

from jaxid.trajectory.files import (
    joint_trajectory as joint_trajectory,
    load_trajectory as load_trajectory,
    save_trajectory as save_trajectory,
    write_csv as write_csv,
    write_ros as write_ros,
)
from jaxid.trajectory.fourier import (
    FourierBasis as FourierBasis,
    RestToRestBasis as RestToRestBasis,
    fourier_series as fourier_series,
    random_fourier_series as random_fourier_series,
)
from jaxid.trajectory.leads import (
    LeadsBasis as LeadsBasis,
    WithLeads as WithLeads,
    with_leads as with_leads,
)
from jaxid.trajectory.spline import (
    PiecewisePolynomial as PiecewisePolynomial,
    RestToRestSplineBasis as RestToRestSplineBasis,
    spline_through as spline_through,
)
from jaxid.trajectory.tip_path import (
    Circle as Circle,
    Line as Line,
    TipPath as TipPath,
    iso9283_path as iso9283_path,
    joint_path as joint_path,
)
from jaxid.trajectory.trajectory import (
    AbstractBasis as AbstractBasis,
    AbstractTrajectory as AbstractTrajectory,
    LinearTrajectory as LinearTrajectory,
    PaddedToCycle as PaddedToCycle,
    Segments as Segments,
)
