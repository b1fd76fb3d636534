"""Estimators: how parameters follow from observations."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.identification.factors import Blocks
from jaxid.identification.solutions import AbstractSolution, AbstractSpectralSolution, Complete
from jaxid.identification.weights import AbstractWeights, MaximumForces, Unweighted
from jaxid.robot.robot import Robot
from jaxid.types import Float


class AbstractEstimator(eqx.Module):
    """A way to estimate base parameters from the factors of observations."""

    @abstractmethod
    def __call__(
        self, robot: Robot, blocks: Blocks
    ) -> tuple[Float[np.ndarray, " joints"], AbstractSpectralSolution]:
        """The weights of the joints, and how the weighted system is solved."""


class LeastSquares(AbstractEstimator):
    """Least squares without weights (Eq. 28).

    Attributes:
        solution: How the system is solved.
    """

    solution: AbstractSolution = Complete()

    def __call__(self, robot, blocks):
        """Every newton metre counts the same, on the shoulder and on the wrist."""
        weights = Unweighted()(robot, blocks.total)
        return weights, self.solution.choose(blocks, weights)


class WeightedLeastSquares(AbstractEstimator):
    """Least squares whose rows are weighted by joint (Eqs. 29-33).

    Attributes:
        weights: By default the reciprocals of the largest forces (Eq. 30).
        solution: How the system is solved.
    """

    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()

    def __call__(self, robot, blocks):
        """Finds the weights, then the solution."""
        weights = self.weights(robot, blocks.total)
        return weights, self.solution.choose(blocks, weights)
