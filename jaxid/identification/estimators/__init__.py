"""Estimators, the weights of the joints, and the solutions of the weighted system."""

from jaxid.identification.estimators.estimate import AbstractEstimator as AbstractEstimator
from jaxid.identification.estimators.estimate import Channel as Channel
from jaxid.identification.estimators.estimate import Estimate as Estimate
from jaxid.identification.estimators.estimate import EstimatorInWords as EstimatorInWords
from jaxid.identification.estimators.friction import NonlinearFriction as NonlinearFriction
from jaxid.identification.estimators.least_squares import AbstractLoss as AbstractLoss
from jaxid.identification.estimators.least_squares import (
    GeneralisedLeastSquares as GeneralisedLeastSquares,
)
from jaxid.identification.estimators.least_squares import Huber as Huber
from jaxid.identification.estimators.least_squares import (
    InstrumentalVariables as InstrumentalVariables,
)
from jaxid.identification.estimators.least_squares import (
    IterativelyReweighted as IterativelyReweighted,
)
from jaxid.identification.estimators.least_squares import LeastSquares as LeastSquares
from jaxid.identification.estimators.least_squares import RelativeTo as RelativeTo
from jaxid.identification.estimators.least_squares import Tukey as Tukey
from jaxid.identification.estimators.least_squares import (
    WeightedLeastSquares as WeightedLeastSquares,
)
from jaxid.identification.estimators.solutions import AbstractSolution as AbstractSolution
from jaxid.identification.estimators.solutions import (
    AbstractSpectralSolution as AbstractSpectralSolution,
)
from jaxid.identification.estimators.solutions import AbstractWeights as AbstractWeights
from jaxid.identification.estimators.solutions import Complete as Complete
from jaxid.identification.estimators.solutions import CrossValidated as CrossValidated
from jaxid.identification.estimators.solutions import GivenWeights as GivenWeights
from jaxid.identification.estimators.solutions import MaximumForces as MaximumForces
from jaxid.identification.estimators.solutions import ResidualVariances as ResidualVariances
from jaxid.identification.estimators.solutions import Ridge as Ridge
from jaxid.identification.estimators.solutions import Truncated as Truncated
