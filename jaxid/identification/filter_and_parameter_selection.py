"""Choices by errors on held-out parts of the log: the filter, and the essential parameters."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.filters import (
    AbstractDecimation,
    AbstractFilter,
    Subsample,
    ZeroPhaseButterworth,
)
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.recording import Recording

from .estimators import AbstractEstimator, WeightedLeastSquares
from .estimators.regularisation_and_weights import Decomposition
from .fit_result import Fit
from .identify import fit_problem, naive_covariance
from .problem import RegressionProblem, cross_validation_folds
from .uncertainty import AbstractUncertainty

FilterCandidate = tuple[AbstractFilter, AbstractDecimation]
"""Filter of motion, forces and columns, and decimation of forces and columns."""


class FilterChoice(eqx.Module):
    """Result of a choice of filters.

    Attributes:
        candidates: Filter and decimation of each candidate, in the given order.
        cutoffs: Cut-off frequencies of forces and columns [Hz].
        errors: Held-out error of each candidate on each part of the log, relative to
            the forces.
        correlations: Mean correlation of neighbouring rows of the residuals for each
            candidate: near zero where rows are independent.
        best: Index of the chosen candidate.
    """

    candidates: tuple[FilterCandidate, ...]
    cutoffs: Float[AnyArray, " candidates"]
    errors: Float[AnyArray, "candidates folds"]
    correlations: Float[AnyArray, " candidates"]
    best: int = eqx.field(static=True)

    @property
    def filter(self) -> AbstractFilter:
        """The chosen filter."""
        return self.candidates[self.best][0]

    @property
    def curve(self) -> Float[np.ndarray, " candidates"]:
        """Held-out error of each candidate on the whole log."""
        return np.sqrt(np.mean(np.square(self.errors), axis=1))

    def __str__(self):
        pairs = zip(self.cutoffs, 100 * self.curve, strict=True)
        shown = ", ".join(f"{cutoff:.3g} Hz {error:.2f} %" for cutoff, error in pairs)
        return (
            f"a cut-off of {self.cutoffs[self.best]:.3g} Hz predicts held-out parts of "
            f"the log best (errors by cut-off: {shown})."
        )


def choose_filter(
    base: BaseParameters,
    recordings: Recording | Sequence[Recording],
    candidates: Sequence[FilterCandidate] | None = None,
    *,
    estimator: AbstractEstimator | None = None,
    criterion: Literal["error", "whiteness"] = "error",
    min_speed: Sequence[float] | Float[AnyArray, " joints"] | None = None,
    progress: Progress | None = None,
) -> FilterChoice:
    """Choose the filter with which a model predicts held-out parts of the log best.

    With each candidate the model is fitted to all parts of the log but one, and
    predicts the forces of that part from the candidate's own motion. Measured and
    predicted forces are compared in the *widest* band of all candidates: a filter that
    hides unexplained forces gains nothing.

    Args:
        base: Base parameters of the robot.
        recordings: One or several logs.
        candidates: Pairs of a filter and its decimation; by default zero-phase
            Butterworth filters with nine cut-off frequencies from 1 Hz to a fifth of
            the sampling rate, but at most 100 Hz, each decimated to about five rows for
            each period.
        estimator: Estimator; by default least squares weighted by the largest forces.
        criterion: "error" for the smallest error on held-out parts; "whiteness" for the
            smallest correlation of neighbouring residuals, among those with at most 5 %
            more error.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or a log and a candidate do not fit to
            each other.
    """
    logs = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    if candidates is None:
        # About five rows for each period of a cut-off.
        dt = logs[0].sample_time
        highest = min(100.0, 0.2 / dt)
        cutoffs = np.geomspace(min(1.0, 0.1 * highest), highest, 9).tolist()
        steps = [max(1, int(1.0 / (5.0 * f * dt))) for f in cutoffs]
        pairs = zip(cutoffs, steps, strict=True)
        candidates = [(ZeroPhaseButterworth(f), Subsample(step)) for f, step in pairs]
    if not candidates:
        raise InputError("`candidates` must hold at least one filter, but is empty.")
    estimator = estimator or WeightedLeastSquares()
    robot, dt = base.model.robot, logs[0].sample_time
    cutoffs = np.array([filter.low_pass(dt).cutoff for filter, _ in candidates])
    edge = max(filter.edge(dt) for filter, _ in candidates)

    def inner_observations(candidate: FilterCandidate) -> list[Observations]:
        """Observe, and mask rows that are too close to the ends for the slowest candidate."""
        inner = []
        for o in (observe(log, robot, *candidate, min_speed) for log in logs):
            at = o.instants
            far = [(at >= a + edge) & (at < b - edge) for a, b in o.segments]
            inner.append(
                o.replace(mask=np.asarray(o.mask) & np.any(far, axis=0)[:, None])
            )
        return inner

    widest = inner_observations(candidates[int(np.argmax(cutoffs))])
    weights = np.asarray(estimator(RegressionProblem(base, widest)).weights)
    errors, correlations = [], []
    for number, candidate in enumerate(candidates):
        own = inner_observations(candidate)
        problem = RegressionProblem(base, own)
        if [o.samples for o in own] != [o.samples for o in widest]:
            raise InputError(
                "`candidates` leave different parts of the recordings: avoid gaps."
            )
        pairs = zip(widest, own, strict=True)
        # The candidate's motion, with forces and rows of the widest band.
        test = RegressionProblem(base, [o.replace(motion=x.motion) for o, x in pairs])
        errors.append(_held_out_errors(problem, test, estimator, weights**2))
        correlations.append(_correlation(problem, estimator))
        if progress is not None:
            progress((number + 1) / len(candidates))
    order = whole = np.mean(np.square(errors), axis=1)
    if criterion == "whiteness":
        order = np.where(whole <= 1.05**2 * whole.min(), np.abs(correlations), np.inf)
    best = int(np.argmin(order))
    found = np.array(errors), np.array(correlations)
    return FilterChoice(tuple(candidates), cutoffs, *found, best)


def _held_out_errors(
    problem, test, estimator: AbstractEstimator, squares
) -> np.ndarray:
    """Return the errors on held-out parts, relative to the forces of all parts."""
    errors, folds = [], cross_validation_folds(problem.blocks)
    total = squares @ test.factors.force_squares / len(folds)
    for rest, part in folds:
        seen = RegressionProblem(problem.base, blocks=problem.blocks.select(rest))
        held_out = test.blocks.select(part).total
        errors.append(
            squares @ held_out.residual_squares(estimator(seen).parameters) / total
        )
    return np.sqrt(errors)


def _correlation(problem: RegressionProblem, estimator: AbstractEstimator) -> float:
    """Return the correlation of neighbouring rows of the residuals, as a mean of the joints."""
    power, product = np.zeros((2, problem.robot.joints))
    for chunk, residuals in problem.residuals(
        np.asarray(estimator(problem).parameters)
    ):
        e = np.where(chunk.mask, residuals, 0.0)
        power += np.sum(e**2, axis=0)
        product += np.sum(e[1:] * e[:-1], axis=0)
    return float(np.mean(product / np.where(power > 0, power, 1.0)))


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
    def last(self) -> Elimination:
        """Last step that is taken."""
        return self.path[len(self.eliminated)]

    @property
    def eliminated(self) -> tuple[str, ...]:
        """Names of the parameters that are not essential, in the order of elimination."""
        return tuple(s.name for s in self.path[1:] if s.remaining >= self.fit.base.size)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""
        if not self.eliminated:
            return (str(self),)
        return str(
            self
        ), f"eliminated, and taken as zero: {', '.join(self.eliminated)}."

    def __str__(self):
        first, last = self.path[0], self.last
        return (
            f"{last.remaining} of {first.remaining} base parameters are essential: "
            "with them alone "
            f"the error on held-out blocks of time is {100 * last.held_out:.2f} % of "
            "the forces, "
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
    if [int(n) for n in problem.factors.rows] != list(fit.rows):
        raise InputError(
            "`observations` must be those of the fit, but they have other rows."
        )
    path, sets = _eliminate(fit, problem)
    most = (1 + cost) * min(step.held_out for step in path)
    kept = [k for k, step in zip(sets, path, strict=True) if step.held_out <= most][-1]
    indices = tuple(fit.base.indices[k] for k in kept)
    kappa = np.asarray(fit.base.kappa)[kept]
    base = dataclasses.replace(fit.base, indices=indices, kappa=kappa)
    reduced = fit_problem(problem.with_base(base), fit.estimator, uncertainty)
    return EssentialParameters(reduced, tuple(path))


def _eliminate(fit: Fit, problem: RegressionProblem) -> tuple[list[Elimination], list]:
    """Return the path to a single parameter, and the remaining parameters at each step."""
    factors, weights, blocks = problem.factors, fit.weights, problem.blocks
    squares = weights**2
    total = float(squares @ factors.force_squares)
    folds = [
        (*blocks.select(rest).total.weighted(weights), blocks.select(part).total)
        for rest, part in cross_validation_folds(blocks, 10)
    ]
    R, z = factors.weighted(weights)
    kept, ratio = list(range(fit.base.size)), np.empty(0)
    path, sets, name = [], [], ""
    while kept:
        held_out = sum(
            squares @ x.residual_squares(_solve(A, b, kept)[0]) for A, b, x in folds
        )
        sets.append(list(kept))
        path.append(Elimination(name, len(kept), float(np.sqrt(held_out / total))))
        p, B = _solve(R, z, kept)
        naive = np.sqrt(np.diag(naive_covariance(factors, weights, p, B)))
        if not ratio.size:
            known = np.isfinite(fit.standard_deviations) & (naive > 0)
            ratio = np.where(
                known, fit.standard_deviations / np.where(known, naive, 1.0), np.inf
            )
        relative = (
            ratio[kept] * naive / np.maximum(np.abs(p[kept]), np.finfo(float).tiny)
        )
        name = fit.base.names[kept.pop(int(np.argmax(relative)))]
    return path, sets


def _solve(
    R: np.ndarray, z: np.ndarray, kept: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return least squares in some parameters, the others zero, and the inverse information."""
    p, B = np.zeros(R.shape[1]), np.zeros((R.shape[1], len(kept)))
    decomposition = Decomposition.of(R[:, kept], z)
    p[kept], B[kept] = decomposition.solve(), decomposition.inverse_information()
    return p, B
