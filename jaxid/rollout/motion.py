"""Motions of joints behind position servos."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Bool, Float, Matrix, Vector
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

from .servo import MAX_DELAY

SETTLING_TIME = 0.5
"""Time at the start of a log that does not count in a fit: its state is unknown [s]."""
STATE_TIME = 0.1
"""Longest time around an instant whose positions give its state [s]."""
MIN_DEVIATION = 1e-3
"""Least deviation of positions around an instant, because encoders round [rad or m]."""
INTEGRAL_SPREAD = 0.3
"""Deviation of integral actions from their balance [rad or m]."""
LENGTH_STEP = 500
"""Samples to a multiple of which motions are padded, so that few lengths compile."""
MIN_PARTS = 4
"""Smallest number of parts for the choice: fewer logs are divided."""
MIN_PART_DURATION = 5.0
"""Shortest part into which a log is divided [s]."""

JointParameters = Float[np.ndarray, "joints parameters"]
"""Parameters of each joint, in the order of `PARAMETERS`."""
FreeParameters = Bool[np.ndarray, "joints parameters"]
"""Whether each parameter of each joint is estimated."""
Place = tuple[int, int, int]
"""Part of a motion: its index, the first sample, and the end."""
MotionSamples = Float[np.ndarray, "motions joints samples"]
"""Positions of joints in several motions, or their errors [rad or m]."""


@dataclasses.dataclass(frozen=True)
class ServoMotion:
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions [motions, joints, commands], which begin before
            the samples.
        positions: Measured positions [motions, joints, samples].
        counted: Whether a sample counts: 1 or 0 [motions, joints, samples].
        start: Initial position, velocity and integral action [motions, joints, states].
        spread: Their standard deviations.
        sample_time: Time between two samples of each motion [s].
        begin: Time of each motion's first sample in its log [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: MotionSamples
    positions: MotionSamples
    counted: MotionSamples
    start: np.ndarray
    spread: np.ndarray
    sample_time: Vector
    begin: Vector
    lengths: tuple[int, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, logs: Sequence[Recording]) -> "ServoMotion":
        """Return the segments of logs whose `forces` are the commands.

        All samples count. Before its first command the robot stands still.

        Raises:
            InputError: If logs have different joints, or no segment lasts longer than a
                second.
        """
        if len({log.joints for log in logs}) != 1:
            raise InputError(
                "`logs` must hold at least one log, and all with the same joints."
            )
        parts = [
            (log, a, b)
            for log in logs
            for a, b in log.segments
            if (b - a) * log.sample_time > 2 * SETTLING_TIME
        ]
        if not parts:
            raise InputError("`logs` hold no segment that lasts longer than a second.")
        times = np.array([log.sample_time for log, _, _ in parts])
        lead = math.ceil(MAX_DELAY / times.min())
        pieces = []
        for log, a, b in parts:
            commands = np.asarray(log.forces)[a:b].T
            first_commands = np.repeat(commands[:, :1], lead, axis=1)
            pieces.append(
                _Piece(
                    np.concatenate([first_commands, commands], axis=1),
                    np.asarray(log.angles)[a:b].T,
                    local_state(np.asarray(log.angles)[a:b].T, 0, log.sample_time),
                )
            )
        begin = np.array([float(log.time[a]) for log, a, _ in parts])
        names = tuple(log.name for log, _, _ in parts)
        return _stack(pieces, times, begin, names)

    @property
    def motions(self) -> int:
        """Number of motions."""
        return len(self.lengths)

    @property
    def lead(self) -> int:
        """Number of commands before the first sample."""
        return self.commands.shape[-1] - self.positions.shape[-1]

    @property
    def sent(self) -> MotionSamples:
        """Commands of the samples."""
        return self.commands[..., self.lead :]

    @property
    def sample_counts(self) -> Matrix:
        """Number of samples that count, one at least [motions, joints]."""
        return np.maximum(self.counted.sum(axis=-1), 1.0)

    def split(self) -> "ServoMotion":
        """Return the motions for a fit: long ones in parts of similar durations.

        The choice of effects needs several parts. Commands before a part are known,
        those before a log are not: its first samples are left out.
        """
        durations = np.array(self.lengths) * self.sample_time
        part_duration = max(float(np.median(durations)), MIN_PARTS * MIN_PART_DURATION)
        min_count = -(-MIN_PARTS // self.motions)
        places = []
        for k, (length, duration) in enumerate(
            zip(self.lengths, durations, strict=True)
        ):
            desired_count = max(min_count, round(duration / part_duration))
            max_count = int(duration // MIN_PART_DURATION)
            count = max(1, min(desired_count, max_count))
            first = math.ceil(max(MAX_DELAY, SETTLING_TIME) / self.sample_time[k])
            ends = np.linspace(first, length, count + 1).round().astype(int)
            places += [(k, a, b) for a, b in itertools.pairwise(ends.tolist())]
        return self.parts(places)

    def parts(self, places: Sequence[Place]) -> "ServoMotion":
        """Return parts of motions."""
        pieces = [
            _Piece(
                self.commands[k][:, a : b + self.lead],
                self.positions[k][:, a:b],
                local_state(
                    self.positions[k][:, : self.lengths[k]],
                    a,
                    float(self.sample_time[k]),
                ),
            )
            for k, a, b in places
        ]
        indices = [k for k, _, _ in places]
        times = self.sample_time[indices]
        starts = np.array([a for _, a, _ in places])
        names = tuple(self.names[k] for k in indices)
        return _stack(pieces, times, self.begin[indices] + starts * times, names)


class LocalState(NamedTuple):
    """Position, velocity and integral action at a sample [joints, states].

    Attributes:
        state: States.
        spread: Their standard deviations.
    """

    state: Matrix
    spread: Matrix


class _Piece(NamedTuple):
    """Commands and positions of one motion [joints, samples], and its first state."""

    commands: Matrix
    positions: Matrix
    start: LocalState


def _stack(
    pieces: Sequence[_Piece], times: Vector, begin: Vector, names: tuple[str, ...]
) -> ServoMotion:
    """Return motions as arrays of one length."""
    lengths = tuple(piece.positions.shape[1] for piece in pieces)
    padded_length = max(lengths)
    if len(set(lengths)) > 1:
        padded_length = LENGTH_STEP * math.ceil(padded_length / LENGTH_STEP)
    lead = pieces[0].commands.shape[1] - lengths[0]

    def pad(x: Matrix, length: int) -> Matrix:
        return np.pad(x, ((0, 0), (0, length - x.shape[1])), "edge")

    positions = np.stack([pad(x.positions, padded_length) for x in pieces])
    commands = np.stack([pad(x.commands, padded_length + lead) for x in pieces])
    ends = np.array(lengths)[:, None, None]
    is_sample = np.arange(padded_length) < ends
    counted = np.where(is_sample, np.ones_like(positions), 0.0)
    start = np.stack([piece.start.state for piece in pieces])
    spread = np.stack([piece.start.spread for piece in pieces])
    return ServoMotion(
        commands, positions, counted, start, spread, times, begin, lengths, names
    )


def local_state(q: Matrix, index: int, dt: float) -> LocalState:
    """Return the state of all joints at a sample, from the samples around it.

    Inside a log it is that of a parabola; at its start that of a line, but the position
    is the measured one.

    Args:
        q: Positions [joints, samples].
        index: Index of the sample.
        dt: Time between two samples [s].
    """
    neighbour_count = max(2, round(STATE_TIME / dt))
    is_inside = index >= neighbour_count
    degree = 2 if is_inside else 1
    first = max(0, index - neighbour_count)
    positions = q[:, first : index + neighbour_count + 1].T
    half_width = neighbour_count * dt
    times = dt * (np.arange(len(positions)) + first - index)
    powers = np.vander(times / half_width, degree + 1, increasing=True)
    inverse = np.linalg.pinv(powers)
    coefficients = inverse @ positions
    residuals = positions - powers @ coefficients
    degrees_of_freedom = max(len(times) - degree - 1, 1)
    error = np.sqrt(np.sum(residuals**2, axis=0) / degrees_of_freedom)

    deviations = np.maximum(error, MIN_DEVIATION)
    # What samples deviate beyond their noise is no polynomial: it bends the velocity.
    rate_deviations = (degree + float(np.linalg.norm(inverse[1]))) * deviations
    position = coefficients[0] if is_inside else q[:, index]
    zeros = np.zeros(len(q))
    state = [position, coefficients[1] / half_width, zeros]
    spread = [deviations, rate_deviations / half_width, zeros + INTEGRAL_SPREAD]
    return LocalState(np.stack(state, axis=-1), np.stack(spread, axis=-1))
