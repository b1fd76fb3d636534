"""Which combinations of parameters a recording does not determine."""

import equinox as eqx
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.solutions import NUMERICAL, Decomposition
from jaxid.types import AnyArray, Float

SHOWN = 0.2
"""Parameters below this share of a direction's largest one are left out of its sentence."""


class UndeterminedDirection(eqx.Module):
    """A combination of base parameters that the forces hardly depend on.

    Attributes:
        parts: Indices of the base parameters in it, the largest first.
        shares: Their shares, as they count in the forces; the largest is 1.
        singular_value: Of the scaled observation matrix, relative to the largest.
        uncertainty: Standard deviation of this combination's forces, were its size the recording's
            whole forces: 1 means that nothing is known about it.
    """

    parts: tuple[int, ...] = eqx.field(static=True)
    shares: tuple[float, ...] = eqx.field(static=True)
    singular_value: float
    uncertainty: float

    def sentence(self, base: BaseParameters) -> str:
        """The combination in words, with the names of the base parameters."""
        names = [base.names[k] for k in self.parts]
        if len(names) == 1:
            return f"{names[0]} is not determined."
        return f"{' and '.join([', '.join(names[:-1]), names[-1]])} are not determined one by one."


def undetermined_directions(
    decomposition: Decomposition, forces_norm: float, rows: int, largest_uncertainty: float
) -> tuple[UndeterminedDirection, ...]:
    """Finds directions in which the data leave more open than they tell.

    Scale the parameters so that each one alone makes forces of its own column's length. A unit step
    along a singular direction changes the forces by its singular value; the noise lets such a step
    be as large as the residual's standard deviation over that value. Where this exceeds a share of
    what would explain the whole recording, the data do not determine the direction.

    Args:
        decomposition: Of the weighted observation matrix with scaled columns.
        forces_norm: Norm of the weighted forces.
        rows: Number of rows.
        largest_uncertainty: The share, of 1.
    """
    s = np.asarray(decomposition.values)
    freedom = max(rows - len(s), 1)
    noise = max(decomposition.rest / np.sqrt(freedom), np.finfo(float).eps * forces_norm)
    found = []
    for value, direction in zip(s, np.asarray(decomposition.directions), strict=True):
        tiny = value <= NUMERICAL * s[0]
        uncertainty = np.inf if tiny else noise / (value * forces_norm)
        if tiny or uncertainty > largest_uncertainty:
            found.append(_direction(direction, float(value / s[0]), float(uncertainty)))
    return tuple(found)


def _direction(
    direction: Float[AnyArray, " base"], value: float, uncertainty: float
) -> UndeterminedDirection:
    size = np.abs(direction) / np.abs(direction).max()
    order = [int(k) for k in np.argsort(-size, kind="stable") if size[k] >= SHOWN]
    signs = np.sign(direction[order]) * np.sign(direction[order[0]])
    shares = tuple(float(x) for x in signs * size[order])
    return UndeterminedDirection(tuple(order), shares, value, uncertainty)
