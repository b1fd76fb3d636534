"""Filters chosen by data: which one lets the model predict forces that it has not seen."""

from abc import abstractmethod
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators import AbstractEstimator, WeightedLeastSquares
from jaxid.identification.problem import RegressionProblem, cross_validation_folds
from jaxid.measurement.decimation import AbstractDecimation, Subsample
from jaxid.measurement.filters import AbstractFilter, ZeroPhaseButterworth
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot

Slow = Sequence[float] | Float[AnyArray, " joints"] | None
CUTOFFS = 9
ROWS_PER_CUTOFF = 5.0
"""Rows for each period of the cut-off that decimation leaves."""


class FilterCandidate(eqx.Module):
    """A filter with its decimation.

    Attributes:
        filter: For motion, forces and columns.
        decimation: For forces and columns.
    """

    filter: AbstractFilter
    decimation: AbstractDecimation = Subsample(1)


class FilterChoice(eqx.Module):
    """The filter that was chosen, and why.

    Attributes:
        candidates: In the order given.
        cutoffs: Of forces and columns [Hz].
        errors: For each candidate and part of the log the held-out error relative to the forces,
            of 1.
        correlations: For each candidate the mean correlation of neighbouring rows of the residuals,
            of 1: near zero where rows are independent.
        best: Which candidate is chosen.
    """

    candidates: tuple[FilterCandidate, ...]
    cutoffs: Float[AnyArray, " candidates"]
    errors: Float[AnyArray, "candidates folds"]
    correlations: Float[AnyArray, " candidates"]
    best: int = eqx.field(static=True)

    @property
    def filter(self) -> AbstractFilter:
        """The chosen filter."""
        return self.candidates[self.best].filter

    @property
    def decimation(self) -> AbstractDecimation:
        """The chosen decimation."""
        return self.candidates[self.best].decimation

    @property
    def curve(self) -> Float[np.ndarray, " candidates"]:
        """For each candidate the held-out error of the whole log, of 1."""
        return np.sqrt(np.mean(np.asarray(self.errors) ** 2, axis=1))

    def __str__(self):
        shown = ", ".join(
            f"{cutoff:.3g} Hz {100 * error:.2f} %"
            for cutoff, error in zip(np.asarray(self.cutoffs), self.curve, strict=True)
        )
        return (
            f"a cut-off of {np.asarray(self.cutoffs)[self.best]:.3g} Hz predicts unseen parts of "
            f"the log best (errors by cut-off: {shown})."
        )


class AbstractFilterCriterion(eqx.Module):
    """What a filter is chosen by."""

    @abstractmethod
    def choose(
        self,
        errors: Float[np.ndarray, "candidates folds"],
        correlations: Float[np.ndarray, " candidates"],
    ) -> int:
        """Number of the best candidate."""


class HeldOutError(AbstractFilterCriterion):
    """The smallest error on parts of the log that the fit has not seen."""

    def choose(self, errors, correlations):
        """The smallest mean square."""
        return int(np.argmin(np.mean(errors**2, axis=1)))


class WhitestResidual(AbstractFilterCriterion):
    """The residuals whose neighbouring rows are least alike.

    Attributes:
        cost: Held-out error that this may cost, of the smallest one, of 1.
    """

    cost: float = eqx.field(static=True, default=0.05)

    def choose(self, errors, correlations):
        """The smallest correlation among candidates that predict nearly as well as the best."""
        whole = np.sqrt(np.mean(errors**2, axis=1))
        good = whole <= (1 + self.cost) * whole.min()
        return int(np.argmin(np.where(good, np.abs(correlations), np.inf)))


def butterworth_candidates(
    sample_time: float, cutoffs: Sequence[float] | None = None, order: int = 4
) -> tuple[FilterCandidate, ...]:
    """Zero-phase Butterworth filters, each decimated to about five rows for each of its periods.

    Args:
        sample_time: Of the recording [s].
        cutoffs: From 1 Hz to a fifth of the sampling rate, but no more than 100 Hz, if None [Hz].
        order: Of one direction.
    """
    if cutoffs is None:
        highest = min(100.0, 0.2 / sample_time)
        cutoffs = [float(f) for f in np.geomspace(min(1.0, 0.1 * highest), highest, CUTOFFS)]
    return tuple(
        FilterCandidate(
            ZeroPhaseButterworth(f, order),
            Subsample(max(1, int(1.0 / (ROWS_PER_CUTOFF * f * sample_time)))),
        )
        for f in cutoffs
    )


def choose_filter(
    base: BaseParameters,
    recordings: Recording | Sequence[Recording],
    candidates: Sequence[FilterCandidate] | None = None,
    *,
    estimator: AbstractEstimator | None = None,
    criterion: AbstractFilterCriterion | None = None,
    slow: Slow = None,
    progress: Progress | None = None,
) -> FilterChoice:
    """Searches the filter with which a model predicts best what it has not seen.

    With each candidate the model is fitted to all parts of the log but one, and predicts the forces
    of that part from the candidate's own motion. Measured and predicted forces are compared in the
    *widest* band of all candidates, the same for all of them: a filter that hides what it cannot
    explain gains nothing.

    Args:
        base: What can be identified on this robot.
        recordings: One or several logs.
        candidates: Butterworth filters of several cut-offs if None.
        estimator: Weighted least squares with the largest forces if None.
        criterion: `HeldOutError` if None.
        slow: Speed of each joint below which its rows do not count [rad/s or m/s].
        progress: Is told now and then which share of the candidates is done, of 1.

    Raises:
        InputError: If there are no candidates, or a log and a candidate do not go together.
    """
    logs = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    if candidates is None:
        candidates = butterworth_candidates(logs[0].sample_time)
    if not candidates:
        raise InputError("`candidates` must hold at least one filter, but is empty.")
    estimator = WeightedLeastSquares() if estimator is None else estimator
    criterion = HeldOutError() if criterion is None else criterion
    robot, dt = base.model.robot, logs[0].sample_time
    cutoffs = np.array([c.filter.low_pass(dt).cutoff for c in candidates])
    edge = max(c.filter.edge(dt) for c in candidates)
    widest = candidates[int(np.argmax(cutoffs))]
    judges = [_inner(_observed(x, robot, widest, slow), edge) for x in logs]
    weights = np.asarray(estimator(RegressionProblem(base, judges)).weights)
    errors, correlations = [], []
    for number, candidate in enumerate(candidates):
        seen = [_inner(_observed(x, robot, candidate, slow), edge) for x in logs]
        rows = RegressionProblem(base, seen)
        judge = RegressionProblem(
            base, [_with_motion(*pair) for pair in zip(judges, seen, strict=True)]
        )
        errors.append(_errors(rows, judge, estimator, weights**2))
        correlations.append(_correlation(rows, estimator))
        if progress is not None:
            progress((number + 1) / len(candidates))
    best = criterion.choose(np.array(errors), np.array(correlations))
    return FilterChoice(tuple(candidates), cutoffs, np.array(errors), np.array(correlations), best)


def _observed(
    recording: Recording, robot: Robot, candidate: FilterCandidate, slow: Slow
) -> Observations:
    return observe(recording, robot, candidate.filter, candidate.decimation, slow)


def _inner(observations: Observations, edge: int) -> Observations:
    """Only rows that are far enough from the ends for the slowest candidate."""
    at = observations.instants
    far = np.zeros(len(at), bool)
    for a, b in observations.segments:
        far |= (at >= a + edge) & (at < b - edge)
    mask = np.asarray(observations.mask) & far[:, None]
    return observations.replace(mask=mask)


def _with_motion(judge: Observations, observations: Observations) -> Observations:
    """A candidate's motion with forces and rows of the widest band."""
    if judge.motion.q.shape != observations.motion.q.shape:
        raise InputError(
            f"the filters of `candidates` leave different parts of `{judge.name}`, whose gaps are "
            "close together: choose on a log without, or take filters whose edges are alike."
        )
    return judge.replace(motion=observations.motion)


def _errors(
    rows: RegressionProblem,
    judge: RegressionProblem,
    estimator: AbstractEstimator,
    squares: Float[np.ndarray, " joints"],
) -> Float[np.ndarray, " folds"]:
    """Errors on parts not seen, relative to the forces of all parts."""
    whole = squares @ judge.factors.force_squares / 5
    pairs = zip(
        cross_validation_folds(rows.blocks), cross_validation_folds(judge.blocks), strict=True
    )
    return np.array(
        [
            np.sqrt(
                squares
                @ part.total.residual_squares(
                    estimator(RegressionProblem(rows.base, blocks=rest)).parameters
                )
                / whole
            )
            for (rest, _), (_, part) in pairs
        ]
    )


def _correlation(rows: RegressionProblem, estimator: AbstractEstimator) -> float:
    """How alike neighbouring rows of the residuals are: the mean of the joints."""
    power, alike = np.zeros(rows.robot.joints), np.zeros(rows.robot.joints)
    for chunk, residuals in rows.residuals(np.asarray(estimator(rows).parameters)):
        e = np.where(chunk.mask, residuals, 0.0)
        power += np.sum(e**2, axis=0)
        alike += np.sum(e[1:] * e[:-1], axis=0)
    return float(np.mean(alike / np.where(power > 0, power, 1.0)))
