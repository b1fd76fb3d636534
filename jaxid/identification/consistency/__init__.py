"""Physical consistency: parameters of bodies that can exist, found with a certificate."""

from .bounds_and_priors import (
    BodyBounds as BodyBounds,
    EntropicPull as EntropicPull,
)
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
from .pseudo_inertia import (
    LogCholesky as LogCholesky,
    consistency_margin as consistency_margin,
    pseudo_inertia as pseudo_inertia,
)
