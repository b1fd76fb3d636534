"""Uncertainty from contiguous blocks of time: jackknife and bootstrap."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    BaseVector,
    Float,
    Joints,
    Matrix,
    PRNGKeyArray,
    Vector,
    require_float64,
)
from jaxid.errors import InputError

from ..estimators.estimate import Estimate
from ..estimators.regularisation_and_weights import (
    RIDGE,
    Decomposition,
    inverse_information,
)
from ..factors import Blocks
from .result import AbstractUncertainty, Uncertainty, rescale_covariance

ResidualBlock = tuple[Matrix, Vector]
"""Derivatives of a block's weighted forces by the unknowns, and the residuals."""
MIN_REMAINDER = 1e-3
"""Share of the information of a direction that the other blocks must have.

A leg that is lifted in one block only tells its friction and rotors there.
"""


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
                "standard deviations assume independent rows, "
                "and are too small where errors of neighbouring rows are correlated: "
                "there is only one block of time."
            )
            dof = np.full(len(naive), np.inf)
            return Uncertainty(naive, dof, naive, None, (note,)), None
        covariance = rescale_covariance(naive, deviations)
        dof = np.full(len(naive), len(estimate.blocks.parts) - 1.0)
        return Uncertainty(covariance, dof, naive, deviations), None


def jackknife(estimate: Estimate) -> BaseVector | None:
    """Return deviations by the block jackknife; None for a single block of time."""
    if len(estimate.blocks.parts) < 2:
        return None
    blocks = residual_blocks(estimate.blocks, estimate.weights, estimate.parameters)
    covariance, _ = block_covariance(blocks, estimate.inverse)
    return np.sqrt(np.diag(covariance))


def residual_blocks(
    blocks: Blocks, weights: AnyArray, parameters: AnyArray
) -> list[ResidualBlock]:
    """Return the weighted factor of each block of time, and its residuals."""
    residuals = []
    for part in blocks.parts:
        R, z = part.weighted(weights)
        residuals.append((R, z - R @ parameters))
    return residuals


def block_covariance(
    blocks: Sequence[ResidualBlock], inverse: AnyArray
) -> tuple[Matrix, float]:
    r"""Return the block jackknife's covariance, and its degrees of freedom.

    Without block $k$ the estimate moves by $(1 - B G_k)^{-1} B g_k$, where $G_k$ is the
    block's information and $g_k$ the product of its derivatives and residuals. The
    covariance has at most the rank of the number of blocks less one: it serves single
    unknowns, and tests of a few. Directions that one block determines alone do not
    move: without it nothing is known of them, and rounding would move all unknowns.
    """
    B = np.asarray(inverse)
    # Eigenvalues compare unknowns, which must not depend on their units.
    deviations = np.sqrt(np.maximum(np.diag(B), 0.0))
    scale = np.where(deviations > 0, deviations, 1.0)
    values, vectors = np.linalg.eigh(B / np.outer(scale, scale))
    # In these coordinates the information of all blocks together is the identity.
    to_unknowns = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))

    steps = []
    for derivatives, residuals in blocks:
        rows = derivatives @ to_unknowns
        left_vectors, sizes, directions = np.linalg.svd(rows, full_matrices=False)
        remaining_parts = 1.0 - sizes**2
        is_shared = remaining_parts > MIN_REMAINDER
        gains = np.where(is_shared, sizes / np.where(is_shared, remaining_parts, 1), 0)
        step = directions.T @ (gains * (left_vectors.T @ residuals))
        steps.append(to_unknowns @ step)
    dof = len(steps) - 1.0
    changes = np.array(steps) - np.mean(steps, axis=0)
    return dof / len(steps) * changes.T @ changes, dof


def bootstrap(
    blocks: Blocks, weights: Joints, draws: int, key: PRNGKeyArray
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
    decomposition = Decomposition.of(*blocks.total.weighted(weights))
    start = decomposition.solve()
    scale = decomposition.scale
    # Products of the blocks' rows, as if all columns had length one.
    information = []
    gradients = []
    for R, residuals in residual_blocks(blocks, weights, start):
        rows = R / scale
        information.append(rows.T @ rows)
        gradients.append(rows.T @ residuals)

    numbers = jax.random.randint(key, (draws, count), 0, count)
    is_drawn = np.asarray(numbers)[:, :, None] == np.arange(count)
    occurrences = is_drawn.sum(axis=1).astype(float)
    total = np.tensordot(occurrences, np.array(information), 1)
    inverse, condition = jax.vmap(inverse_information)(jnp.asarray(total))
    is_open = ~(np.asarray(condition) < 1 / np.sqrt(RIDGE))
    if is_open.any():
        raise InputError(
            f"{is_open.sum()} of {draws} draws do not determine all parameters: take "
            "longer `blocks`."
        )
    total_gradients = occurrences @ np.array(gradients)
    steps = np.einsum("dij,dj->di", np.asarray(inverse), total_gradients)
    return jnp.asarray(start + steps / scale)
