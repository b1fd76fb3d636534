"""Uncertainty from contiguous blocks of time: jackknife and bootstrap."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray, require_float64
from jaxid.errors import InputError

from ..estimators.estimate import Estimate
from ..estimators.regularisation_and_weights import (
    RIDGE,
    Decomposition,
    inverse_information,
)
from ..factors import Blocks
from .result import AbstractUncertainty, Uncertainty

Block = tuple[Float[np.ndarray, "_ unknowns"], Float[np.ndarray, " _"]]
"""Derivatives of a block's weighted residuals by the unknowns, and the residuals."""


class BlockJackknife(AbstractUncertainty):
    """Block jackknife: scatter of estimates without one block of time each.

    It needs only factors of blocks, and allows any correlation of errors within blocks
    and between joints. Ten blocks give rough values. Correlations between parameters
    are those of the naive covariance.
    """

    def __call__(self, problem, estimate, naive):
        """Return the jackknife; with a single block the naive covariance."""
        deviations = jackknife(estimate)
        if deviations is None:
            note = (
                "standard deviations assume independent rows, and are too small where "
                "errors of "
                "neighbouring rows are correlated: there is only one block of time."
            )
            dof = np.full(len(naive), np.inf)
            return Uncertainty(naive, dof, naive, None, (note,)), None
        size = np.sqrt(np.diag(naive))
        known = np.isfinite(size) & (size > 0)
        ratio = np.divide(deviations, size, out=np.zeros_like(size), where=known)
        covariance = np.where(np.isfinite(naive), naive, 0.0) * ratio * ratio[:, None]
        unknown = np.isinf(size)
        covariance[unknown, unknown] = np.inf
        dof = np.full(len(naive), float(len(estimate.blocks.parts) - 1))
        return Uncertainty(covariance, dof, naive, deviations), None


def jackknife(estimate: Estimate) -> Float[np.ndarray, " base"] | None:
    """Return standard deviations by the block jackknife; None for a single block of time."""
    if len(estimate.blocks.parts) < 2:
        return None
    parts = [part.weighted(estimate.weights) for part in estimate.blocks.parts]
    p = np.asarray(estimate.parameters)
    covariance, _ = block_covariance(
        [(R, z - R @ p) for R, z in parts], estimate.inverse
    )
    return np.sqrt(np.diag(covariance))


def block_covariance(
    blocks: Sequence[Block], inverse: AnyArray
) -> tuple[np.ndarray, float]:
    r"""Return the block jackknife's covariance of an estimate, and its degrees of freedom.

    Without block $k$ the estimate moves by $(1 - B G_k)^{-1} B g_k$, where $G_k$ is the
    block's information and $g_k$ the product of its derivatives and residuals. The
    covariance has at most the rank of the number of blocks less one: it serves single
    unknowns, and tests of a few.
    """
    B, count = np.asarray(inverse), len(blocks)
    size = np.sqrt(np.maximum(np.diag(B), 0.0))
    scale = np.where(size > 0, size, 1.0)
    scaled = B / scale / scale[:, None]
    moved = []
    for J, r in blocks:
        rows = J * scale
        step = np.eye(len(B)) - scaled @ (rows.T @ rows)
        moved.append(np.linalg.lstsq(step, scaled @ (rows.T @ r), rcond=None)[0])
    steps = scale * (np.array(moved) - np.mean(moved, axis=0))
    return (count - 1) / count * steps.T @ steps, count - 1.0


def solve_blocks(blocks: Sequence[Block]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return least squares of weighted blocks, the jackknife's covariance and its dof.

    The blocks are derivatives by the unknowns and right-hand sides.
    """
    decomposition = Decomposition.of(*map(np.concatenate, zip(*blocks, strict=True)))
    x, B = decomposition.solve(), decomposition.inverse_information()
    return x, *block_covariance([(J, z - J @ x) for J, z in blocks], B)


def bootstrap(
    blocks: Blocks, weights: Float[AnyArray, " joints"], draws: int, key: PRNGKeyArray
) -> Float[Array, "draws base"]:
    r"""Return estimates from blocks of time that are drawn with replacement.

    Blocks are drawn, not samples, because errors of neighbouring samples are
    correlated. The information of a draw is the sum of the blocks' information, each
    times the number of its occurrences; the weights stay.

    Args:
        blocks: Factors of some dozens of blocks, each longer than the correlation of
            the errors.
        weights: Weights of the joints' rows [1/(N m) or 1/N], such as `fit.weights`.
        draws: Number of draws.
        key: Key of the random numbers.

    Returns:
        Parameters of each draw; their covariance is that of the estimates.

    Raises:
        InputError: If there are fewer than two blocks, or draws do not determine all
            parameters.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a bootstrap")
    count = len(blocks.parts)
    if count < 2:
        raise InputError(
            "`blocks` must hold at least two blocks of time, but holds one."
        )
    whole = Decomposition.of(*blocks.total.weighted(weights))
    start = whole.solve()
    information, gradients = [], []
    for part in blocks.parts:
        R, z = part.weighted(weights)
        R = R / whole.scale
        information.append(R.T @ R)
        gradients.append(R.T @ (z - R @ (start * whole.scale)))
    drawn = jax.random.randint(key, (draws, count), 0, count)
    counts = np.apply_along_axis(
        np.bincount, 1, np.asarray(drawn), minlength=count
    ).astype(float)
    total = np.tensordot(counts, np.array(information), 1)
    inverse, condition = jax.vmap(inverse_information)(jnp.asarray(total))
    step = jnp.einsum("dij,dj->di", inverse, counts @ np.array(gradients))
    poor = int(np.sum(~(np.asarray(condition) < 1 / np.sqrt(RIDGE))))
    if poor:
        raise InputError(
            f"{poor} of {draws} draws leave parameters open: take longer `blocks`."
        )
    return jnp.asarray(start)[None] + step / whole.scale[None]
