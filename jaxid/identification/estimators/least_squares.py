"""Least squares: ordinary, weighted, with instruments, towards a prior."""

import dataclasses
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

from ..factors import Blocks, JointFactor, RowChunk, join_chunks
from ..problem import RegressionProblem
from .estimate import AbstractEstimator, Channel, Estimate, joint_rows
from .regularisation_and_weights import (
    MIN_SINGULAR_VALUE,
    AbstractSolution,
    AbstractWeights,
    Complete,
    CrossValidated,
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
        instruments = self._instruments(problem)
        weighted_rows = joint_rows(weights)

        def influence(chunk: RowChunk, residuals: np.ndarray) -> Iterator[Channel]:
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

    def _instruments(self, problem: RegressionProblem) -> list[list[np.ndarray]]:
        """Return the columns of each recording's reference, joint by joint."""
        recordings = problem.recordings
        count = len(recordings)
        settings = {"references": self.references, "starts": self.starts}
        for name, values in settings.items():
            if len(values) not in (1, count):
                raise InputError(
                    f"`{name}` must hold one entry for all or each of the recordings."
                )
        references = self.references * (count if len(self.references) == 1 else 1)
        starts = self.starts * (count if len(self.starts) == 1 else 1)
        return [
            _reference_columns(problem.base, recording, reference, start)
            for recording, reference, start in zip(
                recordings, references, starts, strict=True
            )
        ]


def _reference_columns(
    base: BaseParameters,
    observations: Observations,
    reference: AbstractTrajectory | Motion,
    start: float,
) -> list[np.ndarray]:
    """Return each joint's columns of a reference, filtered like the recording."""
    if not isinstance(reference, Motion):
        reference = reference.motion(np.asarray(observations.time) - start)
    motion = jax.tree.map(lambda x: np.asarray(x, np.float64), reference)
    source = SamplesInMemory(motion, np.zeros(motion.q.shape))
    problem = RegressionProblem(base, [observations.replace(source=source)])
    return join_chunks(list(problem.chunks())).columns


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
        difference = self.estimator(_ProblemWithoutPrior(problem, prior))
        origin = np.asarray(difference.base.from_standard(prior))
        standard = difference.standard
        return dataclasses.replace(
            difference,
            parameters=difference.parameters + origin,
            blocks=_subtract_forces(difference.blocks, -origin),
            standard=None if standard is None else standard + prior,
        )


class _ProblemWithoutPrior(RegressionProblem):
    """Regression problem with the forces that a prior does not explain."""

    def __init__(self, original_problem: RegressionProblem, prior: np.ndarray):
        origin = np.asarray(original_problem.base.from_standard(prior))
        blocks = _subtract_forces(original_problem.blocks, origin)
        super().__init__(
            original_problem.base,
            original_problem.recordings,
            original_problem.progress,
            blocks=blocks,
        )
        self._original = original_problem
        self._prior = prior
        self._origin = origin

    def with_base(self, base: BaseParameters) -> RegressionProblem:
        return _ProblemWithoutPrior(self._original.with_base(base), self._prior)

    def recording_chunks(self, number, ranges=None):
        for chunk in self._original.recording_chunks(number, ranges):
            yield chunk._replace(forces=chunk.residuals(self._origin))


def _subtract_forces(blocks: Blocks, p: np.ndarray) -> Blocks:
    """Return factors of the same rows, with some parameters' forces subtracted."""

    def subtract(joint: JointFactor) -> JointFactor:
        R = np.array(joint.R)
        R[:, -1] -= R[:, :-1] @ p[list(joint.columns)]
        return dataclasses.replace(joint, R=R)

    return jax.tree.map(subtract, blocks, is_leaf=lambda x: isinstance(x, JointFactor))
