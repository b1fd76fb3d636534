"""Estimators: how parameters follow from observations."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.identification.factors import Factors
from jaxid.identification.solutions import AbstractSolution, Complete, Solved
from jaxid.identification.weights import AbstractWeights, MaximumForces, Unweighted
from jaxid.robot.robot import Robot
from jaxid.types import Float


class AbstractEstimator(eqx.Module):
    """A way to estimate base parameters from the factors of observations."""

    @abstractmethod
    def __call__(
        self, robot: Robot, factors: Factors
    ) -> tuple[Float[np.ndarray, " joints"], Solved]:
        """The weights of the joints and the solution."""


class LeastSquares(AbstractEstimator):
    """Least squares without weights (Eq. 28).

    Attributes:
        solution: How the system is solved.
    """

    solution: AbstractSolution = Complete()

    def __call__(self, robot, factors):
        """Every newton metre counts the same, on the shoulder and on the wrist."""
        weights = Unweighted()(robot, factors, self.solution)
        return weights, self.solution(*factors.weighted(weights))


class WeightedLeastSquares(AbstractEstimator):
    """Least squares whose rows are weighted by joint (Eqs. 29-33).

    Attributes:
        weights: By default the reciprocals of the largest forces (Eq. 30).
        solution: How the system is solved.
    """

    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()

    def __call__(self, robot, factors):
        """Finds the weights, then the parameters."""
        weights = self.weights(robot, factors, self.solution)
        return weights, self.solution(*factors.weighted(weights))
