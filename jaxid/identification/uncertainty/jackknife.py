"""Block jackknife: uncertainty from estimates without one block of time each."""

import numpy as np

from jaxid.arrays import Float
from jaxid.identification.estimators.estimate import Estimate
from jaxid.identification.uncertainty.result import (
    AbstractUncertainty,
    Uncertainty,
    mark_unknown,
)


class BlockJackknife(AbstractUncertainty):
    """Block jackknife: scatter of estimates without one block of time each.

    It needs only factors of blocks, and allows any correlation of errors within blocks and between
    joints. Ten blocks give rough values. Correlations between parameters are those of the naive
    covariance.
    """

    def __call__(self, problem, estimate, naive):
        """Return the jackknife; with a single block the naive covariance."""
        deviations = jackknife(estimate)
        if deviations is None:
            note = (
                "standard deviations assume independent rows, and are too small where errors of "
                "neighbouring rows are correlated: there is only one block of time."
            )
            dof = np.full(len(naive), np.inf)
            return Uncertainty(naive, dof, naive, None, (note,)), None
        size = np.sqrt(np.diag(naive))
        known = np.isfinite(size) & (size > 0)
        ratio = np.where(known, deviations, 0.0) / np.where(known, size, 1.0)
        covariance = np.where(np.isfinite(naive), naive, 0.0) * ratio * ratio[:, None]
        dof = np.full(len(naive), float(len(estimate.blocks.parts) - 1))
        return Uncertainty(mark_unknown(covariance, naive), dof, naive, deviations), None


def jackknife(estimate: Estimate) -> Float[np.ndarray, " base"] | None:
    r"""Return standard deviations from estimates without one block each; None for a single block.

    Without block $k$ the estimate moves by $(1 - B G_k)^{-1} B g_k$, where $G_k$ is the block's
    information and $g_k$ the product of its columns and residuals. Blocks must be longer than the
    correlation of the errors, which need not be stationary.

    Args:
        estimate: Estimate with the factors of contiguous blocks of time.
    """
    blocks, B, p = estimate.blocks, np.asarray(estimate.inverse), np.asarray(estimate.parameters)
    count = len(blocks.parts)
    if count < 2:
        return None
    size = np.sqrt(np.maximum(np.diag(B), 0.0))
    scale = np.where(size > 0, size, 1.0)
    scaled = B / scale / scale[:, None]
    steps = []
    for part in blocks.parts:
        R, z = part.weighted(estimate.weights)
        gradient = (R * scale).T @ (z - R @ p)
        information = (R * scale).T @ (R * scale)
        matrix = np.eye(len(p)) - scaled @ information
        steps.append(np.linalg.lstsq(matrix, scaled @ gradient, rcond=None)[0])
    steps = np.array(steps) - np.mean(steps, axis=0)
    return scale * np.sqrt((count - 1) / count * np.sum(steps**2, axis=0))
