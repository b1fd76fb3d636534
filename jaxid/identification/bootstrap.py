"""Block bootstrap: estimates from blocks of time that are drawn with replacement."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray, require_float64
from jaxid.errors import InputError
from jaxid.identification.estimators.solutions import Complete, Decomposition
from jaxid.identification.factors import Blocks
from jaxid.identification.normal_equations import RIDGE, inverse_information


def bootstrap(
    blocks: Blocks,
    weights: Float[AnyArray, " joints"],
    draws: int,
    key: PRNGKeyArray,
) -> Float[Array, "draws base"]:
    r"""Return estimates from blocks of time that are drawn with replacement.

    Blocks are drawn, not samples, because errors of neighbouring samples are correlated. The
    information of a draw is the sum of the blocks' information, each times the number of its
    occurrences; the weights stay.

    Args:
        blocks: Factors of some dozens of blocks, each longer than the correlation of the errors.
        weights: Weights of the joints' rows [1/(N m) or 1/N], such as `fit.weights`.
        draws: Number of draws.
        key: Key of the random numbers.

    Returns:
        Parameters of each draw; their covariance is that of the estimates.

    Raises:
        InputError: If there are fewer than two blocks, or draws do not determine all parameters.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a bootstrap")
    count = len(blocks.parts)
    if count < 2:
        raise InputError("`blocks` must hold at least two blocks of time, but holds one.")
    whole = Decomposition.of(*blocks.total.weighted(weights))
    start = whole.solve(Complete().inverse(whole.values))
    information, gradients = [], []
    for part in blocks.parts:
        R, z = part.weighted(weights)
        R = R / whole.scale
        information.append(R.T @ R)
        gradients.append(R.T @ (z - R @ (start * whole.scale)))
    drawn = jax.random.randint(key, (draws, count), 0, count)
    counts = np.apply_along_axis(np.bincount, 1, np.asarray(drawn), minlength=count).astype(float)
    step, condition = _steps(counts, np.array(information), np.array(gradients))
    poor = int(np.sum(~(np.asarray(condition) < 1 / np.sqrt(RIDGE))))
    if poor:
        raise InputError(
            f"{poor} of {draws} draws from {count} `blocks` do not determine all parameters: take "
            "longer blocks, in each of which every joint moves."
        )
    return start[None] + step / whole.scale[None]


@jax.jit
def _steps(counts: Array, information: Array, gradients: Array) -> tuple[Array, Array]:
    size = gradients.shape[1]
    total = (counts @ information.reshape(len(information), -1)).reshape((-1, size, size))
    inverse, condition = jax.vmap(inverse_information)(total)
    return jnp.einsum("dij,dj->di", inverse, counts @ gradients), condition
