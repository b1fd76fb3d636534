r"""Least squares over several runs whose parameters depend on common unknowns.

Fit $s$ has the base parameters $p_s = E_s x + c_s$: shared and own ones of several states, a
payload on top, known loads. Its rows enter by their factors only. The common estimate is linear in
those of the single runs, $x = \sum_s A_s (\hat p_s - c_s)$ with
$A_s = (\sum E^T G E)^{-1} E_s^T G_s$ and the information $G_s$ of each run, and so is its error:
the covariance of the single estimates, right for errors that are alike from row to row, leads to
that of the common one.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.estimators import Complete
from jaxid.identification.estimators.solutions import NUMERICAL, Decomposition
from jaxid.identification.fit import Fit
from jaxid.identification.runs.twice import refuse_shared
from jaxid.identification.uncertainty.blocks import Block, block_covariance


class Tied(eqx.Module):
    """The common unknowns of several runs.

    Attributes:
        parameters: Estimates of the unknowns.
        covariance: Covariance of the estimates; infinite on the diagonal where nothing is known.
        freedom: Degrees of freedom of their standard deviations.
        factor: Triangle with the norm of all weighted rows, as a matrix on the unknowns.
        target: The right-hand side that belongs to it.
    """

    parameters: Float[AnyArray, " unknowns"]
    covariance: Float[AnyArray, "unknowns unknowns"]
    freedom: Float[AnyArray, " unknowns"]
    factor: Float[AnyArray, "height unknowns"]
    target: Float[AnyArray, " height"]


def tied(
    runs: Sequence[Fit],
    maps: Sequence[Float[AnyArray, "base unknowns"]],
    known: Sequence[Float[AnyArray, " base"]] | None = None,
) -> Tied:
    """Estimates the unknowns from the factors of all runs (Eq. 33).

    Args:
        runs: Independent of each other.
        maps: For each run how its base parameters follow from the unknowns.
        known: For each run what is known of its base parameters; nothing if None.

    Raises:
        InputError: If two runs have seen the same data.
    """
    refuse_shared([(run.name, run.time_blocks) for run in runs])
    known = [np.zeros(run.base.size) for run in runs] if known is None else known
    maps = [np.asarray(E, np.float64) for E in maps]
    factors = [run.factor for run in runs]
    R = np.vstack([own @ E for (own, _), E in zip(factors, maps, strict=True)])
    z = np.concatenate([z - own @ c for (own, z), c in zip(factors, known, strict=True)])
    triangle = np.asarray(np.linalg.qr(np.column_stack([R, z]), mode="r"))
    decomposition = Decomposition.of(triangle[:, :-1], triangle[:, -1])
    inverse = Complete().inverse(decomposition.values)
    B = decomposition.inverse_information(inverse)
    covariance = np.zeros_like(B)
    scatter = np.zeros(len(B))
    for run, (own, _), E in zip(runs, factors, maps, strict=True):
        part, freedom = _carried(run, B @ E.T @ own.T, own)
        covariance += part
        scatter += np.diag(part) ** 2 / freedom
    variances = np.diag(covariance).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.where(scatter > 0, variances**2 / scatter, np.inf)
    s = np.asarray(decomposition.values)
    null = np.asarray(decomposition.directions)[s <= NUMERICAL * s.max(initial=0.0)]
    unknown = np.sum(null**2, axis=0) > 1e-8
    covariance[unknown, unknown] = np.inf
    return Tied(
        decomposition.solve(inverse), covariance, freedom, triangle[:, :-1], triangle[:, -1]
    )


def _carried(
    run: Fit, onto: Float[np.ndarray, "unknowns height"], own: Float[np.ndarray, "height base"]
) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
    """Return a run's part of the unknowns' covariance, and its degrees of freedom."""
    C, own_freedom = np.asarray(run.covariance), np.asarray(run.uncertainty.dof)
    if not np.isfinite(C).all():
        # The run alone does not determine everything, so not all of its estimates have a variance.
        # What its errors do to others follows from blocks of time.
        C, few = block_covariance(*_blocks(run))
        own_freedom = np.full(len(C), few)
    A = onto @ own
    weights = A**2 * np.diag(C)
    whole = weights.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = whole / (weights / own_freedom).sum(axis=1)
    return A @ C @ A.T, np.where(whole > 0, freedom, np.inf)


def _blocks(run: Fit) -> tuple[list[Block], Float[np.ndarray, "base base"]]:
    """Return the residuals of each block of time, and the inverse of the run's information."""
    decomposition = Decomposition.of(*run.factor)
    inverse = Complete().inverse(decomposition.values)
    p = decomposition.solve(inverse)
    parts = (part.weighted(run.weights) for part in run.time_blocks.parts)
    return [(R, z - R @ p) for R, z in parts], decomposition.inverse_information(inverse)
