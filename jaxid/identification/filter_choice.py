"""Choice of the filter: by the error of prediction on held-out parts of the log."""

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


class FilterCandidate(eqx.Module):
    """A filter with its decimation.

    Attributes:
        filter: Filter of motion, forces and columns.
        decimation: Decimation of forces and columns.
    """

    filter: AbstractFilter
    decimation: AbstractDecimation = Subsample(1)


class FilterChoice(eqx.Module):
    """Result of a choice of filters.

    Attributes:
        candidates: Candidates in the given order.
        cutoffs: Cut-off frequencies of forces and columns [Hz].
        errors: Held-out error of each candidate on each part of the log, relative to the forces.
        correlations: Mean correlation of neighbouring rows of the residuals for each candidate:
            near zero where rows are independent.
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
        return self.candidates[self.best].filter

    @property
    def decimation(self) -> AbstractDecimation:
        """The chosen decimation."""
        return self.candidates[self.best].decimation

    @property
    def curve(self) -> Float[np.ndarray, " candidates"]:
        """Held-out error of each candidate on the whole log."""
        return np.sqrt(np.mean(np.asarray(self.errors) ** 2, axis=1))

    def __str__(self):
        shown = ", ".join(
            f"{cutoff:.3g} Hz {100 * error:.2f} %"
            for cutoff, error in zip(np.asarray(self.cutoffs), self.curve, strict=True)
        )
        return (
            f"a cut-off of {np.asarray(self.cutoffs)[self.best]:.3g} Hz predicts held-out parts of "
            f"the log best (errors by cut-off: {shown})."
        )


class AbstractFilterCriterion(eqx.Module):
    """A criterion by which a filter is chosen."""

    @abstractmethod
    def choose(
        self,
        errors: Float[np.ndarray, "candidates folds"],
        correlations: Float[np.ndarray, " candidates"],
    ) -> int:
        """Return the index of the best candidate."""


class HeldOutError(AbstractFilterCriterion):
    """Smallest error on held-out parts of the log."""

    def choose(self, errors, correlations):
        """Return the candidate with the smallest mean square."""
        return int(np.argmin(np.mean(errors**2, axis=1)))


class WhitestResidual(AbstractFilterCriterion):
    """Smallest correlation of neighbouring rows of the residuals.

    Attributes:
        cost: Acceptable relative increase of the held-out error.
    """

    cost: float = eqx.field(static=True, default=0.05)

    def choose(self, errors, correlations):
        """Return the whitest candidate of those that predict nearly as well as the best."""
        whole = np.sqrt(np.mean(errors**2, axis=1))
        good = whole <= (1 + self.cost) * whole.min()
        return int(np.argmin(np.where(good, np.abs(correlations), np.inf)))


def butterworth_candidates(
    sample_time: float, cutoffs: Sequence[float] | None = None, order: int = 4
) -> tuple[FilterCandidate, ...]:
    """Return zero-phase Butterworth filters, each decimated to about five rows for each period.

    Args:
        sample_time: Sample time of the recording [s].
        cutoffs: Cut-off frequencies [Hz]; by default nine from 1 Hz to a fifth of the sampling
            rate, but at most 100 Hz.
        order: Order of one direction.
    """
    if cutoffs is None:
        highest = min(100.0, 0.2 / sample_time)
        cutoffs = [float(f) for f in np.geomspace(min(1.0, 0.1 * highest), highest, 9)]
    steps = [max(1, int(1.0 / (5.0 * f * sample_time))) for f in cutoffs]
    return tuple(
        FilterCandidate(ZeroPhaseButterworth(f, order), Subsample(step))
        for f, step in zip(cutoffs, steps, strict=True)
    )


def choose_filter(
    base: BaseParameters,
    recordings: Recording | Sequence[Recording],
    candidates: Sequence[FilterCandidate] | None = None,
    *,
    estimator: AbstractEstimator | None = None,
    criterion: AbstractFilterCriterion | None = None,
    min_speed: Sequence[float] | Float[AnyArray, " joints"] | None = None,
    progress: Progress | None = None,
) -> FilterChoice:
    """Choose the filter with which a model predicts held-out parts of the log best.

    With each candidate the model is fitted to all parts of the log but one, and predicts the forces
    of that part from the candidate's own motion. Measured and predicted forces are compared in the
    *widest* band of all candidates: a filter that hides unexplained forces gains nothing.

    Args:
        base: Base parameters of the robot.
        recordings: One or several logs.
        candidates: Candidates; by default Butterworth filters of several cut-off frequencies.
        estimator: Estimator; by default least squares weighted by the largest forces.
        criterion: Criterion; by default `HeldOutError`.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or a log and a candidate do not fit to each other.
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

    def inner_observations(candidate: FilterCandidate) -> list[Observations]:
        filtered = [
            observe(log, robot, candidate.filter, candidate.decimation, min_speed) for log in logs
        ]
        return [_inner_rows(o, edge) for o in filtered]

    widest = inner_observations(candidates[int(np.argmax(cutoffs))])
    weights = np.asarray(estimator(RegressionProblem(base, widest)).weights)
    errors, correlations = [], []
    for number, candidate in enumerate(candidates):
        own = inner_observations(candidate)
        problem = RegressionProblem(base, own)
        test = RegressionProblem(base, [_with_motion(*x) for x in zip(widest, own, strict=True)])
        errors.append(_held_out_errors(problem, test, estimator, weights**2))
        correlations.append(_correlation(problem, estimator))
        if progress is not None:
            progress((number + 1) / len(candidates))
    best = criterion.choose(np.array(errors), np.array(correlations))
    return FilterChoice(tuple(candidates), cutoffs, np.array(errors), np.array(correlations), best)


def _inner_rows(observations: Observations, edge: int) -> Observations:
    """Mask rows that are too close to the ends for the slowest candidate."""
    at = observations.instants
    far = np.zeros(len(at), bool)
    for a, b in observations.segments:
        far |= (at >= a + edge) & (at < b - edge)
    return observations.replace(mask=np.asarray(observations.mask) & far[:, None])


def _with_motion(widest: Observations, own: Observations) -> Observations:
    """Return a candidate's motion with forces and rows of the widest band."""
    if widest.samples != own.samples:
        raise InputError(
            f"the filters of `candidates` leave different parts of `{widest.name}`, whose gaps are "
            "close together: choose on a log without, or take filters with similar edges."
        )
    return widest.replace(motion=own.motion)


def _held_out_errors(
    problem: RegressionProblem,
    test: RegressionProblem,
    estimator: AbstractEstimator,
    squares: Float[np.ndarray, " joints"],
) -> Float[np.ndarray, " folds"]:
    """Return the errors on held-out parts, relative to the forces of all parts."""
    folds = cross_validation_folds(problem.blocks), cross_validation_folds(test.blocks)
    pairs = [(rest, part) for (rest, _), (_, part) in zip(*folds, strict=True)]
    total = squares @ test.factors.force_squares / len(pairs)
    errors = []
    for rest, part in pairs:
        p = estimator(RegressionProblem(problem.base, blocks=rest)).parameters
        errors.append(np.sqrt(squares @ part.total.residual_squares(p) / total))
    return np.array(errors)


def _correlation(problem: RegressionProblem, estimator: AbstractEstimator) -> float:
    """Return the correlation of neighbouring rows of the residuals, as a mean of the joints."""
    power, product = np.zeros(problem.robot.joints), np.zeros(problem.robot.joints)
    for chunk, residuals in problem.residuals(np.asarray(estimator(problem).parameters)):
        e = np.where(chunk.mask, residuals, 0.0)
        power += np.sum(e**2, axis=0)
        product += np.sum(e[1:] * e[:-1], axis=0)
    return float(np.mean(product / np.where(power > 0, power, 1.0)))
