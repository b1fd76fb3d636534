"""Physical consistency: parameters of bodies that can exist, found with a certificate."""

from .bounds_and_priors import (
    BodyBounds as BodyBounds,
    EntropicPull as EntropicPull,
    ParameterPrior as ParameterPrior,
)
from .estimator import (
    Consistency as Consistency,
    ConsistentBatch as ConsistentBatch,
    ConsistentSolver as ConsistentSolver,
    PhysicallyConsistent as PhysicallyConsistent,
    consistent_batch as consistent_batch,
    consistent_body as consistent_body,
)
from .pseudo_inertia import (
    LogCholesky as LogCholesky,
    consistency_margin as consistency_margin,
    pseudo_inertia as pseudo_inertia,
)
