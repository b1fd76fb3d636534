"""Essential parameters: backward elimination, stopped by errors on held-out data."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.errors import InputError
from jaxid.measurement.observations import Observations

from .estimators.regularisation_and_weights import Decomposition
from .factors import Factors
from .fit_result import Fit
from .identify import fit_problem, naive_covariance
from .problem import RegressionProblem, cross_validation_folds
from .uncertainty import AbstractUncertainty

FOLDS = 10
"""Parts of time that are left out in turn."""


class Elimination(NamedTuple):
    """One step of backward elimination."""

    name: str  # base parameter that is eliminated; empty before the first step
    remaining: int  # number of remaining parameters
    held_out: float  # weighted error on held-out blocks of time, relative to the forces


class EssentialParameters(eqx.Module):
    """Result of backward elimination.

    Attributes:
        fit: Fit of the essential parameters alone; the others are zero.
        path: All steps, from the full model to a single parameter.
    """

    fit: Fit
    path: tuple[Elimination, ...]

    @property
    def last_step(self) -> Elimination:
        """Last step that is taken."""
        return self.path[len(self.eliminated)]

    @property
    def eliminated(self) -> tuple[str, ...]:
        """Names of the inessential parameters, in the order of elimination."""
        size = self.fit.base.size
        return tuple(step.name for step in self.path[1:] if step.remaining >= size)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""
        if not self.eliminated:
            return (str(self),)
        names = ", ".join(self.eliminated)
        return str(self), f"eliminated, and taken as zero: {names}."

    def __str__(self):
        start = self.path[0]
        end = self.last_step
        return (
            f"{end.remaining} of {start.remaining} base parameters are essential: "
            "with them alone the error on held-out blocks "
            f"of time is {100 * end.held_out:.2f} % of the forces, "
            f"with all {100 * start.held_out:.2f} %."
        )


def essential_parameters(
    fit: Fit,
    observations: Observations | Sequence[Observations],
    *,
    cost: float = 0.02,
    uncertainty: AbstractUncertainty | None = None,
) -> EssentialParameters:
    """Eliminate the parameter with the largest relative deviation, again and again.

    Held-out errors decide where to stop: at the fewest parameters whose error exceeds
    the smallest on the path by `cost` at most. Standard deviations are those of the
    fit, scaled by the change of those for independent rows (Pham and Gautier, 1991).

    Args:
        fit: Fit of all base parameters.
        observations: Observations of the fit.
        cost: Acceptable relative increase of the held-out error.
        uncertainty: Method for the standard deviations; by default the spectral
            sandwich.

    Raises:
        InputError: If `cost` is negative, or the observations are not those of the fit.
    """
    if not cost >= 0:
        raise InputError(f"`cost` must be zero or more, but is {cost:g}.")
    problem = RegressionProblem(fit.base, observations)
    if problem.factors.rows.tolist() != list(fit.rows):
        raise InputError(
            "`observations` must be those of the fit, but they have other rows."
        )

    order = _elimination_order(fit, problem.factors)
    errors = _held_out_errors(fit, problem, order)
    names = ["", *(fit.base.names[k] for k in order[:-1])]
    path = [
        Elimination(name, len(order) - step, error)
        for step, (name, error) in enumerate(zip(names, errors, strict=True))
    ]

    # The last step of all that cost little, even if one before costs more.
    max_error = (1 + cost) * min(errors)
    last_step = max(step for step, error in enumerate(errors) if error <= max_error)
    essential_indices = np.sort(order[last_step:])
    base = dataclasses.replace(
        fit.base,
        indices=tuple(fit.base.indices[k] for k in essential_indices),
        kappa=np.asarray(fit.base.kappa)[essential_indices],
    )
    reduced_fit = fit_problem(problem.with_base(base), fit.estimator, uncertainty)
    return EssentialParameters(reduced_fit, tuple(path))


def _elimination_order(fit: Fit, factors: Factors) -> list[int]:
    """Return the base parameters in the order in which they are eliminated."""
    weights = np.asarray(fit.weights)
    R, z = factors.weighted(weights)
    candidates = list(range(fit.base.size))
    inflation = None
    order = []
    while candidates:
        p, inverse = _solve(R, z, candidates)
        covariance = naive_covariance(factors, weights, p, inverse)
        naive_deviations = np.sqrt(np.diag(covariance))
        # How much larger deviations are than for independent rows is that of the fit.
        if inflation is None:
            inflation = _inflation(fit.standard_deviations, naive_deviations)
        deviations = inflation[candidates] * naive_deviations
        sizes = np.maximum(np.abs(p[candidates]), np.finfo(float).tiny)
        order.append(candidates.pop(int(np.argmax(deviations / sizes))))
    return order


def _inflation(deviations, naive_deviations) -> np.ndarray:
    """Return deviations over those of independent rows; infinite if unknown."""
    has_ratio = np.isfinite(deviations) & (naive_deviations > 0)
    inflation = np.full_like(deviations, np.inf)
    inflation[has_ratio] = deviations[has_ratio] / naive_deviations[has_ratio]
    return inflation


def _held_out_errors(
    fit: Fit, problem: RegressionProblem, order: Sequence[int]
) -> list[float]:
    """Return held-out errors before each elimination, relative to the forces."""
    joint_weights = fit.weights**2
    total = float(joint_weights @ problem.factors.force_squares)
    squares = np.zeros(len(order))
    for training, test in cross_validation_folds(problem.blocks, FOLDS):
        R, z = problem.blocks.select(training).total.weighted(fit.weights)
        test_factors = problem.blocks.select(test).total
        for step in range(len(order)):
            p, _ = _solve(R, z, sorted(order[step:]))
            squares[step] += joint_weights @ test_factors.residual_squares(p)
    return np.sqrt(squares / total).tolist()


def _solve(R, z, parameters: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return least squares in some parameters, others zero, and inverse information."""
    decomposition = Decomposition.of(R[:, parameters], z)
    p = np.zeros(R.shape[1])
    p[parameters] = decomposition.solve()
    inverse = np.zeros((R.shape[1], len(parameters)))
    inverse[parameters] = decomposition.inverse_information()
    return p, inverse
