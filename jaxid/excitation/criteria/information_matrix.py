"""Information of a motion about the base parameters (Eq. 36)."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, namespace
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.trajectory import AbstractBasis

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
    shape = (base.size, base.size)
    plain = np.zeros(shape)
    weighted = np.zeros(shape) if prior is None else np.array(prior, np.float64)
    rows_by_joint = base.regressor_rows(motion)
    joints = zip(base.acting_columns, rows_by_joint, np.asarray(weights), strict=True)
    for columns, rows, weight in joints:
        gram = rows.T @ rows
        place = np.ix_(columns, columns)
        plain[place] += gram
        weighted[place] += weight**2 * gram
    return Information(plain, weighted, np.ones(base.size) if sizes is None else sizes)


def information_of_coefficients(
    base: BaseParameters,
    basis: AbstractBasis,
    x: Float[AnyArray, "starts joints variables"],
    *,
    samples: int,
    measured: int,
    weights: JointVector,
    prior: BaseMatrix,
    sizes: BaseVector,
) -> Information:
    """Return the information of many trajectories, in JAX (Eq. 36).

    Motions are evaluated at `samples`, which stand for those that are `measured`.
    """
    regressor = base.joint_regressor
    rows = np.asarray(basis.rows(basis.times(samples)))
    q, qd, qdd = (jnp.einsum("sk,bjk->jbs", part, x) for part in rows[:3])
    columns_by_joint = regressor(q, qd, qdd)

    starts = x.shape[0]
    plain = jnp.zeros((starts, base.size, base.size), x.dtype)
    weighted = plain
    for joint, columns in enumerate(columns_by_joint):
        numbers = regressor.columns[joint]
        place = np.ix_(numbers, numbers)
        products = jnp.einsum("bis,bjs->bij", columns, columns)
        gram = measured / samples * products
        plain = plain.at[:, *place].add(gram)
        weighted = weighted.at[:, *place].add(weights[joint] ** 2 * gram)
    return Information(plain, weighted + prior[None], sizes)


def standard_deviations(
    weighted: BaseMatrix,
) -> Float[np.ndarray, " base"]:
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
