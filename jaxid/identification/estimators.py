"""Estimators: how parameters follow from rows."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks
from jaxid.identification.influence import AbstractInfluence, ByJoint
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.solutions import (
    AbstractSolution,
    AbstractSpectralSolution,
    Complete,
    Decomposition,
)
from jaxid.identification.weights import AbstractWeights, MaximumForces, Unweighted


class Estimate(eqx.Module):
    r"""What an estimator has found, and what others need to judge it.

    Near the estimate, a disturbance $e_t$ of the rows moves it by $B \sum_t Z_t^T u(e_t)$:
    `inverse` is $B$, and `influence` knows $Z$ and $u$. Uncertainties follow from that alone, so an
    estimator never computes them.

    Attributes:
        base: Which combinations of standard parameters they are. Those of the rows, unless the
            estimator has chosen constants of the model's terms.
        parameters: The base parameters.
        weights: Of the joints' rows [1/(N m) or 1/N].
        blocks: The factors of the rows as they counted in the end.
        inverse: What takes the place of the inverse of the information; rows and columns of zeros
            for parameters that the estimator holds fixed.
        influence: How a row moves the estimate.
        solution: How the weighted system was solved.
        standard: Standard parameters, of an estimator that finds a complete set of them.
        notes: What the user should know, in sentences.
        consistency: `Consistency` of a physically consistent estimate, or None.
        taken: Number of parameters that the rows decide, of which regularised ones are a part;
            found from `inverse` if None.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"]
    weights: Float[AnyArray, " joints"]
    blocks: Blocks
    inverse: Float[AnyArray, "base base"]
    influence: AbstractInfluence
    solution: AbstractSpectralSolution = Complete()
    standard: Float[AnyArray, " standard"] | None = None
    notes: tuple[str, ...] = eqx.field(static=True, default=())
    consistency: Any = None
    taken: float | None = None

    @classmethod
    def solved(
        cls,
        rows: RegressionProblem,
        weights: Float[AnyArray, " joints"],
        solution: AbstractSpectralSolution,
    ) -> "Estimate":
        """Least squares of rows that are weighted by joint (Eqs. 28, 33)."""
        decomposition = Decomposition.of(*rows.factors.weighted(weights))
        inverse = solution.inverse(decomposition.values)
        return cls(
            base=rows.base,
            parameters=decomposition.solve(inverse),
            weights=np.asarray(weights),
            blocks=rows.blocks,
            inverse=decomposition.inverse_information(inverse),
            influence=ByJoint(weights),
            solution=solution,
            taken=float(np.sum(inverse * np.asarray(decomposition.values) ** 2)),
        )


class AbstractEstimator(eqx.Module):
    """A way to estimate parameters from rows.

    An estimator gets `RegressionProblem` and returns an `Estimate`. What it can ask the rows for:

    * `rows.base`, `rows.robot`: the base parameters, with the model and the robot behind them;
    * `rows.factors`: for each joint the R factor of its columns and forces, all that least squares
      with weights of the joints need, however long the logs are; `rows.blocks`: the same by
      contiguous blocks of time, for cross-validation;
    * `rows.chunks()`, `rows.residuals(p)`: passes over the rows themselves, bounded in memory, as
      often as needed; `rows.reweighted(...)`: new factors with a weight for every row;
    * `rows.with_base(base)`: the same recordings with other columns, where constants of the model's
      terms are looked for; `rows.recordings`: motions and filters.

    Rows of factors only (`rows.has_samples` is False: from other processes, by `fit_blocks`) serve
    estimators that need no pass; the others refuse them in one sentence.

    What it returns: `Estimate.solved` makes the estimate of weighted least squares; start from it
    with `dataclasses.replace` where parts differ. A complete set of standard parameters goes to
    `standard`, other base parameters (of another model) to `base`. Uncertainties, condition
    numbers, and what is not determined are found from it by `identify`, alike for all estimators.
    """

    @abstractmethod
    def __call__(self, rows: RegressionProblem) -> Estimate:
        """The estimate from some rows.

        Raises:
            InputError: If weights are not known, or it needs more than factors and has them only.
        """


class LeastSquares(AbstractEstimator):
    """Least squares without weights (Eq. 28).

    Attributes:
        solution: How the system is solved.
    """

    solution: AbstractSolution = Complete()

    def __call__(self, rows):
        """Every newton metre counts the same, on the shoulder and on the wrist."""
        weights = Unweighted()(rows.robot, rows.factors)
        return Estimate.solved(rows, weights, self.solution.choose(rows.blocks, weights))


class WeightedLeastSquares(AbstractEstimator):
    """Least squares whose rows are weighted by joint (Eqs. 29-33).

    Attributes:
        weights: By default the reciprocals of the largest forces (Eq. 30).
        solution: How the system is solved.
    """

    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()

    def __call__(self, rows):
        """Finds the weights, then the solution."""
        weights = self.weights(rows.robot, rows.factors)
        return Estimate.solved(rows, weights, self.solution.choose(rows.blocks, weights))


class EstimatorInWords(AbstractEstimator):
    """What is left in a file of an estimator that held recordings or functions.

    Attributes:
        words: What it was.
    """

    words: str = eqx.field(static=True)

    def __call__(self, rows):
        """Refuses: only the words are left.

        Raises:
            InputError: Always.
        """
        raise InputError(
            "the estimator of a model file that held recordings or functions is kept in words "
            f"only: make it anew to estimate again. It was {self.words:.200}"
        )

    def __str__(self):
        return self.words
