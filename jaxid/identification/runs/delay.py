"""How late a log's forces are against its angles, found from the model itself."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from scipy import stats
from scipy.interpolate import CubicSpline

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractWeights, Complete, MaximumForces
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Blocks, RowChunk
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.runs.comparison import joint_test
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import require_finite_delay

BLOCKS = 20
"""Blocks of time of all recordings together, from which the uncertainty is found."""
PASSES = 12
"""Most passes over the data."""
SETTLED = 1e-3
"""Change, in standard deviations, below which the search ends."""
ROUNDING = 1e-9
"""Change, in sample times, below which the search ends in any case."""


class Delay(eqx.Module):
    """By how much forces stand later in a log than the angles that belong to them.

    Attributes:
        seconds: The delay of all joints [s].
        standard_deviation: Standard deviation of the delay [s].
        freedom: Degrees of freedom of the standard deviation.
        of_joints: Each joint's own delay [s].
        covariance: Covariance of the joints' own delays [s²].
        joint_names: Names of the joints.
    """

    seconds: float
    standard_deviation: float
    freedom: float
    of_joints: Float[AnyArray, " joints"]
    covariance: Float[AnyArray, "joints joints"]
    joint_names: tuple[str, ...] = eqx.field(static=True)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Lower and upper limit of the delay [s].

        Args:
            level: Share of cases in which it holds the truth, of 1.
        """
        half = self.standard_deviation * float(stats.t.ppf(0.5 + 0.5 * level, self.freedom))
        return self.seconds - half, self.seconds + half

    @property
    def alike(self) -> float:
        """Chance that joints with one common delay would differ so much, of 1."""
        d, C = np.asarray(self.of_joints), np.asarray(self.covariance)
        if len(d) < 2:
            return 1.0
        contrast = np.eye(len(d))[1:] - np.eye(len(d))[:1]
        return joint_test(contrast @ d, contrast @ C @ contrast.T, self.freedom)[1]


def estimate_delay(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    weights: AbstractWeights | None = None,
) -> Delay:
    r"""Estimates the delay of the forces together with the base parameters.

    Forces that are late by $\tau$ are $\Theta(t - \tau) p$: the motion is shifted until the rate of
    the model's own forces explains nothing more of the residuals. The rate is the model's, not that
    of the measured forces, so that noise does not pull the delay towards zero. Remove what was
    found by `remove_delay`, and observe again.

    Args:
        base: What can be identified on this robot.
        observations: One or several recordings with the same delay.
        weights: Weights of the joints; the reciprocals of the largest forces if None.

    Raises:
        InputError: If weights are not known, or the search does not settle: the delay is longer
            than the motion's shortest swings.
    """
    single = isinstance(observations, Observations)
    recordings = (observations,) if single else tuple(observations)
    n, size = base.model.robot.joints, base.size
    common = np.zeros((size + n, size + 1))
    common[:size, :size] = np.eye(size)
    common[size:, size] = 1.0
    each = -(-BLOCKS // len(recordings))
    whole = _with_delays(base, recordings, np.zeros(size), each)
    w = (MaximumForces() if weights is None else weights)(base.model.robot, whole.total)
    p, seconds = _solved(*whole.total.weighted(w))[0][:size], 0.0
    step = np.inf
    for _ in range(PASSES):
        blocks = _with_delays(base, [without_delay(o, seconds) for o in recordings], p, each)
        R, z = blocks.total.weighted(w)
        x, B = _solved(R @ common, z)
        p, step = x[:size], float(x[size])
        parts = [part.weighted(w) for part in blocks.parts]
        joint = [(rows @ common, f - rows @ common @ x) for rows, f in parts]
        covariance, freedom = block_covariance(joint, B)
        deviation = float(np.sqrt(covariance[size, size]))
        seconds += step
        if abs(step) <= max(SETTLED * deviation, ROUNDING * recordings[0].sample_time):
            break
    else:
        raise InputError(
            f"the delay does not settle (last change {1e3 * step:.3g} ms): crop the log to where "
            "the robot moves, check angle columns and signs, or remove most of the delay first."
        )
    own, B = _solved(R, z)
    covariance, _ = block_covariance([(rows, f - rows @ own) for rows, f in parts], B)
    return Delay(
        seconds=seconds,
        standard_deviation=deviation,
        freedom=freedom,
        of_joints=seconds - step + own[size:],
        covariance=covariance[size:, size:],
        joint_names=base.model.robot.joint_names,
    )


def _with_delays(
    base: BaseParameters,
    recordings: Sequence[Observations],
    p: Float[np.ndarray, " base"],
    divisions: int,
) -> Blocks:
    """Return factors with a column for the delay of each joint behind the others."""
    late = []
    for o in recordings:
        forces = base.forces_in_numpy(p, o.motion)
        dt = o.sample_time
        rates = np.concatenate([np.gradient(forces[a:b], dt, axis=0) for a, b in o.segments])
        late.append(-o.reduce(rates))

    def equations(chunk: RowChunk) -> list[np.ndarray]:
        delays = late[chunk.recording][chunk.rows]
        rows = zip(chunk.columns, delays.T, chunk.forces.T, chunk.mask.T, strict=True)
        return [np.column_stack([theta, d, force])[kept] for theta, d, force, kept in rows]

    acting = enumerate(base.acting_columns)
    columns = [(*own, base.size + j) for j, own in acting]
    problem = RegressionProblem(base, recordings, divisions=divisions)
    return problem.fold(equations, columns, base.size + len(columns))


def _solved(
    R: Float[np.ndarray, "height unknowns"], z: Float[np.ndarray, " height"]
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, "unknowns unknowns"]]:
    """The solution, and the inverse of the information."""
    decomposition = Decomposition.of(R, z)
    inverse = Complete().inverse(decomposition.values)
    return decomposition.solve(inverse), decomposition.inverse_information(inverse)


def without_delay(observations: Observations, seconds: float) -> Observations:
    """Remove a delay of the forces, like `remove_delay`: rows near the ends are left out.

    Args:
        observations: Observations whose forces are delayed.
        seconds: Delay of the forces [s]; negative if they are early.

    Raises:
        InputError: If no rows are left.
    """
    require_finite_delay(seconds)
    time, dt = observations.time, observations.sample_time
    lost = math.ceil(abs(seconds) / dt - 1e-9)
    edge = observations.filter.edge(dt)
    mask, instants = np.array(observations.mask), observations.instants
    motion = observations.motion
    parts: dict[str, list[np.ndarray]] = {"q": [], "qd": [], "qdd": []}
    for (a, b), (r0, r1) in zip(observations.segments, observations.row_segments, strict=True):
        # Beyond the ends the nearest motion is used, in rows that do not count.
        at = np.clip(time[a:b] - seconds, time[a], time[b - 1])
        for key, values in parts.items():
            x = np.asarray(getattr(motion, key), np.float64)
            values.append(CubicSpline(time[a:b], x[a:b])(at))
        rows = instants[r0:r1]
        first, last = (a + edge + lost, b) if seconds > 0 else (a, b - edge - lost)
        mask[r0:r1] &= ((rows >= first) & (rows < last))[:, None]
    if not mask.any(axis=0).all():
        raise InputError(
            f"the delay is {seconds:g} s, but `{observations.name}` lasts "
            f"{time[-1] - time[0]:g} s: no rows of some joint are left."
        )
    return observations.replace(
        motion=Motion(**{key: np.concatenate(values) for key, values in parts.items()}), mask=mask
    )
