"""Delay of the forces of all joints, told apart from friction of any shape.

The rate of the predicted forces is one more column beside those of bodies and friction.
Friction that a joint yields to before it slips imitates a delay of some milliseconds
unless its shape is among the columns, too, as it is in `DescribedLog`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.identification.delay import Delay
from jaxid.measurement.recording import Recording

from .descriptions import DescribedLog
from .filtered_log import FilteredLog
from .row_fits import RowFit, Rows

ROUNDS = 3
"""Steps of the search, after which a delay has settled."""
MAX_STEP = 0.03
"""Longest step of the search [s]."""
MIN_DEVIATION = 3e-4
"""Deviation that even a log without noise has [s]: columns imitate friction, no more.

Clean logs of five simulated machines with narrow intervals had delays up to 0.6 ms.
"""
RIDGE = 3e-7
"""Damping of columns of length one, for those that depend on others."""


def estimate_delay(model: Model, recordings: Recording | Sequence[Recording]) -> Delay:
    r"""Estimate the common delay of the forces of all joints, with its interval.

    Forces that are late by $\tau$ are $\Theta(t - \tau) p$. Remove the delay by
    `remove_delay` or `force_delay` in `[recording]`. If it stays, `with_unknown_delay`
    widens the intervals of a fit (`identify_logs` does so).

    Args:
        model: Model of the robot.
        recordings: One or several logs with the same delay.

    Raises:
        InputError: If the logs are too short.
    """
    if isinstance(recordings, Recording):
        recordings = (recordings,)
    log = FilteredLog(model.robot, recordings)
    if not log.is_long_enough:
        raise InputError(
            "`recordings` must hold a log of more than a second without gaps, "
            "to determine a delay: record longer."
        )
    return common_delay(DescribedLog(model, log))


def common_delay(described_log: DescribedLog) -> Delay:
    """Estimate the delay of the forces of all joints.

    Its deviation comes from the jackknife over blocks of time and from the scatter
    between the joints: a delay of one joint, or what its friction imitates, is none of
    all.
    """
    seconds = 0.0
    search = _one_round(described_log, seconds)
    for _ in range(1, ROUNDS):
        seconds += search.step
        search = _one_round(described_log, seconds)
    blocks = described_log.log.blocks
    block_deviation = _deviation_by_blocks(search.equations, blocks)
    joint_deviation = _deviation_by_joints(search.equations)
    # A search that still moves has found no delay.
    deviations = (block_deviation, joint_deviation, search.step, MIN_DEVIATION)
    deviation = float(np.linalg.norm(deviations))
    return Delay(seconds + search.step, deviation, float(blocks[-1]), search.misfit)


class _Round(NamedTuple):
    """Round of the search, with a delay that has been removed from the log."""

    equations: np.ndarray
    step: float  # delay that remains [s]
    misfit: float  # fraction of the forces that the model misses


def _one_round(described_log: DescribedLog, seconds: float) -> _Round:
    """Return what remains if a delay is removed."""
    joints = tuple(range(described_log.robot.joints))
    rows = described_log.with_earlier_forces(joints, seconds)
    fit = described_log.judge.fit(rows)
    equations = _equations(described_log, rows, fit)
    *_, remaining_delay = _solution(_products(equations))
    step = float(np.clip(remaining_delay, -MAX_STEP, MAX_STEP))
    square_misfits = fit.squares / (np.mean(rows.forces**2, axis=0) + 1e-300)
    return _Round(equations, step, float(np.sqrt(np.mean(square_misfits))))


def _equations(described_log: DescribedLog, rows: Rows, fit: RowFit) -> np.ndarray:
    """Return weighted rows of columns, rate and forces [rows, joints, columns + 2]."""
    log = described_log.log
    predicted_forces = described_log.predictions(fit.parameters)
    rates = log.rows_of(log.derivative(predicted_forces))
    columns = (rows.columns, -rates[..., None], rows.forces[..., None])
    weights = described_log.judge.mask * fit.weights
    return np.concatenate(columns, axis=2) * weights[..., None]


def _products(equations: np.ndarray) -> np.ndarray:
    """Return the sums of products of the columns of some rows."""
    flat_rows = equations.reshape(-1, equations.shape[-1])
    return flat_rows.T @ flat_rows


def _solution(products: np.ndarray) -> np.ndarray:
    """Return the least-squares solution for the last column, from sums of products."""
    matrix = products[:-1, :-1]
    lengths = np.sqrt(np.diag(matrix))
    is_zero = lengths < 1e-9 * lengths.max()
    scale = 1.0 / np.where(is_zero, np.inf, lengths)
    scaled_matrix = scale[:, None] * matrix * scale
    scaled_matrix[np.diag_indices(len(scale))] += RIDGE + is_zero
    return scale * np.linalg.solve(scaled_matrix, scale * products[:-1, -1])


def _deviation_by_blocks(equations: np.ndarray, blocks: np.ndarray) -> float:
    """Return the deviation of the delay by the jackknife over blocks of time."""
    total = _products(equations)
    delays = []
    for block in range(blocks[-1] + 1):
        products = total - _products(equations[blocks == block])
        delays.append(_solution(products)[-1])
    count = len(delays)
    # Variance over the blocks times one less than their number.
    return float(np.sqrt(count - 1) * np.std(delays))


def _deviation_by_joints(equations: np.ndarray) -> float:
    """Return the deviation of the delay by what each joint would add to it alone."""
    joints = equations.shape[1]
    if joints == 1:
        return 0.0
    products = _products(equations)
    columns = equations[..., :-2]
    rates = equations[..., -2]
    forces = equations[..., -1]
    *parameters, delay = _solution(products)
    errors = forces - columns @ np.array(parameters) - delay * rates
    # What the parameters leave of the rate.
    multiples = _solution(products[:-1, :-1])
    remainder = rates - columns @ multiples
    shares = np.sum(remainder * errors, axis=0)
    variance = joints / (joints - 1) * np.sum(shares**2)
    return float(np.sqrt(variance) / max(np.sum(remainder**2), 1e-300))
