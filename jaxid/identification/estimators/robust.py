"""Robust estimation: rows with large residuals count less, or not at all."""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Iterator

import equinox as eqx
import numpy as np

from jaxid.arrays import BaseVector, Joints, Matrix
from jaxid.errors import InputError

from ..factors import RowChunk
from ..problem import RegressionProblem
from .estimate import AbstractEstimator, Channel, Estimate, joint_rows
from .regularisation_and_weights import (
    AbstractSolution,
    AbstractWeights,
    Complete,
    Decomposition,
    MaximumForces,
)


class AbstractLoss(eqx.Module):
    """Loss function of residuals in units of their standard deviation.

    Attributes:
        limit: Number of standard deviations at which the loss departs from the square.
    """

    limit: eqx.AbstractVar[float]

    def __check_init__(self):
        if not self.limit > 0.0:
            raise InputError(f"`limit` must be positive, but is {self.limit}.")

    @abstractmethod
    def weight(self, x: np.ndarray) -> np.ndarray:
        """Return the weights (0 to 1) of rows with such residuals."""

    @abstractmethod
    def slope(self, x: np.ndarray) -> np.ndarray:
        """Return the derivative of residual times weight."""


class Huber(AbstractLoss):
    """Huber's loss (1964): linear beyond a limit.

    Attributes:
        limit: Standard deviations up to which a residual counts fully; the default
            loses 5 % of precision for normal noise.
    """

    limit: float = eqx.field(static=True, default=1.345)

    def weight(self, x):
        """Return one up to the limit, then the reciprocal size."""
        return np.minimum(1.0, self.limit / np.maximum(np.abs(x), 1e-300))

    def slope(self, x):
        """Return one up to the limit, then zero."""
        return np.where(np.abs(x) <= self.limit, 1.0, 0.0)


class Tukey(AbstractLoss):
    """Tukey's biweight loss: constant beyond a limit; large residuals do not count.

    Attributes:
        limit: Standard deviations from which a residual does not count; the default
            loses 5 % of precision for normal noise.
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
    """Weighted least squares in which large residuals count less (M-estimation).

    For outliers and friction reversals. The scale of each joint's residuals is taken
    from their median size, every row gets a weight by its own residual, and the system
    is solved again until the forces no longer change. Tukey's loss starts from Huber's
    estimate. Filters that spread an outlier over many rows hide it: filter forces
    little and leave outliers to this estimator.

    Attributes:
        loss: Loss function.
        weights: Weights of the joints; by default the reciprocals of the largest forces
            (Eq. 30).
        solution: Solution of each system.
        iterations: Largest number of iterations.
        tolerance: Relative change of the forces, in units of the residuals, that ends
            them.
    """

    loss: AbstractLoss = Huber()
    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=50)
    tolerance: float = eqx.field(static=True, default=1e-4)

    def __call__(self, problem):
        """Reweight and solve until nothing changes."""
        weights = self.weights(problem.robot, problem.factors)
        p = Estimate.solve(problem, weights, self.solution).parameters
        change = np.inf
        for loss in (Huber(), self.loss):
            for _ in range(self.iterations):
                p, change = self._reweight_and_solve(problem, loss, weights, p)
                if change <= self.tolerance:
                    break

        scale = _residual_scale(problem, p)
        slopes = self._mean_slopes(problem, p, scale)
        blocks = problem.reweighted(p, self.loss.weight, scale)
        solution = self.solution.choose(blocks, weights)
        weighted_rows = joint_rows(weights)

        def influence(chunk: RowChunk, residuals: Matrix) -> Iterator[Channel]:
            """Weight each row's residuals; equations have the loss's mean slope."""
            row_weights = self.loss.weight(residuals / scale)
            channels = weighted_rows(chunk, row_weights * residuals)
            for channel, slope in zip(channels, slopes, strict=True):
                yield channel._replace(equations=slope * channel.equations)

        notes = ()
        if change > self.tolerance:
            notes = (
                f"the robust estimate still changed by {100 * change:.2g} % of the "
                f"residuals after {self.iterations} iterations: there are too many "
                "outliers to separate them from good rows.",
            )
        return dataclasses.replace(
            Estimate.solve(problem, weights * np.sqrt(slopes), solution),
            parameters=p,
            weights=weights,
            blocks=blocks,
            influence=influence,
            notes=notes,
            effective_parameters=None,
        )

    def _reweight_and_solve(
        self, problem: RegressionProblem, loss: AbstractLoss, weights, p
    ):
        """Return new parameters, and the forces' change relative to the residuals."""
        scale = _residual_scale(problem, p)
        blocks = problem.reweighted(p, loss.weight, scale)
        R, z = blocks.total.weighted(weights)
        decomposition = Decomposition.of(R, z)
        solution = self.solution.choose(blocks, weights)
        parameters = decomposition.solve(solution.inverse(decomposition.values))
        residual_norm = float(np.linalg.norm(z - R @ parameters))
        if residual_norm == 0:
            return parameters, 0.0
        step_norm = float(np.linalg.norm(R @ (parameters - p)))
        return parameters, step_norm / residual_norm

    def _mean_slopes(self, problem: RegressionProblem, p, scale) -> Joints:
        """Return the mean slope of the loss at each joint's residuals, at least 0.1."""
        sums = np.zeros(len(scale))
        for chunk, residuals in problem.residuals(p):
            slopes = self.loss.slope(residuals / scale)
            sums += np.sum(np.where(chunk.mask, slopes, 0.0), axis=0)
        return np.maximum(sums / np.maximum(problem.factors.rows, 1), 0.1)


def _residual_scale(problem: RegressionProblem, p: BaseVector) -> Joints:
    """Return the deviation of each joint's ordinary residuals by medians [N m or N]."""
    # Of more than a million rows some suffice, evenly spread.
    max_rows = int(problem.factors.rows.max())
    step = max(1, math.ceil(max_rows / 2**20))
    sizes = [[] for _ in range(problem.robot.joints)]
    for chunk, residuals in problem.residuals(p):
        joints = zip(sizes, residuals.T, chunk.mask.T, strict=True)
        for joint_sizes, residual, mask in joints:
            selection = residual[mask][::step]
            joint_sizes.append(np.abs(selection))
    medians = [np.median(np.concatenate(x)) for x in sizes]
    # A floor for rows without noise, whose residuals are zero.
    max_norm = float(np.sqrt(problem.factors.force_squares.max()))
    floor = max(1e-12 * max_norm, np.finfo(float).tiny)
    # 1.4826: standard deviation of a normal variable over its median size.
    return 1.4826 * np.maximum(medians, floor)
