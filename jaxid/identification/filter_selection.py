"""Choice of a filter by errors on held-out parts of the log."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Joints
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
from .problem import RegressionProblem, cross_validation_folds

FilterCandidate = tuple[AbstractFilter, AbstractDecimation]
"""Filter of motion, forces and columns, and decimation of forces and columns."""

CANDIDATES = 9
"""Number of filters that are tried by default."""
MAX_CUTOFF = 100.0
"""Highest cut-off frequency that is tried by default [Hz]."""
MAX_CUTOFF_SHARE = 0.2
"""The same, relative to the sampling rate."""
ROWS_PER_PERIOD = 5.0
"""Rows that the default decimation keeps in each period of a cut-off frequency."""


class FilterChoice(eqx.Module):
    """Result of a choice of filters.

    Attributes:
        candidates: Filter and decimation of each candidate, in the given order.
        cutoffs: Cut-off frequencies of forces and columns [Hz].
        errors: Held-out error of each candidate on each part of the log, relative to
            the forces.
        best: Index of the chosen candidate.
    """

    candidates: tuple[FilterCandidate, ...]
    cutoffs: Float[AnyArray, " candidates"]
    errors: Float[AnyArray, "candidates folds"]
    best: int = eqx.field(static=True)

    @property
    def filter(self) -> AbstractFilter:
        """The chosen filter."""
        return self.candidates[self.best][0]

    @property
    def curve(self) -> np.ndarray:
        """Held-out error of each candidate on the whole log."""
        return np.sqrt(np.mean(np.square(self.errors), axis=1))

    def __str__(self):
        pairs = zip(self.cutoffs, 100 * self.curve, strict=True)
        errors = ", ".join(f"{cutoff:.3g} Hz {error:.2f} %" for cutoff, error in pairs)
        return (
            f"a cut-off of {self.cutoffs[self.best]:.3g} Hz predicts held-out parts of "
            f"the log best (errors by cut-off: {errors})."
        )


def choose_filter(
    base: BaseParameters,
    recordings: Recording | Sequence[Recording],
    candidates: Sequence[FilterCandidate] | None = None,
    *,
    estimator: AbstractEstimator | None = None,
    min_speed: Sequence[float] | Joints | None = None,
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
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or a log and a candidate do not fit to
            each other.
    """
    logs = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    if candidates is None:
        candidates = _default_candidates(logs[0].sample_time)
    if not candidates:
        raise InputError("`candidates` must hold at least one filter, but is empty.")
    estimator = estimator or WeightedLeastSquares()
    robot = base.model.robot
    dt = logs[0].sample_time
    cutoffs = np.array([filter.low_pass(dt).cutoff for filter, _ in candidates])
    edge = max(filter.edge(dt) for filter, _ in candidates)

    def observe_with(candidate: FilterCandidate):
        """Observe the rows that are far enough from the ends for all candidates."""
        observations = [observe(log, robot, *candidate, min_speed) for log in logs]
        return [_mask_ends(o, edge) for o in observations]

    widest_band = observe_with(candidates[int(np.argmax(cutoffs))])
    # All candidates are judged with the same weights of the joints.
    weights = np.asarray(estimator(RegressionProblem(base, widest_band)).weights)
    errors = []
    for number, candidate in enumerate(candidates):
        observations = observe_with(candidate)
        problem = RegressionProblem(base, observations)
        test = RegressionProblem(base, _with_motions(widest_band, observations))
        errors.append(_held_out_errors(problem, test, estimator, weights**2))
        if progress is not None:
            progress((number + 1) / len(candidates))
    return FilterChoice(
        candidates=tuple(candidates),
        cutoffs=cutoffs,
        errors=np.array(errors),
        best=int(np.argmin(np.mean(np.square(errors), axis=1))),
    )


def _default_candidates(sample_time: float):
    """Return Butterworth filters over the usual range of cut-off frequencies."""
    max_cutoff = min(MAX_CUTOFF, MAX_CUTOFF_SHARE / sample_time)
    min_cutoff = min(1.0, 0.1 * max_cutoff)
    candidates = []
    for cutoff in np.geomspace(min_cutoff, max_cutoff, CANDIDATES).tolist():
        step = max(1, int(1.0 / (ROWS_PER_PERIOD * cutoff * sample_time)))
        candidates.append((ZeroPhaseButterworth(cutoff), Subsample(step)))
    return candidates


def _with_motions(
    widest_band: Sequence[Observations], observations: Sequence[Observations]
):
    """Return the motions of a candidate, with forces and rows of the widest band."""
    if [o.samples for o in observations] != [o.samples for o in widest_band]:
        raise InputError(
            "`candidates` leave different parts of the recordings: avoid gaps."
        )
    pairs = zip(widest_band, observations, strict=True)
    return [o.replace(motion=candidate.motion) for o, candidate in pairs]


def _mask_ends(observations: Observations, edge: int) -> Observations:
    """Mask the rows that are closer than some samples to the ends of a segment."""
    instants = observations.instants
    is_inside = np.zeros(len(instants), bool)
    for start, stop in observations.segments:
        is_inside |= (instants >= start + edge) & (instants < stop - edge)
    mask = np.asarray(observations.mask) & is_inside[:, None]
    return observations.replace(mask=mask)


def _held_out_errors(
    problem: RegressionProblem, test: RegressionProblem, estimator, joint_weights
) -> np.ndarray:
    """Return the error on each part of time, relative to the forces of all parts.

    The parameters come from the other parts of `problem`, the rows from `test`.
    """
    folds = cross_validation_folds(problem.blocks)
    squares = []
    for training_part, test_part in folds:
        training_blocks = problem.blocks.select(training_part)
        training = RegressionProblem(problem.base, blocks=training_blocks)
        parameters = estimator(training).parameters
        test_factors = test.blocks.select(test_part).total
        squares.append(joint_weights @ test_factors.residual_squares(parameters))
    # Relative to the same force for each part: the errors' mean is that of the log.
    mean_forces = joint_weights @ test.factors.force_squares / len(folds)
    return np.sqrt(squares / mean_forces)
