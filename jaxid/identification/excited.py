"""Which combinations of parameters a recording does not determine."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.factors import Blocks
from jaxid.identification.solutions import NUMERICAL, Decomposition

LARGEST_UNCERTAINTY = 0.1
"""Share of the whole forces by which an undetermined combination may be wrong."""
SHOWN = 0.3
"""Parameters below this share of a direction's largest one are left out of its sentence."""

NAMED = 5
"""Most parameters that a sentence names."""


class UndeterminedDirection(eqx.Module):
    """A combination of base parameters that the forces hardly depend on.

    Attributes:
        parts: Indices of the base parameters in it, the largest first.
        shares: Their shares, as they count in the forces; the largest is 1.
        singular_value: Of the scaled observation matrix, relative to the largest.
        uncertainty: Standard deviation of the forces that this combination's parameters make one by
            one, relative to the recording's whole forces, of 1; infinite if it was not moved.
    """

    parts: tuple[int, ...] = eqx.field(static=True)
    shares: tuple[float, ...] = eqx.field(static=True)
    singular_value: float
    uncertainty: float

    def sentence(self, base: BaseParameters) -> str:
        """The combination in words, with the names of the base parameters."""
        names = [base.names[k] for k in self.parts]
        if len(names) == 1:
            return f"{names[0]} is not determined"
        if len(names) > NAMED:
            names = [*names[: NAMED - 1], f"{len(names) - NAMED + 1} others"]
        return f"{', '.join(names[:-1])} and {names[-1]} cannot be told apart"


def undetermined_directions(
    blocks: Blocks, weights: Float[AnyArray, " joints"], decomposition: Decomposition
) -> tuple[UndeterminedDirection, ...]:
    r"""Finds directions in which the data leave more open than they tell.

    Scale the parameters so that each of them alone makes forces of its own column's length. A step
    along a singular direction changes the forces by the singular value $s$ only. The noise along it
    is taken from how much contiguous blocks of time disagree about it, so that coloured noise and
    errors of the model count: the sum $g_k$ of residuals times the direction's forces over block
    $k$ gives the deviation $\sqrt{\sum g_k^2 K/(K-1)} / s^2$. Where parameters may thus make forces
    of a tenth of the whole recording that cancel each other, the direction is not determined.

    Args:
        blocks: Factors of contiguous blocks of time.
        weights: Of the joints.
        decomposition: Of the weighted observation matrix.
    """
    s, V = np.asarray(decomposition.values), np.asarray(decomposition.directions)
    size = np.hypot(np.linalg.norm(decomposition.forces), decomposition.rest)
    live = s > NUMERICAL * s.max(initial=0.0)
    inverse = np.where(live, 1.0 / np.where(live, s, 1.0) ** 2, 0.0)
    p = decomposition.solve(inverse)
    sums = np.zeros(len(s))
    for part in blocks.parts:
        R, z = part.weighted(weights)
        g = V @ ((R.T @ (R @ p - z)) / np.asarray(decomposition.scale))
        sums += g**2
    count = len(blocks.parts)
    deviations = np.sqrt(sums * count / max(count - 1, 1)) * inverse
    floor = np.finfo(float).eps * size
    whole = max(size, np.finfo(float).tiny)
    uncertainty = np.where(live, np.maximum(deviations, floor) / whole, np.inf)
    return tuple(
        _direction(V[k], float(s[k] / s[0]), float(uncertainty[k]))
        for k in np.flatnonzero(uncertainty > LARGEST_UNCERTAINTY)[::-1]
    )


def _direction(
    direction: Float[AnyArray, " base"], value: float, uncertainty: float
) -> UndeterminedDirection:
    size = np.abs(direction) / np.abs(direction).max()
    order = [int(k) for k in np.argsort(-size, kind="stable") if size[k] >= SHOWN]
    signs = np.sign(direction[order]) * np.sign(direction[order[0]])
    shares = tuple(float(x) for x in signs * size[order])
    return UndeterminedDirection(tuple(order), shares, value, uncertainty)
