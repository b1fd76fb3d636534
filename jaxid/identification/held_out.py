"""Errors on blocks of time that a fit has not seen: what choices are made by."""

from collections.abc import Iterator

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator
from jaxid.identification.factors import Blocks
from jaxid.identification.rows import Rows

FOLDS = 5


def folds(blocks: Blocks, count: int = FOLDS) -> Iterator[tuple[Blocks, Blocks]]:
    """Divides blocks of time into contiguous parts: all but one, and the one, in turn.

    Raises:
        InputError: If there are fewer than two blocks.
    """
    size = len(blocks.parts)
    if size < 2:
        raise InputError("held-out errors need at least two blocks of rows, but there is one.")
    for part in np.array_split(np.arange(size), min(count, size)):
        out = part.tolist()
        rest = tuple(b for k, b in enumerate(blocks.parts) if k not in out)
        yield Blocks(rest), Blocks(tuple(blocks.parts[k] for k in out))


def held_out_squares(
    rows: Rows, estimator: AbstractEstimator, count: int = FOLDS
) -> Float[np.ndarray, "folds joints"]:
    """Sums of the squared errors of each joint on parts that the estimate has not seen.

    Args:
        rows: Their factors are enough.
        estimator: One that needs no more than factors.
        count: Number of parts [1].

    Raises:
        InputError: If there is one block only, or the estimator needs the rows themselves.
    """
    return np.array(
        [
            part.total.residual_squares(estimator(Rows(rows.base, rest)).parameters)
            for rest, part in folds(rows.blocks, count)
        ]
    )


def weighted_error(
    squares: Float[np.ndarray, "folds joints"], rows: Rows, weights: Float[np.ndarray, " joints"]
) -> float:
    """The weighted error relative to the weighted forces, of 1."""
    w = np.asarray(weights) ** 2
    return float(np.sqrt(np.sum(squares @ w) / (rows.factors.force_squares @ w)))
