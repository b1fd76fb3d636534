"""Robust estimation: iteratively reweighted least squares (M-estimation)."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.identification.estimators.estimate import (
    AbstractEstimator,
    Channel,
    Estimate,
    weighted_joints,
)
from jaxid.identification.estimators.solutions import (
    AbstractSolution,
    AbstractWeights,
    Complete,
    Decomposition,
    MaximumForces,
)
from jaxid.identification.factors import Blocks, RowChunk
from jaxid.identification.problem import RegressionProblem


class AbstractLoss(eqx.Module):
    """Loss function of residuals in units of their standard deviation.

    Attributes:
        limit: Number of standard deviations at which the loss departs from the square.
    """

    limit: eqx.AbstractVar[float]

    def __check_init__(self):
        if not self.limit > 0.0:
            raise InputError(
                f"`limit` of `{type(self).__name__}` must be a positive number of standard "
                f"deviations, but is {self.limit}."
            )

    @abstractmethod
    def weight(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """Return the weights (0 to 1) of rows with such residuals."""

    @abstractmethod
    def slope(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """Return the derivative of residual times weight."""


class Huber(AbstractLoss):
    """Huber's loss (1964): linear beyond a limit.

    Attributes:
        limit: Standard deviations up to which a residual counts fully; the default loses 5 % of
            precision for normal noise.
    """

    limit: float = eqx.field(static=True, default=1.345)

    def weight(self, x):
        """Return one up to the limit, then the reciprocal size."""
        return np.minimum(1.0, self.limit / np.maximum(np.abs(x), 1e-300))

    def slope(self, x):
        """Return one up to the limit, then zero."""
        return np.where(np.abs(x) <= self.limit, 1.0, 0.0)


class Tukey(AbstractLoss):
    """Tukey's biweight loss: constant beyond a limit, so that large residuals do not count.

    Attributes:
        limit: Standard deviations from which a residual does not count; the default loses 5 % of
            precision for normal noise.
    """

    limit: float = eqx.field(static=True, default=4.685)

    def weight(self, x):
        """Return weights that fall smoothly to zero at the limit."""
        return np.square(np.maximum(1.0 - (x / self.limit) ** 2, 0.0))

    def slope(self, x):
        """Return slopes that are negative shortly before the limit."""
        u = (x / self.limit) ** 2
        return np.where(u < 1.0, (1.0 - u) * (1.0 - 5.0 * u), 0.0)


class IterativelyReweighted(AbstractEstimator):
    """Weighted least squares in which rows with large residuals count less (M-estimation).

    For outliers and friction reversals. The scale of each joint's residuals is taken from their
    median size, every row gets a weight by its own residual, and the system is solved again until
    the forces no longer change. Tukey's loss starts from Huber's estimate. Filters that spread an
    outlier over many rows hide it: filter forces little and leave outliers to this estimator.

    Attributes:
        loss: Loss function.
        weights: Weights of the joints; by default the reciprocals of the largest forces (Eq. 30).
        solution: Solution of each system.
        iterations: Largest number of iterations.
        tolerance: Relative change of the forces, in units of the residuals, that ends them.
    """

    loss: AbstractLoss = Huber()
    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=50)
    tolerance: float = eqx.field(static=True, default=1e-4)

    def __call__(self, problem):
        """Reweight and solve until nothing changes."""
        problem.require_samples("an iteratively reweighted estimate")
        weights = self.weights(problem.robot, problem.factors)
        p = np.asarray(Estimate.solve(problem, weights, self.solution).parameters)
        change = np.inf
        for loss in (Huber(), self.loss):
            p, change = self._iterate(problem, weights, p, loss)
        scale = _residual_scale(problem, p)
        slopes = np.zeros(len(scale))
        for chunk, residuals in problem.residuals(p):
            slopes += np.sum(np.where(chunk.mask, self.loss.slope(residuals / scale), 0.0), axis=0)
        slope = np.maximum(slopes / np.maximum(problem.factors.rows, 1), 0.1)
        blocks = _reweight(problem, p, self.loss, scale)
        solution = self.solution.choose(blocks, weights)
        d = Decomposition.of(*problem.factors.weighted(weights * np.sqrt(slope)))

        def influence(chunk: RowChunk, residuals: np.ndarray) -> list[Channel]:
            """Weight the residuals of each row; the equations have the mean slope of the loss."""
            felt = self.loss.weight(residuals / scale) * residuals
            joints = zip(weighted_joints(chunk, weights), slope, felt.T, strict=True)
            return [Channel(own, Z, k * Z, w * r, n) for (own, Z, w, n), k, r in joints]

        notes = ()
        if change > self.tolerance:
            notes = (
                f"the robust estimate still changed by {100 * change:.2g} % of the residuals after "
                f"{self.iterations} iterations: there are too many outliers to tell them apart.",
            )
        return Estimate(
            base=problem.base,
            parameters=p,
            weights=weights,
            blocks=blocks,
            inverse=d.inverse_information(solution.inverse(d.values)),
            influence=influence,
            solution=solution,
            notes=notes,
        )

    def _iterate(
        self, problem: RegressionProblem, weights: np.ndarray, p: np.ndarray, loss: AbstractLoss
    ) -> tuple[np.ndarray, float]:
        """Return parameters that reweighting no longer changes, and the last change."""
        change = np.inf
        scale = _residual_scale(problem, p)
        for _ in range(self.iterations):
            blocks = _reweight(problem, p, loss, scale)
            R, z = blocks.total.weighted(weights)
            d = Decomposition.of(R, z)
            new = d.solve(self.solution.choose(blocks, weights).inverse(d.values))
            rest = float(np.linalg.norm(z - R @ new))
            step = float(np.linalg.norm(R @ (new - p)))
            p, change = new, step / rest if rest > 0 else 0.0
            if change <= self.tolerance:
                break
            scale = _residual_scale(problem, p)
        return p, change


def _reweight(
    problem: RegressionProblem, p: np.ndarray, loss: AbstractLoss, scale: np.ndarray
) -> Blocks:
    return problem.reweighted(p, lambda residuals, mask: loss.weight(residuals / scale))


def _residual_scale(
    problem: RegressionProblem, p: Float[np.ndarray, " base"]
) -> Float[np.ndarray, " joints"]:
    """Return the standard deviation of each joint's ordinary residuals, by medians [N m or N]."""
    # Of more than a million rows some suffice, evenly spread.
    step = max(1, -(-int(problem.factors.rows.max()) // 2**20))
    sizes = [[] for _ in range(problem.robot.joints)]
    for chunk, residuals in problem.residuals(p):
        for j, own in enumerate(sizes):
            own.append(np.abs(residuals[chunk.mask[:, j], j])[::step])
    medians = np.array([np.median(np.concatenate(own)) for own in sizes])
    # A floor for rows without noise, whose residuals are zero.
    largest = float(np.sqrt(problem.factors.force_squares.max()))
    floor = max(1e-12 * largest, np.finfo(float).tiny)
    # 1.4826: standard deviation of a normal variable over its median size.
    return 1.4826 * np.maximum(medians, floor)
