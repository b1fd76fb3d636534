"""Combinations of parameters that logs leave open."""

import numpy as np
import scipy

from jaxid.arrays import Joints, Matrix
from jaxid.dynamics.open_directions import UndeterminedDirection, open_directions

from .estimators.regularisation_and_weights import Complete, Decomposition
from .factors import Blocks


def undetermined(
    blocks: Blocks, weights: Joints, decomposition: Decomposition, rows: Matrix
) -> tuple[UndeterminedDirection, ...]:
    """Return the combinations of parameters that observations leave open.

    Each singular direction of the observations is judged by the forces that its 95 %
    interval makes on other motions: a log says little of what it has not moved, however
    well it fits.

    Args:
        blocks: Factors of the observations by contiguous blocks of time.
        weights: Weights of the joints.
        decomposition: Decomposition of the weighted observations.
        rows: Rows of other motions, as `random_rows` returns them.
    """
    half_widths = _half_widths(blocks, weights, decomposition)
    return open_directions(
        decomposition.directions,
        decomposition.scale,
        decomposition.values,
        half_widths,
        rows,
    )


def _half_widths(
    blocks: Blocks, weights: Joints, decomposition: Decomposition
) -> np.ndarray:
    r"""Return half the 95 % intervals of the singular directions' coefficients.

    The noise along a direction is taken from how much contiguous blocks of time
    disagree about it, so that coloured noise and errors of the model count: the sum
    $g_k$ of residuals times the direction's forces over block $k$ gives the deviation
    $\sqrt{\sum g_k^2 K/(K-1)} / s^2$ of its coefficient, where $s$ is the singular
    value. It is infinite where only rounding is left of a direction.
    """
    values = decomposition.values
    p = decomposition.solve()
    squares = np.zeros(len(values))
    for part in blocks.parts:
        R, z = part.weighted(weights)
        gradient = R.T @ (R @ p - z) / decomposition.scale
        squares += (decomposition.directions @ gradient) ** 2
    count = len(blocks.parts)
    freedom = max(count - 1, 1)
    inverse = Complete().inverse(values)
    deviations = np.sqrt(squares * count / freedom) * inverse
    force_norm = np.hypot(np.linalg.norm(decomposition.forces), decomposition.rest)
    rounding = np.finfo(float).eps * force_norm
    half_widths = scipy.special.stdtrit(freedom, 0.975) * np.maximum(
        deviations, rounding
    )
    return np.where(inverse == 0, np.inf, half_widths)
