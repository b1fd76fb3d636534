"""Identification: from observations to parameters and uncertainty (Eqs. 26-33)."""

import dataclasses
import datetime
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, BaseMatrix, BaseVector, Matrix, Texts
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.open_directions import random_rows
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations, ObservedLogs, Progress

from .determination import undetermined
from .estimators.estimate import AbstractEstimator
from .estimators.least_squares import WeightedLeastSquares
from .estimators.regularisation_and_weights import (
    MIN_SINGULAR_VALUE,
    AbstractSpectralSolution,
    Decomposition,
)
from .factors import Factors
from .fit_result import ConditionNumbers, Fit
from .problem import RegressionProblem
from .uncertainty.result import AbstractUncertainty
from .uncertainty.spectral import SpectralSandwich


def identify(
    base: BaseParameters,
    observations: ObservedLogs | RegressionProblem,
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
            problem of recordings, whose factors several estimators share.
        estimator: Estimator; by default least squares weighted by the largest forces,
            or by the variances of the residuals if these forces are not known.
        progress: Callback, called with the completed fraction (0 to 1) of a pass over a
            long log.
        uncertainty: Method for the standard deviations; by default the spectral
            sandwich.
        name: Name of the fit, such as `cold`; by default the names of its recordings.

    Returns:
        The estimates; `undetermined` names what these recordings do not determine.

    Raises:
        TypeError: If a model is passed instead of base parameters, or a recording
            instead of observations.
        InputError: If the observations belong to another number of joints, have fewer
            rows than there are parameters, or the estimator needs weights that are not
            known.
    """
    if isinstance(observations, RegressionProblem):
        problem = observations
    else:
        is_sequence = isinstance(observations, Iterable)
        recordings = tuple(observations) if is_sequence else (observations,)
        _check_arguments(base, recordings)
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
    _require_more_rows_than_parameters(problem)
    if estimator is None:
        estimator = WeightedLeastSquares()
    if uncertainty is None:
        uncertainty = SpectralSandwich()

    estimate = estimator(problem)
    base, weights = estimate.base, estimate.weights
    # An estimator may choose other columns, and weight single rows.
    rows = problem if base is problem.base else problem.with_base(base)
    has_row_weights = estimate.blocks is not rows.blocks
    factors = estimate.blocks.total if has_row_weights else rows.factors
    R, z = factors.weighted(weights)
    decomposition = Decomposition.of(R, z)
    unbounded_estimate = estimate.without_bounds()
    independent_covariance = naive_covariance(
        factors,
        weights,
        unbounded_estimate.parameters,
        unbounded_estimate.inverse,
        unbounded_estimate.number_of_parameters(R),
    )
    independent_covariance[decomposition.unknown, decomposition.unknown] = np.inf
    errors, spectra = uncertainty(rows, unbounded_estimate, independent_covariance)

    # Residuals are those of all rows, whatever weights the estimator gave them.
    squares = rows.factors.residual_squares(estimate.parameters)
    force_norm = np.sqrt(rows.factors.force_squares.sum())
    relative_residual = (
        np.sqrt(squares.sum()) / force_norm if force_norm > 0 else np.inf
    )
    other_motions = random_rows(base, estimate.parameters)
    shrinkage_notes = _shrinkage_notes(decomposition.values, estimate.solution)
    return Fit(
        base=base,
        parameters=estimate.parameters,
        uncertainty=errors,
        weights=weights,
        condition_numbers=_condition_numbers(factors, R),
        rows=tuple(rows.factors.rows.tolist()),
        residual_rms=np.sqrt(squares / np.maximum(rows.factors.rows, 1)),
        residual_spectra=spectra,
        residual=float(relative_residual),
        undetermined=undetermined(
            estimate.blocks, weights, decomposition, other_motions
        ),
        estimator=estimator,
        solution=estimate.solution,
        consistency=estimate.consistency,
        full_parameters=estimate.standard,
        recordings=problem.names,
        notes=(
            *base.notes,
            *shrinkage_notes,
            *estimate.notes,
            *errors.notes,
        ),
        date=datetime.date.today().isoformat(),
        blocks=rows.blocks,
        name=", ".join(problem.names),
    )


def _check_arguments(base: Any, recordings: Sequence[Any]) -> None:
    """Reject arguments of another type, and recordings of another number of joints."""
    _require_type("base", base, BaseParameters, "base_parameters(model)")
    joints = base.model.robot.joints
    for recording in recordings:
        _require_type("observations", recording, Observations, "observe(...)")
        if recording.joints != joints:
            raise InputError(
                f"`observations` of `{recording.name}` have "
                f"{recording.joints} joints, the robot {joints}."
            )


def _require_type(name: str, value: Any, kind: type, function: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(
            f"`{name}` must come from `{function}`, not `{type(value).__name__}`."
        )


def _require_more_rows_than_parameters(problem: RegressionProblem) -> None:
    count = int(problem.factors.rows.sum())
    if count <= problem.base.size:
        raise InputError(
            f"there are {count} rows for {problem.base.size} base parameters: record "
            "longer, or leave out fewer rows."
        )


def _condition_numbers(factors: Factors, weighted_matrix: Matrix) -> ConditionNumbers:
    unweighted_matrix, _ = factors.weighted(np.ones(len(factors.joints)))
    lengths = np.linalg.norm(weighted_matrix, axis=0)
    scaled_matrix = weighted_matrix / np.where(lengths > 0, lengths, 1.0)
    matrices = unweighted_matrix, weighted_matrix, scaled_matrix
    return ConditionNumbers(
        *(float(np.linalg.cond(x)) if x.any() else np.inf for x in matrices)
    )


def naive_covariance(
    factors: Factors,
    weights: AnyArray,
    parameters: BaseVector,
    inverse: BaseMatrix,
    effective_parameters: float = 0.0,
) -> BaseMatrix:
    r"""Return the covariance for independent rows and a variance of each joint.

    The estimates are $B \Theta^T W^2 Q$, so their covariance is
    $B (\sum_j w_j^4 \sigma_j^2 \Theta_j^T \Theta_j) B$. This is right also where the
    weights are not the reciprocals of the standard deviations.
    """
    # Each joint pays for the parameters by its share of the rows.
    remaining_share = 1.0 - effective_parameters / float(factors.rows.sum())
    squares = factors.residual_squares(parameters)
    unknowns = inverse.shape[1]
    covariance = np.zeros((unknowns, unknowns))
    for joint, weight, square in zip(factors.joints, weights, squares, strict=True):
        variance = square / max(joint.rows * remaining_share, 1.0)
        columns = np.asarray(joint.R)[:, :-1]
        gain = weight**2 * columns @ inverse[list(joint.columns)]
        covariance += variance * (gain.T @ gain)
    return covariance


def _shrinkage_notes(values: BaseVector, solution: AbstractSpectralSolution) -> Texts:
    """Return what standard deviations omit if a solution shrinks weak directions."""
    is_visible = values > MIN_SINGULAR_VALUE * values.max(initial=0.0)
    fractions = solution.inverse(values) * values**2
    count = np.count_nonzero(is_visible & (fractions <= 0.5))
    if not count:
        return ()
    return (
        f"regularisation shrinks {count} of {len(values)} combinations of parameters "
        "to less than half of their value without it: standard deviations do not "
        "include the resulting bias.",
    )
