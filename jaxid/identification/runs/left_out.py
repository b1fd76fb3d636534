"""Covariances from blocks of time that are left out in turn, of any estimate with residuals."""

from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Float

Block = tuple[Float[np.ndarray, "height unknowns"], Float[np.ndarray, " height"]]
"""Derivatives of a block's weighted residuals by the unknowns, and the residuals."""


def left_out(
    blocks: Sequence[Block], inverse: Float[np.ndarray, "unknowns unknowns"]
) -> Float[np.ndarray, "blocks unknowns"]:
    r"""How far the estimate moves without each block: $(1 - B G_k)^{-1} B g_k$.

    $G_k$ is the block's information and $g_k$ the product of its derivatives and residuals.

    Args:
        blocks: Contiguous blocks of time, longer than the errors remember.
        inverse: $B$, the inverse of the information of all blocks.
    """
    B = np.asarray(inverse)
    size = np.sqrt(np.maximum(np.diag(B), 0.0))
    scale = np.where(size > 0, size, 1.0)
    scaled = B / scale / scale[:, None]
    moved = []
    for J, r in blocks:
        rows = J * scale
        step = np.eye(len(B)) - scaled @ (rows.T @ rows)
        moved.append(np.linalg.lstsq(step, scaled @ (rows.T @ r), rcond=None)[0])
    return scale * np.array(moved)


def block_covariance(
    blocks: Sequence[Block], inverse: Float[np.ndarray, "unknowns unknowns"]
) -> tuple[Float[np.ndarray, "unknowns unknowns"], float]:
    """The block jackknife's covariance of an estimate, and its degrees of freedom.

    Its rank is at most one less than the number of blocks: it serves intervals of single unknowns,
    and joint tests of a few.

    Args:
        blocks: Contiguous blocks of time, longer than the errors remember.
        inverse: The inverse of the information of all blocks.
    """
    moved = left_out(blocks, inverse)
    count = len(moved)
    moved = moved - moved.mean(axis=0)
    return (count - 1) / count * moved.T @ moved, count - 1.0
