"""Weights of the joints: the diagonal of W (Eq. 30)."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, is_traced, one_or_each
from jaxid.errors import InputError
from jaxid.identification.estimators.solutions import Complete, Decomposition
from jaxid.identification.factors import Factors
from jaxid.robot.robot import Robot


class AbstractWeights(eqx.Module):
    """A choice of one weight for each joint."""

    @abstractmethod
    def __call__(self, robot: Robot, factors: Factors) -> Float[np.ndarray, " joints"]:
        """Return the weights [1/(N m) or 1/N] for some observations of a robot."""


class Unweighted(AbstractWeights):
    """Equal weights for all rows, whatever their unit (Eq. 28)."""

    def __call__(self, robot, factors):
        """Return ones."""
        return np.ones(robot.joints)


class GivenWeights(AbstractWeights):
    """Known weights.

    Attributes:
        weights: Weight of each joint [1/(N m) or 1/N].
    """

    weights: Float[AnyArray, " joints"] = eqx.field(converter=one_or_each)

    def __check_init__(self):
        # `in_axes` of `vmap` and tracers have no values to check.
        if not isinstance(self.weights, AnyArray) or is_traced(self.weights):
            return
        w = np.asarray(self.weights)
        if w.ndim != 1 or not (np.isfinite(w).all() and (w >= 0.0).all() and w.any()):
            raise InputError(
                "`weights` must be one finite number for each joint, none below zero and not all "
                f"zero, but are {w}."
            )

    def __call__(self, robot, factors):
        """Return the weights.

        Raises:
            InputError: If their number is not that of the joints.
        """
        if np.shape(self.weights) != (robot.joints,):
            raise InputError(
                f"`weights` must be one number for each of the {robot.joints} joints of "
                f"`{robot.name}`, but have shape {np.shape(self.weights)}."
            )
        return np.asarray(self.weights)


class MaximumForces(AbstractWeights):
    r"""Reciprocals of the largest forces, $1 / (i_{Gj} M_{j,max})$ (Eq. 30)."""

    def __call__(self, robot, factors):
        """Return the reciprocals.

        Raises:
            InputError: If the largest force of some joint is not known.
        """
        return 1.0 / np.asarray(robot.max_forces)


class MeasuredForces(AbstractWeights):
    """Reciprocals of the RMS values of the forces, where the largest forces are not known."""

    def __call__(self, robot, factors):
        """Return the reciprocals."""
        return _reciprocal(np.sqrt(factors.force_squares / np.maximum(factors.rows, 1)))


class ResidualVariances(AbstractWeights):
    """Reciprocals of the residuals' standard deviations, found iteratively.

    Attributes:
        iterations: Number of times that weights and parameters are computed in turn.
    """

    iterations: int = eqx.field(static=True, default=5)

    def __call__(self, robot, factors):
        """Return the reciprocals; the iteration starts from the size of the forces."""
        weights = MeasuredForces()(robot, factors)
        for _ in range(self.iterations):
            decomposition = Decomposition.of(*factors.weighted(weights))
            p = decomposition.solve(Complete().inverse(decomposition.values))
            squares = factors.residual_squares(p)
            weights = _reciprocal(np.sqrt(squares / np.maximum(factors.rows, 1)))
        return weights


def _reciprocal(deviations: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
    """Return reciprocals that are finite also for a joint without any force or residual."""
    floor = max(1e-9 * float(deviations.max()), np.finfo(float).tiny)
    return 1.0 / np.maximum(deviations, floor)
