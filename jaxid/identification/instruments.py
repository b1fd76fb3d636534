"""Instrumental variables: columns of a motion without noise keep a noisy encoder from biasing."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator, Estimate
from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.problem import RegressionProblem, reduced_rows
from jaxid.identification.solutions import NUMERICAL, Complete
from jaxid.identification.weights import AbstractWeights, MaximumForces
from jaxid.measurement.observations import Observations
from jaxid.trajectory.trajectory import AbstractTrajectory


class InstrumentRows(AbstractInfluence):
    """Rows that move the estimate by the columns of another motion.

    Attributes:
        weights: Of the joints' rows [1/(N m) or 1/N].
        instruments: For each recording and joint the columns of the other motion
            [rows, columns that act on the joint].
    """

    weights: Float[AnyArray, " joints"]
    instruments: tuple[tuple[AnyArray, ...], ...]

    def channels(self, chunk, residuals):
        """One channel for each joint: its own equations, and the other motion's columns."""
        found = []
        for j, (theta, own) in enumerate(zip(chunk.columns, chunk.indices, strict=True)):
            counted = chunk.mask[:, j]
            rows = np.where(counted, np.asarray(self.weights)[j], 0.0)
            Z = rows[:, None] * np.asarray(self.instruments[chunk.recording][j])[chunk.rows]
            equations, disturbance = rows[:, None] * theta, rows * residuals[:, j]
            found.append(Channel(own, Z, equations, disturbance, int(counted.sum())))
        return found


class InstrumentalVariables(AbstractEstimator):
    r"""Weighted least squares with the columns of a motion without noise (IDIM-IV).

    Noise of the encoders is in the regressor, where filters and differences leave it: least squares
    then see columns that are too large, and pull their parameters towards zero, however long the
    log is. With the columns $Z$ of the motion that was commanded, which has no such noise,
    $\hat p = (Z^T W^2 \Theta)^{-1} Z^T W^2 Q$ has no such bias. The reference need not be followed
    exactly: it must be alike, and independent of the encoders' noise. The instruments are held in
    memory.

    Attributes:
        references: The commanded trajectory of each recording; one for all if there is one only.
        starts: Stamps of the recordings at which the trajectories began [s]; one for all if there
            is one only.
        weights: Of the joints; by default the reciprocals of the largest forces (Eq. 30).
    """

    references: tuple[AbstractTrajectory, ...]
    weights: AbstractWeights = MaximumForces()
    starts: tuple[float, ...] = eqx.field(static=True, default=(0.0,))

    def __call__(self, rows):
        """Solves with the references' columns.

        Raises:
            InputError: If only factors of the rows are known, or the number of references is wrong.
        """
        rows.require_samples("an estimate with instrumental variables")
        weights = self.weights(rows.robot, rows.factors)
        count = len(rows.recordings)
        references, starts = (
            _for(count, "references", self.references),
            _for(count, "starts", self.starts),
        )
        instruments = tuple(
            _columns(rows.base, recording, reference, start)
            for recording, reference, start in zip(rows.recordings, references, starts, strict=True)
        )
        influence = InstrumentRows(weights, instruments)
        size = rows.base.size
        information, products = np.zeros((size, size)), np.zeros(size)
        for chunk, forces in rows.residuals(np.zeros(size)):
            for own, Z, theta, u, _ in influence.channels(chunk, forces):
                information[np.ix_(own, own)] += Z.T @ theta
                products[list(own)] += Z.T @ u
        inverse = _inverse(information, rows, weights)
        return Estimate(
            base=rows.base,
            parameters=inverse @ products,
            weights=weights,
            blocks=rows.blocks,
            inverse=inverse,
            influence=influence,
            solution=Complete(),
        )


def _for(recordings: int, name: str, given: tuple) -> tuple:
    """One for each recording."""
    if len(given) not in (1, recordings):
        raise InputError(
            f"`{name}` must hold one entry, or one for each of {recordings} recordings, but holds "
            f"{len(given)}."
        )
    return given * recordings if len(given) == 1 else given


def _columns(
    base: BaseParameters, observations: Observations, reference: AbstractTrajectory, start: float
) -> tuple[np.ndarray, ...]:
    """The columns of a reference, reduced like those of the recording."""
    held = np.asarray(observations.time)
    dt = observations.sample_time
    # A log that stays on the disk does not keep its stamps, and starts at zero.
    time = held if held.any() else dt * np.arange(len(held))
    n = observations.joints

    def read(samples: slice) -> tuple[Motion, np.ndarray]:
        t = time[samples] - start
        m = reference.motion(t)
        motion = Motion(*(np.asarray(x, np.float64) for x in (m.q, m.qd, m.qdd)))
        return motion, np.zeros((len(t), n))

    parts = [columns for _, columns, _ in reduced_rows(base, observations, read=read)]
    return tuple(np.concatenate(joint) for joint in zip(*parts, strict=True))


def _inverse(information: np.ndarray, rows: RegressionProblem, weights: np.ndarray) -> np.ndarray:
    R, _ = rows.factors.weighted(weights)
    norms = np.linalg.norm(R, axis=0)
    scale = np.where(norms > NUMERICAL * norms.max(initial=0.0), norms, np.inf)
    return np.linalg.pinv(information / scale / scale[:, None], NUMERICAL) / scale / scale[:, None]
