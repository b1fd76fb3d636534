"""Instrumental variables: unbiased estimates from noisy encoders."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.estimators.estimate import (
    AbstractEstimator,
    AbstractInfluence,
    Channel,
    Estimate,
    weighted_joints,
)
from jaxid.identification.estimators.solutions import NUMERICAL
from jaxid.identification.estimators.weights import AbstractWeights, MaximumForces
from jaxid.identification.problem import RegressionProblem, reduced_rows
from jaxid.measurement.observations import Observations
from jaxid.trajectory.trajectory import AbstractTrajectory


class InstrumentRows(AbstractInfluence):
    """Influence of rows by the columns of another motion.

    Attributes:
        weights: Weights of the joints' rows [1/(N m) or 1/N].
        instruments: For each recording and joint the columns of the other motion
            [rows, columns that act on the joint].
    """

    weights: Float[AnyArray, " joints"]
    instruments: tuple[tuple[AnyArray, ...], ...]

    def channels(self, chunk, residuals):
        """Return one channel for each joint: its equations, and the other motion's columns."""
        joints = weighted_joints(chunk, self.weights)
        instruments = self.instruments[chunk.recording]
        return [
            Channel(own, w[:, None] * np.asarray(Z)[chunk.rows], theta, w * r, count)
            for (own, theta, w, count), Z, r in zip(joints, instruments, residuals.T, strict=True)
        ]


class InstrumentalVariables(AbstractEstimator):
    r"""Weighted least squares with the columns of a motion without noise (IDIM-IV).

    Noise of the encoders enters the regressor: least squares then see columns that are too large,
    and bias their parameters towards zero, however long the log is. With the columns $Z$ of the
    commanded motion, which has no such noise, $\hat p = (Z^T W^2 \Theta)^{-1} Z^T W^2 Q$ has no
    such bias. The reference need not be followed exactly: it must be similar, and independent of
    the encoders' noise. The instruments are kept in memory.

    Attributes:
        references: Commanded trajectory of each recording, or one for all.
        weights: Weights of the joints; by default the reciprocals of the largest forces (Eq. 30).
        starts: Time stamps of the recordings at which the trajectories began [s], or one for all.
    """

    references: tuple[AbstractTrajectory, ...]
    weights: AbstractWeights = MaximumForces()
    starts: tuple[float, ...] = eqx.field(static=True, default=(0.0,))

    def __call__(self, problem):
        """Solve with the references' columns.

        Raises:
            InputError: If only factors of the rows are known, or the number of references is wrong.
        """
        problem.require_samples("an estimate with instrumental variables")
        weights = self.weights(problem.robot, problem.factors)
        count = len(problem.recordings)
        references = _one_or_each("references", self.references, count)
        starts = _one_or_each("starts", self.starts, count)
        triples = zip(problem.recordings, references, starts, strict=True)
        influence = InstrumentRows(weights, tuple(_columns(problem.base, *x) for x in triples))
        size = problem.base.size
        information, products = np.zeros((size, size)), np.zeros(size)
        for chunk, forces in problem.residuals(np.zeros(size)):
            for own, Z, theta, u, _ in influence.channels(chunk, forces):
                information[np.ix_(own, own)] += Z.T @ theta
                products[list(own)] += Z.T @ u
        inverse = _pseudo_inverse(information, problem, weights)
        return Estimate(
            base=problem.base,
            parameters=inverse @ products,
            weights=weights,
            blocks=problem.blocks,
            inverse=inverse,
            influence=influence,
        )


def _one_or_each(name: str, given: tuple, recordings: int) -> tuple:
    if len(given) not in (1, recordings):
        raise InputError(
            f"`{name}` must hold one entry, or one for each of {recordings} recordings, but holds "
            f"{len(given)}."
        )
    return given * recordings if len(given) == 1 else given


def _columns(
    base: BaseParameters, observations: Observations, reference: AbstractTrajectory, start: float
) -> tuple[np.ndarray, ...]:
    """Return the columns of a reference, filtered like those of the recording."""
    time, n = np.asarray(observations.time), observations.joints

    def read(samples: slice) -> tuple[Motion, np.ndarray]:
        m = reference.motion(time[samples] - start)
        motion = Motion(*(np.asarray(x, np.float64) for x in (m.q, m.qd, m.qdd)))
        return motion, np.zeros((len(motion.q), n))

    parts = [columns for _, columns, _ in reduced_rows(base, observations, read=read)]
    return tuple(np.concatenate(joint) for joint in zip(*parts, strict=True))


def _pseudo_inverse(
    information: np.ndarray, problem: RegressionProblem, weights: np.ndarray
) -> np.ndarray:
    R, _ = problem.factors.weighted(weights)
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > NUMERICAL * norms.max(initial=0.0), norms, np.inf)
    return np.linalg.pinv(information / scale / scale[:, None], NUMERICAL) / scale / scale[:, None]
