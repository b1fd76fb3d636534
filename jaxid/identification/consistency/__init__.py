"""Physical consistency: parameters of bodies that can exist, found with a certificate."""

from jaxid.identification.consistency.bounds import BodyBounds as BodyBounds
from jaxid.identification.consistency.bounds import EntropicPull as EntropicPull
from jaxid.identification.consistency.bounds import ParameterPrior as ParameterPrior
from jaxid.identification.consistency.estimator import Consistency as Consistency
from jaxid.identification.consistency.estimator import ConsistentBatch as ConsistentBatch
from jaxid.identification.consistency.estimator import ConsistentSolver as ConsistentSolver
from jaxid.identification.consistency.estimator import PhysicallyConsistent as PhysicallyConsistent
from jaxid.identification.consistency.estimator import consistent_batch as consistent_batch
from jaxid.identification.consistency.estimator import consistent_body as consistent_body
from jaxid.identification.consistency.pseudo_inertia import consistency_margin as consistency_margin
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia as pseudo_inertia
