"""Delay of a log's forces against its angles, identified with the model."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from scipy import linalg, special
from scipy.interpolate import CubicSpline

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import require_finite_delay

from .estimators import AbstractWeights, MaximumForces
from .estimators.regularisation_and_weights import Decomposition
from .factors import Blocks, RowChunk
from .parameter_changes import joint_test
from .problem import RegressionProblem
from .uncertainty.blocks import solve_blocks

BLOCKS = 20
"""Blocks of time of all recordings together, from which the uncertainty is computed."""
PASSES = 12
"""Largest number of passes over the data."""


class Delay(eqx.Module):
    """Time by which forces stand later in a log than the angles that belong to them.

    Attributes:
        seconds: Delay of all joints [s].
        standard_deviation: Standard deviation of the delay [s].
        dof: Degrees of freedom of the standard deviation.
        of_joints: Each joint's own delay [s].
        p_value: Probability that joints with one common delay would differ so much.
    """

    seconds: float
    standard_deviation: float
    dof: float
    of_joints: Float[AnyArray, " joints"]
    p_value: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the lower and upper limit of the delay [s].

        Args:
            level: Probability (0 to 1) that the interval contains the true delay.
        """
        half = self.standard_deviation * float(special.stdtrit(self.dof, 0.5 + 0.5 * level))
        return self.seconds - half, self.seconds + half


def estimate_delay(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    weights: AbstractWeights | None = None,
) -> Delay:
    r"""Estimate the delay of the forces together with the base parameters.

    Forces that are late by $\tau$ are $\Theta(t - \tau) p$: the motion is shifted until the rate of
    the model's own forces explains nothing more of the residuals. The rate is the model's, not that
    of the measured forces, so that noise does not pull the delay towards zero. Remove the delay by
    `remove_delay`, and observe again.

    Args:
        base: Base parameters of the robot.
        observations: One or several recordings with the same delay.
        weights: Weights of the joints; the reciprocals of the largest forces if None.

    Raises:
        InputError: If weights are not known, or the search does not settle: the delay is longer
            than the motion's shortest swings.
    """
    recordings = RegressionProblem(base, observations).recordings
    n, size = base.model.robot.joints, base.size
    common = linalg.block_diag(np.eye(size), np.ones((n, 1)))
    total = _add_delays(base, recordings, np.zeros(size)).total
    w = (MaximumForces() if weights is None else weights)(base.model.robot, total)
    p, seconds, step = Decomposition.of(*total.weighted(w)).solve()[:size], 0.0, np.inf
    for _ in range(PASSES):
        shifted = [without_delay(o, seconds) for o in recordings]
        blocks = _add_delays(base, shifted, p)
        parts = [part.weighted(w) for part in blocks.parts]
        x, covariance, dof = solve_blocks([(R @ common, z) for R, z in parts])
        p, step, deviation = x[:size], float(x[size]), float(np.sqrt(covariance[size, size]))
        seconds += step
        if abs(step) <= max(1e-3 * deviation, 1e-9 * recordings[0].sample_time):
            break
    else:
        raise InputError(
            f"the delay does not settle (last change {1e3 * step:.3g} ms): crop the log to where "
            "the robot moves, and check angle columns and signs."
        )
    x, covariance, _ = solve_blocks(parts)
    contrast = np.eye(n)[1:] - np.eye(n)[:1]
    differences = contrast @ covariance[size:, size:] @ contrast.T
    p_value = joint_test(contrast @ x[size:], differences, dof)[1]
    return Delay(seconds, deviation, dof, seconds - step + x[size:], p_value)


def _add_delays(base: BaseParameters, recordings, p: np.ndarray) -> Blocks:
    """Return factors with a column for the delay of each joint behind the others."""
    delays = []
    for o in recordings:
        forces = base.forces_in_numpy(p, o.motion)
        rates = [np.gradient(forces[a:b], o.sample_time, axis=0) for a, b in o.segments]
        delays.append(-o.reduce(np.concatenate(rates)))

    def equations(chunk: RowChunk) -> list[np.ndarray]:
        late = delays[chunk.recording][chunk.rows]
        joints = zip(chunk.columns, late.T, chunk.forces.T, chunk.mask.T, strict=True)
        return [np.column_stack([theta, d, force])[kept] for theta, d, force, kept in joints]

    columns = [(*own, base.size + j) for j, own in enumerate(base.acting_columns)]
    problem = RegressionProblem(base, recordings, divisions=-(-BLOCKS // len(recordings)))
    return problem.fold(equations, columns, base.size + len(columns))


def without_delay(observations: Observations, seconds: float) -> Observations:
    """Remove a delay of the forces [s], like `remove_delay`: rows near the ends are left out."""
    require_finite_delay(seconds)
    time, dt = observations.time, observations.sample_time
    lost = math.ceil(abs(seconds) / dt - 1e-9)
    edge = observations.filter.edge(dt)
    mask, instants = np.array(observations.mask), observations.instants
    motion = Motion(*(np.array(x, np.float64) for x in vars(observations.motion).values()))
    for (a, b), (r0, r1) in zip(observations.segments, observations.row_segments, strict=True):
        # Beyond the ends the nearest motion is used, in rows that do not count.
        at = np.clip(time[a:b] - seconds, time[a], time[b - 1])
        for x in (motion.q, motion.qd, motion.qdd):
            x[a:b] = CubicSpline(time[a:b], x[a:b])(at)
        first, last = (a + edge + lost, b) if seconds > 0 else (a, b - edge - lost)
        rows = instants[r0:r1]
        mask[r0:r1] &= ((rows >= first) & (rows < last))[:, None]
    if not mask.any(axis=0).all():
        raise InputError(
            f"`{observations.name}` is too short for a delay of {seconds:g} s: no rows of some "
            "joint are left."
        )
    return observations.replace(motion=motion, mask=mask)
