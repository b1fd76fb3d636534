"""Essential parameters: backward elimination, stopped by errors on held-out data."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.measurement.observations import Observations

from .estimators.regularisation_and_weights import Decomposition
from .factors import Factors
from .fit_result import Fit
from .identify import fit_problem
from .problem import RegressionProblem, cross_validation_folds

FOLDS = 10
"""Parts of time that are left out in turn."""


def essential_parameters(
    fit: Fit,
    observations: Observations | Sequence[Observations],
    *,
    cost: float = 0.02,
) -> Fit:
    """Eliminate the parameter with the largest relative deviation, again and again.

    Held-out errors decide where to stop: at the fewest parameters whose error exceeds
    the smallest on the path by `cost` at most. Standard deviations are those of the
    fit, scaled by the change of those for independent rows (Pham and Gautier, 1991).

    Args:
        fit: Fit of all base parameters.
        observations: Observations of the fit.
        cost: Acceptable relative increase of the held-out error.

    Returns:
        Fit of the essential parameters alone; the others are zero, and a note names
        them.

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
    # The last step of all that cost little, even if one before costs more.
    steps = np.flatnonzero(errors <= (1 + cost) * errors.min())
    count = int(steps[-1])
    essential_indices = np.sort(order[count:])
    base = dataclasses.replace(
        fit.base,
        indices=tuple(fit.base.indices[k] for k in essential_indices),
        kappa=np.asarray(fit.base.kappa)[essential_indices],
    )
    reduced_fit = fit_problem(problem.with_base(base), fit.estimator)
    names = ", ".join(fit.base.names[k] for k in order[:count])
    note = (
        f"{base.size} of {fit.base.size} base parameters are essential: with them "
        f"alone the error on held-out blocks of time is {100 * errors[count]:.2f} % "
        f"of the forces, with all {100 * errors[0]:.2f} %; "
        f"eliminated, and taken as zero: {names or 'none'}."
    )
    return dataclasses.replace(reduced_fit, notes=(*reduced_fit.notes, note))


def _elimination_order(fit: Fit, factors: Factors) -> list[int]:
    """Return the base parameters in the order in which they are eliminated."""
    R, z = factors.weighted(fit.weights)
    # How much larger deviations are than for independent rows is that of the fit.
    decomposition = Decomposition.of(R, z)
    inflation = fit.standard_deviations / _unit_deviations(decomposition)
    candidates = list(range(fit.base.size))
    order = []
    while candidates:
        decomposition = Decomposition.of(R[:, candidates], z)
        p = decomposition.solve()
        deviations = inflation[candidates] * _unit_deviations(decomposition)
        sizes = np.maximum(np.abs(p), np.finfo(float).tiny)
        order.append(candidates.pop(int(np.argmax(deviations / sizes))))
    return order


def _unit_deviations(decomposition: Decomposition) -> np.ndarray:
    """Return the parameters' deviations for independent rows with unit noise."""
    return np.sqrt(np.diag(decomposition.inverse_information()))


def _held_out_errors(
    fit: Fit, problem: RegressionProblem, order: Sequence[int]
) -> np.ndarray:
    """Return held-out errors before each elimination, relative to the forces."""
    joint_weights = fit.weights**2
    total = float(joint_weights @ problem.factors.force_squares)
    squares = np.zeros(len(order))
    for training, test in cross_validation_folds(problem.blocks, FOLDS):
        R, z = problem.blocks.select(training).total.weighted(fit.weights)
        test_factors = problem.blocks.select(test).total
        for step in range(len(order)):
            remaining = sorted(order[step:])
            p = np.zeros(len(order))
            p[remaining] = Decomposition.of(R[:, remaining], z).solve()
            squares[step] += joint_weights @ test_factors.residual_squares(p)
    return np.sqrt(squares / total)
