"""Estimators, the weights of the joints, and the solutions of the weighted system."""

from .estimate import (
    AbstractEstimator as AbstractEstimator,
    Channel as Channel,
    Estimate as Estimate,
    EstimatorInWords as EstimatorInWords,
)
from .least_squares import (
    InstrumentalVariables as InstrumentalVariables,
    LeastSquares as LeastSquares,
    WeightedLeastSquares as WeightedLeastSquares,
)
from .regularisation_and_weights import (
    AbstractSolution as AbstractSolution,
    AbstractSpectralSolution as AbstractSpectralSolution,
    AbstractWeights as AbstractWeights,
    Complete as Complete,
    CrossValidated as CrossValidated,
    GivenWeights as GivenWeights,
    MaximumForces as MaximumForces,
    ResidualVariances as ResidualVariances,
    Ridge as Ridge,
)
from .robust import (
    AbstractLoss as AbstractLoss,
    Huber as Huber,
    IterativelyReweighted as IterativelyReweighted,
    Tukey as Tukey,
)
