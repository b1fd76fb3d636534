"""Trajectories: bases, splines, leads, paths of the end-effector, and their files."""

from .controllers import write_rsi as write_rsi, write_urscript as write_urscript
from .files import (
    load_trajectory as load_trajectory,
    save_trajectory as save_trajectory,
    write_csv as write_csv,
    write_ros as write_ros,
)
from .fourier import (
    FourierBasis as FourierBasis,
    RestToRestBasis as RestToRestBasis,
    random_fourier_series as random_fourier_series,
)
from .lead_in_and_out import (
    LeadsBasis as LeadsBasis,
    WithLeads as WithLeads,
    with_leads as with_leads,
)
from .motion_on_feet import MotionOnFeet as MotionOnFeet
from .prescribed_tip_path import (
    TipPath as TipPath,
    circle as circle,
    iso9283_path as iso9283_path,
    joint_path as joint_path,
    line as line,
)
from .spline import (
    PiecewisePolynomial as PiecewisePolynomial,
    RestToRestSplineBasis as RestToRestSplineBasis,
)
from .trajectory import (
    AbstractBasis as AbstractBasis,
    AbstractTrajectory as AbstractTrajectory,
    LinearTrajectory as LinearTrajectory,
    PaddedToCycle as PaddedToCycle,
)
