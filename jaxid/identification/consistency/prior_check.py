"""Bodies of a file as a prior: tested against the logs, bounded, and their strength.

The pull towards a body grows without bounds as the prior's body shrinks: a placeholder
of one gram would rule the estimate. The prior is therefore a mixture with the bodies
that the logs alone tell, which bounds the pull, and blocks of the logs decide how much
it is worth.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Joints, Texts, Vector

from ..factors import Factors
from ..problem import RegressionProblem, cross_validation_folds
from .bounds_and_priors import WEAK_PULL, EntropicPull

Solve = Callable[[Factors, EntropicPull], Vector]
"""Function from factors and a pull to standard parameters."""

STRENGTHS = (WEAK_PULL, 10.0)
"""Strengths of the pull from which the logs choose.

With 100, placeholders of a gram made unseen errors of two simulated arms 15 % larger.
"""
FITTED_SHARE = 0.1
"""Share of the bodies that the logs tell in the prior.

With 3 to 30 %, placeholders raise residuals by at most 0.3 % on four simulated machines
(palletiser, lightweight arm, gantry, two arms in `benchmarks/judgement/machines.py`).
"""
MAX_GROWTH = 1.04
"""Largest ratio of squared residuals on unseen blocks to those with balls."""


class ChosenPull(NamedTuple):
    """Pull that the logs bear, None for none, and sentences for the user."""

    pull: EntropicPull | None
    notes: Texts


def choose_pull(
    rows: RegressionProblem,
    weights: Joints,
    columns: np.ndarray,
    bodies: AnyArray,
    solve: Solve,
) -> ChosenPull:
    """Return the pull towards a file's bodies that the logs bear.

    Its strength is the one whose estimate predicts blocks of the logs best that it has
    not seen. If that is worse than an estimate with balls, these are the prior.

    Args:
        rows: Regression problem.
        weights: Weights of the joints.
        columns: Columns of each body [bodies, width].
        bodies: Parameters of the file's bodies [bodies, 10].
        solve: Function from factors and a pull to standard parameters.
    """
    balls = EntropicPull(None, WEAK_PULL)
    fitted_bodies = solve(rows.factors, balls)[columns]
    mixture = (1.0 - FITTED_SHARE) * np.asarray(bodies)
    mixture[:, : columns.shape[1]] += FITTED_SHARE * fitted_bodies
    pulls = [EntropicPull(mixture, strength) for strength in STRENGTHS]
    ball_square, *squares = _unseen_squares(rows, weights, solve, [balls, *pulls])
    if min(squares) > MAX_GROWTH * ball_square:
        note = (
            "the bodies of the robot's file are not used as a prior: with them, "
            "predictions of unseen parts of the logs are worse."
        )
        return ChosenPull(balls, (note,))
    return ChosenPull(pulls[int(np.argmin(squares))], ())


def _unseen_squares(
    rows: RegressionProblem, weights: Joints, solve: Solve, pulls: list[EntropicPull]
) -> Vector:
    """Return each pull's squared residuals on blocks that are left out in turn."""
    squares = np.zeros(len(pulls))
    for other_blocks, part in cross_validation_folds(rows.blocks):
        training_factors = rows.blocks.select(other_blocks).total
        test_factors = rows.blocks.select(part).total
        for k, pull in enumerate(pulls):
            p = rows.base.from_standard(solve(training_factors, pull))
            residual_squares = test_factors.residual_squares(np.asarray(p))
            squares[k] += weights**2 @ residual_squares
    return squares
