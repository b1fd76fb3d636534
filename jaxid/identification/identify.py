"""Identification: from observations to parameters with their uncertainty (Eqs. 26-33)."""

import dataclasses
import datetime
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations, Progress

from .estimators.estimate import AbstractEstimator
from .estimators.least_squares import WeightedLeastSquares
from .estimators.regularisation_and_weights import (
    NUMERICAL,
    AbstractSpectralSolution,
    Decomposition,
    undetermined,
)
from .factors import Factors
from .fit_result import ConditionNumbers, Fit
from .problem import RegressionProblem
from .uncertainty.result import AbstractUncertainty
from .uncertainty.spectral import SpectralSandwich


def identify(
    base: BaseParameters,
    observations: Observations | Sequence[Observations] | RegressionProblem,
    estimator: AbstractEstimator | None = None,
    progress: Progress | None = None,
    uncertainty: AbstractUncertainty | None = None,
    *,
    name: str | None = None,
) -> Fit:
    """Estimate the base parameters from one or several recordings (Eqs. 26-33).

    Args:
        base: Base parameters of the robot.
        observations: Observations of one recording, or of several that are fitted
            together; logs larger than memory come from `scan_log`. Or the regression
            problem of recordings, such as that of several processes.
        estimator: Estimator; by default least squares weighted by the largest forces.
        progress: Callback, called with the completed fraction (0 to 1) of a pass over a
            long log.
        uncertainty: Method for the standard deviations; by default the spectral
            sandwich.
        name: Name of the fit, such as `cold`; by default the names of its recordings.

    Returns:
        The estimates; `undetermined` names what these recordings do not determine.

    Raises:
        TypeError: If a model stands for base parameters, or a recording for
            observations.
        InputError: If the observations belong to another number of joints, have fewer
            rows than there are parameters, or weights are not known.
    """
    problem = observations
    if not isinstance(problem, RegressionProblem):
        recordings = tuple(problem) if isinstance(problem, Iterable) else (problem,)
        _check(base, recordings)
        problem = RegressionProblem(base, recordings, progress)
    fit = fit_problem(problem, estimator, uncertainty)
    return fit if name is None else dataclasses.replace(fit, name=name)


def fit_problem(
    problem: RegressionProblem,
    estimator: AbstractEstimator | None = None,
    uncertainty: AbstractUncertainty | None = None,
) -> Fit:
    """Estimate the base parameters of a regression problem.

    The other arguments are those of `identify`. Where only factors are known, standard
    deviations come from the block jackknife.
    """
    count = int(problem.factors.rows.sum())
    if count <= problem.base.size:
        raise InputError(
            f"there are {count} rows for {problem.base.size} base parameters: record "
            "longer, or "
            "leave out fewer rows."
        )
    estimator = estimator or WeightedLeastSquares()
    estimate = estimator(problem)
    base, blocks = estimate.base, estimate.blocks
    # Residuals are those of all rows, whatever weights the estimator gave them.
    plain = problem if base is problem.base else problem.with_base(base)
    p, weights = np.asarray(estimate.parameters), np.asarray(estimate.weights)
    squares = plain.factors.residual_squares(p)
    forces = float(np.sqrt(plain.factors.force_squares.sum()))
    factors = plain.factors if blocks is plain.blocks else blocks.total
    R, z = factors.weighted(weights)
    decomposition = Decomposition.of(R, z)
    B, taken = np.asarray(estimate.inverse), estimate.effective_parameters
    taken = float(np.sum((R @ B) * R)) if taken is None else taken
    free = p if estimate.unbounded is None else np.asarray(estimate.unbounded)
    naive = naive_covariance(factors, weights, free, B, taken)
    unknown = decomposition.unknown
    naive[unknown, unknown] = np.inf
    raw, _ = factors.weighted(np.ones(len(weights)))
    # Columns of length one.
    scaled = R / np.where(R.any(axis=0), np.linalg.norm(R, axis=0), 1.0)
    numbers = [
        float(np.linalg.cond(x)) if x.any() else np.inf for x in (raw, R, scaled)
    ]
    method = SpectralSandwich() if uncertainty is None else uncertainty
    errors, spectra = method(
        plain, dataclasses.replace(estimate, parameters=free), naive
    )
    shrinkage = _shrinkage_notes(decomposition.values, estimate.solution)
    return Fit(
        base=base,
        parameters=p,
        uncertainty=errors,
        weights=weights,
        condition_numbers=ConditionNumbers(*numbers),
        rows=tuple(int(n) for n in plain.factors.rows),
        residual_rms=np.sqrt(squares / np.maximum(plain.factors.rows, 1)),
        residual_spectra=spectra,
        residual=float(np.sqrt(squares.sum()) / forces) if forces > 0 else np.inf,
        undetermined=undetermined(blocks, weights, decomposition),
        estimator=estimator,
        solution=estimate.solution,
        consistency=estimate.consistency,
        full_parameters=None
        if estimate.standard is None
        else np.asarray(estimate.standard),
        recordings=problem.names,
        notes=(*base.notes, *shrinkage, *estimate.notes, *errors.notes),
        date=datetime.date.today().isoformat(),
        blocks=plain.blocks,
        name=", ".join(problem.names),
    )


def _check(base: Any, recordings: Sequence[Any]) -> None:
    wanted = [("base", base, BaseParameters, "base_parameters(model)")]
    wanted += [("observations", o, Observations, "observe(...)") for o in recordings]
    for name, value, kind, function in wanted:
        if not isinstance(value, kind):
            raise TypeError(
                f"`{name}` must come from `{function}`, not `{type(value).__name__}`."
            )
    n = base.model.robot.joints
    for o in recordings:
        if o.joints != n:
            raise InputError(
                f"`observations` of `{o.name}` have {o.joints} joints, the robot {n}."
            )


def naive_covariance(factors: Factors, weights, p, B, taken: float = 0.0) -> np.ndarray:
    r"""Return the covariance for independent rows and a variance of each joint.

    The estimates are $B \Theta^T W^2 Q$, so their covariance is
    $B (\sum_j w_j^4 \sigma_j^2 \Theta_j^T \Theta_j) B$: right also where the weights
    are not the reciprocals of the standard deviations. The rows determine so many
    (`taken`) parameters.
    """
    free = 1.0 - taken / float(factors.rows.sum())
    total = np.zeros((B.shape[1], B.shape[1]))
    squares = factors.residual_squares(p)
    for joint, w, square in zip(factors.joints, weights, squares, strict=True):
        gain = w**2 * np.asarray(joint.R)[:, :-1] @ B[list(joint.columns)]
        total += square / max(joint.rows * free, 1.0) * (gain.T @ gain)
    return total


def _shrinkage_notes(
    s: np.ndarray, solution: AbstractSpectralSolution
) -> tuple[str, ...]:
    """Return what standard deviations leave out where a solution shrinks weak directions."""
    live = s > NUMERICAL * s.max(initial=0.0)
    halved = solution.inverse(s) * s**2 <= 0.5
    pulled = np.count_nonzero(live & halved)
    if not pulled:
        return ()
    return (
        f"the solution pulls {pulled} of {len(s)} directions of the parameters to "
        "less than half "
        "of what the data say: standard deviations do not tell how far from the truth "
        "this is.",
    )
