"""Estimators, the weights of the joints, and the solutions of the weighted system."""

from .estimate import AbstractEstimator as AbstractEstimator
from .estimate import Channel as Channel
from .estimate import Estimate as Estimate
from .estimate import EstimatorInWords as EstimatorInWords
from .friction import NonlinearFriction as NonlinearFriction
from .least_squares import AbstractLoss as AbstractLoss
from .least_squares import GeneralisedLeastSquares as GeneralisedLeastSquares
from .least_squares import Huber as Huber
from .least_squares import InstrumentalVariables as InstrumentalVariables
from .least_squares import IterativelyReweighted as IterativelyReweighted
from .least_squares import LeastSquares as LeastSquares
from .least_squares import RelativeTo as RelativeTo
from .least_squares import Tukey as Tukey
from .least_squares import WeightedLeastSquares as WeightedLeastSquares
from .solutions import AbstractSolution as AbstractSolution
from .solutions import AbstractSpectralSolution as AbstractSpectralSolution
from .solutions import AbstractWeights as AbstractWeights
from .solutions import Complete as Complete
from .solutions import CrossValidated as CrossValidated
from .solutions import GivenWeights as GivenWeights
from .solutions import MaximumForces as MaximumForces
from .solutions import ResidualVariances as ResidualVariances
from .solutions import Ridge as Ridge
from .solutions import Truncated as Truncated
