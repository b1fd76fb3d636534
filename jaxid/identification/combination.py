r"""Combination of fits: least squares over several of them, from their factors alone.

Fit $s$ has the base parameters $p_s = E_s x + c_s$ of common unknowns $x$: shared and
own parameters of several states, a payload on top, known loads. The common estimate is
linear in those of the single fits, $x = \sum_s A_s (\hat p_s - c_s)$ with $A_s = (\sum
E^T G E)^{-1} E_s^T G_s$ and the information $G_s$ of each fit, and so is its error: the
covariances of the single estimates, which are right for correlated errors, give that of
the common one.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Vector
from jaxid.errors import InputError

from .estimators import GivenWeights, WeightedLeastSquares
from .estimators.regularisation_and_weights import Decomposition
from .factors import Blocks
from .fit_result import Fit
from .identify import fit_problem
from .problem import RegressionProblem
from .uncertainty import Uncertainty
from .uncertainty.blocks import block_covariance, residual_blocks


def require_same_base(fits: Sequence[Fit]) -> None:
    """Check that fits have the same base parameters."""
    first_fit = fits[0]
    for fit in fits[1:]:
        base, other_base = first_fit.base, fit.base
        has_same_columns = (
            base.names == other_base.names and base.indices == other_base.indices
        )
        if has_same_columns and np.allclose(
            base.kappa, other_base.kappa, rtol=1e-6, atol=1e-9
        ):
            continue
        differing_names = sorted({*base.names} ^ {*other_base.names})
        difference = "lengths differ"
        if differing_names:
            difference = f"`{differing_names[0]}` is in one of them only"
        raise InputError(
            f"`{first_fit.name}` and `{fit.name}` have different "
            f"base parameters ({difference}): use one model."
        )


def as_least_squares(fit: Fit) -> Fit:
    """Return weighted least squares of a fit's factors; the fit itself if it is that.

    For robust, regularised or consistent estimates the factors are solved again with
    the same weights. The standard deviations of consistent ones are those of least
    squares already; of others they come from the block jackknife.
    """
    if fit.is_least_squares:
        return fit
    problem = RegressionProblem(fit.base, blocks=fit.blocks, names=fit.recordings)
    solution = fit_problem(problem, WeightedLeastSquares(GivenWeights(fit.weights)))
    if fit.consistency is not None:
        solution = replace_estimates(solution, solution.parameters, fit.uncertainty)
    return dataclasses.replace(solution, name=fit.name)


def without_bounds(fit: Fit) -> Fit:
    """Return the least squares behind a consistent fit; other fits as they are.

    The standard deviations are those of the consistent fit.
    """
    return fit if fit.consistency is None else as_least_squares(fit)


def replace_estimates(fit: Fit, parameters, uncertainty: Uncertainty) -> Fit:
    """Return a fit with estimates and uncertainty computed from several fits."""
    notes = tuple(note for note in fit.notes if note not in fit.uncertainty.notes)
    return dataclasses.replace(
        fit, parameters=parameters, uncertainty=uncertainty, notes=notes
    )


def relative_residual(fit: Fit, parameters: Vector) -> float:
    """Return the norm of the residuals of a fit's rows, relative to the forces."""
    factors = fit.time_blocks.total
    squares = factors.residual_squares(parameters)
    return float(np.sqrt(squares.sum() / factors.force_squares.sum()))


def combine(fits: Sequence[Fit], maps, offsets=None) -> tuple[Vector, Uncertainty]:
    """Estimate common unknowns from factors of several fits by least squares (Eq. 33).

    The base parameters of each fit are its map [base, unknowns] times the unknowns,
    plus its offset [base], if there are any.
    """
    for first_fit, second_fit in itertools.combinations(fits, 2):
        if has_common_rows(first_fit.time_blocks, second_fit.time_blocks):
            raise InputError(
                f"`{first_fit.name}` and `{second_fit.name}` contain the same data, "
                "which would count twice."
            )
    if offsets is None:
        offsets = [np.zeros(fit.base.size) for fit in fits]
    factors = []
    matrices = []
    sides = []
    for fit, E, offset in zip(fits, maps, offsets, strict=True):
        R, z = fit.factor
        factors.append(R)
        matrices.append(R @ E)
        sides.append(z - R @ offset)
    decomposition = Decomposition.of(np.vstack(matrices), np.concatenate(sides))
    B = decomposition.inverse_information()

    covariance = np.zeros_like(B)
    scatter = np.zeros(len(B))
    for fit, R, E in zip(fits, factors, maps, strict=True):
        fit_covariance, dof = _finite_covariance(fit)
        A = B @ E.T @ R.T @ R
        part = A @ fit_covariance @ A.T
        variances = np.diag(part)
        covariance += part
        # The degrees of freedom of a sum are a mean of those of its terms.
        shares = A**2 * np.diag(fit_covariance)
        total_shares = np.maximum(shares.sum(axis=1), 1e-300)
        mean_inverse_dof = (shares / dof).sum(axis=1) / total_shares
        scatter += variances**2 * mean_inverse_dof
    total_dof = np.full(len(B), np.inf)
    has_scatter = scatter > 0
    variances = np.diag(covariance)[has_scatter]
    total_dof[has_scatter] = variances**2 / scatter[has_scatter]
    covariance[decomposition.unknown, decomposition.unknown] = np.inf
    return decomposition.solve(), Uncertainty(covariance, total_dof, covariance)


def _finite_covariance(fit: Fit):
    """Return the covariance of a fit's estimates and degrees of freedom.

    A fit that does not determine everything has no variance of some estimates. The
    effect of its errors on others follows from its blocks of time.
    """
    if np.isfinite(fit.covariance).all():
        return np.asarray(fit.covariance), np.asarray(fit.uncertainty.dof)
    decomposition = Decomposition.of(*fit.factor)
    blocks = residual_blocks(fit.time_blocks, fit.weights, decomposition.solve())
    inverse = decomposition.inverse_information()
    covariance, dof = block_covariance(blocks, inverse)
    return covariance, np.full(len(covariance), dof)


def combine_fits(earlier: Fit, later: Fit) -> Fit:
    """Add a later fit to an earlier one, as if both had been identified together.

    The estimates are those of the joint fit to rounding, and only factors are needed:
    the earlier fit may come from a file. If the weights of the fits differ, each keeps
    its own. The name is that of both in a row.

    Args:
        earlier: Fit of the earlier recordings.
        later: Fit of later recordings of the robot in the same state.

    Raises:
        InputError: If the fits have different base parameters, or have seen the same
            data.
    """
    require_same_base((earlier, later))
    first_fit = as_least_squares(earlier)
    second_fit = as_least_squares(later)
    identity = np.eye(first_fit.base.size)
    parameters, uncertainty = combine((first_fit, second_fit), (identity, identity))
    # The later rows are scaled so that they keep their weights under those of the
    # earlier fit.
    scaled_blocks = second_fit.time_blocks.scale_joints(
        second_fit.weights / first_fit.weights
    )
    problem = RegressionProblem(
        first_fit.base,
        blocks=Blocks((*first_fit.time_blocks.parts, *scaled_blocks.parts)),
        names=(*first_fit.recordings, *second_fit.recordings),
    )
    fit = fit_problem(problem, WeightedLeastSquares(GivenWeights(first_fit.weights)))
    fit = dataclasses.replace(fit, name=f"{first_fit.name}, {second_fit.name}")
    return replace_estimates(fit, parameters, uncertainty)


def has_common_rows(first: Blocks, second: Blocks) -> bool:
    """Return whether two sets of factors were made of the same rows, at least in part.

    Names do not tell: different logs may have the same, and one log several. Norms of
    the columns and forces do, whatever the weights. Two blocks must agree: one may be a
    robot at rest.
    """
    first_norms = _column_norms(first)
    second_norms = _column_norms(second)
    count = sum(any(_are_equal(a, b) for b in second_norms) for a in first_norms)
    return count >= max(1, min(2, len(first_norms), len(second_norms)))


def _are_equal(first: Vector, second: Vector) -> bool:
    return first.shape == second.shape and np.abs(first - second).max() <= 1e-9


def _column_norms(blocks: Blocks):
    """Return each block's rows and norms, relative to the joint's largest."""
    block_norms = []
    for part in blocks.parts:
        if part.rows.any():
            norms = [np.linalg.norm(joint.R, axis=0) for joint in part.joints]
            relative_norms = [x / max(x.max(initial=0.0), 1e-300) for x in norms]
            block_norms.append(np.concatenate([part.rows, *relative_norms]))
    return block_norms
