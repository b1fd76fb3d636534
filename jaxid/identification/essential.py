"""Essential parameters: those without which the model predicts worse."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.factors import Factors
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem, cross_validation_folds
from jaxid.identification.solutions import NUMERICAL
from jaxid.identification.uncertainty.methods import AbstractUncertainty
from jaxid.measurement.observations import Observations

COST = 0.02
"""Held-out error that leaving parameters out may cost, of the smallest on the way, of 1."""


class Elimination(eqx.Module):
    """One step of backward elimination.

    Attributes:
        name: Of the base parameter that is left out; empty before the first step.
        deviation: Its standard deviation relative to its size when it was left out, of 1.
        left: Number of parameters that are left.
        error: Weighted error on the rows themselves, relative to the forces, of 1.
        held_out: Weighted error on blocks of time not seen, relative to the forces, of 1.
    """

    name: str = eqx.field(static=True)
    deviation: float
    left: int = eqx.field(static=True)
    error: float
    held_out: float


class EssentialParameters(eqx.Module):
    """What is left of a model when parameters that tell nothing are left out.

    Attributes:
        fit: Of the essential parameters alone; the others are zero.
        full: The fit that it began with.
        path: All steps, from the full model on, beyond the chosen one too.
    """

    fit: Fit
    full: Fit
    path: tuple[Elimination, ...]

    @property
    def chosen(self) -> Elimination:
        """The step at which elimination was stopped."""
        return next(step for step in self.path if step.left == self.fit.base.size)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the parameters that are not essential, in the order in which they went."""
        return tuple(s.name for s in self.path[1:] if s.left >= self.fit.base.size)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know, in sentences."""
        if not self.left_out:
            return (str(self),)
        return str(self), f"left out, and taken as zero: {', '.join(self.left_out)}."

    def __str__(self):
        first, last = self.path[0], self.chosen
        return (
            f"{last.left} of {first.left} base parameters are essential: with them alone the error "
            f"on blocks of time not seen is {100 * last.held_out:.2f} % of the forces, with all "
            f"{100 * first.held_out:.2f} %."
        )


def essential_parameters(
    fit: Fit,
    observations: Observations | Sequence[Observations],
    *,
    cost: float = COST,
    uncertainty: AbstractUncertainty | None = None,
) -> EssentialParameters:
    """Leaves out the parameter with the largest relative standard deviation, again and again.

    Errors on blocks of time that were left out in turn decide where to stop: at the fewest
    parameters whose error exceeds the smallest on the way by `cost` at most. Standard deviations
    are those of the fit, changed as they change for independent rows. (Pham and Gautier, 1991.)

    Args:
        fit: Of all base parameters.
        observations: Those of the fit.
        cost: Held-out error that this may cost, of the smallest on the way, of 1.
        uncertainty: How standard deviations are found; the spectral sandwich if None.

    Raises:
        InputError: If `cost` is negative, or the observations are not those of the fit.
    """
    if not cost >= 0:
        raise InputError(f"`cost` must be a share of zero or more, but is {cost:g}.")
    single = isinstance(observations, Observations)
    recordings = (observations,) if single else tuple(observations)
    rows = RegressionProblem(fit.base, recordings)
    if [int(n) for n in rows.factors.rows] != list(fit.rows):
        raise InputError(
            "`observations` must be those that the fit was made of, but they have other rows."
        )
    path, kept = _eliminated(fit, rows)
    smallest = min(step.held_out for step in path)
    within = [k for k, step in enumerate(path) if step.held_out <= (1 + cost) * smallest]
    base = restricted(fit.base, kept[within[-1]])
    left = fit_problem(RegressionProblem(base, recordings), fit.estimator, uncertainty=uncertainty)
    return EssentialParameters(left, fit, tuple(path))


def restricted(base: BaseParameters, kept: Sequence[int]) -> BaseParameters:
    """The model in which only some base parameters are not zero.

    Args:
        base: All base parameters.
        kept: Positions of those that are left.
    """
    return dataclasses.replace(
        base,
        indices=tuple(base.indices[k] for k in kept),
        kappa=np.asarray(base.kappa)[list(kept)],
    )


def _eliminated(fit: Fit, rows: RegressionProblem) -> tuple[list[Elimination], list[list[int]]]:
    """The path to a single parameter, and which are left at each step."""
    weights, names = np.asarray(fit.weights), fit.base.names
    squares = weights**2
    whole = float(squares @ rows.factors.force_squares)
    R, z = rows.factors.weighted(weights)
    parts = [
        (rest.total.weighted(weights), part.total)
        for rest, part in cross_validation_folds(rows.blocks, 10)
    ]
    kept = list(range(fit.base.size))
    deviations = _deviations(rows.factors, R, z, weights, kept)[1]
    honest = np.asarray(fit.standard_deviations)
    known = np.isfinite(honest) & (deviations > 0)
    ratio = np.where(known, honest / np.where(deviations > 0, deviations, 1.0), np.inf)
    path, sets, name, share = [], [], "", 0.0
    while kept:
        p, naive = _deviations(rows.factors, R, z, weights, kept)
        left_out = sum(squares @ part.residual_squares(_solved(*r, kept)) for r, part in parts)
        error = float(squares @ rows.factors.residual_squares(p))
        sets.append(list(kept))
        path.append(
            Elimination(
                name,
                share,
                len(kept),
                float(np.sqrt(error / whole)),
                float(np.sqrt(left_out / whole)),
            )
        )
        size = np.maximum(np.abs(p[kept]), np.finfo(float).tiny)
        relative = ratio[kept] * naive / size
        worst = int(np.argmax(relative))
        name, share = names[kept[worst]], float(relative[worst])
        del kept[worst]
    return path, sets


def _solved(R: np.ndarray, z: np.ndarray, kept: list[int]) -> np.ndarray:
    """Least squares in some parameters; the others are zero."""
    p = np.zeros(R.shape[1])
    scale = np.linalg.norm(R[:, kept], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    p[kept] = np.linalg.lstsq(R[:, kept] / scale, z, rcond=NUMERICAL)[0] / scale
    return p


def _deviations(
    factors: Factors,
    R: np.ndarray,
    z: np.ndarray,
    weights: Float[AnyArray, " joints"],
    kept: list[int],
) -> tuple[Float[np.ndarray, " base"], Float[np.ndarray, " kept"]]:
    """Estimates, and standard deviations for independent rows with a variance of each joint."""
    p = _solved(R, z, kept)
    variances = factors.residual_squares(p) / np.maximum(factors.rows, 1)
    half = np.linalg.pinv(R[:, kept], rcond=NUMERICAL)
    B = half @ half.T
    place = {k: i for i, k in enumerate(kept)}
    inner = np.zeros(len(kept))
    for joint, w, variance in zip(factors.joints, weights, variances, strict=True):
        own = [(place[k], c) for c, k in enumerate(joint.columns) if k in place]
        if own:
            rows, columns = (list(x) for x in zip(*own, strict=True))
            felt = w**2 * np.asarray(joint.R)[:, columns] @ B[rows]
            inner += variance * np.sum(felt**2, axis=0)
    return p, np.sqrt(inner)
