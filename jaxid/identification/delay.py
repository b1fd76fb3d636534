"""Delay of a log's forces against its angles, identified with the model."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import linalg, special
from scipy.interpolate import CubicSpline

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.observations import Chunk, Observations
from jaxid.measurement.recording import require_finite_delay

from .estimators import AbstractWeights, MaximumForces
from .parameter_changes import joint_test
from .problem import RegressionProblem

BLOCKS = 20
"""Blocks of time of all recordings together, from which the uncertainty is computed."""


class Delay(eqx.Module):
    """Time by which forces stand later in a log than the angles that belong to them.

    Attributes:
        seconds: Delay of all joints [s].
        standard_deviation: Standard deviation of the delay [s].
        dof: Degrees of freedom of the standard deviation.
        feedback: Largest error that disturbances can cause which the controller
            counteracts [s]; zero if the commanded motion is known.
        resolution: What no log tells [s]: a tenth of a sample, for drives hold their
            forces, and a model does not follow a filtered motion exactly.
        of_joints: Each joint's own delay [s].
        p_value: Probability that joints with one common delay would differ so much.
    """

    seconds: float
    standard_deviation: float
    dof: float
    feedback: float
    resolution: float
    of_joints: Float[AnyArray, " joints"]
    p_value: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the lower and upper limit of the delay [s], with `feedback` and `resolution`.

        Args:
            level: Probability (0 to 1) that the interval contains the true delay.
        """
        half = self.standard_deviation * float(
            special.stdtrit(self.dof, 0.5 + 0.5 * level)
        )
        half += self.feedback + self.resolution
        return self.seconds - half, self.seconds + half


def estimate_delay(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    weights: AbstractWeights | None = None,
    *,
    commanded: Observations | Sequence[Observations] | None = None,
) -> Delay:
    r"""Estimate the delay of the forces together with the base parameters.

    Forces that are late by $\tau$ are $\Theta(t - \tau) p$: the motion is shifted until
    the rate of the model's own forces explains nothing more of the residuals. Remove
    the delay by `remove_delay`, and observe again.

    Disturbances that move a controlled robot are in its forces and in its motion. With
    the commanded motion, which knows nothing of them, its regressor and rates are the
    instruments: the estimate is consistent. Without it, disturbances $d$ reach the
        forces of the motion as $S d$
    with the sensitivity $S$ of the loop, and shift the estimate by at most
    $|S|_\infty\, |d|\, |\dot d| / |r|^2$, where $r$ is what the parameters leave of the
    rate; `feedback` is that with the residuals as $d$ and $|S|_\infty = 2$.

    The deviation is that of the jackknife over blocks of time.

    Args:
        base: Base parameters of the robot.
        observations: One or several recordings with the same delay.
        weights: Weights of the joints; the reciprocals of the largest forces if None.
        commanded: The commanded motion of each recording, with its forces, filtered
            alike: the same log, read with the commanded angles in place of the measured
                ones.

    Raises:
        InputError: If weights are not known, the commanded motion has other samples, or
            the search does not settle: the delay is longer than the motion's shortest
            swings.
    """
    problem, n = RegressionProblem(base, observations), base.model.robot.joints
    recordings = instruments = problem.recordings
    if commanded is not None:
        instruments = RegressionProblem(base, commanded).recordings
        if [o.segments for o in instruments] != [o.segments for o in recordings]:
            raise InputError("`commanded` must have the samples of `observations`.")
    w = (MaximumForces() if weights is None else weights)(
        base.model.robot, problem.factors
    )
    together = linalg.block_diag(np.eye(base.size), np.ones((n, 1)))
    p, seconds, step, damping = np.zeros(base.size), 0.0, 0.0, 1.0
    # Without a delay at first.
    start = np.eye(base.size + n)[:, : base.size]
    p = _equations(base, recordings, recordings, w, p).combined(start).solve()
    for _ in range(12):
        moved = (
            [without_delay(o, seconds) for o in logs]
            for logs in (recordings, instruments)
        )
        each = _equations(base, *moved, w, p)
        common = each.combined(together)
        x, deviation = common.solve(), float(np.sqrt(common.jackknife()[-1, -1]))
        # Steps that go to and fro become shorter.
        damping *= 0.5 if x[-1] * step < 0 else 1.0
        p, step = x[:-1], damping * float(x[-1])
        seconds += step
        if abs(step) <= max(0.02 * deviation, 1e-6 * recordings[0].sample_time):
            break
    else:
        raise InputError(
            f"the delay does not settle (last change {1e3 * step:.3g} ms): crop the "
            "log to where "
            "the robot moves, and check angle columns and signs."
        )
    delays, spread = (
        each.solve()[base.size :],
        each.jackknife()[base.size :, base.size :],
    )
    contrast = np.eye(n)[1:] - np.eye(n)[:1]
    differences = contrast @ spread @ contrast.T
    p_value = joint_test(contrast @ delays, differences, BLOCKS - 1.0)[1]
    feedback = common.feedback(x) if commanded is None else 0.0
    limits = feedback, 0.1 * recordings[0].sample_time
    return Delay(
        seconds, deviation, BLOCKS - 1.0, *limits, seconds - step + delays, p_value
    )


class _Equations(NamedTuple):
    """Normal equations: sums of products over the rows, with the forces as last column."""

    products: np.ndarray  # instruments times regressor, in each block of time
    squares: np.ndarray  # regressor times regressor
    rates: np.ndarray  # rates of the regressor times rates of the regressor

    def combined(self, columns: np.ndarray) -> "_Equations":
        """Return the equations for parameters of which the present ones are combinations."""
        whole = linalg.block_diag(columns, 1.0)
        squares, rates = (whole.T @ x @ whole for x in (self.squares, self.rates))
        return _Equations(columns.T @ self.products @ whole, squares, rates)

    def solve(self, without: int | None = None) -> np.ndarray:
        """Return the parameters, from all blocks or without one of them."""
        total = self.products.sum(axis=0)
        total = total if without is None else total - self.products[without]
        scale = np.sqrt(np.diag(self.squares)[:-1])
        scale = 1.0 / np.where(scale > 0, scale, np.inf)
        A = scale[:, None] * total[:, :-1] * scale
        return scale * np.linalg.lstsq(A, scale * total[:, -1], rcond=1e-12)[0]

    def jackknife(self) -> np.ndarray:
        """Return the covariance of the parameters, from estimates without each of the blocks."""
        count = len(self.products)
        estimates = np.array([self.solve(block) for block in range(count)])
        return (count - 1) ** 2 / count * np.cov(estimates.T)

    def feedback(self, x: np.ndarray) -> float:
        """Return the largest effect of fed-back disturbances on the last parameter."""
        residual = np.append(x, -1.0)
        squares = (residual @ y @ residual for y in (self.squares, self.rates))
        size, rate = (np.sqrt(max(float(x), 0.0)) for x in squares)
        G = self.squares[:-1, :-1]
        others = np.linalg.lstsq(G[:-1, :-1], G[:-1, -1], rcond=1e-14)[0]
        left = float(G[-1, -1] - G[:-1, -1] @ others)
        # A sensible control loop amplifies disturbances twice at most.
        return 2.0 * size * rate / left if left > 0 else np.inf


def _equations(
    base: BaseParameters,
    recordings: Sequence[Observations],
    instruments: Sequence[Observations],
    w: np.ndarray,
    p: np.ndarray,
) -> _Equations:
    """Return the normal equations of the parameters and of a delay of each joint."""
    m = base.size + len(w)
    products, every = np.zeros((BLOCKS, m, m + 1)), sum(o.rows for o in recordings)
    squares, rates, done = np.zeros((m + 1, m + 1)), np.zeros((m + 1, m + 1)), 0
    for o, c in zip(recordings, instruments, strict=True):
        spacing = o.sample_time * o.decimation.factor
        for chunk in o.chunks(8192):
            first, stop = chunk.rows
            kept = np.asarray(o.mask)[first:stop, :, None]
            X = kept * _rows(base, o, chunk, w, p)
            Z = X if c is o else kept * _rows(base, c, chunk, w, p)
            blocks = (done + np.arange(first, stop)) * BLOCKS // every
            for block in np.unique(blocks):
                z, x = (y[blocks == block].reshape(-1, m + 1) for y in (Z, X))
                products[block] += z[:, :-1].T @ x
            squares += np.tensordot(X, X, ((0, 1), (0, 1)))
            change = np.diff(X, axis=0)[(kept[1:] & kept[:-1])[..., 0]] / spacing
            rates += change.T @ change
        done += o.rows
    return _Equations(products, squares, rates)


def _rows(
    base: BaseParameters, o: Observations, chunk: Chunk, w: np.ndarray, p: np.ndarray
) -> Float[np.ndarray, "rows joints columns"]:
    """Return weighted rows: base parameters, delay of each joint, forces."""
    motion, forces = o.read(slice(*chunk.samples))
    rate = np.gradient(base.forces_in_numpy(p, motion), o.sample_time, axis=0)
    n, size = len(w), base.size
    columns = np.zeros((len(rate), n, size + n + 1))
    rows = zip(base.acting_columns, base.regressor_rows(motion), strict=True)
    for joint, (own, values) in enumerate(rows):
        columns[:, joint, own] = values
        columns[:, joint, size + joint] = -rate[:, joint]
    columns[..., -1] = np.asarray(forces) - base.tool_forces(motion)
    reduced = chunk.reduce(columns.reshape(len(rate), -1))
    return w[:, None] * reduced.reshape(-1, n, size + n + 1)


def without_delay(observations: Observations, seconds: float) -> Observations:
    """Remove a delay of the forces [s], like `remove_delay`: rows near the ends are left out."""
    require_finite_delay(seconds)
    time, dt = observations.time, observations.sample_time
    lost = math.ceil(abs(seconds) / dt - 1e-9)
    edge = observations.filter.edge(dt)
    mask, instants = np.array(observations.mask), observations.instants
    given = observations.motion
    motion = Motion(*(np.array(x, np.float64) for x in (given.q, given.qd, given.qdd)))
    for (a, b), (r0, r1) in zip(
        observations.segments, observations.row_segments, strict=True
    ):
        # Beyond the ends the nearest motion is used, in rows that do not count.
        at = np.clip(time[a:b] - seconds, time[a], time[b - 1])
        for x in (motion.q, motion.qd, motion.qdd):
            x[a:b] = CubicSpline(time[a:b], x[a:b])(at)
        first, last = (a + edge + lost, b) if seconds > 0 else (a, b - edge - lost)
        rows = instants[r0:r1]
        mask[r0:r1] &= ((rows >= first) & (rows < last))[:, None]
    if not mask.any(axis=0).all():
        raise InputError(
            f"`{observations.name}` is too short for a delay of {seconds:g} s: no "
            "rows of some "
            "joint are left."
        )
    return observations.replace(motion=motion, mask=mask)
