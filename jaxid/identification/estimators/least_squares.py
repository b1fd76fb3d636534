"""Least squares: ordinary, weighted, with instruments."""

from collections.abc import Iterator

import jax
import numpy as np

from jaxid.arrays import Matrix
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.samples import SamplesInMemory

from ..factors import RowChunk, join_chunks
from ..problem import RegressionProblem
from .estimate import AbstractEstimator, Channel, Estimate, joint_rows
from .regularisation_and_weights import (
    MIN_SINGULAR_VALUE,
    AbstractSolution,
    AbstractWeights,
    Complete,
    MaximumForces,
)


class LeastSquares(AbstractEstimator):
    """Least squares without weights (Eq. 28).

    Attributes:
        solution: Solution of the system.
    """

    solution: AbstractSolution = Complete()

    def __call__(self, problem):
        """Solve the system; a newton metre counts the same at every joint."""
        return Estimate.solve(problem, np.ones(problem.robot.joints), self.solution)


class WeightedLeastSquares(AbstractEstimator):
    """Least squares whose rows are weighted by joint (Eqs. 29-33).

    Attributes:
        weights: Weights of the joints; by default the reciprocals of the largest forces
            (Eq. 30).
        solution: Solution of the system.
    """

    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()

    def __call__(self, problem):
        """Compute the weights, and solve the system."""
        weights = self.weights(problem.robot, problem.factors)
        return Estimate.solve(problem, weights, self.solution)


class InstrumentalVariables(AbstractEstimator):
    r"""Weighted least squares with the columns of a motion without noise (IDIM-IV).

    Noise of the encoders enters the regressor: least squares then see columns that are
    too large, and bias their parameters towards zero, however long the log is. With the
    columns $Z$ of the commanded motion, which has no such noise, $\hat p = (Z^T W^2
    \Theta)^{-1} Z^T W^2 Q$ has no such bias. The reference need not be followed
    exactly: it must be similar, and independent of the encoders' noise. The instruments
    are kept in memory.

    Attributes:
        references: Commanded or simulated motion of each recording, at its samples,
            like `trajectory.motion(observations.time)`.
        weights: Weights of the joints; by default the reciprocals of the largest forces
            (Eq. 30).
    """

    references: tuple[Motion, ...]
    weights: AbstractWeights = MaximumForces()

    def __call__(self, problem):
        """Solve with the references' columns."""
        weights = self.weights(problem.robot, problem.factors)
        instruments = self._instruments(problem)
        weighted_rows = joint_rows(weights)

        def influence(chunk: RowChunk, residuals: Matrix) -> Iterator[Channel]:
            """Use the reference's columns, not the measured ones, as instruments."""
            channels = weighted_rows(chunk, residuals)
            joints = zip(
                channels,
                instruments[chunk.recording],
                weights,
                chunk.mask.T,
                strict=True,
            )
            for channel, columns, weight, mask in joints:
                row_weights = np.where(mask, weight, 0.0)
                weighted_columns = row_weights[:, None] * columns[chunk.rows]
                yield channel._replace(instruments=weighted_columns)

        size = problem.base.size
        information = np.zeros((size, size))
        products = np.zeros(size)
        for chunk in problem.chunks():
            for channel in influence(chunk, chunk.forces):
                columns = list(channel.columns)
                instruments_of_rows = channel.instruments.T
                information[np.ix_(columns, columns)] += (
                    instruments_of_rows @ channel.equations
                )
                products[columns] += instruments_of_rows @ channel.disturbance
        R, _ = problem.factors.weighted(weights)
        lengths = np.linalg.norm(R, axis=0)
        is_visible = lengths > MIN_SINGULAR_VALUE * lengths.max(initial=0.0)
        # Columns of rounding get an infinite scale, and their parameters stay zero.
        scale = np.where(is_visible, lengths, np.inf)
        scales = np.outer(scale, scale)
        inverse = np.linalg.pinv(information / scales, MIN_SINGULAR_VALUE) / scales
        return Estimate(
            base=problem.base,
            parameters=inverse @ products,
            weights=weights,
            blocks=problem.blocks,
            inverse=inverse,
            influence=influence,
        )

    def _instruments(self, problem: RegressionProblem):
        """Return the columns of each recording's reference, filtered like it."""
        problem.require_rows()
        recordings = problem.recordings
        if len(self.references) != len(recordings):
            raise InputError(
                f"`references` must be one motion for each of {len(recordings)} "
                f"recordings, but holds {len(self.references)}."
            )
        columns = []
        for recording, reference in zip(recordings, self.references, strict=True):
            motion = jax.tree.map(lambda x: np.asarray(x, np.float64), reference)
            source = SamplesInMemory(motion, np.zeros(motion.q.shape))
            reference_problem = RegressionProblem(
                problem.base, recording.replace(source=source)
            )
            columns.append(join_chunks(list(reference_problem.chunks())).columns)
        return columns
