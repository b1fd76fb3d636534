"""Estimates, the influence of single rows on them, and the family of estimators."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import (
    BaseMatrix,
    BaseVector,
    Indices,
    Joints,
    Matrix,
    Texts,
    Vector,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError

from ..factors import Blocks, RowChunk
from ..problem import RegressionProblem
from .regularisation_and_weights import (
    AbstractSolution,
    AbstractSpectralSolution,
    Complete,
    Decomposition,
)


class Channel(NamedTuple):
    r"""One series of equations $u_t = \theta_t (p - \hat p)$ + disturbance.

    Usually it is that of one joint.

    The estimate moves by $B \sum_t z_t u_t$. Rows that do not count are zero.
    """

    columns: Indices  # base parameters of the equations
    instruments: (
        Matrix  # $z_t$ [rows, columns]: for least squares the equations themselves
    )
    equations: Matrix  # $\theta_t$ [rows, columns], weighted
    disturbance: Vector  # $u_t$ [rows]: residuals, weighted
    counted: int  # number of rows that count


Influence = Callable[[RowChunk, Matrix], Iterator[Channel]]
"""Function from rows and their residuals to weighted equations.

The residuals are [rows, joints], in [N m] or [N]; each joint has one channel.
"""


def joint_rows(weights: Joints) -> Influence:
    """Return the influence of rows weighted by joint: one channel for each joint."""

    def channels(chunk: RowChunk, residuals: Matrix) -> Iterator[Channel]:
        joints = zip(
            chunk.indices,
            chunk.columns,
            residuals.T,
            chunk.mask.T,
            weights,
            strict=True,
        )
        for columns, theta, residual, mask, weight in joints:
            row_weights = np.where(mask, weight, 0.0)
            equations = row_weights[:, None] * theta
            yield Channel(
                columns=tuple(columns),
                instruments=equations,
                equations=equations,
                disturbance=row_weights * residual,
                counted=int(mask.sum()),
            )

    return channels


class Estimate(eqx.Module):
    r"""Estimate of an estimator, with what its uncertainty is computed from.

    Near the estimate, a disturbance $e_t$ of the rows moves it by $B \sum_t Z_t^T
    u(e_t)$: `inverse` is $B$, and `influence` returns $Z$ and $u$. Uncertainties follow
    from these alone, so estimators never compute them.

    Attributes:
        base: Base parameters: those of the problem, unless the estimator has found
            constants of the model's terms.
        parameters: Estimated base parameters.
        weights: Weights of the joints' rows [1/(N m) or 1/N].
        blocks: Factors of the rows with their final weights.
        inverse: Inverse of the information, or its substitute; zero for fixed
            parameters.
        influence: Function from some rows and their residuals to weighted equations
            (`Channel`).
        solution: Solution of the weighted system.
        standard: Standard parameters, of an estimator that finds a complete set of
            them.
        notes: Sentences for the user.
        consistency: `Consistency` of a physically consistent estimate, or None.
        unbounded: Parameters without bounds, whose residuals the uncertainty is
            computed from; `parameters` themselves if None.
        effective_parameters: Number of parameters that the rows determine, in fractions
            if the solution is regularised; computed from `inverse` if None.
    """

    base: BaseParameters
    parameters: BaseVector = eqx.field(converter=np.asarray)
    weights: Vector = eqx.field(converter=np.asarray)
    blocks: Blocks
    inverse: BaseMatrix = eqx.field(converter=np.asarray)
    influence: Influence
    solution: AbstractSpectralSolution = Complete()
    standard: Vector | None = None
    notes: Texts = eqx.field(static=True, default=())
    consistency: Any = None
    unbounded: BaseVector | None = None
    effective_parameters: float | None = None

    @classmethod
    def solve(
        cls,
        problem: RegressionProblem,
        weights: Joints,
        solution: AbstractSolution,
    ) -> "Estimate":
        """Return the least-squares estimate of rows weighted by joint (Eqs. 28, 33).

        Args:
            problem: Regression problem.
            weights: Weights of the joints' rows [1/(N m) or 1/N].
            solution: Solution of the weighted system.
        """
        spectral_solution = solution.choose(problem.blocks, weights)
        decomposition = Decomposition.of(*problem.factors.weighted(weights))
        inverse = spectral_solution.inverse(decomposition.values)
        return cls(
            base=problem.base,
            parameters=decomposition.solve(inverse),
            weights=weights,
            blocks=problem.blocks,
            inverse=decomposition.inverse_information(inverse),
            influence=joint_rows(weights),
            solution=spectral_solution,
            effective_parameters=float(np.sum(inverse * decomposition.values**2)),
        )

    def without_bounds(self) -> "Estimate":
        """Return the estimate whose parameters have no bounds."""
        if self.unbounded is None:
            return self
        return dataclasses.replace(self, parameters=self.unbounded)

    def number_of_parameters(self, R: Matrix) -> float:
        """Return how many parameters the rows with a weighted factor `R` determine."""
        if self.effective_parameters is not None:
            return self.effective_parameters
        return float(np.sum((R @ self.inverse) * R))


class AbstractEstimator(eqx.Module):
    """An estimator of base parameters.

    An estimator takes a `RegressionProblem` and returns an `Estimate`. The problem
    offers:

    * `problem.base`, `problem.robot`: the base parameters, with the model and the
      robot;
    * `problem.factors`: for each joint the R factor of its columns and forces, which is
      sufficient for least squares with weights of the joints; `problem.blocks`: the
      same by contiguous blocks of time, for cross-validation;
    * `problem.chunks()`, `problem.residuals(p)`, `problem.reweighted(...)`: passes over
      the rows, where these are known (else an `InputError`);
    * `problem.with_base(base)`: the same recordings with other columns.

    `Estimate.solve` returns the estimate of weighted least squares; use
    `dataclasses.replace` where parts differ. `identify` computes uncertainties,
    condition numbers and undetermined directions from the estimate, alike for all
    estimators.
    """

    @abstractmethod
    def __call__(self, problem: RegressionProblem) -> Estimate:
        """Return the estimate of a regression problem.

        Raises:
            InputError: If weights are not known, the estimator needs rows and only
                factors are known, or its settings do not fit the model or the
                recordings.
        """


class EstimatorInWords(AbstractEstimator):
    """Description of an estimator that held recordings or functions, in a model file.

    Attributes:
        words: Description of the estimator.
    """

    words: str = eqx.field(static=True)

    def __call__(self, problem):
        """Reject the problem: only a description is left."""
        raise InputError(
            f"the `estimator` is only described, create it again: {self.words:.200}"
        )

    def __str__(self):
        return self.words
