"""Identification: from observations to parameters with their uncertainty (Eqs. 26-33)."""

import datetime
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator, Estimate, WeightedLeastSquares
from jaxid.identification.excited import undetermined_directions
from jaxid.identification.factors import Blocks, Factors
from jaxid.identification.fit import ConditionNumbers, Fit
from jaxid.identification.rows import Rows
from jaxid.identification.solutions import NUMERICAL, AbstractSpectralSolution, Decomposition
from jaxid.identification.streaming import Progress
from jaxid.identification.uncertainty.methods import AbstractUncertainty, SpectralSandwich
from jaxid.measurement.observations import Observations


def identify(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    estimator: AbstractEstimator | None = None,
    progress: Progress | None = None,
    uncertainty: AbstractUncertainty | None = None,
) -> Fit:
    """Estimates the base parameters from one or several recordings (Eqs. 26-33).

    Args:
        base: What can be identified on this robot.
        observations: Of one recording, or of several that are fitted together; logs larger than
            memory come from `scan_log`.
        estimator: Weighted least squares with the largest forces if None.
        progress: Is told now and then which share of a pass over a long log is done, of 1.
        uncertainty: How standard deviations are found: the spectral sandwich if None.

    Returns:
        The estimates; `undetermined` names what these recordings do not determine.

    Raises:
        TypeError: If a model stands for base parameters, or a recording for observations.
        InputError: If the observations belong to another number of joints, have fewer rows than
            there are parameters, or weights are not known.
    """
    recordings = tuple(observations) if isinstance(observations, Iterable) else (observations,)
    estimator = WeightedLeastSquares() if estimator is None else estimator
    _check(base, recordings)
    return fit_rows(Rows.of(base, recordings, progress), estimator, uncertainty=uncertainty)


def fit_blocks(
    base: BaseParameters,
    blocks: Blocks,
    estimator: AbstractEstimator,
    recordings: tuple[str, ...] = (),
) -> Fit:
    """Estimates the base parameters from factors that were made before.

    Standard deviations come from the block jackknife: there are no residuals to look at.

    Args:
        base: What can be identified on this robot.
        blocks: Factors of one or several recordings.
        estimator: How.
        recordings: Their names.

    Raises:
        InputError: If there are fewer rows than parameters, or weights are not known.
    """
    return fit_rows(Rows(base, blocks), estimator, recordings)


def fit_rows(
    rows: Rows,
    estimator: AbstractEstimator,
    recordings: tuple[str, ...] | None = None,
    uncertainty: AbstractUncertainty | None = None,
) -> Fit:
    """Estimates the base parameters from rows that were factorised before.

    Args:
        rows: Of one or several recordings.
        estimator: How.
        recordings: Their names; the rows' own if None.
        uncertainty: How standard deviations are found: the spectral sandwich if None.

    Raises:
        InputError: If there are fewer rows than parameters, weights are not known, or the estimator
            needs more than factors and has them only.
    """
    count = int(rows.factors.rows.sum())
    if count <= rows.base.size:
        raise InputError(
            f"there are {count} rows for {rows.base.size} base parameters: record longer, decimate "
            "less, or leave out fewer slow rows."
        )
    estimate = estimator(rows)
    blocks, base = estimate.blocks, estimate.base
    # Residuals are those of all rows alike, however they counted.
    plain = rows if base is rows.base else rows.with_base(base)
    p, weights = np.asarray(estimate.parameters), np.asarray(estimate.weights)
    squares = plain.factors.residual_squares(p)
    forces = float(np.sqrt(plain.factors.force_squares.sum()))
    R, z = blocks.total.weighted(weights)
    decomposition = Decomposition.of(R, z)
    naive = _naive(blocks.total, weights, decomposition, estimate)
    method = SpectralSandwich() if uncertainty is None else uncertainty
    found, spectra = method(plain, estimate, naive)
    return Fit(
        base=base,
        parameters=p,
        uncertainty=found,
        weights=weights,
        condition_numbers=_condition_numbers(blocks.total, R),
        rows=tuple(int(n) for n in plain.factors.rows),
        residual_rms=np.sqrt(squares / np.maximum(plain.factors.rows, 1)),
        residual_spectra=spectra,
        residual=float(np.sqrt(squares.sum()) / forces) if forces > 0 else np.inf,
        undetermined=undetermined_directions(blocks, weights, decomposition),
        estimator=estimator,
        solution=estimate.solution,
        consistency=estimate.consistency,
        full_parameters=None if estimate.standard is None else np.asarray(estimate.standard),
        recordings=tuple(o.name for o in rows.recordings) if recordings is None else recordings,
        notes=(
            *base.notes,
            *_pulled(decomposition, estimate.solution),
            *estimate.notes,
            *found.notes,
        ),
        date=datetime.date.today().isoformat(),
    )


def _check(base: Any, recordings: Sequence[Any]) -> None:
    if not recordings:
        raise InputError("`observations` must hold at least one recording, but is empty.")
    if not isinstance(base, BaseParameters):
        raise TypeError(
            f"`base` must be base parameters, but is a `{type(base).__name__}`: take those that "
            "`base_parameters(model)` finds."
        )
    n = base.model.robot.joints
    for observations in recordings:
        if not isinstance(observations, Observations):
            raise TypeError(
                "`observations` must be what `observe` makes of a recording, or a sequence of "
                f"such, but hold a `{type(observations).__name__}`."
            )
        if observations.joints != n:
            raise InputError(
                f"the observations `{observations.name}` have {observations.joints} joints, but "
                f"`{base.model.robot.name}` has {n}."
            )


def _naive(
    factors: Factors, weights: np.ndarray, decomposition: Decomposition, estimate: Estimate
) -> np.ndarray:
    r"""Covariance of the estimates if rows were independent and every joint had its own variance.

    The estimates are $B \Theta^T W^2 Q$, so their covariance is
    $B (\sum_j w_j^4 \sigma_j^2 \Theta_j^T \Theta_j) B$: right also where the weights are not the
    reciprocals of the standard deviations.
    """
    s = np.asarray(decomposition.values)
    B = np.asarray(estimate.inverse)
    squares = factors.residual_squares(estimate.parameters)
    taken = estimate.taken
    if taken is None:
        R, _ = factors.weighted(weights)
        taken = float(np.sum((R @ B) * R))
    freedom = 1.0 - taken / float(factors.rows.sum())
    inner = np.zeros_like(B)
    for joint, w, square in zip(factors.joints, weights, squares, strict=True):
        variance = square / max(joint.rows * freedom, 1.0)
        columns = list(joint.columns)
        felt = w**2 * np.asarray(joint.R)[:, :-1] @ B[columns]
        inner += variance * (felt.T @ felt)
    null = np.asarray(decomposition.directions)[s <= NUMERICAL * s.max(initial=0.0)]
    unknown = np.sum(null**2, axis=0) > 1e-8
    inner[unknown, unknown] = np.inf
    return inner


def _pulled(decomposition: Decomposition, solution: AbstractSpectralSolution) -> tuple[str, ...]:
    """Says what standard deviations leave out where a solution keeps weak directions small."""
    s = np.asarray(decomposition.values)
    live = s > NUMERICAL * s.max(initial=0.0)
    pulled = int(np.count_nonzero(live & (solution.inverse(s) * s**2 <= 0.5)))
    if not pulled:
        return ()
    return (
        f"the solution pulls {pulled} of {len(s)} directions of the parameters to less than half "
        "of what the data say: standard deviations tell how estimates scatter, not how far this "
        "pull takes them from the truth, and look too good where logs leave parameters open.",
    )


def _condition_numbers(factors: Factors, weighted: np.ndarray) -> ConditionNumbers:
    raw, _ = factors.weighted(np.ones(len(factors.joints)))
    norms = np.linalg.norm(weighted, axis=0)
    scaled = weighted / np.where(norms > 0, norms, 1.0)
    return ConditionNumbers(
        *(float(np.linalg.cond(x)) if x.any() else np.inf for x in (raw, weighted, scaled))
    )
