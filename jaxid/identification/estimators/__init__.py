"""Estimators, the weights of the joints, and the solutions of the weighted system."""

from .estimate import (
    AbstractEstimator as AbstractEstimator,
    Channel as Channel,
    Estimate as Estimate,
    EstimatorInWords as EstimatorInWords,
)
from .friction_shapes import select_shapes as select_shapes
from .least_squares import (
    AbstractLoss as AbstractLoss,
    GeneralisedLeastSquares as GeneralisedLeastSquares,
    Huber as Huber,
    InstrumentalVariables as InstrumentalVariables,
    IterativelyReweighted as IterativelyReweighted,
    LeastSquares as LeastSquares,
    RelativeTo as RelativeTo,
    Tukey as Tukey,
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
    Truncated as Truncated,
)
from .variable_projection import (
    NonlinearFriction as NonlinearFriction,
    ShapeSearch as ShapeSearch,
)
