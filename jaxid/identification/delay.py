"""Delay of a log's forces against its angles, identified with the model."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import linalg, special
from scipy.interpolate import CubicSpline

from jaxid.arrays import Joints
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations, ObservedLogs
from jaxid.measurement.recording import require_finite_delay
from jaxid.measurement.samples import Chunk

from .estimators import AbstractWeights, MaximumForces
from .parameter_changes import equality_test
from .problem import RegressionProblem

BLOCKS = 20
"""Blocks of time of all recordings together, from which the uncertainty is computed."""
MAX_ROUNDS = 12
SAMPLES_PER_CHUNK = 8192
RESOLUTION = 0.1
"""Error that no log shows, in samples."""
MAX_SENSITIVITY = 2.0
"""How much a sensible control loop amplifies disturbances at most."""


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
    of_joints: Joints
    p_value: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the limits of the delay [s], with `feedback` and `resolution`.

        Args:
            level: Probability (0 to 1) that the interval contains the true delay.
        """
        quantile = float(special.stdtrit(self.dof, 0.5 + 0.5 * level))
        half_width = quantile * self.standard_deviation
        half_width += self.feedback + self.resolution
        return self.seconds - half_width, self.seconds + half_width


def estimate_delay(
    base: BaseParameters,
    observations: ObservedLogs,
    weights: AbstractWeights | None = None,
    *,
    commanded: ObservedLogs | None = None,
) -> Delay:
    r"""Estimate the delay of the forces together with the base parameters.

    Forces that are late by $\tau$ are $\Theta(t - \tau) p$: the motion is shifted until
    the rate of the model's own forces explains nothing more of the residuals. Remove
    the delay by `remove_delay`, and observe again.

    Disturbances that move a controlled robot are in its forces and in its motion. With
    the commanded motion, which knows nothing of them, its regressor and rates are the
    instruments: the estimate is consistent. Without it, disturbances $d$ reach the
    forces of the motion as $S d$ with the sensitivity $S$ of the loop, and shift the
    estimate by at most $|S|_\infty\, |d|\, |\dot d| / |r|^2$, where $r$ is what the
    parameters leave of the rate; `feedback` is that with the residuals as $d$ and
    $|S|_\infty = 2$.

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
    problem = RegressionProblem(base, observations)
    recordings = problem.recordings
    instruments = None
    if commanded is not None:
        instruments = RegressionProblem(base, commanded).recordings
        if [o.segments for o in instruments] != [o.segments for o in recordings]:
            raise InputError("`commanded` must have the samples of `observations`.")
    weights = weights or MaximumForces()
    joint_weights = weights(base.model.robot, problem.factors)
    search = _search(base, recordings, instruments, joint_weights)
    each_delay = search.each_delay
    delays = each_delay.solve()[base.size :]
    covariance = each_delay.jackknife()[base.size :, base.size :]
    _, p_value = equality_test(delays[:, None], covariance, BLOCKS - 1.0)
    feedback = 0.0
    if commanded is None:
        feedback = search.one_delay.feedback(search.solution)
    return Delay(
        seconds=search.seconds + search.step,
        standard_deviation=search.deviation,
        dof=BLOCKS - 1.0,
        feedback=feedback,
        resolution=RESOLUTION * recordings[0].sample_time,
        of_joints=search.seconds + delays,
        p_value=p_value,
    )


class _Search(NamedTuple):
    """Last round of the search for the delay."""

    seconds: float  # delay that has been removed from the motions
    step: float  # delay that remains
    deviation: float
    solution: np.ndarray  # base parameters, remaining delay
    one_delay: "_Equations"  # of a delay of all joints
    each_delay: "_Equations"  # of a delay of each joint


def _search(
    base: BaseParameters,
    recordings: Sequence[Observations],
    instruments: Sequence[Observations] | None,
    joint_weights: np.ndarray,
) -> _Search:
    """Shift the motions until the rates of the forces explain nothing more."""
    joints = len(joint_weights)
    map_without_delay = np.eye(base.size + joints)[:, : base.size]
    common_delay_map = linalg.block_diag(np.eye(base.size), np.ones((joints, 1)))
    start = _equations(base, recordings, recordings, joint_weights, np.zeros(base.size))
    p = start.combine(map_without_delay).solve()
    seconds = 0.0
    step = 0.0
    damping = 1.0
    for _ in range(MAX_ROUNDS):
        seconds += step
        shifted_logs = [without_delay(o, seconds) for o in recordings]
        shifted_instruments = shifted_logs
        if instruments is not None:
            shifted_instruments = [without_delay(o, seconds) for o in instruments]
        each_delay = _equations(
            base, shifted_logs, shifted_instruments, joint_weights, p
        )
        one_delay = each_delay.combine(np.asarray(common_delay_map))
        solution = one_delay.solve()
        deviation = float(np.sqrt(one_delay.jackknife()[-1, -1]))
        if solution[-1] * step < 0:
            # Steps that go to and fro become shorter.
            damping *= 0.5
        p = solution[:-1]
        step = damping * float(solution[-1])
        if abs(step) <= max(0.02 * deviation, 1e-6 * recordings[0].sample_time):
            return _Search(seconds, step, deviation, solution, one_delay, each_delay)
    raise InputError(
        f"the delay does not settle (last change {1e3 * step:.3g} ms): crop the log to "
        "where the robot moves, and check angle columns and signs."
    )


class _Equations(NamedTuple):
    """Normal equations: sums of products over rows, with forces as the last column."""

    products: np.ndarray  # instruments times regressor, in each block of time
    squares: np.ndarray  # regressor times regressor
    rates: np.ndarray  # rates of the regressor times rates of the regressor

    def combine(self, columns: np.ndarray) -> "_Equations":
        """Return equations for parameters that the present ones combine."""
        extended_columns = np.asarray(linalg.block_diag(columns, 1.0))
        return _Equations(
            products=columns.T @ self.products @ extended_columns,
            squares=extended_columns.T @ self.squares @ extended_columns,
            rates=extended_columns.T @ self.rates @ extended_columns,
        )

    def solve(self, without: int | None = None) -> np.ndarray:
        """Return the parameters, from all blocks or without one of them."""
        products = self.products.sum(axis=0)
        if without is not None:
            products = products - self.products[without]
        lengths = np.sqrt(np.diag(self.squares)[:-1])
        scale = 1.0 / np.where(lengths > 0, lengths, np.inf)
        A = scale[:, None] * products[:, :-1] * scale
        b = scale * products[:, -1]
        solution, *_ = np.linalg.lstsq(A, b, rcond=1e-12)
        return scale * solution

    def jackknife(self) -> np.ndarray:
        """Return the parameters' covariance from estimates without each block."""
        count = len(self.products)
        estimates = np.array([self.solve(block) for block in range(count)])
        # `cov` divides by one less than the count; the jackknife multiplies by that.
        return (count - 1) ** 2 / count * np.cov(estimates.T)

    def feedback(self, parameters: np.ndarray) -> float:
        """Return the largest effect of fed-back disturbances on the last parameter."""
        residual = np.append(parameters, -1.0)
        residual_square = max(residual @ self.squares @ residual, 0.0)
        rate_square = max(residual @ self.rates @ residual, 0.0)
        disturbances = np.sqrt(residual_square) * np.sqrt(rate_square)
        # What the other parameters leave of the rate, whose column is the last but one.
        gram = self.squares[:-2, :-2]
        products = self.squares[:-2, -2]
        multiples, *_ = np.linalg.lstsq(gram, products, rcond=1e-14)
        remainder = float(self.squares[-2, -2] - products @ multiples)
        if remainder <= 0:
            return np.inf
        return float(MAX_SENSITIVITY * disturbances / remainder)


def _equations(
    base: BaseParameters,
    recordings: Sequence[Observations],
    instruments: Sequence[Observations],
    joint_weights,
    p,
) -> _Equations:
    """Return the normal equations of the parameters and of a delay of each joint."""
    size = base.size + len(joint_weights) + 1
    products = np.zeros((BLOCKS, size - 1, size))
    squares = np.zeros((size, size))
    rates = np.zeros((size, size))
    total_rows = sum(log.rows for log in recordings)
    first_row = 0
    for log, instrument in zip(recordings, instruments, strict=True):
        spacing = log.sample_time * log.decimation.factor
        for chunk in log.chunks(SAMPLES_PER_CHUNK):
            rows = np.arange(*chunk.rows)
            mask = np.asarray(log.mask)[rows]
            X = _rows(base, log, chunk, joint_weights, p)
            X[~mask] = 0.0
            Z = X
            if instrument is not log:
                Z = _rows(base, instrument, chunk, joint_weights, p)
            blocks = (first_row + rows) * BLOCKS // total_rows
            for block in np.unique(blocks):
                is_inside = blocks == block
                # Rows that do not count are zero in one of both factors.
                x = X[is_inside].reshape(-1, size)
                z = Z[is_inside].reshape(-1, size)
                products[block] += z[:, :-1].T @ x
            squares += np.tensordot(X, X, ((0, 1), (0, 1)))
            # Rates need two rows in sequence.
            is_pair = mask[1:] & mask[:-1]
            changes = np.diff(X, axis=0)
            x_rates = changes[is_pair] / spacing
            rates += x_rates.T @ x_rates
        first_row += log.rows
    return _Equations(products, squares, rates)


def _rows(base: BaseParameters, log: Observations, chunk: Chunk, joint_weights, p):
    """Return weighted rows: base parameters, delay of each joint, forces."""
    motion, forces = log.read(slice(*chunk.samples))
    predictions = base.forces_in_numpy(p, motion)
    # A delay adds the rate of the forces times it, and filters act on both alike.
    rates = np.gradient(predictions, log.sample_time, axis=0)
    samples = len(rates)
    joints = len(joint_weights)
    width = base.size + joints + 1
    columns = np.zeros((samples, joints, width))
    for joint, values in enumerate(base.regressor_rows(motion)):
        parameters = list(base.acting_columns[joint])
        columns[:, joint, parameters] = values
        delay_column = base.size + joint
        columns[:, joint, delay_column] = -rates[:, joint]
    columns[..., -1] = np.asarray(forces) - base.tool_forces(motion)
    flat_columns = columns.reshape(samples, -1)
    rows = chunk.reduce(flat_columns).reshape(-1, joints, width)
    return joint_weights[:, None] * rows


def without_delay(observations: Observations, seconds: float) -> Observations:
    """Remove a delay of forces [s], like `remove_delay`; end rows are left out."""
    require_finite_delay(seconds)
    time = observations.time
    dt = observations.sample_time
    # Whole samples that the shift reaches over; rounding does not make one more.
    samples = math.ceil(abs(seconds) / dt - 1e-9)
    edge = observations.filter.edge(dt)
    instants = observations.instants
    is_counted = np.zeros(len(instants), bool)
    source = observations.motion
    channels = [np.array(x, np.float64) for x in (source.q, source.qd, source.qdd)]
    for a, b in observations.segments:
        # Beyond the ends the nearest motion is used, in rows that do not count.
        times = np.clip(time[a:b] - seconds, time[a], time[b - 1])
        for channel in channels:
            channel[a:b] = CubicSpline(time[a:b], channel[a:b])(times)
        start = a + edge + samples if seconds > 0 else a
        stop = b if seconds > 0 else b - edge - samples
        is_counted |= (instants >= start) & (instants < stop)
    mask = np.asarray(observations.mask) & is_counted[:, None]
    if not mask.any(axis=0).all():
        raise InputError(
            f"`{observations.name}` is too short for a delay of {seconds:g} s: "
            "no rows of some joint are left."
        )
    return observations.replace(motion=Motion(*channels), mask=mask)
