"""Rows of all standard parameters, in units of the noise."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import namespace
from jaxid.dynamics.base import BaseParameters

from .pseudo_inertia import Values

MIN_NOISE = 1e-3
"""Noise below this fraction of the forces is not credible."""


class ScaledRows(NamedTuple):
    r"""Rows $|A p - b|^2$ of all standard parameters, in units of the noise.

    `scale` is half the number of rows: about half the squared residuals at the optimum.
    """

    A: Values
    b: Values
    scale: Values


def scaled_rows(base: BaseParameters, R: Values, z: Values, rows: Values) -> ScaledRows:
    """Divide a weighted triangle by the standard deviation of its residuals."""
    xp = namespace(R)
    residuals = z[base.size :]
    dof = xp.asarray(rows - base.size, float)
    dof = xp.maximum(dof, 1.0)
    force_variance = (z @ z) / (dof + base.size)
    residual_variance = (residuals @ residuals) / dof
    min_variance = MIN_NOISE**2 * force_variance
    variance = xp.maximum(residual_variance, min_variance)
    # Forces of zero have no noise to divide by.
    noise = xp.sqrt(xp.where(variance > 0, variance, 1.0))
    # Base parameters as combinations of the standard ones.
    combination = np.zeros((base.size, base.model.size))
    combination[range(base.size), base.indices] = 1.0
    combination[:, list(base.dependent)] = base.kappa
    A = (R @ combination) / noise
    return ScaledRows(A, z / noise, 0.5 * xp.asarray(rows, float))
