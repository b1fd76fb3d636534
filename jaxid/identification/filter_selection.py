"""Choice of a filter by errors on held-out parts of the log, judged in one band."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Joints, Matrix, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.filters import AbstractFilter, Subsample, ZeroPhaseButterworth
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.recording import Recording
from jaxid.result_table import percent
from jaxid.robot.robot import Robot

from .estimators import AbstractEstimator, WeightedLeastSquares
from .friction_laws import identify_transition_speeds
from .problem import RegressionProblem, cross_validation_folds

USUAL_CUTOFF = 10.0
"""Cut-off frequency of which another one must be better [Hz]."""
USUAL_CUTOFFS = (USUAL_CUTOFF, 2.0, 3.5, 5.0)
"""Cut-off frequencies of which one is chosen by default [Hz], and those of a motion."""
USUAL_FILTERS = tuple(map(ZeroPhaseButterworth, USUAL_CUTOFFS))
"""Filters with these cut-off frequencies."""
SUGGESTED_CUTOFFS = (2.0, 5.0)
"""Cut-off frequencies that a motion suggests, over the highest frequency in it."""
FORCE_BAND = 2.0
"""Band of forces over that of the motion: they hold squares of velocities."""
MOTION_POWER_SHARE = 0.99
"""Fraction of the power of the velocities up to the highest frequency of a motion."""
ROWS_PER_PERIOD = 5.0
"""Rows that are kept in each period of the highest cut-off frequency."""


class ChoiceLimits(NamedTuple):
    """Limits of the choice between filters.

    Set on five robots simulated by MuJoCo (palletiser, seven axes, gantry, two arms,
    oblique axes), where 10 Hz are best, and on a double pendulum with noisy angles,
    where 3.5 to 6 Hz lower the errors on unseen logs by 11 to 65 %. Growth of errors
    over growth of forces from the lower cut-off to 10 Hz: at most 1.2 on the former, 5
    to 190 on the latter.

    Attributes:
        lost_share: Largest fraction of the logs that a filter may take at the ends.
        rate_share: Largest cut-off frequency that a motion suggests, relative to the
            sampling rate.
        distance: Smallest ratio between cut-off frequencies that are both tried.
        gain: Fraction by which another filter must lower the error of the usual one.
        noise: Growth of squared errors, over that of squared forces, from which motion
            between two cut-off frequencies is noise.
    """

    lost_share: float = 0.25
    rate_share: float = 0.2
    distance: float = 1.2
    gain: float = 0.1
    noise: float = 2.0


LIMITS = ChoiceLimits()


class OneBand(NamedTuple):
    """Logs filtered by each of several candidates, and in one band.

    Attributes:
        candidates: Filters that leave enough of the logs.
        observations: Rows of all logs by each candidate, from which models are fitted.
        judged: Rows of all logs by each candidate, with the motion of its filter and
            forces and columns in one band, on which its models are judged.
        band: Cut-off frequency of these rows [Hz].
    """

    candidates: tuple[AbstractFilter, ...]
    observations: list[list[Observations]]
    judged: list[list[Observations]]
    band: float


class FilterChoice(eqx.Module):
    """Result of a choice of filters.

    Attributes:
        candidates: Filters that were compared.
        cutoffs: Cut-off frequencies of forces and columns [Hz].
        errors: Held-out error of each candidate on each part of the log, relative to
            the forces.
        best: Index of the chosen candidate.
        band: Cut-off frequency of the band in which all errors are taken [Hz].
    """

    candidates: tuple[AbstractFilter, ...]
    cutoffs: Float[AnyArray, " candidates"]
    errors: Float[AnyArray, "candidates folds"]
    best: int = eqx.field(static=True)
    band: float = eqx.field(static=True)

    @property
    def filter(self) -> AbstractFilter:
        """The chosen filter."""
        return self.candidates[self.best]

    @property
    def curve(self) -> Vector:
        """Held-out error of each candidate on the whole log."""
        return np.sqrt(np.mean(np.square(self.errors), axis=1))

    def __str__(self):
        cutoff = f"the logs are filtered at {self.cutoffs[self.best]:.3g} Hz"
        if len(self.candidates) == 1:
            return f"{cutoff}: they are too short for a choice between cut-offs."
        order = np.argsort(self.cutoffs).tolist()
        errors = ", ".join(
            f"{self.cutoffs[k]:.3g} Hz {percent(float(self.curve[k]))} %" for k in order
        )
        return (
            f"{cutoff}. Errors on parts of the logs that were left out of the fit, for "
            f"each cut-off, all in a band of {self.band:.3g} Hz: {errors}."
        )


def choose_filter(
    base: BaseParameters,
    recordings: Recording | Sequence[Recording],
    candidates: Sequence[AbstractFilter] = USUAL_FILTERS,
    *,
    estimator: AbstractEstimator | None = None,
    min_speed: Sequence[float] | Joints | None = None,
    row_step: int = 1,
    progress: Progress | None = None,
) -> FilterChoice:
    """Choose the filter with which a model predicts held-out parts of the log best.

    With each candidate the model is fitted to all parts of the log but one, and
    predicts the forces of that part. Measured and predicted forces are compared in one
    band, that of the motion, so that a filter gains nothing by removing what it cannot
    explain. The candidate nearest to 10 Hz is kept unless another one has errors that
    are smaller by a tenth, and by more than one standard deviation of the difference
    between the parts. A lower cut-off must also remove noise: with its parameters, the
    motion above it would enlarge the errors by more than twice the forces there.
    Otherwise it gains only by what it does not see.

    Args:
        base: Base parameters of the robot.
        recordings: One or several logs.
        candidates: Filters; by default Butterworth filters of 2, 3.5, 5 and 10 Hz, and
            of twice and five times the highest frequency of the motion. Those that
            would take more than a quarter of the logs are left out.
        estimator: Estimator; by default least squares weighted by the largest forces.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        row_step: Number of samples for each row that a filter must allow.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or a log and a candidate do not fit to
            each other.
    """
    logs = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    estimator = estimator or WeightedLeastSquares()
    robot = base.model.robot
    rows = observe_in_one_band(robot, logs, candidates, min_speed, row_step)
    cutoffs = [_cutoff(x, logs[0].sample_time) for x in rows.candidates]
    usual_number = _usual_candidate(cutoffs)
    base = identify_transition_speeds(base, rows.observations[usual_number])
    problems = [RegressionProblem(base, x) for x in rows.observations]
    # All candidates are judged with the same weights of the joints.
    joint_weights = estimator(problems[usual_number]).weights ** 2

    errors = []
    is_eligible = []
    for number, problem in enumerate(problems):
        test = RegressionProblem(base, rows.judged[number])
        errors.append(_held_out_errors(problem, test, estimator, joint_weights))
        is_higher = cutoffs[number] >= cutoffs[usual_number]
        is_eligible.append(
            is_higher
            or _removes_noise(problem, problems[usual_number], estimator, joint_weights)
        )
        if progress is not None:
            progress((number + 1) / len(problems))
    best_number = _best_candidate(
        np.square(errors), np.array(is_eligible), usual_number
    )
    return FilterChoice(
        candidates=rows.candidates,
        cutoffs=np.array(cutoffs),
        errors=np.array(errors),
        best=best_number,
        band=rows.band,
    )


def observe_in_one_band(
    robot: Robot,
    recordings: Sequence[Recording],
    candidates: Sequence[AbstractFilter] = USUAL_FILTERS,
    min_speed: Sequence[float] | Joints | None = None,
    row_step: int = 1,
) -> OneBand:
    """Filter logs by each candidate, and in the band of their motion.

    All observations count the rows that are far enough from the ends for every filter.

    Args:
        robot: The robot.
        recordings: Logs.
        candidates: Filters; those of the motion are added to the usual ones.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        row_step: Number of samples for each row that a filter must allow.

    Raises:
        InputError: If there are no candidates, or the one nearest to 10 Hz does not
            suit the logs.
    """
    if not candidates:
        raise InputError("`candidates` must hold at least one filter, but is empty.")
    dt = recordings[0].sample_time
    usual_filter = candidates[_usual_candidate([_cutoff(x, dt) for x in candidates])]
    frequencies = [
        _highest_frequency(observe(log, robot, usual_filter)) for log in recordings
    ]
    highest_frequency = max(frequencies)
    if tuple(getattr(x, "cutoff", None) for x in candidates) == USUAL_CUTOFFS:
        max_cutoff = LIMITS.rate_share / (dt * row_step)
        suggestions = [factor * highest_frequency for factor in SUGGESTED_CUTOFFS]
        possible_cutoffs = [x for x in suggestions if 0 < x <= max_cutoff]
        candidates = _with_suggestions(candidates, possible_cutoffs)
    suitable_filters = tuple(
        x for x in candidates if x is usual_filter or _leaves_enough(x, recordings)
    )
    # Lower bands would take more of the ends than any candidate.
    cutoffs = [_cutoff(x, dt) for x in suitable_filters]
    band = np.clip(FORCE_BAND * highest_frequency, min(cutoffs), max(cutoffs))
    band_filter = ZeroPhaseButterworth(float(band))
    filters = (*suitable_filters, band_filter)
    max_band = max(x.low_pass(dt).cutoff for x in filters)

    def observe_with(filter: AbstractFilter) -> list[Observations]:
        """Observe the rows that are far enough from the ends for all filters."""
        observations = []
        for log in recordings:
            rows_of_period = ROWS_PER_PERIOD * log.sample_time * max_band
            step = Subsample(max(1, int(1.0 / rows_of_period)))
            rows = observe(log, robot, filter, step, min_speed)
            edge = max(x.edge(log.sample_time) for x in filters)
            observations.append(_mask_ends(rows, edge))
        return observations

    observations = [observe_with(filter) for filter in suitable_filters]
    rows_in_band = observe_with(band_filter)
    judged = []
    for candidate_logs in observations:
        pairs = zip(rows_in_band, candidate_logs, strict=True)
        judged.append([rows.replace(motion=log.motion) for rows, log in pairs])
    return OneBand(suitable_filters, observations, judged, band_filter.cutoff)


def _cutoff(filter: AbstractFilter, sample_time: float) -> float:
    """Return the lower one of the cut-off frequencies of motion and forces [Hz]."""
    force_cutoff = filter.low_pass(sample_time).cutoff
    return min(force_cutoff, getattr(filter, "cutoff", force_cutoff))


def _usual_candidate(cutoffs: Sequence[float]) -> int:
    """Return the index of the cut-off frequency that is nearest to the usual one."""
    distances = np.abs(np.log(np.array(cutoffs) / USUAL_CUTOFF))
    return int(np.argmin(distances))


def _highest_frequency(log: Observations) -> float:
    """Return the highest frequency of a motion [Hz], all joints taken together."""
    velocities = log.motion.qd
    frequency, power = scipy.signal.periodogram(
        velocities, 1.0 / log.sample_time, "hann", axis=0
    )
    joint_shares = power / np.maximum(power.sum(axis=0), 1e-300)
    cumulative_share = np.cumsum(joint_shares.sum(axis=1))
    limit = MOTION_POWER_SHARE * cumulative_share[-1]
    return float(frequency[np.searchsorted(cumulative_share, limit)])


def _with_suggestions(
    candidates: Sequence[Any], cutoffs: Sequence[float]
) -> list[AbstractFilter]:
    """Return filters, and copies with other cut-offs unless they are nearly equal."""
    filters = [*candidates]
    for cutoff in cutoffs:
        ratios = np.array([x.cutoff / cutoff for x in filters])
        if np.abs(np.log(ratios)).min() >= np.log(LIMITS.distance):
            rounded_cutoff = float(f"{cutoff:.2g}")
            filters.append(dataclasses.replace(filters[0], cutoff=rounded_cutoff))
    return filters


def _leaves_enough(filter: AbstractFilter, recordings: Sequence[Recording]) -> bool:
    """Return whether a filter takes only a small part of each log at the ends."""
    for log in recordings:
        edges = 2 * filter.edge(log.sample_time)
        lost_samples = sum(min(b - a, edges) for a, b in log.segments)
        if lost_samples > LIMITS.lost_share * log.samples:
            return False
    return True


def _mask_ends(observations: Observations, edge: int) -> Observations:
    """Mask the rows that are closer than some samples to the ends of a segment."""
    instants = observations.instants
    is_inside = np.zeros(len(instants), bool)
    for start, stop in observations.segments:
        is_inside |= (instants >= start + edge) & (instants < stop - edge)
    mask = observations.mask & is_inside[:, None]
    return observations.replace(mask=mask)


def _held_out_errors(
    problem: RegressionProblem, test: RegressionProblem, estimator, joint_weights
) -> Vector:
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


def _removes_noise(
    problem: RegressionProblem,
    wider_problem: RegressionProblem,
    estimator: AbstractEstimator,
    joint_weights: Vector,
) -> bool:
    """Return whether the motion between two cut-off frequencies is noise.

    Args:
        problem: Rows with the lower cut-off frequency.
        wider_problem: Rows with the higher one.
        estimator: Estimator.
        joint_weights: Weights of the joints' squared errors.
    """
    parameters = estimator(problem).parameters
    errors = []
    forces = []
    for factors in (problem.factors, wider_problem.factors):
        row_weights = joint_weights / np.maximum(factors.rows, 1)
        errors.append(row_weights @ factors.residual_squares(parameters))
        forces.append(row_weights @ factors.force_squares)
    error_growth = errors[1] - errors[0]
    force_growth = max(forces[1] - forces[0], 0.0)
    return bool(error_growth > errors[0] + LIMITS.noise * force_growth)


def _best_candidate(squares: Matrix, is_eligible: np.ndarray, usual_number: int) -> int:
    """Return the candidate with the smallest error, or the usual one if it is as good.

    Args:
        squares: Squared errors on parts [candidates, parts].
        is_eligible: Whether a candidate may replace the usual one.
        usual_number: Index of the usual candidate.
    """
    means = np.where(is_eligible, squares.mean(axis=1), np.inf)
    best_number = int(np.argmin(means))
    differences = squares[usual_number] - squares[best_number]
    deviation = differences.std(ddof=1) / np.sqrt(len(differences))
    gain = 1.0 - np.sqrt(means[best_number] / means[usual_number])
    is_better = differences.mean() > deviation and gain >= LIMITS.gain
    return best_number if is_better else usual_number
