"""Identification: from observations to parameters with their uncertainty (Eqs. 26-33)."""

from collections.abc import Sequence

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.estimators import AbstractEstimator, WeightedLeastSquares
from jaxid.identification.excited import undetermined_directions
from jaxid.identification.factors import Factors, factorise
from jaxid.identification.fit import ConditionNumbers, Fit
from jaxid.identification.solutions import Decomposition, Solved
from jaxid.measurement.observations import Observations

LARGEST_UNCERTAINTY = 0.1
"""Share of the whole forces by which an undetermined combination may be wrong."""


def identify(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    estimator: AbstractEstimator | None = None,
) -> Fit:
    """Estimates the base parameters from one or several recordings (Eqs. 26-33).

    Args:
        base: What can be identified on this robot.
        observations: Of one recording, or of several that are fitted together.
        estimator: Weighted least squares with the largest forces if None.

    Returns:
        The estimates; `undetermined` names what these recordings do not determine.

    Raises:
        ValueError: If the observations belong to another number of joints, have fewer rows than
            there are parameters, or weights are not known.
    """
    recordings = (observations,) if isinstance(observations, Observations) else tuple(observations)
    estimator = WeightedLeastSquares() if estimator is None else estimator
    _check(base, recordings)
    factors = factorise(base, recordings)
    return fit_factors(base, factors, estimator, tuple(o.name for o in recordings))


def fit_factors(
    base: BaseParameters,
    factors: Factors,
    estimator: AbstractEstimator,
    recordings: tuple[str, ...] = (),
) -> Fit:
    """Estimates the base parameters from factors that were made before.

    Args:
        base: What can be identified on this robot.
        factors: Of one or several recordings.
        estimator: How.
        recordings: Their names.

    Raises:
        ValueError: If there are fewer rows than parameters, or weights are not known.
    """
    rows = int(factors.rows.sum())
    if rows <= base.size:
        raise ValueError(
            f"there are {rows} rows for {base.size} base parameters: record longer, decimate less, "
            "or leave out fewer slow rows."
        )
    weights, solved = estimator(base.model.robot, factors)
    R, z = factors.weighted(weights)
    decomposition = Decomposition.of(R, z)
    p = np.asarray(solved.parameters)
    squares = factors.residual_squares(p)
    undetermined = undetermined_directions(
        decomposition, float(np.linalg.norm(z)), rows, LARGEST_UNCERTAINTY
    )
    forces = float(np.sqrt(factors.force_squares.sum()))
    return Fit(
        base=base,
        parameters=p,
        covariance=_covariance(factors, weights, solved, squares),
        weights=weights,
        condition_numbers=_condition_numbers(factors, R),
        rows=tuple(int(n) for n in factors.rows),
        residual_rms=np.sqrt(squares / np.maximum(factors.rows, 1)),
        residual=float(np.sqrt(squares.sum()) / forces) if forces > 0 else np.inf,
        undetermined=undetermined,
        estimator=estimator,
        recordings=recordings,
        notes=base.notes,
    )


def _check(base: BaseParameters, recordings: Sequence[Observations]) -> None:
    if not recordings:
        raise ValueError("`observations` must hold at least one recording, but is empty.")
    n = base.model.robot.joints
    for observations in recordings:
        if observations.joints != n:
            raise ValueError(
                f"the observations `{observations.name}` have {observations.joints} joints, but "
                f"`{base.model.robot.name}` has {n}."
            )


def _covariance(
    factors: Factors, weights: np.ndarray, solved: Solved, squares: np.ndarray
) -> np.ndarray:
    r"""Covariance of the estimates when every joint has a variance of its own.

    With $S S^T$ the inverse of the information, it is
    $S S^T (\sum_j w_j^4 \sigma_j^2 \Theta_j^T \Theta_j) S S^T$: right also where the weights are
    not the reciprocals of the standard deviations.
    """
    root = np.asarray(solved.root)
    freedom = 1.0 - solved.kept / float(factors.rows.sum())
    inner = np.zeros((solved.kept, solved.kept))
    for joint, w, square in zip(factors.joints, weights, squares, strict=True):
        variance = square / max(joint.rows * freedom, 1.0)
        felt = np.asarray(joint.R)[:, :-1] @ root[list(joint.columns)]
        inner += w**4 * variance * (felt.T @ felt)
    covariance = root @ inner @ root.T
    unknown = ~np.any(root != 0.0, axis=1)
    covariance[unknown, unknown] = np.inf
    return covariance


def _condition_numbers(factors: Factors, weighted: np.ndarray) -> ConditionNumbers:
    raw, _ = factors.weighted(np.ones(len(factors.joints)))
    norms = np.linalg.norm(weighted, axis=0)
    scaled = weighted / np.where(norms > 0, norms, 1.0)
    return ConditionNumbers(
        *(float(np.linalg.cond(x)) if x.any() else np.inf for x in (raw, weighted, scaled))
    )
