"""Commanded angles that stand where the measured ones should be."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.measurement.recording import Recording

from .descriptions import DescribedLog
from .filtered_log import FilteredLog


class CommandLimits(NamedTuple):
    """Limits between measured angles and commanded ones.

    Encoders round, commands are smooth. On 140 simulated clean logs of ten machines the
    roughness of the commands was at most 0.1 of that of the angles, and the gain of
    the commands at most 0.09; exchanged, the roughness was above 300 and the gain above
    0.26. The limits were chosen after all ten machines had been seen.
    """

    roughness: float = 5.0
    gain: float = 0.1


LIMITS = CommandLimits()


def are_exchanged(
    described_log: DescribedLog,
    recordings: Sequence[Recording],
    commands: Sequence[Recording],
) -> bool:
    """Return whether the commanded angles are those that were measured.

    Args:
        described_log: Log of the recordings.
        recordings: Logs.
        commands: The same logs with the commanded angles as angles.
    """
    roughness = _roughness(commands) / np.maximum(_roughness(recordings), 1e-300)
    if np.median(roughness) < LIMITS.roughness:
        return False
    log = FilteredLog(described_log.robot, commands)
    if log.motion.q.shape != described_log.log.motion.q.shape:
        return False
    judge = described_log.judge
    command_rows = described_log.with_motion(log.motion)
    squares = judge.unseen_squares(described_log.rows)
    command_squares = judge.unseen_squares(command_rows)
    return judge.score(squares) - judge.score(command_squares) > LIMITS.gain


def _roughness(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the RMS third differences of the angles [joints]."""
    differences = [
        np.diff(np.asarray(recording.angles)[start:stop], n=3, axis=0)
        for recording in recordings
        for start, stop in recording.segments
    ]
    return np.sqrt(np.mean(np.concatenate(differences) ** 2, axis=0))
