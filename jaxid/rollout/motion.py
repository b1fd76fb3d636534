"""Motions of joints behind position servos."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import Bool, Float, Matrix, Texts, Vector
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
Spans = Sequence[tuple[float, float]]
"""Starts and ends of stretches of time, by the clock of a log [s]."""
Contacts = Spans | Mapping[str, Spans]
"""When something holds the robot: in all logs, or by the name of the log."""
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
    names: Texts

    @classmethod
    def of(cls, logs: Sequence[Recording], contacts: Contacts = ()) -> "ServoMotion":
        """Return the segments of logs whose `forces` are the commands.

        All samples count that are not within contacts. Before its first command the
        robot stands still.

        Raises:
            InputError: If logs have different joints, no segment lasts longer than a
                second, or a contact ends before it starts.
        """
        if len({log.joints for log in logs}) != 1:
            raise InputError(
                "`logs` must hold at least one log, and all logs must have the same "
                "joints."
            )
        lead = math.ceil(MAX_DELAY / min(log.sample_time for log in logs))
        pieces = []
        for log in logs:
            all_positions = np.asarray(log.angles).T
            all_commands = np.asarray(log.forces).T
            counted = np.where(_is_in_contact(log, contacts), 0.0, 1.0)
            all_counted = np.tile(counted, (log.joints, 1))
            for a, b in log.segments:
                if (b - a) * log.sample_time <= 2 * SETTLING_TIME:
                    continue
                positions = all_positions[:, a:b]
                piece = _Piece(
                    np.pad(all_commands[:, a:b], ((0, 0), (lead, 0)), "edge"),
                    positions,
                    all_counted[:, a:b],
                    local_state(positions, 0, log.sample_time),
                    log.sample_time,
                    float(log.time[a]),
                    log.name,
                )
                pieces.append(piece)
        if not pieces:
            raise InputError("`logs` hold no segment that lasts longer than a second.")
        return _stack(pieces)

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
    def left_out(self) -> int:
        """Number of samples within contacts that were given."""
        return sum(self.lengths) - int(self.counted[:, 0].sum())

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
        pieces = []
        for k, a, b in places:
            dt = float(self.sample_time[k])
            positions = self.positions[k][:, : self.lengths[k]]
            piece = _Piece(
                self.commands[k][:, a : b + self.lead],
                positions[:, a:b],
                self.counted[k][:, a:b],
                local_state(positions, a, dt),
                dt,
                float(self.begin[k]) + a * dt,
                self.names[k],
            )
            pieces.append(piece)
        return _stack(pieces)


class LocalState(NamedTuple):
    """Position, velocity and integral action at a sample [joints, states].

    Attributes:
        state: States.
        spread: Their standard deviations.
    """

    state: Matrix
    spread: Matrix


class _Piece(NamedTuple):
    """One motion: arrays [joints, samples], first state, times [s], name of the log."""

    commands: Matrix
    positions: Matrix
    counted: Matrix
    start: LocalState
    sample_time: float
    begin: float
    name: str


def _stack(pieces: Sequence[_Piece]) -> ServoMotion:
    """Return motions as arrays of one length."""
    lengths = tuple(piece.positions.shape[1] for piece in pieces)
    padded_length = max(lengths)
    if len(set(lengths)) > 1:
        padded_length = LENGTH_STEP * math.ceil(padded_length / LENGTH_STEP)
    gaps = [padded_length - length for length in lengths]

    def pad(arrays: Iterable[Matrix], mode: Any = "edge") -> MotionSamples:
        pairs = zip(arrays, gaps, strict=True)
        return np.stack([np.pad(x, ((0, 0), (0, gap)), mode) for x, gap in pairs])

    return ServoMotion(
        pad(x.commands for x in pieces),
        pad(x.positions for x in pieces),
        # Behind its end a motion does not count.
        pad((x.counted for x in pieces), "constant"),
        np.stack([x.start.state for x in pieces]),
        np.stack([x.start.spread for x in pieces]),
        np.array([x.sample_time for x in pieces]),
        np.array([x.begin for x in pieces]),
        lengths,
        tuple(x.name for x in pieces),
    )


def _is_in_contact(log: Recording, contacts: Contacts) -> np.ndarray:
    """Return which samples of a log are within contacts that were given."""
    spans = contacts.get(log.name, ()) if isinstance(contacts, Mapping) else contacts
    within = np.zeros(len(log.time), bool)
    for start, end in spans:
        if not start < end:
            raise InputError(
                f"`contacts`: each must be a start and a later end [s], not {start:g} "
                f"and {end:g}."
            )
        within |= (log.time >= start) & (log.time <= end)
    return within


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
