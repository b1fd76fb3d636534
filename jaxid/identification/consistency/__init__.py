"""Physical consistency: parameters of bodies that can exist, found with a certificate."""

from .bounds import BodyBounds as BodyBounds
from .bounds import EntropicPull as EntropicPull
from .bounds import ParameterPrior as ParameterPrior
from .estimator import Consistency as Consistency
from .estimator import ConsistentBatch as ConsistentBatch
from .estimator import ConsistentSolver as ConsistentSolver
from .estimator import PhysicallyConsistent as PhysicallyConsistent
from .estimator import consistent_batch as consistent_batch
from .estimator import consistent_body as consistent_body
from .pseudo_inertia import consistency_margin as consistency_margin
from .pseudo_inertia import pseudo_inertia as pseudo_inertia
