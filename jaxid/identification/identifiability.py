"""Combinations of parameters that a recording does not determine."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.estimators.solutions import NUMERICAL, Decomposition
from jaxid.identification.factors import Blocks

LARGEST_UNCERTAINTY = 0.1
"""Fraction of the forces by which an undetermined combination may be wrong."""


class UndeterminedDirection(eqx.Module):
    """A combination of base parameters on which the forces hardly depend.

    Attributes:
        parts: Indices of the base parameters in it, the largest first.
        shares: Their fractions, as they count in the forces; the largest is 1.
        singular_value: Singular value of the scaled observation matrix, relative to the largest.
        uncertainty: Standard deviation of the forces that the parameters of this combination make
            one by one, relative to all forces; infinite if the combination was not moved.
    """

    parts: tuple[int, ...] = eqx.field(static=True)
    shares: tuple[float, ...] = eqx.field(static=True)
    singular_value: float
    uncertainty: float

    def sentence(self, base: BaseParameters) -> str:
        """Return the combination in words, with the names of five base parameters at most."""
        names = [base.names[k] for k in self.parts]
        if len(names) == 1:
            return f"{names[0]} is not determined"
        if len(names) > 5:
            names = [*names[:4], f"{len(names) - 4} others"]
        return f"{', '.join(names[:-1])} and {names[-1]} cannot be told apart"


def undetermined(
    blocks: Blocks, weights: Float[AnyArray, " joints"], decomposition: Decomposition
) -> tuple[UndeterminedDirection, ...]:
    r"""Return the directions in which the data leave more open than they tell.

    Scale the parameters so that each of them alone makes forces of its own column's length. A step
    along a singular direction changes the forces by the singular value $s$ only. The noise along it
    is taken from how much contiguous blocks of time disagree about it, so that coloured noise and
    errors of the model count: the sum $g_k$ of residuals times the direction's forces over block
    $k$ gives the deviation $\sqrt{\sum g_k^2 K/(K-1)} / s^2$. Where parameters may thus make forces
    of a tenth of the whole recording that cancel each other, the direction is not determined.

    Args:
        blocks: Factors of contiguous blocks of time.
        weights: Weights of the joints.
        decomposition: Decomposition of the weighted observation matrix.
    """
    s, V = np.asarray(decomposition.values), np.asarray(decomposition.directions)
    size = np.hypot(np.linalg.norm(decomposition.forces), decomposition.rest)
    live = s > NUMERICAL * s.max(initial=0.0)
    inverse = np.where(live, 1.0 / np.where(live, s, 1.0) ** 2, 0.0)
    p = decomposition.solve(inverse)
    sums = np.zeros(len(s))
    for part in blocks.parts:
        R, z = part.weighted(weights)
        sums += (V @ ((R.T @ (R @ p - z)) / np.asarray(decomposition.scale))) ** 2
    count = len(blocks.parts)
    deviations = np.sqrt(sums * count / max(count - 1, 1)) * inverse
    floor = np.finfo(float).eps * size
    forces = max(size, np.finfo(float).tiny)
    uncertainty = np.where(live, np.maximum(deviations, floor) / forces, np.inf)
    return tuple(
        _direction(V[k], float(s[k] / s[0]), float(uncertainty[k]))
        for k in np.flatnonzero(uncertainty > LARGEST_UNCERTAINTY)[::-1]
    )


def _direction(
    direction: Float[AnyArray, " base"], value: float, uncertainty: float
) -> UndeterminedDirection:
    size = np.abs(direction) / np.abs(direction).max()
    # Parameters below 0.3 of the largest one are left out.
    order = [int(k) for k in np.argsort(-size, kind="stable") if size[k] >= 0.3]
    signs = np.sign(direction[order]) * np.sign(direction[order[0]])
    shares = tuple(float(x) for x in signs * size[order])
    return UndeterminedDirection(tuple(order), shares, value, uncertainty)
