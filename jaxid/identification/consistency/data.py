"""Weighted rows as data of a consistent estimate: all standard parameters, units of the noise."""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.consistency.cone_program import Number, Values

NOISE = 1e-3
"""Smallest noise that is believed, as a share of the forces."""


class Data(eqx.Module):
    r"""The rows $|A p - b|^2$ of all standard parameters, in units of their standard deviation.

    Attributes:
        A: Matrix.
        b: Right-hand side.
        noise: The standard deviation that is the unit.
        scale: Half the number of rows: what half the squares are about in the end.
    """

    A: Float[AnyArray, "*batch height standard"]
    b: Float[AnyArray, "*batch height"]
    noise: Number
    scale: Number


def combination(base: BaseParameters) -> Float[np.ndarray, "base standard"]:
    r"""The matrix $[I\; \kappa]$, with its columns in the order of the standard parameters."""
    C = np.zeros((base.size, base.model.size))
    C[range(base.size), base.indices] = 1.0
    C[:, list(base.dependent)] = np.asarray(base.kappa)
    return C


def whitened(
    xp: ModuleType,
    base: BaseParameters,
    R: Float[AnyArray, "height base"],
    z: Float[AnyArray, " height"],
    rows: Values | int,
) -> Data:
    """Divides a weighted triangular factor by the standard deviation of what it leaves.

    Args:
        xp: NumPy, or what JAX has in its place.
        base: Whose columns they are.
        R: Upper triangle of the weighted rows.
        z: Weighted forces, of the same decomposition.
        rows: How many rows it stands for.
    """
    left = z[base.size :]
    freedom = xp.maximum(xp.asarray(rows - base.size, float), 1.0)
    square = xp.maximum((left @ left) / freedom, NOISE**2 * (z @ z) / (freedom + base.size))
    noise = xp.sqrt(xp.where(square > 0, square, 1.0))
    return Data((R @ combination(base)) / noise, z / noise, noise, 0.5 * xp.asarray(rows, float))
