"""Essential parameters: backward elimination of parameters that do not improve the prediction."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators.solutions import NUMERICAL
from jaxid.identification.factors import Factors
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem, cross_validation_folds
from jaxid.identification.uncertainty import AbstractUncertainty
from jaxid.measurement.observations import Observations


class Elimination(eqx.Module):
    """One step of backward elimination.

    Attributes:
        name: Base parameter that is eliminated; empty before the first step.
        deviation: Its standard deviation relative to its size.
        remaining: Number of remaining parameters.
        error: Weighted error on the rows themselves, relative to the forces.
        held_out: Weighted error on held-out blocks of time, relative to the forces.
    """

    name: str = eqx.field(static=True)
    deviation: float
    remaining: int = eqx.field(static=True)
    error: float
    held_out: float


class EssentialParameters(eqx.Module):
    """Result of backward elimination.

    Attributes:
        fit: Fit of the essential parameters alone; the others are zero.
        full: Fit of all parameters.
        path: All steps, from the full model to a single parameter.
    """

    fit: Fit
    full: Fit
    path: tuple[Elimination, ...]

    @property
    def last(self) -> Elimination:
        """Last step that is taken."""
        return next(step for step in self.path if step.remaining == self.fit.base.size)

    @property
    def eliminated(self) -> tuple[str, ...]:
        """Names of the parameters that are not essential, in the order of elimination."""
        return tuple(s.name for s in self.path[1:] if s.remaining >= self.fit.base.size)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""
        if not self.eliminated:
            return (str(self),)
        return str(self), f"eliminated, and taken as zero: {', '.join(self.eliminated)}."

    def __str__(self):
        first, last = self.path[0], self.last
        return (
            f"{last.remaining} of {first.remaining} base parameters are essential: with them alone "
            f"the error on held-out blocks of time is {100 * last.held_out:.2f} % of the forces, "
            f"with all {100 * first.held_out:.2f} %."
        )


def essential_parameters(
    fit: Fit,
    observations: Observations | Sequence[Observations],
    *,
    cost: float = 0.02,
    uncertainty: AbstractUncertainty | None = None,
) -> EssentialParameters:
    """Eliminate the parameter with the largest relative standard deviation, again and again.

    Held-out errors decide where to stop: at the fewest parameters whose error exceeds the smallest
    on the path by `cost` at most. Standard deviations are those of the fit, scaled by the change of
    those for independent rows (Pham and Gautier, 1991).

    Args:
        fit: Fit of all base parameters.
        observations: Observations of the fit.
        cost: Acceptable relative increase of the held-out error.
        uncertainty: Method for the standard deviations; by default the spectral sandwich.

    Raises:
        InputError: If `cost` is negative, or the observations are not those of the fit.
    """
    if not cost >= 0:
        raise InputError(f"`cost` must be zero or more, but is {cost:g}.")
    recordings = (observations,) if isinstance(observations, Observations) else tuple(observations)
    problem = RegressionProblem(fit.base, recordings)
    if [int(n) for n in problem.factors.rows] != list(fit.rows):
        raise InputError("`observations` must be those of the fit, but they have other rows.")
    path, kept = _eliminate(fit, problem)
    smallest = min(step.held_out for step in path)
    within = [k for k, step in enumerate(path) if step.held_out <= (1 + cost) * smallest]
    reduced = RegressionProblem(restrict(fit.base, kept[within[-1]]), recordings)
    return EssentialParameters(fit_problem(reduced, fit.estimator, uncertainty), fit, tuple(path))


def restrict(base: BaseParameters, kept: Sequence[int]) -> BaseParameters:
    """Return the base parameters of a model in which the others are zero.

    Args:
        base: All base parameters.
        kept: Positions of those that remain.
    """
    return dataclasses.replace(
        base,
        indices=tuple(base.indices[k] for k in kept),
        kappa=np.asarray(base.kappa)[list(kept)],
    )


def _eliminate(fit: Fit, problem: RegressionProblem) -> tuple[list[Elimination], list[list[int]]]:
    """Return the path to a single parameter, and the remaining parameters at each step."""
    factors, weights, names = problem.factors, np.asarray(fit.weights), fit.base.names
    squares = weights**2
    total = float(squares @ factors.force_squares)
    R, z = factors.weighted(weights)
    parts = [
        (rest.total.weighted(weights), part.total)
        for rest, part in cross_validation_folds(problem.blocks, 10)
    ]
    kept = list(range(fit.base.size))
    naive = _estimates(factors, R, z, weights, kept)[1]
    deviations = np.asarray(fit.standard_deviations)
    known = np.isfinite(deviations) & (naive > 0)
    ratio = np.where(known, deviations / np.where(naive > 0, naive, 1.0), np.inf)
    path, sets, name, deviation = [], [], "", 0.0
    while kept:
        p, naive = _estimates(factors, R, z, weights, kept)
        error = float(squares @ factors.residual_squares(p))
        held_out = sum(squares @ part.residual_squares(_solve(*r, kept)) for r, part in parts)
        errors = float(np.sqrt(error / total)), float(np.sqrt(held_out / total))
        sets.append(list(kept))
        path.append(Elimination(name, deviation, len(kept), *errors))
        size = np.maximum(np.abs(p[kept]), np.finfo(float).tiny)
        relative = ratio[kept] * naive / size
        worst = int(np.argmax(relative))
        name, deviation = names[kept[worst]], float(relative[worst])
        del kept[worst]
    return path, sets


def _solve(R: np.ndarray, z: np.ndarray, kept: list[int]) -> np.ndarray:
    """Return the least-squares solution in some parameters; the others are zero."""
    p = np.zeros(R.shape[1])
    scale = np.linalg.norm(R[:, kept], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    p[kept] = np.linalg.lstsq(R[:, kept] / scale, z, rcond=NUMERICAL)[0] / scale
    return p


def _estimates(
    factors: Factors,
    R: np.ndarray,
    z: np.ndarray,
    weights: Float[AnyArray, " joints"],
    kept: list[int],
) -> tuple[Float[np.ndarray, " base"], Float[np.ndarray, " kept"]]:
    """Return estimates, and standard deviations for independent rows and joints' variances."""
    p = _solve(R, z, kept)
    variances = factors.residual_squares(p) / np.maximum(factors.rows, 1)
    half = np.linalg.pinv(R[:, kept], rcond=NUMERICAL)
    B = half @ half.T
    place = {k: i for i, k in enumerate(kept)}
    inner = np.zeros(len(kept))
    for joint, w, variance in zip(factors.joints, weights, variances, strict=True):
        own = [(place[k], c) for c, k in enumerate(joint.columns) if k in place]
        if own:
            rows, columns = (list(x) for x in zip(*own, strict=True))
            influence = w**2 * np.asarray(joint.R)[:, columns] @ B[rows]
            inner += variance * np.sum(influence**2, axis=0)
    return p, np.sqrt(inner)
