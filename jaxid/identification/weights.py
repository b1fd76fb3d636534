"""How much the rows of each joint count: the diagonal of W (Eq. 30)."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.identification.factors import Factors
from jaxid.identification.solutions import AbstractSolution
from jaxid.robot.robot import Robot
from jaxid.types import Float


class AbstractWeights(eqx.Module):
    """A choice of one weight for each joint."""

    @abstractmethod
    def __call__(
        self, robot: Robot, factors: Factors, solution: AbstractSolution
    ) -> Float[np.ndarray, " joints"]:
        """The weights [1/(N m) or 1/N].

        Args:
            robot: Whose joints are weighted.
            factors: Of the observations.
            solution: How a weighted system is solved, for weights that depend on residuals.
        """


class Unweighted(AbstractWeights):
    r"""Every row counts the same, whatever its unit (Eq. 28)."""

    def __call__(self, robot, factors, solution):
        """Ones."""
        return np.ones(robot.joints)


class MaximumForces(AbstractWeights):
    r"""The reciprocals of the largest forces, $1 / (i_{Gj} M_{j,max})$ (Eq. 30)."""

    def __call__(self, robot, factors, solution):
        """The reciprocals.

        Raises:
            ValueError: If the largest force of some joint is not known.
        """
        return 1.0 / np.asarray(robot.max_forces)


class ResidualVariances(AbstractWeights):
    """The reciprocals of the residuals' standard deviations, found by solving again.

    Attributes:
        iterations: How often weights and parameters are found in turn.
    """

    iterations: int = eqx.field(static=True, default=5)

    def __call__(self, robot, factors, solution):
        """Starts from the size of the forces."""
        deviations = np.sqrt(factors.force_squares / np.maximum(factors.rows, 1))
        floor = 1e-9 * max(float(deviations.max()), np.finfo(float).tiny)
        for _ in range(self.iterations):
            weights = 1.0 / np.maximum(deviations, floor)
            p = solution(*factors.weighted(weights)).parameters
            deviations = np.sqrt(factors.residual_squares(p) / np.maximum(factors.rows, 1))
        return 1.0 / np.maximum(deviations, floor)
