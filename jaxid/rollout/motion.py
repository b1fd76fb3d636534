"""Motions of joints behind position servos."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

SETTLING = 0.5
"""Time at the start of a log that does not count: the initial speed is unknown [s]."""
NEAR = 0.1
"""Time around an instant whose positions give its state [s]."""
ROUNDING = 1e-3
"""Least deviation of positions around an instant, because encoders round [rad or m]."""
HISTORY, AHEAD = 0.3, 0.1
"""Time before the first and after the last sample from which commands may act [s]."""
PADDED = 500
"""Samples to a multiple of which motions are padded, so that few lengths compile."""


class ServoMotion(eqx.Module):
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions, which begin before the samples.
        positions: Measured positions [motions, joints, samples].
        load: Torques of the bodies between a sample, or step, and the next one [N m or
            N].
        inertia: Inertia of the bodies about each joint [kg m² or kg].
        start: Initial positions and velocities, and integral actions of servos that
            have them.
        spread: Standard deviations of the initial states.
        acceleration: Initial accelerations.
        counted: Whether a sample counts in the fit.
        sample_time: Time between two samples of each motion [s].
        begin: Time of each motion's first sample in its log [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: Float[AnyArray, "*motions joints commanded"]
    positions: Float[AnyArray, "*motions joints samples"]
    load: Float[AnyArray, "*motions joints instants"]
    inertia: Float[AnyArray, "*motions joints instants"]
    start: Float[AnyArray, "*motions states joints"]
    spread: Float[AnyArray, "*motions states joints"]
    acceleration: Float[AnyArray, "*motions joints"]
    counted: Float[AnyArray, "*motions joints samples"]
    sample_time: Float[AnyArray, " *motions"]
    begin: Float[AnyArray, " *motions"]
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
            if (b - a) * log.sample_time > 2 * SETTLING
        ]
        if not parts:
            raise InputError("`logs` hold no segment that lasts longer than a second.")
        lengths = tuple(b - a for _, a, b in parts)
        padded = PADDED * math.ceil(max(lengths) / PADDED)

        def stacked(channel: str) -> np.ndarray:
            rows = (np.asarray(getattr(log, channel))[a:b] for log, a, b in parts)
            filled = [np.pad(x, ((0, padded - len(x)), (0, 0)), "edge").T for x in rows]
            return np.stack(filled)

        positions, times = (
            stacked("angles"),
            np.array([log.sample_time for log, _, _ in parts]),
        )
        index = np.arange(padded)
        first = np.ceil(SETTLING / times)[:, None]
        counted = (index >= first) & (index < np.array(lengths)[:, None])
        states = [
            state_at(x[:, :n], 0, float(dt))
            for x, n, dt in zip(positions, lengths, times, strict=True)
        ]
        start, spread, acceleration = (np.stack(x) for x in zip(*states, strict=True))
        lead = math.ceil(HISTORY / times.min())
        return cls(
            # Before the first command the robot stands still.
            commands=np.pad(stacked("forces"), ((0, 0), (0, 0), (lead, 0)), "edge"),
            positions=positions,
            load=np.zeros_like(positions),
            inertia=np.zeros_like(positions),
            start=start,
            spread=spread,
            acceleration=acceleration,
            counted=np.repeat(
                counted[:, None].astype(float), positions.shape[1], axis=1
            ),
            sample_time=times,
            begin=np.array([float(log.time[a]) for log, a, _ in parts]),
            lengths=lengths,
            names=tuple(log.name for log, _, _ in parts),
        )

    @property
    def certainty(self) -> Float[np.ndarray, "motions states joints"]:
        """Inverse variance of the initial states, over the number of samples."""
        counted = np.maximum(np.asarray(self.counted).sum(axis=-1), 1.0)
        return 1.0 / np.asarray(self.spread) ** 2 / counted[:, None]

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
    def sent(self) -> Float[np.ndarray, "motions joints samples"]:
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
        return self._from(places, size).replace(lengths=(size,) * len(places))

    def known(self) -> "ServoMotion":
        """Return the motions where commands are known, whatever the delay.

        They begin later; at their ends samples do not count that late positions might
        decide.
        """
        samples, times = self.positions.shape[-1], np.asarray(self.sample_time)
        first = math.ceil(HISTORY / times.min())
        found = self._from([(k, first) for k in range(self.motions)], samples)
        lengths = np.array(self.lengths) - first
        ends = lengths - np.ceil(AHEAD / times)
        counted = np.asarray(found.counted) * (np.arange(samples) < ends[:, None, None])
        return found.replace(lengths=tuple(map(int, lengths)), counted=counted)

    def _from(self, places: Sequence[tuple[int, int]], size: int) -> "ServoMotion":
        """Return motions of a size that start from states measured at these samples."""

        def cut(x: AnyArray, more: int = 0) -> np.ndarray:
            rows = (np.asarray(x)[k, :, a : a + more + size] for k, a in places)
            filled = (
                np.pad(y, ((0, 0), (0, more + size - y.shape[1])), "edge") for y in rows
            )
            return np.stack(list(filled))

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
        index, first = np.array(places).T
        times = np.asarray(self.sample_time)[index]
        return self.replace(
            **arrays,
            commands=cut(self.commands, self.lead),
            start=start,
            spread=spread,
            acceleration=acceleration,
            sample_time=times,
            begin=np.asarray(self.begin)[index] + first * times,
            lengths=tuple(self.lengths[k] for k in index),
            names=tuple(self.names[k] for k in index),
        )

    def repeated(self, count: int) -> "ServoMotion":
        """Return the motions several times."""
        found = jax.tree.map(lambda x: np.concatenate([np.asarray(x)] * count), self)
        return found.replace(lengths=self.lengths * count, names=self.names * count)

    def part(self, motion: int) -> "ServoMotion":
        """Return one motion, without the axis of motions."""
        return jax.tree.map(lambda x: x[motion, ...], self)


def state_at(
    q: Float[np.ndarray, "joints samples"], index: int, dt: float
) -> tuple[Float[np.ndarray, "2 joints"], Float[np.ndarray, "2 joints"], np.ndarray]:
    """Return positions and velocities at a sample, their deviations, and accelerations.

    They are those of a parabola through the samples around it. At the start the
    velocity is that of a line, and the position the measured one.
    """
    near = max(2, round(NEAR / dt))
    first, last = max(0, index - near), min(q.shape[1], index + near + 1)
    t = dt * (np.arange(first, last) - index)
    inside = index >= near
    A = np.vander(t, 3 if inside else 2, increasing=True)
    found, *_ = np.linalg.lstsq(A, q[:, first:last].T, rcond=None)
    rest = max(len(t) - A.shape[1], 1)
    error = np.sqrt(np.sum((q[:, first:last].T - A @ found) ** 2, axis=0) / rest)
    rate = np.maximum(error, 0.1 * ROUNDING) / np.sqrt(np.sum((t - t.mean()) ** 2))
    state = np.stack([found[0] if inside else q[:, index], found[1]])
    spread = np.stack([np.maximum(error, ROUNDING), rate])
    return state, spread, 2.0 * found[2] if inside else 0.0 * rate


def smooth_rates(
    q: np.ndarray, dt: float, cutoff: float = 8.0
) -> tuple[np.ndarray, ...]:
    """Return positions below a frequency [Hz] with first and second derivatives."""
    from scipy.signal import butter, sosfiltfilt

    if cutoff < 0.4 / dt:
        q = sosfiltfilt(butter(2, 2.0 * cutoff * dt, output="sos"), q, axis=0)
    qd = np.gradient(q, dt, axis=0)
    return q, qd, np.gradient(qd, dt, axis=0)
