"""Motions of joints behind position servos."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, Matrix
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

SETTLING_TIME = 0.5
"""Time at the start of a log that does not count: the initial speed is unknown [s]."""
STATE_TIME = 0.1
"""Longest time around an instant whose positions give its state [s]."""
MIN_NEIGHBOURS = 4
"""Least number of samples on each side of an instant that give its state."""
MIN_DEVIATION = 1e-3
"""Least deviation of positions around an instant, because encoders round [rad or m]."""
MAX_DELAY = 0.3
"""Time before the first sample from which commands may act [s]."""
MAX_ADVANCE = 0.1
"""Time after the last sample from which commands may act [s]."""
LENGTH_STEP = 500
"""Samples to a multiple of which motions are padded, so that few lengths compile."""

JointParameters = Float[np.ndarray, "joints parameters"]
"""Parameters of each joint, in the order of `PARAMETERS`."""
FreeParameters = Bool[np.ndarray, "joints parameters"]
"""Whether each parameter of each joint is estimated."""
MotionSamples = Float[np.ndarray, "motions joints samples"]
"""Positions of joints in several motions, or their errors [rad or m]."""


class ServoMotion(eqx.Module):
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions [motions, joints, commands], which begin before
            the samples.
        positions: Measured positions [motions, joints, samples].
        load: Torques of the bodies between a sample, or step, and the next one, of the
            same shape [N m or N].
        inertia: Inertia of the bodies about each joint, of the same shape [kg m² or
            kg].
        start: Initial positions and velocities, and integral actions of servos that
            have them [motions, states, joints].
        spread: Standard deviations of the initial states.
        acceleration: Initial accelerations [motions, joints].
        counted: Whether a sample counts in the fit [motions, joints, samples].
        sample_time: Time between two samples of each motion [s].
        begin: Time of each motion's first sample in its log [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: AnyArray
    positions: AnyArray
    load: AnyArray
    inertia: AnyArray
    start: AnyArray
    spread: AnyArray
    acceleration: AnyArray
    counted: AnyArray
    sample_time: AnyArray
    begin: AnyArray
    lengths: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, logs: Sequence[Recording]) -> "ServoMotion":
        """Return the segments of logs whose `forces` are the commands.

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
        lengths = tuple(b - a for _, a, b in parts)
        padded_length = LENGTH_STEP * math.ceil(max(lengths) / LENGTH_STEP)

        def stack_channel(channel: str) -> np.ndarray:
            rows = (np.asarray(getattr(log, channel))[a:b] for log, a, b in parts)
            padded_rows = [
                np.pad(x, ((0, padded_length - len(x)), (0, 0)), "edge").T for x in rows
            ]
            return np.stack(padded_rows)

        positions = stack_channel("angles")
        times = np.array([log.sample_time for log, _, _ in parts])
        index = np.arange(padded_length)
        start_indices = np.ceil(SETTLING_TIME / times)[:, None]
        counted_samples = (index >= start_indices) & (
            index < np.array(lengths)[:, None]
        )
        states = [
            state_at(x[:, :n], 0, float(dt))
            for x, n, dt in zip(positions, lengths, times, strict=True)
        ]
        start, spread, acceleration = (np.stack(x) for x in zip(*states, strict=True))
        lead_count = math.ceil(MAX_DELAY / times.min())
        return cls(
            # Before the first command the robot stands still.
            commands=np.pad(
                stack_channel("forces"), ((0, 0), (0, 0), (lead_count, 0)), "edge"
            ),
            positions=positions,
            load=np.zeros_like(positions),
            inertia=np.zeros_like(positions),
            start=start,
            spread=spread,
            acceleration=acceleration,
            counted=np.repeat(
                counted_samples[:, None].astype(float), positions.shape[1], axis=1
            ),
            sample_time=times,
            begin=np.array([float(log.time[a]) for log, a, _ in parts]),
            lengths=lengths,
            names=tuple(log.name for log, _, _ in parts),
        )

    @property
    def certainty(self) -> np.ndarray:
        """Inverse variance of the initial states, over the number of samples."""
        sample_counts = np.maximum(np.asarray(self.counted).sum(axis=-1), 1.0)
        return 1.0 / np.asarray(self.spread) ** 2 / sample_counts[:, None]

    @property
    def motions(self) -> int:
        """Number of motions."""
        return len(self.lengths)

    def replace(self, **fields: Any) -> "ServoMotion":
        """Return the motions with other arrays."""
        return dataclasses.replace(self, **fields)

    @property
    def lead(self) -> int:
        """Number of commands before the first sample."""
        return self.commands.shape[-1] - self.positions.shape[-1]

    @property
    def sent(self) -> MotionSamples:
        """Commands of the samples."""
        return np.asarray(self.commands)[..., self.lead :]

    def windows(self, horizon: float) -> "ServoMotion":
        """Return consecutive windows of a length [s] as motions of their own.

        They begin with the states of the smoothed positions.
        """
        size = max(3, round(horizon / float(self.sample_time.mean())))
        places = [
            (k, a)
            for k, n in enumerate(self.lengths)
            for a in range(0, n - size + 1, size)
        ]
        return self._motions_from(places, size).replace(lengths=(size,) * len(places))

    def known(self) -> "ServoMotion":
        """Return the motions where commands are known, whatever the delay.

        They begin later; at their ends samples do not count that late positions might
        decide.
        """
        samples = self.positions.shape[-1]
        times = np.asarray(self.sample_time)
        start_index = math.ceil(MAX_DELAY / times.min())
        later_motions = self._motions_from(
            [(k, start_index) for k in range(self.motions)], samples
        )
        lengths = np.array(self.lengths) - start_index
        ends = lengths - np.ceil(MAX_ADVANCE / times)
        counted_samples = np.asarray(later_motions.counted) * (
            np.arange(samples) < ends[:, None, None]
        )
        return later_motions.replace(
            lengths=tuple(map(int, lengths)), counted=counted_samples
        )

    def _motions_from(
        self, places: Sequence[tuple[int, int]], size: int
    ) -> "ServoMotion":
        """Return motions of a size that start from states measured at these samples."""

        def cut(x: AnyArray, lead: int = 0) -> np.ndarray:
            rows = (np.asarray(x)[k, :, a : a + lead + size] for k, a in places)
            padded_rows = (
                np.pad(y, ((0, 0), (0, lead + size - y.shape[1])), "edge") for y in rows
            )
            return np.stack(list(padded_rows))

        arrays = {
            x: cut(getattr(self, x))
            for x in ("positions", "load", "inertia", "counted")
        }
        states = [
            state_at(np.asarray(self.positions[k])[:, : self.lengths[k]], a, float(dt))
            for (k, a), dt in zip(
                places, self.sample_time[[k for k, _ in places]], strict=True
            )
        ]
        start, spread, acceleration = (np.stack(x) for x in zip(*states, strict=True))
        motion_indices, start_indices = np.array(places).T
        times = np.asarray(self.sample_time)[motion_indices]
        return self.replace(
            **arrays,
            commands=cut(self.commands, self.lead),
            start=start,
            spread=spread,
            acceleration=acceleration,
            sample_time=times,
            begin=np.asarray(self.begin)[motion_indices] + start_indices * times,
            lengths=tuple(self.lengths[k] for k in motion_indices),
            names=tuple(self.names[k] for k in motion_indices),
        )

    def repeated(self, count: int) -> "ServoMotion":
        """Return the motions several times."""
        copies = jax.tree.map(lambda x: np.concatenate([np.asarray(x)] * count), self)
        return copies.replace(lengths=self.lengths * count, names=self.names * count)

    def part(self, motion: int) -> "ServoMotion":
        """Return one motion, without the axis of motions."""
        return jax.tree.map(lambda x: x[motion, ...], self)


class LocalState(NamedTuple):
    """State of all joints at a sample, from the samples around it.

    Attributes:
        state: Positions and velocities [2, joints].
        spread: Their standard deviations.
        acceleration: Accelerations [joints].
    """

    state: Matrix
    spread: Matrix
    acceleration: np.ndarray


def state_at(q: Matrix, index: int, dt: float) -> LocalState:
    """Return the state at a sample: that of a polynomial through the samples around it.

    At the start of a log the velocity is that of a line, and the position the measured
    one.
    """
    neighbour_count = max(2, round(STATE_TIME / dt))
    if index >= neighbour_count:
        return _state_inside(q, index, dt, neighbour_count)

    line = _polynomial(q, index, dt, neighbour_count, 1)
    noise = np.maximum(line.error, 0.1 * MIN_DEVIATION)
    state = np.stack([q[:, index], line.coefficients[1]])
    deviations = np.maximum(line.error, MIN_DEVIATION)
    spread = np.stack([deviations, line.rate_noise * noise])
    return LocalState(state, spread, np.zeros(len(q)))


def _state_inside(q: Matrix, index: int, dt: float, neighbour_count: int) -> LocalState:
    """Return the state at a sample with neighbours on both sides.

    Each joint has the stretch of time and the degree that make its velocity most
    certain: on fast motions a long parabola would cut the peaks.
    """
    parabola = _polynomial(q, index, dt, neighbour_count, 2)
    polynomials = [parabola]
    while neighbour_count > MIN_NEIGHBOURS:
        neighbour_count = max(MIN_NEIGHBOURS, round(0.7 * neighbour_count))
        for degree in (2, 4):
            polynomials.append(_polynomial(q, index, dt, neighbour_count, degree))
    # The shortest stretch deviates by noise alone.
    noise = np.maximum(polynomials[-1].error, 0.1 * MIN_DEVIATION)
    rate_deviations = np.array([x.rate_deviation(noise) for x in polynomials])
    best = np.argmin(rate_deviations, axis=0)

    joints = np.arange(len(q))
    states = np.array([x.coefficients[:2] for x in polynomials])
    errors = np.array([x.error for x in polynomials])
    deviations = np.maximum(errors[best, joints], MIN_DEVIATION)
    spread = np.stack([deviations, rate_deviations[best, joints]])
    # Accelerations of short stretches are mostly noise.
    acceleration = 2.0 * parabola.coefficients[2]
    return LocalState(states[best, :, joints].T, spread, acceleration)


class _Polynomial(NamedTuple):
    """Polynomials of all joints through the samples around an instant.

    Attributes:
        coefficients: Coefficients of powers of time [powers, joints].
        error: Standard deviation of the samples around them [joints].
        rate_noise: Standard deviation of the velocity for samples of deviation 1 [1/s].
        bend: Bend of the velocity for samples that lie 1 beside the polynomial [1/s].
    """

    coefficients: np.ndarray
    error: np.ndarray
    rate_noise: float
    bend: float

    def rate_deviation(self, noise: np.ndarray) -> np.ndarray:
        """Return standard deviations of the velocities [rad/s or m/s].

        What samples deviate beyond their noise is no polynomial: it bends the velocity.
        """
        lack_of_fit = np.sqrt(np.maximum(self.error**2 - noise**2, 0.0))
        return np.hypot(self.rate_noise * noise, self.bend * lack_of_fit)


def _polynomial(
    q: Matrix, index: int, dt: float, neighbour_count: int, degree: int
) -> _Polynomial:
    """Return the polynomials through a sample and its neighbours."""
    start_index = max(0, index - neighbour_count)
    positions = q[:, start_index : index + neighbour_count + 1].T
    half_width = neighbour_count * dt
    times = dt * (np.arange(len(positions)) + start_index - index)
    powers = np.vander(times / half_width, degree + 1, increasing=True)
    inverse = np.linalg.pinv(powers)
    scaled_coefficients = inverse @ positions

    residuals = positions - powers @ scaled_coefficients
    degrees_of_freedom = max(len(times) - degree - 1, 1)
    error = np.sqrt(np.sum(residuals**2, axis=0) / degrees_of_freedom)
    scales = half_width ** -np.arange(degree + 1.0)
    return _Polynomial(
        coefficients=scales[:, None] * scaled_coefficients,
        error=error,
        rate_noise=float(np.linalg.norm(inverse[1])) / half_width,
        bend=degree / half_width,
    )


def smooth_rates(
    q: np.ndarray, dt: float, cutoff: float = 8.0
) -> tuple[np.ndarray, ...]:
    """Return positions below a frequency [Hz] with first and second derivatives."""
    from scipy.signal import butter, sosfiltfilt

    if cutoff < 0.4 / dt:
        q = sosfiltfilt(butter(2, 2.0 * cutoff * dt, output="sos"), q, axis=0)
    qd = np.gradient(q, dt, axis=0)
    return q, qd, np.gradient(qd, dt, axis=0)
