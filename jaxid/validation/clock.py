"""Clock of a log: steps of the angles against the steps that their speeds explain."""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.measurement.recording import Recording
from jaxid.measurement.time_grid import MAX_JITTER
from jaxid.robot.robot import Robot

SMOOTH_CUTOFF = 12.0
"""Cut-off of the speeds that explain the steps [Hz]."""
MIN_RATE = 60.0
"""Sampling rate from which steps are compared with smooth speeds [Hz]."""
MIN_STEPS = 100
"""Number of steps at high speed that tell something."""
MIN_HOLDS = 20
"""Number of changes of a force that tell how long it is held."""


class ClockLimits(NamedTuple):
    """Limits between clean logs and logs whose rows do not belong to their times.

    On 140 simulated clean logs of ten machines the spread was at most 0.04, also with
    encoders of 13 bits, the shares 0.0002; on eleven real ones the spread was 0.03. A
    jitter of one sample time has a spread of 1.4, of a fifth 0.26; a row of 67 that is
    lost or repeated, a share of 0.014 and a spread of 0.14, but at 100 Hz its share is
    too small to be told. A log whose rows are all held for some samples has a share of
    one half and more: a filter does not mind. The limits were chosen after logs of all
    ten machines had been seen.
    """

    spread: float = 0.2
    share: float = 0.006
    regular_share: float = 0.3  # repeated share from which rows are held regularly
    noise_spread: float = 0.15  # by noise of the angles, above which no share tells
    hold_time: float = 0.015  # of forces [s], from which a force is late


LIMITS = ClockLimits()


class ClockStatistics(NamedTuple):
    """Steps of the angles over the steps that their speeds explain.

    Attributes:
        spread: Standard deviation, less what noise of the angles explains.
        repeated_share: Fraction (0 to 1) of the steps that are near zero.
        lost_share: Fraction (0 to 1) of the steps that are near two.
        noise_spread: Standard deviation that noise of the angles explains.
    """

    spread: float
    repeated_share: float
    lost_share: float
    noise_spread: float

    @property
    def is_held(self) -> bool:
        """Whether the angles change only every few samples."""
        return self.repeated_share > LIMITS.regular_share

    @property
    def is_jittering(self) -> bool:
        """Whether the steps scatter by more than noise explains."""
        return self.spread > max(LIMITS.spread, 2 * self.noise_spread)

    @property
    def has_shares(self) -> bool:
        """Whether single steps tell something in spite of noise."""
        return self.noise_spread < LIMITS.noise_spread


def clock_statistics(recording: Recording) -> ClockStatistics | None:
    """Return the statistics of a log's clock; None if the log cannot tell."""
    dt = recording.sample_time
    if dt * MIN_RATE > 1.0:
        return None
    angles = np.asarray(recording.angles)
    segments = [
        _step_ratios(angles[start:stop], dt)
        for start, stop in recording.segments
        if (stop - start) * dt * SMOOTH_CUTOFF > 10.0
    ]
    if sum(len(segment.ratios) for segment in segments) < MIN_STEPS:
        return None
    ratios = np.concatenate([segment.ratios for segment in segments])
    noise_squares = np.concatenate([segment.noise_squares for segment in segments])
    noise_square = float(np.mean(noise_squares))
    return ClockStatistics(
        spread=float(np.sqrt(max(0.0, np.var(ratios) - noise_square))),
        repeated_share=float(np.mean(np.abs(ratios) < 0.3)),
        lost_share=float(np.mean(np.abs(ratios - 2.0) < 0.3)),
        noise_spread=float(np.sqrt(noise_square)),
    )


class _StepRatios(NamedTuple):
    """Steps over explained steps at high speed, and their variances by noise."""

    ratios: np.ndarray
    noise_squares: np.ndarray


def _step_ratios(angles: np.ndarray, dt: float) -> _StepRatios:
    """Return the ratios of all joints together, in which fast ones count most."""
    sections = scipy.signal.butter(2, SMOOTH_CUTOFF, fs=1 / dt, output="sos")
    smooth_angles = scipy.signal.sosfiltfilt(sections, angles, axis=0)
    max_steps = np.abs(np.diff(smooth_angles, axis=0)).max(axis=0)
    is_moving = max_steps > 0.0
    scales = max_steps[is_moving]
    steps = np.diff(angles[:, is_moving], axis=0) / scales
    explained_steps = np.diff(smooth_angles[:, is_moving], axis=0) / scales

    energies = np.sum(explained_steps**2, axis=1)
    is_fast = energies > np.mean(energies)
    fast_steps = explained_steps[is_fast]
    fast_energies = energies[is_fast]
    products = np.sum(steps[is_fast] * fast_steps, axis=1)
    variances = _noise_variances(steps, explained_steps)
    noise_squares = np.sum(fast_steps**2 * variances, axis=1) / fast_energies**2
    return _StepRatios(products / fast_energies, noise_squares)


def _noise_variances(steps: np.ndarray, explained_steps: np.ndarray) -> np.ndarray:
    """Return the variances of the steps [joints] where a clock has no influence.

    A wrong clock changes steps by a share of themselves: the quarter of the samples in
    which a joint is slowest shows its noise.
    """
    sizes = np.abs(explained_steps)
    is_slow = sizes <= np.quantile(sizes, 0.25, axis=0)
    square_gaps = (steps - explained_steps) ** 2
    variances = np.sum(square_gaps * is_slow, axis=0) / np.sum(is_slow, axis=0)
    # Encoders round also where joints stand still: a step has two roundings.
    nonzero_sizes = np.where(steps == 0, np.inf, np.abs(steps))
    increments = nonzero_sizes.min(axis=0)
    return np.maximum(variances, increments**2 / 6)


def clock_finding(recording: Recording) -> str:
    """Return a sentence if the rows of a log do not belong to their times."""
    statistics = clock_statistics(recording)
    if statistics is None or statistics.is_held:
        return ""
    if statistics.is_jittering:
        percent = f"{100 * statistics.spread:.2g} %"
        return (
            f"the clock of the log seems to jitter, by {percent} of the sample time: "
            f"{_cure_of_times(recording)}."
        )
    # Rows between uneven stamps are interpolated: none of them is missing.
    deviation = recording.stamp_deviation
    has_even_stamps = deviation is None or deviation <= MAX_JITTER
    if not (has_even_stamps and statistics.has_shares):
        return ""
    shares = {"lost": statistics.lost_share, "repeated": statistics.repeated_share}
    for problem, share in shares.items():
        if share > LIMITS.share:
            return (
                f"rows seem to be {problem}, {100 * share:.2g} % of them: "
                f"{_cure_of_times(recording)}."
            )
    return ""


def _cure_of_times(recording: Recording) -> str:
    """Return what to do about times that are not those of the measurement."""
    deviation = recording.stamp_deviation
    if deviation is None:
        return "name the column of times (`recording.time`), or record again"
    if deviation > MAX_JITTER:
        return (
            "its stamps are uneven; if the robot samples evenly, give `recording."
            "sample_time` instead of them"
        )
    return "its stamps do not show which rows, so record again"


def held_forces(robot: Robot, recording: Recording) -> list[str]:
    """Return a sentence about forces that are held regularly where angles are not.

    Steps of a coarse sensor last differently long; those of a slow one equally long.
    """
    statistics = clock_statistics(recording)
    if statistics is None or statistics.is_held or recording.forces is None:
        return []
    findings = []
    for name, channel in zip(robot.joint_names, recording.forces.T, strict=True):
        changes = np.flatnonzero(np.diff(np.asarray(channel)))
        if len(changes) < MIN_HOLDS:
            continue
        lengths = np.diff(changes)
        hold_length = np.median(lengths)
        hold_time = hold_length * recording.sample_time
        is_regular = np.mean(np.abs(lengths - hold_length) <= 1) > 0.9
        if is_regular and hold_time > LIMITS.hold_time:
            findings.append(
                f"the force of joint `{name}` is held for {1e3 * hold_time:.2g} ms "
                "each time, but the angles are not. The force is late by half of that "
                "time: log it as often as the angles."
            )
    return findings
