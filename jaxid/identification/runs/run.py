"""What a run has told, without its data: enough to add, compare and combine runs later."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators import (
    AbstractWeights,
    Complete,
    GivenWeights,
    MaximumForces,
    WeightedLeastSquares,
)
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Blocks, Factors, JointFactor
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.runs.estimates import freedom_of, with_covariance
from jaxid.measurement.observations import Observations, Progress

ROUNDING = 1e-7
"""Difference of predicted forces, relative to the forces, up to which estimates are the same."""


class Run(eqx.Module):
    """One or several recordings of a robot in one state: their factors, estimates, uncertainty.

    The factors are all that least squares need of the data, and the covariance, found while the
    rows were at hand, is right for errors that are alike from row to row. A run takes a few hundred
    kilobytes, whatever the length of its logs.

    Attributes:
        base: The base parameters.
        blocks: Factors of the rows, by contiguous blocks of time.
        weights: Of the joints' rows [1/(N m) or 1/N].
        parameters: Weighted least squares of this run alone.
        covariance: Of these estimates; infinite on the diagonal where nothing is known.
        freedom: Degrees of freedom of their standard deviations.
        name: Of the run, such as `cold`.
        recordings: Names of its recordings.
    """

    base: BaseParameters
    blocks: Blocks
    weights: Float[AnyArray, " joints"]
    parameters: Float[AnyArray, " base"]
    covariance: Float[AnyArray, "base base"]
    freedom: Float[AnyArray, " base"]
    name: str = eqx.field(static=True)
    recordings: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        base: BaseParameters,
        observations: Observations | Sequence[Observations],
        *,
        weights: AbstractWeights | None = None,
        name: str | None = None,
        progress: Progress | None = None,
    ) -> "Run":
        """Goes through recordings once or twice, and keeps what they tell.

        Args:
            base: What can be identified on this robot.
            observations: Of one recording, or of several in the same state.
            weights: Of the joints; the reciprocals of the largest forces if None. Runs that are to
                be combined should have the same.
            name: Of the run; those of its recordings if None.
            progress: Is told now and then which share of a pass over a long log is done, of 1.

        Raises:
            InputError: If there are fewer rows than parameters, or weights are not known.
        """
        single = isinstance(observations, Observations)
        recordings = (observations,) if single else tuple(observations)
        rows = RegressionProblem(base, recordings, progress)
        chosen = MaximumForces() if weights is None else weights
        return cls._fitted(rows, fit_problem(rows, WeightedLeastSquares(chosen)), name)

    @classmethod
    def of_rows(cls, rows: RegressionProblem, fit: Fit, name: str | None = None) -> "Run":
        """What rows tell that a fit has seen.

        Where the fit's estimates are not weighted least squares, as those of robust, regularised or
        consistent estimators, the run's are found anew, with the same weights.

        Args:
            rows: Of one or several recordings.
            fit: What was made of them.
            name: Of the run; those of its recordings if None.
        """
        R, z = rows.blocks.total.weighted(np.asarray(fit.weights))
        decomposition = Decomposition.of(R, z)
        plain = decomposition.solve(Complete().inverse(decomposition.values))
        same = fit.base.names == rows.base.names and is_same(R, z, plain, fit.parameters)
        if not same:
            fit = fit_problem(rows, WeightedLeastSquares(GivenWeights(np.asarray(fit.weights))))
        return cls._fitted(rows, fit, name)

    @classmethod
    def _fitted(cls, rows: RegressionProblem, fit: Fit, name: str | None) -> "Run":
        return cls(
            base=rows.base,
            blocks=rows.blocks,
            weights=np.asarray(fit.weights),
            parameters=np.asarray(fit.parameters),
            covariance=np.asarray(fit.covariance),
            freedom=freedom_of(fit),
            name=", ".join(fit.recordings) if name is None else name,
            recordings=fit.recordings,
        )

    def tells(self, fit: Fit) -> bool:
        """Whether a fit's estimates are those of this run, up to rounding.

        Args:
            fit: Of the same rows.
        """
        R, z = self.factor
        return fit.base.names == self.base.names and is_same(
            R, z, np.asarray(self.parameters), fit.parameters
        )

    @property
    def factor(self) -> tuple[Float[np.ndarray, "height base"], Float[np.ndarray, " height"]]:
        """Matrix and right-hand side with the norms of all weighted rows (Eq. 29)."""
        return self.blocks.total.weighted(self.weights)

    @property
    def fit(self) -> Fit:
        """The estimates as a fit: to validate, compare and report."""
        estimator = WeightedLeastSquares(GivenWeights(self.weights))
        problem = RegressionProblem(self.base, blocks=self.blocks, names=self.recordings)
        fit = fit_problem(problem, estimator)
        return with_covariance(fit, self.parameters, self.covariance, self.freedom)

    def weighted_like(self, weights: Float[AnyArray, " joints"]) -> "Run":
        """The same run with factors that say the same under other weights of the joints."""
        ratio = np.asarray(self.weights) / np.asarray(weights)
        if np.allclose(ratio, 1.0, rtol=1e-12, atol=0.0):
            return self
        parts = tuple(
            Factors(
                tuple(
                    JointFactor(joint.columns, r * np.asarray(joint.R), joint.rows)
                    for joint, r in zip(part.joints, ratio, strict=True)
                ),
                part.size,
            )
            for part in self.blocks.parts
        )
        return dataclasses.replace(self, blocks=Blocks(parts), weights=np.asarray(weights))


def is_same(
    R: Float[np.ndarray, "height base"],
    z: Float[np.ndarray, " height"],
    first: Float[AnyArray, " base"],
    second: Float[AnyArray, " base"],
) -> bool:
    """Whether two sets of estimates predict the same forces, up to rounding.

    Args:
        R: Factor of the weighted rows.
        z: Its right-hand side.
        first: Some estimates.
        second: Others.
    """
    apart = np.linalg.norm(R @ (np.asarray(first) - np.asarray(second)))
    return bool(apart <= ROUNDING * np.linalg.norm(z))


def require_same_base(runs: Sequence[Run]) -> None:
    """Refuses to combine runs of different base parameters.

    Raises:
        InputError: If there is no run, or base parameters differ.
    """
    if not runs:
        raise InputError("`runs` must hold at least one run, but is empty.")
    first = runs[0]
    for run in runs[1:]:
        same = run.base.indices == first.base.indices and run.base.names == first.base.names
        if not same or not np.allclose(run.base.kappa, first.base.kappa, rtol=1e-6, atol=1e-9):
            raise InputError(
                f"the runs `{first.name}` and `{run.name}` have different base parameters: use one "
                "robot and the same terms for both."
            )
