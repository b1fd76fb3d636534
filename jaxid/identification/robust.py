"""Robust estimators: rows that the model cannot explain count less, and are weighed again."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator, Estimate
from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.solutions import AbstractSolution, Complete, Decomposition
from jaxid.identification.weights import AbstractWeights, MaximumForces

NORMAL = 1.4826
"""Standard deviation of a normal number over the median of its size."""
MANY = 2**20
"""Residuals from which a median is taken; of more rows some, evenly spread."""
LEAST_SLOPE = 0.1
"""Mean slope of a loss that uncertainties reckon with at least."""


class AbstractLoss(eqx.Module):
    """How much a residual counts, by its size in standard deviations."""

    @abstractmethod
    def share(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """The weight of rows with such residuals, of 1."""

    @abstractmethod
    def slope(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """The derivative of residual times weight."""


def _require_limit(loss: AbstractLoss, limit: float) -> None:
    if not limit > 0.0:
        raise InputError(
            f"`limit` of `{type(loss).__name__}` must be a positive number of standard deviations, "
            f"but is {limit}."
        )


class Huber(AbstractLoss):
    """Large residuals count by their size and not by its square (Huber 1964).

    Attributes:
        limit: Standard deviations up to which a residual counts fully, of 1; the default loses 5 %
            of precision where the noise is normal.
    """

    limit: float = eqx.field(static=True, default=1.345)

    def __check_init__(self):
        _require_limit(self, self.limit)

    def share(self, x):
        """One, then falling with the residual's size."""
        return np.minimum(1.0, self.limit / np.maximum(np.abs(x), 1e-300))

    def slope(self, x):
        """One, then zero."""
        return np.where(np.abs(x) <= self.limit, 1.0, 0.0)


class Tukey(AbstractLoss):
    """Large residuals do not count at all (Tukey's biweight).

    Attributes:
        limit: Standard deviations from which a residual counts nothing, of 1; the default loses 5 %
            of precision where the noise is normal.
    """

    limit: float = eqx.field(static=True, default=4.685)

    def __check_init__(self):
        _require_limit(self, self.limit)

    def share(self, x):
        """Falls smoothly to zero."""
        return np.square(np.maximum(1.0 - (x / self.limit) ** 2, 0.0))

    def slope(self, x):
        """Falls below zero before it ends."""
        u = (x / self.limit) ** 2
        return np.where(u < 1.0, (1.0 - u) * (1.0 - 5.0 * u), 0.0)


class RobustRows(AbstractInfluence):
    """Rows that count by the size of their residuals.

    Attributes:
        weights: Of the joints' rows [1/(N m) or 1/N].
        scale: Standard deviation of each joint's ordinary residuals [N m or N].
        slope: Mean slope of the loss for each joint, of 1.
        loss: How much residuals count.
    """

    weights: Float[AnyArray, " joints"]
    scale: Float[AnyArray, " joints"]
    slope: Float[AnyArray, " joints"]
    loss: AbstractLoss

    def channels(self, chunk, residuals):
        """Residuals enter as the loss lets them; a change of parameters by the mean slope."""
        found = []
        felt = self.loss.share(residuals / self.scale) * residuals
        for j, (theta, own) in enumerate(zip(chunk.columns, chunk.indices, strict=True)):
            counted = chunk.mask[:, j]
            rows = np.where(counted, np.asarray(self.weights)[j], 0.0)
            Z = rows[:, None] * theta
            slope = np.asarray(self.slope)[j]
            found.append(Channel(own, Z, slope * Z, rows * felt[:, j], int(counted.sum())))
        return found


class IterativelyReweighted(AbstractEstimator):
    """Weighted least squares in which rows with large residuals count less (M-estimation).

    For outliers and friction reversals: starting from weighted least squares, the scale of each
    joint's residuals is taken from their median size, every row gets a weight by its own residual,
    and the system is solved again until the forces no longer change. Tukey's loss starts from
    Huber's answer. An outlier must stand out from its row: filters that spread it over many rows
    hide it, so filter forces little and let this estimator do the rest.

    Attributes:
        loss: How much residuals count.
        weights: Of the joints; by default the reciprocals of the largest forces (Eq. 30).
        solution: How each system is solved.
        iterations: Most that are made.
        tolerance: Change of the forces, as a share of the residuals, that ends them, of 1.
    """

    loss: AbstractLoss = Huber()
    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=50)
    tolerance: float = eqx.field(static=True, default=1e-4)

    def __call__(self, rows):
        """Solves until nothing changes.

        Raises:
            InputError: If only factors of the rows are known.
        """
        rows.require_samples("an iteratively reweighted estimate")
        weights = self.weights(rows.robot, rows.factors)
        start = Estimate.solved(rows, weights, self.solution.choose(rows.blocks, weights))
        p, _ = self._settled(rows, weights, np.asarray(start.parameters), Huber())
        p, change = self._settled(rows, weights, p, self.loss)
        scale = spread(rows, p)
        slope = np.maximum(_mean_slope(rows, p, scale, self.loss), LEAST_SLOPE)
        blocks = rows.reweighted(p, _share(self.loss, scale))
        solution = self.solution.choose(blocks, weights)
        d = Decomposition.of(*rows.factors.weighted(weights * np.sqrt(slope)))
        said = ()
        if change > self.tolerance:
            said = (
                f"the robust estimate still changed by {100 * change:.2g} % of the residuals after "
                f"{self.iterations} iterations: outliers are too many to be told apart.",
            )
        return Estimate(
            base=rows.base,
            parameters=p,
            weights=weights,
            blocks=blocks,
            inverse=d.inverse_information(solution.inverse(d.values)),
            influence=RobustRows(weights, scale, slope, self.loss),
            solution=solution,
            notes=said,
        )

    def _settled(
        self, rows: RegressionProblem, weights: np.ndarray, p: np.ndarray, loss: AbstractLoss
    ) -> tuple[np.ndarray, float]:
        """Parameters that reweighting no longer changes, and the last change."""
        change = np.inf
        scale = spread(rows, p)
        for _ in range(self.iterations):
            blocks = rows.reweighted(p, _share(loss, scale))
            R, z = blocks.total.weighted(weights)
            solution = self.solution.choose(blocks, weights)
            d = Decomposition.of(R, z)
            new = d.solve(solution.inverse(d.values))
            rest = float(np.linalg.norm(z - R @ new))
            moved = float(np.linalg.norm(R @ (new - p)))
            p, change = new, moved / rest if rest > 0 else 0.0
            if change <= self.tolerance:
                break
            scale = spread(rows, p)
        return p, change


def spread(rows: RegressionProblem, p: Float[np.ndarray, " base"]) -> Float[np.ndarray, " joints"]:
    """Standard deviation of each joint's ordinary residuals, from their median size [N m or N]."""
    step = max(1, -(-int(rows.factors.rows.max()) // MANY))
    found = [[] for _ in range(rows.robot.joints)]
    for chunk, residuals in rows.residuals(p):
        for j, own in enumerate(found):
            own.append(np.abs(residuals[chunk.mask[:, j], j])[::step])
    medians = np.array([np.median(np.concatenate(own)) for own in found])
    # Residuals of zero are of rows without noise: all count.
    floor = max(1e-12 * float(np.sqrt(rows.factors.force_squares.max())), np.finfo(float).tiny)
    return NORMAL * np.maximum(medians, floor)


def _share(loss: AbstractLoss, scale: np.ndarray):
    return lambda residuals, counted: loss.share(residuals / scale)


def _mean_slope(
    rows: RegressionProblem, p: np.ndarray, scale: np.ndarray, loss: AbstractLoss
) -> Float[np.ndarray, " joints"]:
    total = np.zeros(len(scale))
    for chunk, residuals in rows.residuals(p):
        total += np.sum(np.where(chunk.mask, loss.slope(residuals / scale), 0.0), axis=0)
    return total / np.maximum(rows.factors.rows, 1)
