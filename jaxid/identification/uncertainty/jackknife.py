"""The block jackknife: how much estimates change when a block of time is left out."""

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.factors import Blocks


def jackknife(
    blocks: Blocks,
    weights: Float[AnyArray, " joints"],
    inverse: Float[AnyArray, "base base"],
    p: Float[AnyArray, " base"],
) -> Float[np.ndarray, " base"]:
    r"""Standard deviations from estimates without one block each.

    Without block $k$ the estimate moves by $(1 - B G_k)^{-1} B g_k$, where $G_k$ is the block's
    information and $g_k$ the product of its columns and residuals. It assumes that blocks are
    longer than the errors remember, but not that errors are alike all the time.

    Args:
        blocks: Factors of at least two contiguous blocks of time.
        weights: Of the joints' rows [1/(N m) or 1/N].
        inverse: What takes the place of the inverse of the information.
        p: The estimate.
    """
    B, p = np.asarray(inverse), np.asarray(p)
    size = np.sqrt(np.maximum(np.diag(B), 0.0))
    scale = np.where(size > 0, size, 1.0)
    scaled = B / scale / scale[:, None]
    moved = []
    for part in blocks.parts:
        R, z = part.weighted(weights)
        left = (R * scale).T @ (z - R @ p)
        taken = (R * scale).T @ (R * scale)
        step = np.linalg.lstsq(np.eye(len(p)) - scaled @ taken, scaled @ left, rcond=None)[0]
        moved.append(step)
    count = len(moved)
    moved = np.array(moved) - np.mean(moved, axis=0)
    return scale * np.sqrt((count - 1) / count * np.sum(moved**2, axis=0))
