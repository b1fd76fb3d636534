"""Generalised least squares: joints whose residuals are correlated with each other."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.estimators import AbstractEstimator, Estimate
from jaxid.identification.factors import Blocks, RowChunk
from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.problem import RegressionProblem, chunk_residuals
from jaxid.identification.solutions import AbstractSolution, Complete, Decomposition
from jaxid.identification.weights import ResidualVariances

LEAST = 1e-6
"""Smallest variance of a combination of joints, each of variance one, that is believed."""


class WhitenedRows(AbstractInfluence):
    r"""Rows of all joints at one instant, multiplied with $S^{-1/2}$ of those that count.

    Attributes:
        covariance: $S$, of the joints' residuals [joints, joints].
    """

    covariance: Float[AnyArray, "joints joints"]

    def channels(self, chunk, residuals):
        """Combinations of joints whose residuals are not correlated."""
        size = 1 + max((max(own) for own in chunk.indices if own), default=0)
        whole = np.zeros((*residuals.shape, size + 1))
        for j, own in enumerate(chunk.indices):
            whole[:, j, list(own)] = chunk.columns[j]
        whole[..., -1] = residuals
        mixed = self._mixed(whole, chunk.mask)
        found = []
        for c in range(residuals.shape[1]):
            Z = mixed[:, c, :-1]
            counted = int(chunk.mask[:, c].sum())
            found.append(Channel(tuple(range(size)), Z, Z, mixed[:, c, -1], counted))
        return found

    def _mixed(self, x: np.ndarray, counted: np.ndarray) -> np.ndarray:
        """Rows [rows, joints, columns] multiplied by the root of what counts at their instant."""
        S, out = np.asarray(self.covariance), np.zeros_like(x)
        patterns, which = np.unique(counted, axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            own = np.flatnonzero(pattern)
            if len(own):
                root = np.linalg.inv(np.linalg.cholesky(S[np.ix_(own, own)]))
                rows = np.flatnonzero(which.ravel() == k)
                out[np.ix_(rows, own)] = np.einsum("cj,rjk->rck", root, x[np.ix_(rows, own)])
        return out


class GeneralisedLeastSquares(AbstractEstimator):
    """Least squares with the full covariance of the joints' residuals (Aitken).

    Residuals of neighbouring joints are often correlated: an error of the model acts on several.
    The covariance is found from the residuals of weighted least squares, and again from its own.

    Attributes:
        solution: How the system is solved.
        iterations: How often covariance and parameters are found in turn.
    """

    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=2)

    def __call__(self, rows):
        """Solves, and estimates the covariance, in turn.

        Raises:
            InputError: If only factors of the rows are known.
        """
        rows.require_samples("least squares with the full covariance of the joints")
        weights = ResidualVariances()(rows.robot, rows.factors)
        estimate = Estimate.solved(rows, weights, self.solution.choose(rows.blocks, weights))
        for _ in range(self.iterations):
            influence = WhitenedRows(residual_covariance(rows, estimate.parameters))
            weights = 1.0 / np.sqrt(np.diag(influence.covariance))
            blocks = _whitened(rows, influence, np.asarray(estimate.parameters), weights)
            solution = self.solution.choose(blocks, weights)
            d = Decomposition.of(*blocks.total.weighted(weights))
            inverse = solution.inverse(d.values)
            estimate = Estimate(
                base=rows.base,
                parameters=d.solve(inverse),
                weights=weights,
                blocks=blocks,
                inverse=d.inverse_information(inverse),
                influence=influence,
                solution=solution,
            )
        return estimate


def residual_covariance(
    rows: RegressionProblem, p: Float[AnyArray, " base"]
) -> Float[np.ndarray, "joints joints"]:
    """Covariance of the joints' residuals at the same instants [N² m², N m N or N²]."""
    n = rows.robot.joints
    products, counts = np.zeros((n, n)), np.zeros((n, n))
    for chunk, residuals in rows.residuals(np.asarray(p)):
        r, c = np.where(chunk.mask, residuals, 0.0), chunk.mask.astype(float)
        products += r.T @ r
        counts += c.T @ c
    S = products / np.maximum(counts, 1.0)
    size = np.sqrt(np.maximum(np.diag(S), np.finfo(float).tiny))
    values, directions = np.linalg.eigh(S / size / size[:, None])
    # Pairs that count at different instants need not make a covariance together.
    whole = (directions * np.maximum(values, LEAST)) @ directions.T
    return whole * size * size[:, None]


def _whitened(
    rows: RegressionProblem, influence: WhitenedRows, p: np.ndarray, weights: np.ndarray
) -> Blocks:
    """The factors of combinations of joints, as if they were the joints' own."""
    size = rows.base.size

    def equations(chunk: RowChunk) -> list[np.ndarray]:
        found = []
        for c, channel in enumerate(influence.channels(chunk, chunk_residuals(chunk, p))):
            Z = np.zeros((len(chunk.mask), size))
            Z[:, list(channel.columns)] = channel.equations
            both = np.column_stack([Z, channel.disturbance + Z @ p])[chunk.mask[:, c]]
            found.append(both / weights[c])
        return found

    return rows.fold(equations, [tuple(range(size))] * len(weights))
