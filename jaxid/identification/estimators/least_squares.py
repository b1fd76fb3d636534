"""Least squares: ordinary, weighted by joint, generalised, and relative to a prior."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators.estimate import (
    AbstractEstimator,
    AbstractInfluence,
    Channel,
    Estimate,
)
from jaxid.identification.estimators.solutions import (
    AbstractSolution,
    Complete,
    CrossValidated,
    Decomposition,
)
from jaxid.identification.estimators.weights import (
    AbstractWeights,
    MaximumForces,
    ResidualVariances,
    Unweighted,
)
from jaxid.identification.factors import Blocks, Factors, RowChunk
from jaxid.identification.problem import RegressionProblem, Span, chunk_residuals


class LeastSquares(AbstractEstimator):
    """Least squares without weights (Eq. 28).

    Attributes:
        solution: Solution of the system.
    """

    solution: AbstractSolution = Complete()

    def __call__(self, problem):
        """Solve the system; a newton metre counts the same at every joint."""
        weights = Unweighted()(problem.robot, problem.factors)
        return Estimate.solve(problem, weights, self.solution)


class WeightedLeastSquares(AbstractEstimator):
    """Least squares whose rows are weighted by joint (Eqs. 29-33).

    Attributes:
        weights: Weights of the joints; by default the reciprocals of the largest forces (Eq. 30).
        solution: Solution of the system.
    """

    weights: AbstractWeights = MaximumForces()
    solution: AbstractSolution = Complete()

    def __call__(self, problem):
        """Compute the weights, and solve the system."""
        weights = self.weights(problem.robot, problem.factors)
        return Estimate.solve(problem, weights, self.solution)


class WhitenedRows(AbstractInfluence):
    r"""Influence of the rows of all joints at one instant, multiplied by $S^{-1/2}$.

    Attributes:
        covariance: Covariance $S$ of the joints' residuals.
    """

    covariance: Float[AnyArray, "joints joints"]

    def channels(self, chunk, residuals):
        """Return combinations of joints whose residuals are not correlated."""
        size = 1 + max((max(own) for own in chunk.indices if own), default=0)
        rows = np.zeros((*residuals.shape, size + 1))
        for j, own in enumerate(chunk.indices):
            rows[:, j, list(own)] = chunk.columns[j]
        rows[..., -1] = residuals
        mixed = self._whiten(rows, chunk.mask)
        found = []
        for c in range(residuals.shape[1]):
            Z = mixed[:, c, :-1]
            count = int(chunk.mask[:, c].sum())
            found.append(Channel(tuple(range(size)), Z, Z, mixed[:, c, -1], count))
        return found

    def _whiten(self, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Multiply rows [rows, joints, columns] by the root of the joints that count then."""
        S, whitened = np.asarray(self.covariance), np.zeros_like(x)
        patterns, which = np.unique(mask, axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            own = np.flatnonzero(pattern)
            if len(own):
                root = np.linalg.inv(np.linalg.cholesky(S[np.ix_(own, own)]))
                rows = np.flatnonzero(which.ravel() == k)
                whitened[np.ix_(rows, own)] = np.einsum("cj,rjk->rck", root, x[np.ix_(rows, own)])
        return whitened


class GeneralisedLeastSquares(AbstractEstimator):
    """Least squares with the full covariance of the joints' residuals (Aitken).

    Residuals of neighbouring joints are often correlated: an error of the model acts on several.
    The covariance is computed from the residuals of weighted least squares, and again from its own.

    Attributes:
        solution: Solution of the system.
        iterations: Number of times that covariance and parameters are computed in turn.
    """

    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=2)

    def __call__(self, problem):
        """Estimate covariance and parameters in turn.

        Raises:
            InputError: If only factors of the rows are known.
        """
        problem.require_samples("least squares with the full covariance of the joints")
        weights = ResidualVariances()(problem.robot, problem.factors)
        estimate = Estimate.solve(problem, weights, self.solution)
        for _ in range(self.iterations):
            influence = WhitenedRows(_residual_covariance(problem, estimate.parameters))
            weights = 1.0 / np.sqrt(np.diag(influence.covariance))
            blocks = _whiten(problem, influence, np.asarray(estimate.parameters), weights)
            solution = self.solution.choose(blocks, weights)
            d = Decomposition.of(*blocks.total.weighted(weights))
            inverse = solution.inverse(d.values)
            estimate = Estimate(
                base=problem.base,
                parameters=d.solve(inverse),
                weights=weights,
                blocks=blocks,
                inverse=d.inverse_information(inverse),
                influence=influence,
                solution=solution,
            )
        return estimate


def _residual_covariance(
    problem: RegressionProblem, p: Float[AnyArray, " base"]
) -> Float[np.ndarray, "joints joints"]:
    """Return the covariance of the joints' residuals at the same instants [N² m², N m N or N²]."""
    n = problem.robot.joints
    products, counts = np.zeros((n, n)), np.zeros((n, n))
    for chunk, residuals in problem.residuals(np.asarray(p)):
        r, c = np.where(chunk.mask, residuals, 0.0), chunk.mask.astype(float)
        products += r.T @ r
        counts += c.T @ c
    S = products / np.maximum(counts, 1.0)
    size = np.sqrt(np.maximum(np.diag(S), np.finfo(float).tiny))
    values, directions = np.linalg.eigh(S / size / size[:, None])
    # Pairs that count at different instants may give a matrix that is not positive definite.
    definite = (directions * np.maximum(values, 1e-6)) @ directions.T
    return definite * size * size[:, None]


def _whiten(
    problem: RegressionProblem, influence: WhitenedRows, p: np.ndarray, weights: np.ndarray
) -> Blocks:
    """Return the factors of combinations of joints, as if they were the joints' own."""
    size = problem.base.size

    def equations(chunk: RowChunk) -> list[np.ndarray]:
        found = []
        for c, channel in enumerate(influence.channels(chunk, chunk_residuals(chunk, p))):
            Z = np.zeros((len(chunk.mask), size))
            Z[:, list(channel.columns)] = channel.equations
            both = np.column_stack([Z, channel.disturbance + Z @ p])[chunk.mask[:, c]]
            found.append(both / weights[c])
        return found

    return problem.fold(equations, [tuple(range(size))] * len(weights))


class RelativeTo(AbstractEstimator):
    r"""Another estimator, applied to the forces that a prior does not explain.

    A regularised solution, which keeps badly determined parameters small, then keeps them near
    those of the prior instead: a ridge towards a CAD model minimises
    $\|W (Q - \Theta p)\|^2 + \lambda^2 \|D (p - p_0)\|^2$. Without regularisation nothing changes.
    For a pull of whole bodies (a Bregman divergence) see `PhysicallyConsistent` and `EntropicPull`.

    Attributes:
        parameters: Standard parameters of the prior, in the model's order.
        estimator: Estimator; by default weighted least squares with a cross-validated ridge.
    """

    parameters: Float[AnyArray, " standard"]
    estimator: AbstractEstimator = eqx.field(
        default_factory=lambda: WeightedLeastSquares(solution=CrossValidated())
    )

    def __call__(self, problem):
        """Subtract the prior's forces, estimate, and add the prior.

        Raises:
            InputError: If the number of parameters is not that of the model, or the estimator
                rejects the problem.
        """
        size = problem.base.model.size
        if np.shape(self.parameters) != (size,):
            raise InputError(
                f"`parameters` of `RelativeTo` must be the {size} standard parameters of the "
                f"model, but have the shape {np.shape(self.parameters)}."
            )
        prior = np.asarray(self.parameters)
        found = self.estimator(_RelativeProblem(problem, prior))
        origin = np.asarray(found.base.from_standard(prior))
        return dataclasses.replace(
            found,
            parameters=np.asarray(found.parameters) + origin,
            blocks=_subtract_forces(found.blocks, -origin),
            standard=None if found.standard is None else found.standard + prior,
        )


class _RelativeProblem(RegressionProblem):
    """Regression problem with the forces that a prior does not explain."""

    def __init__(self, whole: RegressionProblem, prior: np.ndarray):
        origin = np.asarray(whole.base.from_standard(prior))
        blocks = _subtract_forces(whole.blocks, origin)
        super().__init__(whole.base, whole.recordings, whole.progress, blocks=blocks)
        self._whole, self._prior, self._origin = whole, prior, origin

    def with_base(self, base: BaseParameters) -> RegressionProblem:
        return _RelativeProblem(self._whole.with_base(base), self._prior)

    def chunks(self, spans: Sequence[Span] | None = None):
        for chunk, forces in self._whole.residuals(self._origin, spans):
            yield chunk._replace(forces=forces)


def _subtract_forces(blocks: Blocks, p: Float[np.ndarray, " base"]) -> Blocks:
    """Return the factors of the same rows with the forces of some parameters subtracted."""
    parts = []
    for part in blocks.parts:
        joints = []
        for joint in part.joints:
            R = np.array(joint.R)
            R[:, -1] -= R[:, :-1] @ p[list(joint.columns)]
            joints.append(dataclasses.replace(joint, R=R))
        parts.append(Factors(tuple(joints), part.size))
    return Blocks(tuple(parts))
