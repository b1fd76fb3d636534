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
from collections.abc import Iterator, Sequence

import numpy as np

from jaxid.errors import InputError

from .estimators import GivenWeights, WeightedLeastSquares
from .estimators.regularisation_and_weights import Decomposition
from .factors import Blocks
from .fit_result import Fit
from .identify import fit_problem
from .problem import RegressionProblem
from .uncertainty import Uncertainty
from .uncertainty.blocks import solve_blocks


def require_same_base(fits: Sequence[Fit]) -> None:
    """Check that fits have the same base parameters."""
    first, a = fits[0], fits[0].base
    for fit in fits[1:]:
        b = fit.base
        same = a.names == b.names and a.indices == b.indices
        if not same or not np.allclose(a.kappa, b.kappa, rtol=1e-6, atol=1e-9):
            others = sorted({*a.names} ^ {*b.names})
            differs = (
                f"`{others[0]}` is in one of them only" if others else "lengths differ"
            )
            pair = f"`{first.name}` and `{fit.name}`"
            raise InputError(
                f"{pair} have different base parameters ({differs}): use one model."
            )


def as_least_squares(fit: Fit) -> Fit:
    """Return weighted least squares of a fit's factors: the fit itself where it is that.

    For robust, regularised or consistent estimates the factors are solved again with
    the same weights. The standard deviations of consistent ones are those of least
    squares already; of others they come from the block jackknife.
    """
    if fit.is_least_squares:
        return fit
    problem = RegressionProblem(fit.base, blocks=fit.blocks, names=fit.recordings)
    plain = fit_problem(problem, WeightedLeastSquares(GivenWeights(fit.weights)))
    if fit.consistency is not None:
        plain = replace_estimates(plain, plain.parameters, fit.uncertainty)
    return dataclasses.replace(plain, name=fit.name)


def without_bounds(fit: Fit) -> Fit:
    """Return the least squares behind a consistent fit, with its deviations; other fits as is."""
    return fit if fit.consistency is None else as_least_squares(fit)


def replace_estimates(fit: Fit, parameters, uncertainty: Uncertainty) -> Fit:
    """Return a fit with estimates and an uncertainty that were computed from several fits."""
    notes = tuple(note for note in fit.notes if note not in fit.uncertainty.notes)
    return dataclasses.replace(
        fit, parameters=parameters, uncertainty=uncertainty, notes=notes
    )


def combine(fits: Sequence[Fit], maps, offsets=None) -> tuple[np.ndarray, Uncertainty]:
    """Estimate common unknowns from the factors of several fits by least squares (Eq. 33).

    The base parameters of each fit are its map [base, unknowns] times the unknowns,
    plus its offset [base], if there are any.
    """
    for one, other in itertools.combinations(fits, 2):
        if share_rows(one.time_blocks, other.time_blocks):
            names = f"`{one.name}` and `{other.name}`"
            raise InputError(
                f"{names} have seen the same data, which would count twice."
            )
    offsets = offsets or [np.zeros(fit.base.size) for fit in fits]
    factors, rows = [fit.factor for fit in fits], []
    for (R, z), E, c in zip(factors, maps, offsets, strict=True):
        rows.append(np.column_stack([R @ E, z - R @ c]))
    triangle = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))
    decomposition = Decomposition.of(triangle[:, :-1], triangle[:, -1])
    B = decomposition.inverse_information()
    covariance, scatter = np.zeros_like(B), np.zeros(len(B))
    for fit, (R, _), E in zip(fits, factors, maps, strict=True):
        C, dof = fit.covariance, fit.uncertainty.dof
        if not np.isfinite(C).all():
            # The fit alone does not determine everything, so not all of its estimates
            # have a variance. The effect of its errors on others follows from blocks of
            # time.
            parts = [part.weighted(fit.weights) for part in fit.time_blocks.parts]
            _, C, few = solve_blocks(parts)
            dof = np.full(len(C), few)
        A = B @ E.T @ R.T @ R
        part = A @ C @ A.T
        covariance += part
        # The degrees of freedom of a sum are a mean of those of its terms.
        weights = A**2 * np.diag(C)
        whole = np.maximum(weights.sum(axis=1), 1e-300)
        scatter += np.diag(part) ** 2 * (weights / dof).sum(axis=1) / whole
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = np.where(scatter > 0, np.diag(covariance) ** 2 / scatter, np.inf)
    unknown = decomposition.unknown
    covariance[unknown, unknown] = np.inf
    return decomposition.solve(), Uncertainty(covariance, dof, covariance)


def combine_fits(earlier: Fit, later: Fit, name: str | None = None) -> Fit:
    """Add a later fit to an earlier one, as if both had been identified together.

    The estimates are those of the joint fit to rounding, and only factors are needed:
    the earlier fit may come from a file. If the weights of the fits differ, each keeps
    its own.

    Args:
        earlier: Fit of the earlier recordings.
        later: Fit of later recordings of the robot in the same state.
        name: Name of both together; by default their names in a row.

    Raises:
        InputError: If the fits have different base parameters, or have seen the same
            data.
    """
    require_same_base((earlier, later))
    earlier, later = as_least_squares(earlier), as_least_squares(later)
    identity = np.eye(earlier.base.size)
    p, uncertainty = combine((earlier, later), (identity, identity))
    # The later rows are scaled so that they keep their weights under those of the
    # earlier fit.
    scaled = later.time_blocks.scale_joints(later.weights / earlier.weights)
    blocks = Blocks((*earlier.time_blocks.parts, *scaled.parts))
    names = (*earlier.recordings, *later.recordings)
    problem = RegressionProblem(earlier.base, blocks=blocks, names=names)
    fit = fit_problem(problem, WeightedLeastSquares(GivenWeights(earlier.weights)))
    name = f"{earlier.name}, {later.name}" if name is None else name
    return replace_estimates(dataclasses.replace(fit, name=name), p, uncertainty)


def share_rows(first: Blocks, second: Blocks) -> bool:
    """Return whether two sets of factors were made of the same rows, at least in part.

    Names do not tell: different logs may have the same, and one log several. Norms of
    the columns and forces do, whatever the weights. Two blocks must agree: one may be a
    robot at rest.
    """
    ours, theirs = list(_column_norms(first)), list(_column_norms(second))
    equal = sum(
        any(
            m == n and a.shape == b.shape and np.abs(a - b).max() <= 1e-9
            for n, b in theirs
        )
        for m, a in ours
    )
    return equal >= max(1, min(2, len(ours), len(theirs)))


def _column_norms(blocks: Blocks) -> Iterator[tuple[list[int], np.ndarray]]:
    """Yield the numbers of rows of each block, and the norms relative to the joint's largest."""
    for part in blocks.parts:
        if part.rows.any():
            norms = [np.linalg.norm(joint.R, axis=0) for joint in part.joints]
            relative = [x / max(x.max(initial=0.0), 1e-300) for x in norms]
            yield part.rows.tolist(), np.concatenate(relative)
