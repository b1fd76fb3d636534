"""Least squares: ordinary, weighted, generalised, robust, with instruments, towards a prior."""

import dataclasses
from abc import abstractmethod
from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.measurement.samples import SamplesInMemory
from jaxid.trajectory.trajectory import AbstractTrajectory

from ..factors import Blocks, JointFactor, RowChunk
from ..problem import RegressionProblem
from .estimate import AbstractEstimator, Channel, Estimate, Influence, weighted_joints
from .regularisation_and_weights import (
    NUMERICAL,
    AbstractSolution,
    AbstractWeights,
    Complete,
    CrossValidated,
    Decomposition,
    MaximumForces,
    ResidualVariances,
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


class GeneralisedLeastSquares(AbstractEstimator):
    """Least squares with the full covariance of the joints' residuals (Aitken).

    Residuals of neighbouring joints are often correlated: an error of the model acts on
    several. The covariance is computed from the residuals of weighted least squares,
    and again from its own.

    Attributes:
        solution: Solution of the system.
        iterations: Number of times that covariance and parameters are computed in turn.
    """

    solution: AbstractSolution = Complete()
    iterations: int = eqx.field(static=True, default=2)

    def __call__(self, problem):
        """Estimate covariance and parameters in turn."""
        weights = ResidualVariances()(problem.robot, problem.factors)
        estimate = Estimate.solve(problem, weights, self.solution)
        size, n = problem.base.size, problem.robot.joints
        for _ in range(self.iterations):
            S = _residual_covariance(problem, np.asarray(estimate.parameters))
            influence, weights = whitened_rows(S, size), 1.0 / np.sqrt(np.diag(S))

            def equations(chunk, influence=influence, weights=weights):
                """Return the combinations of joints, as if they were the joints' own rows."""
                mixed = zip(
                    influence(chunk, chunk.forces), weights, chunk.mask.T, strict=True
                )
                return [np.column_stack(x[2:4])[mask] / w for x, w, mask in mixed]

            blocks = problem.fold(equations, [tuple(range(size))] * n)
            mixed = RegressionProblem(problem.base, blocks=blocks)
            estimate = Estimate.solve(mixed, weights, self.solution)
            estimate = dataclasses.replace(estimate, influence=influence)
        return estimate


def _residual_covariance(problem: RegressionProblem, p: np.ndarray) -> np.ndarray:
    """Return the covariance of the joints' residuals at the same instants [N² m², N m N or N²]."""
    n = problem.robot.joints
    products, counts = np.zeros((n, n)), np.zeros((n, n))
    for chunk, residuals in problem.residuals(p):
        r, c = np.where(chunk.mask, residuals, 0.0), chunk.mask.astype(float)
        products += r.T @ r
        counts += c.T @ c
    S = products / np.maximum(counts, 1.0)
    size = np.sqrt(np.maximum(np.diag(S), np.finfo(float).tiny))
    values, directions = np.linalg.eigh(S / size / size[:, None])
    # Pairs that count at different instants may give a matrix that is not positive
    # definite.
    definite = (directions * np.maximum(values, 1e-6)) @ directions.T
    return definite * size * size[:, None]


def whitened_rows(S: np.ndarray, size: int) -> Influence:
    """Return the influence of the joints' rows at one instant, multiplied by S^(-1/2).

    The channels are combinations of joints whose residuals are not correlated.
    """

    def channels(chunk: RowChunk, residuals: np.ndarray) -> Iterator[Channel]:
        rows = np.zeros((*residuals.shape, size + 1))
        for j, own in enumerate(chunk.indices):
            rows[:, j, list(own)] = chunk.columns[j]
        rows[..., -1] = residuals
        mixed = np.zeros_like(rows)
        # Instants at which the same joints count share a root.
        patterns, which = np.unique(chunk.mask, axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            own = np.flatnonzero(pattern)
            if len(own):
                root = np.linalg.inv(np.linalg.cholesky(S[np.ix_(own, own)]))
                at = np.ix_(np.flatnonzero(which.ravel() == k), own)
                mixed[at] = np.einsum("cj,rjk->rck", root, rows[at])
        for c, mask in enumerate(chunk.mask.T):
            Z, u = mixed[:, c, :-1], mixed[:, c, -1]
            yield Channel(tuple(range(size)), Z, Z, u, int(mask.sum()))

    return channels


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
    def weight(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """Return the weights (0 to 1) of rows with such residuals."""

    @abstractmethod
    def slope(self, x: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
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
    """Tukey's biweight loss: constant beyond a limit, so that large residuals do not count.

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
    """Weighted least squares in which rows with large residuals count less (M-estimation).

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
        p = np.asarray(Estimate.solve(problem, weights, self.solution).parameters)
        change = np.inf
        for loss in (Huber(), self.loss):
            for _ in range(self.iterations):
                scale = _residual_scale(problem, p)
                blocks = problem.reweighted(p, loss.weight, scale)
                R, z = blocks.total.weighted(weights)
                d = Decomposition.of(R, z)
                new = d.solve(self.solution.choose(blocks, weights).inverse(d.values))
                rest = float(np.linalg.norm(z - R @ new))
                step = float(np.linalg.norm(R @ (new - p)))
                p, change = new, step / rest if rest > 0 else 0.0
                if change <= self.tolerance:
                    break
        scale = _residual_scale(problem, p)
        slopes = np.zeros(len(scale))
        for chunk, residuals in problem.residuals(p):
            slopes += np.sum(
                np.where(chunk.mask, self.loss.slope(residuals / scale), 0.0), axis=0
            )
        slope = np.maximum(slopes / np.maximum(problem.factors.rows, 1), 0.1)
        blocks = problem.reweighted(p, self.loss.weight, scale)
        solution = self.solution.choose(blocks, weights)

        def influence(chunk: RowChunk, residuals: np.ndarray) -> Iterator[Channel]:
            """Weight the residuals of each row; the equations have the mean slope of the loss."""
            felt = self.loss.weight(residuals / scale) * residuals
            joints = zip(weighted_joints(chunk, weights), slope, felt.T, strict=True)
            return (Channel(own, Z, k * Z, w * r, n) for (own, Z, w, n), k, r in joints)

        notes = ()
        if change > self.tolerance:
            notes = (
                f"the robust estimate still changed by {100 * change:.2g} % of the "
                "residuals after "
                f"{self.iterations} iterations: there are too many outliers to tell "
                "them apart.",
            )
        return dataclasses.replace(
            Estimate.solve(problem, weights * np.sqrt(slope), solution),
            parameters=p,
            weights=weights,
            blocks=blocks,
            influence=influence,
            notes=notes,
            effective_parameters=None,
        )


def _residual_scale(problem: RegressionProblem, p: np.ndarray) -> np.ndarray:
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


class InstrumentalVariables(AbstractEstimator):
    r"""Weighted least squares with the columns of a motion without noise (IDIM-IV).

    Noise of the encoders enters the regressor: least squares then see columns that are
    too large, and bias their parameters towards zero, however long the log is. With the
    columns $Z$ of the commanded motion, which has no such noise, $\hat p = (Z^T W^2
    \Theta)^{-1} Z^T W^2 Q$ has no such bias. The reference need not be followed
    exactly: it must be similar, and independent of the encoders' noise. The instruments
        are kept in memory.

    Attributes:
        references: Commanded trajectory of each recording, or one for all; or motions
            at their samples, such as simulated ones.
        weights: Weights of the joints; by default the reciprocals of the largest forces
            (Eq. 30).
        starts: Time stamps of the recordings at which the trajectories began [s], or
            one for all.
    """

    references: tuple[AbstractTrajectory | Motion, ...]
    weights: AbstractWeights = MaximumForces()
    starts: tuple[float, ...] = eqx.field(static=True, default=(0.0,))

    def __call__(self, problem):
        """Solve with the references' columns."""
        weights = self.weights(problem.robot, problem.factors)
        recordings, size = problem.recordings, problem.base.size
        given = {"references": self.references, "starts": self.starts}
        for name, values in given.items():
            if len(values) not in (1, len(recordings)):
                raise InputError(
                    f"`{name}` must hold one entry for all or each of the recordings."
                )
        each = [x * len(recordings) if len(x) == 1 else x for x in given.values()]
        triples = zip(recordings, *each, strict=True)
        instruments = [_columns(problem.base, *triple) for triple in triples]

        def influence(chunk: RowChunk, residuals: np.ndarray) -> Iterator[Channel]:
            joints = weighted_joints(chunk, weights)
            triples = zip(
                joints, instruments[chunk.recording], residuals.T, strict=True
            )
            return (
                Channel(own, w[:, None] * Z[chunk.rows], theta, w * r, count)
                for (own, theta, w, count), Z, r in triples
            )

        information, products = np.zeros((size, size)), np.zeros(size)
        for chunk, forces in problem.residuals(np.zeros(size)):
            for own, Z, theta, u, _ in influence(chunk, forces):
                information[np.ix_(own, own)] += Z.T @ theta
                products[list(own)] += Z.T @ u
        norms = np.linalg.norm(problem.factors.weighted(weights)[0], axis=0)
        scale = np.where(norms > NUMERICAL * norms.max(initial=0.0), norms, np.inf)
        scaled = np.linalg.pinv(information / scale / scale[:, None], NUMERICAL)
        inverse = scaled / scale / scale[:, None]
        return Estimate(
            base=problem.base,
            parameters=inverse @ products,
            weights=weights,
            blocks=problem.blocks,
            inverse=inverse,
            influence=influence,
        )


def _columns(
    base,
    observations: Observations,
    reference: AbstractTrajectory | Motion,
    start: float,
) -> tuple[np.ndarray, ...]:
    """Return the columns of a reference for each joint, filtered like those of the recording."""
    known = isinstance(reference, Motion)
    m = reference if known else reference.motion(np.asarray(observations.time) - start)
    motion = Motion(*(np.asarray(x, np.float64) for x in (m.q, m.qd, m.qdd)))
    source = SamplesInMemory(motion, np.zeros(motion.q.shape))
    problem = RegressionProblem(base, [observations.replace(source=source)])
    parts = [chunk.columns for chunk in problem.chunks()]
    return tuple(np.concatenate(joint) for joint in zip(*parts, strict=True))


class RelativeTo(AbstractEstimator):
    r"""Another estimator, applied to the forces that a prior does not explain.

    A regularised solution, which keeps badly determined parameters small, then keeps
    them near those of the prior instead: a ridge towards a CAD model minimises
    $\|W (Q - \Theta p)\|^2 + \lambda^2 \|D (p - p_0)\|^2$. Without regularisation
    nothing changes. For a pull of whole bodies (a Bregman divergence) see
    `PhysicallyConsistent` and `EntropicPull`.

    Attributes:
        parameters: Standard parameters of the prior, in the model's order.
        estimator: Estimator; by default weighted least squares with a cross-validated
            ridge.
    """

    parameters: Float[AnyArray, " standard"]
    estimator: AbstractEstimator = eqx.field(
        default_factory=lambda: WeightedLeastSquares(solution=CrossValidated())
    )

    def __call__(self, problem):
        """Subtract the prior's forces, estimate, and add the prior."""
        size = problem.base.model.size
        if np.shape(self.parameters) != (size,):
            raise InputError(
                f"`parameters` must be the {size} standard parameters of the model."
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

    def recording_chunks(self, number, ranges=None):
        for chunk in self._whole.recording_chunks(number, ranges):
            yield chunk._replace(forces=chunk.residuals(self._origin))


def _subtract_forces(blocks: Blocks, p: np.ndarray) -> Blocks:
    """Return the factors of the same rows with the forces of some parameters subtracted."""

    def subtracted(joint: JointFactor) -> JointFactor:
        R = np.array(joint.R)
        R[:, -1] -= R[:, :-1] @ p[list(joint.columns)]
        return dataclasses.replace(joint, R=R)

    return jax.tree.map(
        subtracted, blocks, is_leaf=lambda x: isinstance(x, JointFactor)
    )
