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
"""Time at the start of a log that does not count, because the initial speed is not known [s]."""
EARLY = 0.2
"""Time at the start of a log whose velocities bound the initial ones [s]."""
ROUNDING = 1e-3
"""Rounding of positions that is assumed for those of the start [rad or m]."""
PADDED = 500
"""Samples to a multiple of which motions are padded, so that few lengths are compiled."""


class ServoMotion(eqx.Module):
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions [motions, joints, samples].
        positions: Measured positions.
        load: Torques of the bodies between a sample, or step, and the next one [N m or N].
        inertia: Inertia of the bodies about each joint [kg m² or kg].
        start: Initial positions and velocities.
        counted: Whether a sample counts in the fit.
        sample_time: Time between two samples of each motion [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: Float[AnyArray, "motions joints samples"]
    positions: Float[AnyArray, "motions joints samples"]
    load: Float[AnyArray, "motions joints instants"]
    inertia: Float[AnyArray, "motions joints instants"]
    start: Float[AnyArray, "motions 2 joints"]
    counted: Float[AnyArray, "motions joints samples"]
    sample_time: Float[AnyArray, " motions"]
    lengths: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, logs: Sequence[Recording]) -> "ServoMotion":
        """Return the segments of logs whose `forces` are the commands.

        Raises:
            InputError: If logs have different joints, or no segment lasts longer than a second.
        """
        if len({log.joints for log in logs}) != 1:
            raise InputError("`logs` must hold at least one log, and all with the same joints.")
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

        positions, times = stacked("angles"), np.array([log.sample_time for log, _, _ in parts])
        index = np.arange(padded)
        first = np.ceil(SETTLING / times)[:, None]
        counted = (index >= first) & (index < np.array(lengths)[:, None])
        early = np.maximum(2, (0.1 / times).astype(int))
        rates = [
            (x[:, k] - x[:, 0]) / (k * dt) for x, k, dt in zip(positions, early, times, strict=True)
        ]
        return cls(
            commands=stacked("forces"),
            positions=positions,
            load=np.zeros_like(positions),
            inertia=np.zeros_like(positions),
            start=np.stack([positions[..., 0], np.array(rates)], axis=1),
            counted=np.repeat(counted[:, None].astype(float), positions.shape[1], axis=1),
            sample_time=times,
            lengths=lengths,
            names=tuple(log.name for log, _, _ in parts),
        )

    @property
    def certainty(self) -> Float[np.ndarray, "motions 2 joints"]:
        """Inverse variance of the initial states as the first samples show them, over their number.

        Velocities are within those of the first fifth of a second, positions within rounding.
        """
        found = np.full(self.start.shape, 1.0 / ROUNDING**2)
        for k, dt in enumerate(map(float, self.sample_time)):
            count = max(2, round(EARLY / dt))
            ranges = np.ptp(np.asarray(self.positions[k])[:, : count + 1], axis=-1)
            found[k, 1] = (count * dt / np.maximum(ranges, ROUNDING)) ** 2
        return found / np.maximum(np.asarray(self.counted).sum(axis=-1), 1.0)[:, None]

    @property
    def motions(self) -> int:
        """Number of motions."""
        return len(self.lengths)

    def replace(self, **fields: Any) -> "ServoMotion":
        """Return the motions with other arrays."""
        return dataclasses.replace(self, **fields)

    def windows(self, horizon: float) -> "ServoMotion":
        """Return consecutive windows of a length [s] as motions of their own.

        Their velocities begin with those of the smoothed positions.
        """
        size = max(3, round(horizon / float(self.sample_time.mean())))
        places = [(k, a) for k, n in enumerate(self.lengths) for a in range(0, n - size + 1, size)]
        index = np.array([k for k, _ in places])

        def cut(x: AnyArray) -> np.ndarray:
            return np.stack([np.asarray(x)[k, :, a : a + size] for k, a in places])

        channels = ("commands", "positions", "load", "inertia", "counted")
        arrays = {key: cut(getattr(self, key)) for key in channels}
        q, dt = arrays["positions"], np.asarray(self.sample_time)[index]
        smooth = [
            smooth_rates(np.asarray(self.positions[k])[:, :n].T, float(self.sample_time[k]))[1]
            for k, n in enumerate(self.lengths)
        ]
        rates = np.array([smooth[k][a] for k, a in places])
        names = tuple(self.names[k] for k in index)
        lengths = (size,) * len(index)
        start = np.stack([q[..., 0], rates], axis=1)
        return self.replace(**arrays, start=start, sample_time=dt, lengths=lengths, names=names)

    def part(self, motion: int) -> "ServoMotion":
        """Return one motion, without the axis of motions."""
        return jax.tree.map(lambda x: x[motion], self)


def settling(motion: ServoMotion) -> np.ndarray:
    """Return the number of first samples of each motion that do not count."""
    return np.ceil(SETTLING / np.asarray(motion.sample_time)).astype(int)


def smooth_rates(q: np.ndarray, dt: float, cutoff: float = 8.0) -> tuple[np.ndarray, ...]:
    """Return positions below a frequency [Hz] with their first and second derivatives."""
    from scipy.signal import butter, sosfiltfilt

    if cutoff < 0.4 / dt:
        q = sosfiltfilt(butter(2, 2.0 * cutoff * dt, output="sos"), q, axis=0)
    qd = np.gradient(q, dt, axis=0)
    return q, qd, np.gradient(qd, dt, axis=0)
