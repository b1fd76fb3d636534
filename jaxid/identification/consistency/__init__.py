"""Physical consistency: parameters of possible bodies, found with a certificate."""

from .bounds_and_priors import (
    BodyBounds as BodyBounds,
    EntropicPull as EntropicPull,
)
from .cone_program import ConeProgram as ConeProgram
from .consistent_batch import (
    ConsistentBatch as ConsistentBatch,
    ConsistentSolver as ConsistentSolver,
    consistent_batch as consistent_batch,
)
from .estimator import (
    Consistency as Consistency,
    PhysicallyConsistent as PhysicallyConsistent,
    consistent_body as consistent_body,
)
from .feasible_set import FeasibleSet as FeasibleSet
from .pseudo_inertia import (
    consistency_margin as consistency_margin,
    inertial_parameters as inertial_parameters,
    pseudo_inertia as pseudo_inertia,
)
from .scaled_rows import ScaledRows as ScaledRows
from .solver import (
    Optimum as Optimum,
    solve_compiled as solve_compiled,
    solve_in_numpy as solve_in_numpy,
)
