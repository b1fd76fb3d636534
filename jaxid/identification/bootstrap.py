"""Bootstrap over blocks of time, by their products of rows."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray, require_float64
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks
from jaxid.identification.normal_equations import RIDGE, inverse_information
from jaxid.identification.solutions import Complete, Decomposition


def bootstrap(
    blocks: Blocks,
    weights: Float[AnyArray, " joints"],
    draws: int,
    key: PRNGKeyArray,
) -> Float[Array, "draws base"]:
    r"""Estimates from blocks of time that are drawn with replacement.

    Blocks are drawn, not samples: neighbouring samples have neighbouring errors. A draw counts how
    often each block occurs, and its information is the counts times the blocks' products of rows;
    no row is seen again. The weights stay.

    Args:
        blocks: Factors of blocks of time: some dozens, each longer than the errors remember.
        weights: Of the joints' rows [1/(N m) or 1/N], such as `fit.weights`.
        draws: Number of draws.
        key: Of the random numbers.

    Returns:
        The parameters of each draw; their covariance is that of the estimates.

    Raises:
        InputError: If there are fewer than two blocks, or draws do not determine all parameters.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a bootstrap")
    count = len(blocks.parts)
    if count < 2:
        raise InputError("`blocks` must hold at least two blocks of time, but holds one.")
    p = Decomposition.of(*blocks.total.weighted(weights))
    start = p.solve(Complete().inverse(p.values))
    information, gradients = [], []
    for part in blocks.parts:
        R, z = part.weighted(weights)
        R = R / p.scale
        information.append(R.T @ R)
        gradients.append(R.T @ (z - R @ (start * p.scale)))
    drawn = jax.random.randint(key, (draws, count), 0, count)
    counts = np.apply_along_axis(np.bincount, 1, np.asarray(drawn), minlength=count).astype(float)
    step, condition = _steps(counts, np.array(information), np.array(gradients))
    poor = int(np.sum(~(np.asarray(condition) < 1 / np.sqrt(RIDGE))))
    if poor:
        raise InputError(
            f"{poor} of {draws} draws from {count} blocks do not determine all parameters: take "
            "longer blocks, in each of which every joint moves."
        )
    return start[None] + step / p.scale[None]


@jax.jit
def _steps(counts: Array, information: Array, gradients: Array) -> tuple[Array, Array]:
    size = gradients.shape[1]
    whole = (counts @ information.reshape(len(information), -1)).reshape((-1, size, size))
    inverse, condition = jax.vmap(inverse_information)(whole)
    return jnp.einsum("dij,dj->di", inverse, counts @ gradients), condition
