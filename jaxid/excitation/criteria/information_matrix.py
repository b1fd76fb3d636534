"""Information of a motion about the base parameters (Eq. 36)."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, namespace
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed_regressor import JointRegressor

BaseVector = Float[AnyArray, " base"]
"""One number for each base parameter."""
BaseMatrix = Float[AnyArray, "base base"]
JointVector = Float[AnyArray, " joints"]

RANK_TOLERANCE = 1e-12
"""Relative eigenvalue below which a direction has no information."""
MIN_SHARE = 1e-3
"""Component in such a direction above which a parameter takes part in it."""


class Information(eqx.Module):
    r"""Information of an experiment, as criteria need it.

    Attributes:
        plain: The paper's $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).
        weighted: The same in units of the noise, $\Theta_B^T W^2 \Theta_B$, plus prior
            information; its inverse is the covariance of weighted least squares.
        sizes: Typical size of each parameter, in its unit.
    """

    plain: Float[AnyArray, "*batch base base"]
    weighted: Float[AnyArray, "*batch base base"]
    sizes: BaseVector


def information(
    base: BaseParameters,
    motion: Motion,
    weights: JointVector,
    prior: BaseMatrix | None = None,
    sizes: BaseVector | None = None,
) -> Information:
    """Return the information of one motion, computed in NumPy (Eq. 36).

    Args:
        base: Base parameters.
        motion: All samples that will be measured.
        weights: Inverse standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments; none if None.
        sizes: Typical size of each parameter; one if None.
    """
    columns = [rows.T[None] for rows in base.regressor_rows(motion)]
    plain_matrices, weighted_matrices = gram_matrices(
        base.joint_regressor, columns, weights
    )
    prior_matrix = 0.0 if prior is None else np.asarray(prior)
    typical_sizes = np.ones(base.size) if sizes is None else sizes
    return Information(
        plain_matrices[0], weighted_matrices[0] + prior_matrix, typical_sizes
    )


def gram_matrices(
    regressor: JointRegressor,
    columns: Sequence[AnyArray],
    weights: JointVector,
) -> tuple[Any, Any]:
    r"""Return $\Theta_B^T \Theta_B$ and $\Theta_B^T W^2 \Theta_B$ of some motions.

    Args:
        regressor: Base regressor.
        columns: Its columns for each joint [motions, columns, samples], in NumPy or
            JAX.
        weights: Inverse standard deviation of each joint's noise [1/(N m) or 1/N].
    """
    plain_matrices = 0.0
    weighted_matrices = 0.0
    xp = namespace(*columns)
    for numbers, rows, weight in zip(regressor.columns, columns, weights, strict=True):
        gram = xp.pad(rows @ rows.swapaxes(1, 2), ((0, 0), (0, 1), (0, 1)))
        # Parameters that do not act on the joint take the zeros at the end.
        places = np.full(regressor.size, len(numbers))
        places[list(numbers)] = np.arange(len(numbers))
        gram = gram[:, places[:, None], places]
        plain_matrices = plain_matrices + gram
        weighted_matrices = weighted_matrices + weight**2 * gram
    return plain_matrices, weighted_matrices


def standard_deviations(
    weighted: BaseMatrix,
) -> np.ndarray:
    """Return standard deviations from information; infinite where undetermined."""
    matrix, scale = scale_to_unit_diagonal(np.asarray(weighted, np.float64))
    eigenvalues, directions = np.linalg.eigh(matrix)
    has_information = eigenvalues >= RANK_TOLERANCE * eigenvalues[-1]
    variances = 1.0 / eigenvalues[has_information]
    squares = directions[:, has_information] ** 2
    deviations = scale * np.sqrt(squares @ variances)

    # A parameter is undetermined if it takes part in a direction without information.
    shares = np.abs(directions[:, ~has_information])
    is_undetermined = (shares > MIN_SHARE).any(axis=1)
    return np.where(is_undetermined, np.inf, deviations)


def scale_to_unit_diagonal(matrix: AnyArray) -> tuple[Any, Any]:
    """Return the matrix with a unit diagonal, and the factor of each row."""
    xp = namespace(matrix)
    diagonal = xp.diagonal(matrix)
    scale = 1.0 / xp.sqrt(xp.where(diagonal > 0, diagonal, 1.0))
    return scale[:, None] * matrix * scale[None], scale
