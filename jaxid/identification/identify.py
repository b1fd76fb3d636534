"""Identification: from observations to parameters with their uncertainty (Eqs. 26-33)."""

from collections.abc import Sequence

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.estimators import AbstractEstimator, WeightedLeastSquares
from jaxid.identification.excited import undetermined_directions
from jaxid.identification.factors import Blocks, Factors, factorise
from jaxid.identification.fit import ConditionNumbers, Fit
from jaxid.identification.solutions import NUMERICAL, Decomposition
from jaxid.identification.streaming import Progress
from jaxid.identification.streaming_log import LongLog
from jaxid.measurement.observations import Observations


def identify(
    base: BaseParameters,
    observations: Observations | LongLog | Sequence[Observations | LongLog],
    estimator: AbstractEstimator | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Estimates the base parameters from one or several recordings (Eqs. 26-33).

    Args:
        base: What can be identified on this robot.
        observations: Of one recording, or of several that are fitted together; logs larger than
            memory come from `open_log`.
        estimator: Weighted least squares with the largest forces if None.
        progress: Is told now and then which share of a long log is done, of 1.

    Returns:
        The estimates; `undetermined` names what these recordings do not determine.

    Raises:
        ValueError: If the observations belong to another number of joints, have fewer rows than
            there are parameters, or weights are not known.
    """
    single = isinstance(observations, Observations | LongLog)
    recordings = (observations,) if single else tuple(observations)
    estimator = WeightedLeastSquares() if estimator is None else estimator
    _check(base, recordings)
    blocks = factorise(base, recordings, progress=progress)
    return fit_blocks(base, blocks, estimator, tuple(o.name for o in recordings))


def fit_blocks(
    base: BaseParameters,
    blocks: Blocks,
    estimator: AbstractEstimator,
    recordings: tuple[str, ...] = (),
) -> Fit:
    """Estimates the base parameters from factors that were made before.

    Args:
        base: What can be identified on this robot.
        blocks: Factors of one or several recordings.
        estimator: How.
        recordings: Their names.

    Raises:
        ValueError: If there are fewer rows than parameters, or weights are not known.
    """
    factors = blocks.total
    rows = int(factors.rows.sum())
    if rows <= base.size:
        raise ValueError(
            f"there are {rows} rows for {base.size} base parameters: record longer, decimate less, "
            "or leave out fewer slow rows."
        )
    weights, solution = estimator(base.model.robot, blocks)
    R, z = factors.weighted(weights)
    decomposition = Decomposition.of(R, z)
    inverse = solution.inverse(decomposition.values)
    p = decomposition.solve(inverse)
    squares = factors.residual_squares(p)
    forces = float(np.sqrt(factors.force_squares.sum()))
    return Fit(
        base=base,
        parameters=p,
        covariance=_covariance(factors, weights, decomposition, inverse, squares),
        weights=weights,
        condition_numbers=_condition_numbers(factors, R),
        rows=tuple(int(n) for n in factors.rows),
        residual_rms=np.sqrt(squares / np.maximum(factors.rows, 1)),
        residual=float(np.sqrt(squares.sum()) / forces) if forces > 0 else np.inf,
        undetermined=undetermined_directions(blocks, weights, decomposition),
        estimator=estimator,
        solution=solution,
        recordings=recordings,
        notes=(*base.notes, *_pulled(decomposition, inverse)),
    )


def _check(base: BaseParameters, recordings: Sequence[Observations | LongLog]) -> None:
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
    factors: Factors,
    weights: np.ndarray,
    decomposition: Decomposition,
    inverse: np.ndarray,
    squares: np.ndarray,
) -> np.ndarray:
    r"""Covariance of the estimates when every joint has a variance of its own.

    The estimates are $B \Theta^T W^2 Q$, so their covariance is
    $B (\sum_j w_j^4 \sigma_j^2 \Theta_j^T \Theta_j) B$: right also where the weights are not the
    reciprocals of the standard deviations.
    """
    s, scale = np.asarray(decomposition.values), np.asarray(decomposition.scale)
    V = np.asarray(decomposition.directions) / scale
    B = (V.T * inverse) @ V
    freedom = 1.0 - float(np.sum(inverse * s**2)) / float(factors.rows.sum())
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


def _pulled(decomposition: Decomposition, inverse: np.ndarray) -> tuple[str, ...]:
    """Says what standard deviations leave out where a solution keeps weak directions small."""
    s = np.asarray(decomposition.values)
    live = s > NUMERICAL * s.max(initial=0.0)
    pulled = int(np.count_nonzero(live & (inverse * s**2 <= 0.5)))
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
