"""Fits as weighted least squares of their factors: the form in which they can be combined."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.estimators import GivenWeights, WeightedLeastSquares
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem


def least_squares_of(fit: Fit) -> Fit:
    """Return weighted least squares of a fit's factors: the fit itself where it is that.

    For robust, regularised or consistent estimates the factors are solved anew with the same
    weights, and standard deviations come from the block jackknife.

    Raises:
        InputError: If the fit does not hold its factors.
    """
    if fit.is_least_squares:
        return fit
    problem = RegressionProblem(fit.base, blocks=fit.blocks, names=fit.recordings)
    plain = fit_problem(problem, WeightedLeastSquares(GivenWeights(np.asarray(fit.weights))))
    return dataclasses.replace(plain, name=fit.name)


def weighted_like(fit: Fit, weights: Float[AnyArray, " joints"]) -> Fit:
    """Return a fit with factors that say the same under other weights of the joints."""
    ratio = np.asarray(fit.weights) / np.asarray(weights)
    if fit.blocks is None or np.allclose(ratio, 1.0, rtol=1e-12, atol=0.0):
        return fit
    blocks = fit.blocks.scale_joints(ratio)
    return dataclasses.replace(fit, blocks=blocks, weights=np.asarray(weights))


def require_same_base(fits: Sequence[Fit]) -> None:
    """Check that fits have the same base parameters.

    Raises:
        InputError: If there is no fit, or base parameters differ.
    """
    if not fits:
        raise InputError("`runs` must hold at least one fit, but is empty.")
    first = fits[0]
    for fit in fits[1:]:
        a, b = first.base, fit.base
        if (
            a.indices != b.indices
            or a.names != b.names
            or not np.allclose(a.kappa, b.kappa, rtol=1e-6, atol=1e-9)
        ):
            raise InputError(
                f"the fits `{first.name}` and `{fit.name}` have different base parameters: use one "
                "robot and the same terms for both."
            )
