"""Search for the amounts of mistakes, the most promising ones first."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaxid.measurement.observations import Progress

from .descriptions import DescribedLog
from .row_fits import RowFit, Rows, promise
from .suspects import Quantity

MAX_SEARCHED = 12
"""Number of quantities that are searched, the most promising ones."""
SCREENED_PROMISE = 0.03
"""Fall of the score that a column must promise for its amount to be searched."""


class Trial(NamedTuple):
    """Rows under a mistake, and the fall of the score in the fit."""

    gain: float
    sentence: str
    rows: Rows
    is_gain: bool = False


def searched_quantities(
    described_log: DescribedLog,
    quantities: Sequence[Quantity],
    progress: Progress,
) -> list[Trial]:
    """Return the best amounts of the most promising quantities."""
    judge = described_log.judge
    rows = described_log.rows
    fit = judge.fit(rows)
    # Weights from the errors of a spoilt log may hide its mistake: those from the
    # forces are tried, too.
    fits = fit, judge.weighted_fit(rows, judge.force_weights(rows))
    promises = [_promise(described_log, quantity, fits) for quantity in quantities]
    order = np.argsort(promises)[::-1][:MAX_SEARCHED]
    trials = []
    for number, k in enumerate(order):
        progress(number / len(order))
        if promises[k] > SCREENED_PROMISE:
            quantity = quantities[k]
            amount = best_amount(described_log, quantity)
            if _is_plausible(quantity, amount):
                trial_rows = quantity.rows(amount)
                gain = fit.score - judge.fit(trial_rows).score
                sentence = quantity.sentence(amount)
                trials.append(Trial(gain, sentence, trial_rows, quantity.is_gain))
    return trials


def _promise(
    described_log: DescribedLog, quantity: Quantity, fits: Sequence[RowFit]
) -> float:
    """Return the fall of the score that a small amount promises."""
    step = quantity.step
    higher_rows = quantity.rows(step)
    lower_rows = quantity.rows(-step)
    columns = (higher_rows.columns - lower_rows.columns) / (2 * step)
    forces = (higher_rows.forces - lower_rows.forces) / (2 * step)
    gains = []
    for fit in fits:
        column = (columns @ fit.parameters - forces)[..., None]
        gains.append(promise(described_log.judge, described_log.rows, fit, column))
    return max(gains)


def _is_plausible(quantity: Quantity, amount: float) -> bool:
    """Return whether an amount matters and lies within the bounds, not at them."""
    lower, upper = quantity.bounds
    margin = 0.02 * (upper - lower)
    is_inside = lower + margin < amount < upper - margin
    return is_inside and abs(amount) > quantity.min_amount


def best_amount(described_log: DescribedLog, quantity: Quantity) -> float:
    """Return the amount that leaves least."""

    def score(amount: float) -> float:
        return described_log.judge.fit(quantity.rows(amount)).score

    lower, upper = quantity.bounds
    grid = np.linspace(lower, upper, 9)
    scores = [score(amount) for amount in grid]
    best = int(np.argmin(scores))
    bracket = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    options = {"maxiter": 12, "xatol": 0.02 * quantity.step}
    result: Any = scipy.optimize.minimize_scalar(
        score, bounds=bracket, method="bounded", options=options
    )
    return float(result.x) if result.fun < scores[best] else float(grid[best])
