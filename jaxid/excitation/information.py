r"""Information of a motion about the base parameters: the matrix $\Theta_B^T W^2 \Theta_B$."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.trajectory import AbstractBasis


class Information(eqx.Module):
    r"""Information of an experiment, as criteria need it.

    Attributes:
        plain: The paper's $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).
        weighted: The same in units of the noise, plus prior information; its inverse is the
            covariance of weighted least squares.
        sizes: Typical size of each parameter, in its unit.
    """

    plain: Float[AnyArray, "*batch base base"]
    weighted: Float[AnyArray, "*batch base base"]
    sizes: Float[AnyArray, " base"]


def information(
    base: BaseParameters,
    motion: Motion,
    weights: Float[AnyArray, " joints"],
    prior: Float[AnyArray, "base base"] | None = None,
    sizes: Float[AnyArray, " base"] | None = None,
) -> Information:
    """Return the information of one motion, computed in NumPy (Eq. 36).

    Args:
        base: Base parameters.
        motion: All samples that will be measured.
        weights: Inverse standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments; none if None.
        sizes: Typical size of each parameter; one if None.
    """
    plain = np.zeros((base.size, base.size))
    weighted = plain.copy() if prior is None else np.array(prior, np.float64)
    columns = base.joint_regressor.columns
    for own, theta, w in zip(
        columns, base.regressor_rows(motion), np.asarray(weights), strict=True
    ):
        gram = theta.T @ theta
        place = np.ix_(own, own)
        plain[place] += gram
        weighted[place] += w**2 * gram
    return Information(plain, weighted, np.ones(base.size) if sizes is None else sizes)


def information_map(
    base: BaseParameters,
    basis: AbstractBasis,
    *,
    samples: int,
    measured: int,
    weights: Float[AnyArray, " joints"],
    prior: Float[AnyArray, "base base"],
) -> Callable[[Float[Array, "starts joints variables"]], tuple[Array, Array]]:
    """Return a function from coefficients of many trajectories to their information matrices.

    Args:
        base: Base parameters.
        basis: Family of trajectories.
        samples: Number of samples at which motions are evaluated.
        measured: Number of measured samples for which they stand.
        weights: Inverse standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments.

    Returns:
        Function whose results are the plain and the weighted information.
    """
    rows = base.joint_regressor.for_gradients
    motion = np.asarray(basis.rows(basis.times(samples))[:3])

    def evaluate(x: Float[Array, "starts joints variables"]) -> tuple[Array, Array]:
        arrays = [jnp.einsum("sk,bjk->jbs", part, x) for part in motion]
        plain = jnp.zeros((x.shape[0], rows.size, rows.size), x.dtype)
        weighted = plain
        for own, columns, w in zip(rows.columns, rows(*arrays), weights, strict=True):
            k = np.array(own, int)
            gram = measured / samples * jnp.asarray(_gram(columns))
            plain = plain.at[:, k[:, None], k].add(gram)
            weighted = weighted.at[:, k[:, None], k].add(w**2 * gram)
        return plain, weighted + prior[None]

    return evaluate


def standard_deviations(weighted: Float[AnyArray, "base base"]) -> Float[np.ndarray, " base"]:
    """Return standard deviations from weighted information; infinite for undetermined parameters.

    Args:
        weighted: Weighted information.
    """
    weighted = np.asarray(weighted, np.float64)
    square = np.diag(weighted)
    scale = 1.0 / np.sqrt(np.where(square > 0, square, 1.0))
    values, U = np.linalg.eigh(scale[:, None] * weighted * scale[None])
    lost = values < 1e-12 * values[-1]
    variances = (U[:, ~lost] ** 2 / values[None, ~lost]).sum(axis=1)
    # A parameter is undetermined if it takes part in a direction without information.
    undetermined = (np.abs(U[:, lost]) > 1e-3).any(axis=1)
    return np.where(undetermined, np.inf, scale * np.sqrt(variances))


@jax.custom_vjp
def _gram(
    columns: Float[Array, "starts columns samples"],
) -> Float[Array, "starts columns columns"]:
    """Return products of columns; the derivative takes one product instead of two."""
    return jnp.einsum("bis,bjs->bij", columns, columns)


def _gram_forward(columns: Array) -> tuple[Array, Array]:
    return _gram(columns), columns


def _gram_backward(columns: Array, g: Array) -> tuple[Array]:
    return (jnp.einsum("bij,bjs->bis", g + jnp.swapaxes(g, 1, 2), columns),)


_gram.defvjp(_gram_forward, _gram_backward)
