"""A log on a coarse grid of time, with one pair of filters for all that is compared."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.measurement.recording import Recording
from jaxid.measurement.samples import joint_side
from jaxid.robot.robot import Robot

GRID_RATE = 50.0
"""Samples of the grid in a second, after the first filter."""
FIRST_CUTOFF = 12.0
"""Cut-off of the first filter, of angles and forces [Hz]."""
SECOND_CUTOFF = 4.0
"""Cut-off of the second filter, of forces and columns [Hz]."""
ROW_TIME = 0.08
"""Time between two rows [s]."""
BLOCK_TIME = 1.0
"""Longest block of time whose rows are left out together [s]."""
MIN_BLOCKS = 10
"""Number of blocks that even a short log has."""
MIN_DURATION = 1.0
"""Duration from which logs are searched [s]."""
MAX_DURATION = 60.0
"""Duration of all logs together that tells enough [s]."""
STRETCHES = 4
"""Number of parts of longer logs, at even distances."""
FOLDS = 5
"""Number of parts of a log, of several blocks each, that are left out in turn."""
REST_SPEED = 0.02
"""Fraction of a joint's largest speed below which it rests."""


class Motion(NamedTuple):
    """Coordinates of a log on its grid, and their derivatives [samples, joints]."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    def combined(self, matrix: np.ndarray) -> "Motion":
        """Return the motion with other combinations of its columns."""
        return Motion(*(x @ matrix.T for x in self))

    def shifted(self, offsets: np.ndarray) -> "Motion":
        """Return the motion with other zeros of the coordinates."""
        return Motion(self.q + offsets, self.qd, self.qdd)


class FilteredLog:
    """Motion and forces of one or several logs, and the rows they are compared in.

    Angles and forces pass a first zero-phase filter. Whatever is compared with the
    forces is computed from the filtered angles and passes, like the forces, a second
    one, which leaves a row every `ROW_TIME`.

    Attributes:
        motion: Motion on the grid.
        forces: Forces on the grid [N m or N].
        times: Times of the grid in the logs [s].
        is_long_enough: Whether there is enough to search; all else is missing if not.
        blocks: Number of the block of time of each row.
        is_moving: Whether each joint moves, for each row.
    """

    def __init__(self, robot: Robot, recordings: Sequence[Recording]):
        segments = _shortened(
            [
                segment
                for recording in recordings
                for segment in _grid_segments(robot, recording)
            ]
        )
        self._lengths = [len(segment.forces) for segment in segments]
        self.is_long_enough = sum(self._lengths) > MIN_DURATION * GRID_RATE
        if not self.is_long_enough:
            return
        self.times = np.concatenate([segment.times for segment in segments])
        motions = [segment.motion for segment in segments]
        q, qd, qdd = (np.concatenate(x) for x in zip(*motions, strict=True))
        self.motion = Motion(q, qd, qdd)
        self.forces = np.concatenate([segment.forces for segment in segments])
        thinnings = [_thinning(length) for length in self._lengths]
        self._thinning = scipy.sparse.block_diag(thinnings, format="csr")

        row_counts = [len(_centres(length)) for length in self._lengths]
        self.blocks = self._block_numbers(row_counts)
        speeds = np.abs(self.motion.qd)
        is_resting = speeds <= REST_SPEED * speeds.max(axis=0)
        self.is_moving = self.rows_of(is_resting.astype(float)) < 0.5

    def _block_numbers(self, row_counts: Sequence[int]) -> np.ndarray:
        """Return the number of the block of each row; a block lies in one segment."""
        longest_block = max(1, sum(row_counts) // MIN_BLOCKS)
        rows_of_block = min(round(BLOCK_TIME / ROW_TIME), longest_block)
        blocks: list[np.ndarray] = []
        for count in row_counts:
            first = blocks[-1][-1] + 1 if blocks else 0
            blocks.append(first + np.arange(count) // rows_of_block)
        return np.concatenate(blocks)

    @property
    def folds(self) -> np.ndarray:
        """Number of the part to which each row belongs, 0 to `FOLDS` - 1."""
        return self.blocks % FOLDS

    @cached_property
    def force_rows(self) -> np.ndarray:
        """Forces, filtered twice [rows, joints]."""
        return self.rows_of(self.forces)

    def rows_of(self, samples: np.ndarray) -> np.ndarray:
        """Return the rows of columns on the grid: the second filter [rows, ...]."""
        flat = samples.reshape(len(samples), -1)
        return (self._thinning @ flat).reshape(-1, *samples.shape[1:])

    @cached_property
    def friction_shares(self) -> np.ndarray:
        """Shares of the squared forces that have the sign of the speed [joints]."""
        forces = self.forces
        braking_squares = np.sign(self.motion.qd) * forces * np.abs(forces)
        squares = np.sum(forces**2, axis=0) + 1e-300
        return np.abs(np.sum(braking_squares, axis=0)) / squares

    def times_of(self, *instants: float) -> tuple[float, ...]:
        """Return the times in the logs of instants on the grid [s]."""
        last = len(self.times) - 1
        return tuple(
            float(self.times[min(round(instant * GRID_RATE), last)])
            for instant in instants
        )

    def by_segment(
        self, change: Callable[[np.ndarray], np.ndarray], samples: np.ndarray
    ) -> np.ndarray:
        """Apply a change to the samples of each segment, as filters need it."""
        stops = np.cumsum(self._lengths)[:-1]
        return np.concatenate([change(x) for x in np.split(samples, stops)])

    def derivative(self, samples: np.ndarray) -> np.ndarray:
        """Return the derivative of columns on the grid, by time."""
        step = 1 / GRID_RATE
        return self.by_segment(lambda x: np.gradient(x, step, axis=0), samples)


class _GridSegment(NamedTuple):
    """Motion and forces of a log between two gaps, on the grid."""

    times: np.ndarray
    motion: Motion
    forces: np.ndarray

    def part(self, samples: slice) -> "_GridSegment":
        """Return some of the samples."""
        motion = Motion(*(x[samples] for x in self.motion))
        return _GridSegment(self.times[samples], motion, self.forces[samples])


def _shortened(segments: Sequence[_GridSegment]) -> list[_GridSegment]:
    """Return stretches of segments that are long together."""
    lengths = [len(segment.forces) for segment in segments]
    max_length = int(MAX_DURATION * GRID_RATE)
    if sum(lengths) <= max_length:
        return list(segments)
    stretch = max_length // STRETCHES
    starts = np.linspace(0, sum(lengths) - stretch, STRETCHES).astype(int)
    parts = []
    segment_start = 0
    for segment, length in zip(segments, lengths, strict=True):
        for start in starts - segment_start:
            samples = slice(max(start, 0), min(start + stretch, length))
            if samples.stop - samples.start > 2 * _half_window() + 2:
                parts.append(segment.part(samples))
        segment_start += length
    return parts


def _grid_segments(robot: Robot, recording: Recording) -> list[_GridSegment]:
    """Return the segments of a recording that are long enough for both filters."""
    if recording.forces is None:
        return []
    dt = recording.sample_time
    angles, _, forces = joint_side(
        robot, recording, recording.angles, None, recording.forces
    )
    segments = []
    for start, stop in recording.segments:
        grid_length = int((stop - start) * dt * GRID_RATE)
        if grid_length <= 2 * _half_window() + 2:
            continue
        times = np.arange(grid_length) / GRID_RATE
        sample_times = dt * np.arange(stop - start)

        def on_grid(x: np.ndarray, stamps=sample_times, instants=times) -> np.ndarray:
            return np.array([np.interp(instants, stamps, c) for c in x.T]).T

        q = _low_pass(angles[start:stop], 1 / dt)
        qd = np.gradient(q, dt, axis=0)
        qdd = np.gradient(qd, dt, axis=0)
        motion = Motion(on_grid(q), on_grid(qd), on_grid(qdd))
        filtered_forces = _low_pass(forces[start:stop], 1 / dt)
        start_time = float(np.asarray(recording.time)[start])
        segments.append(
            _GridSegment(start_time + times, motion, on_grid(filtered_forces))
        )
    return segments


def _low_pass(x: np.ndarray, rate: float) -> np.ndarray:
    """Return a channel after the first filter; slow logs stay as they are."""
    if rate <= 2.2 * FIRST_CUTOFF:
        return np.asarray(x)
    sections = scipy.signal.butter(2, FIRST_CUTOFF, fs=rate, output="sos")
    padding = min(len(x) - 1, int(rate))
    return scipy.signal.sosfiltfilt(sections, x, axis=0, padlen=padding)


def _half_window() -> int:
    """Return the half length of the second filter, in samples of the grid."""
    return int(4 * _width())


def _width() -> float:
    """Return the standard deviation of the second filter, in samples of the grid."""
    # A Gaussian of this width has lost 3 dB at the cut-off.
    return math.sqrt(math.log(2)) / (2 * math.pi * SECOND_CUTOFF) * GRID_RATE


def _centres(length: int) -> np.ndarray:
    """Return the samples of a segment in whose middle a row lies."""
    half = _half_window()
    step = max(1, round(ROW_TIME * GRID_RATE))
    return np.arange(half, length - half, step)


def _thinning(length: int) -> scipy.sparse.csr_matrix:
    """Return the second filter of a segment as a matrix [rows, samples]."""
    offsets = np.arange(-_half_window(), _half_window() + 1)
    weights = np.exp(-0.5 * (offsets / _width()) ** 2)
    weights /= weights.sum()
    centres = _centres(length)
    columns = centres[:, None] + offsets
    row_starts = len(offsets) * np.arange(len(centres) + 1)
    values = np.tile(weights, len(centres))
    shape = (len(centres), length)
    return scipy.sparse.csr_matrix((values, columns.ravel(), row_starts), shape)
