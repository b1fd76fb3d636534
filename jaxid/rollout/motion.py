"""Motions of joints behind position servos, and the bodies that load them."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

SETTLING = 0.5
"""Time at the start of a log that does not count, because the initial speed is not known [s]."""
PADDED = 500
"""Samples to a multiple of which motions are padded, so that few lengths are compiled."""


class ServoMotion(eqx.Module):
    """Segments of logs as arrays of one length, padded behind their ends.

    Attributes:
        commands: Commanded positions [motions, joints, samples].
        positions: Measured positions.
        load: Torques of the bodies between a sample, or step, and the next one [N m or N].
        inertia: Inertia of the bodies about each joint [kg m² or kg].
        rates: Initial velocities [motions, joints].
        counted: Whether a sample counts in the fit.
        sample_time: Time between two samples of each motion [s].
        lengths: Number of samples of each motion.
        names: Name of the log of each motion.
    """

    commands: Float[AnyArray, "motions joints samples"]
    positions: Float[AnyArray, "motions joints samples"]
    load: Float[AnyArray, "motions joints instants"]
    inertia: Float[AnyArray, "motions joints instants"]
    rates: Float[AnyArray, "motions joints"]
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
            rates=np.array(rates),
            counted=np.repeat(counted[:, None].astype(float), positions.shape[1], axis=1),
            sample_time=times,
            lengths=lengths,
            names=tuple(log.name for log, _, _ in parts),
        )

    @property
    def motions(self) -> int:
        """Number of motions."""
        return len(self.lengths)

    def replace(self, **fields: Any) -> "ServoMotion":
        """Return the motions with other arrays."""
        return dataclasses.replace(self, **fields)

    def windows(self, horizon: float) -> "ServoMotion":
        """Return consecutive windows of a length [s] as motions of their own."""
        size = max(3, round(horizon / float(self.sample_time.mean())))
        places = [(k, a) for k, n in enumerate(self.lengths) for a in range(0, n - size + 1, size)]
        index = np.array([k for k, _ in places])

        def cut(x: AnyArray) -> np.ndarray:
            return np.stack([np.asarray(x)[k, :, a : a + size] for k, a in places])

        channels = ("commands", "positions", "load", "inertia", "counted")
        arrays = {key: cut(getattr(self, key)) for key in channels}
        q, dt = arrays["positions"], np.asarray(self.sample_time)[index]
        early = min(2, size - 1)
        rates = (q[..., early] - q[..., 0]) / (early * dt[:, None])
        names = tuple(self.names[k] for k in index)
        lengths = (size,) * len(index)
        return self.replace(**arrays, rates=rates, sample_time=dt, lengths=lengths, names=names)

    def part(self, motion: int) -> "ServoMotion":
        """Return one motion, without the axis of motions."""
        return jax.tree.map(lambda x: x[motion], self)


def settling(motion: ServoMotion) -> np.ndarray:
    """Return the number of first samples of each motion that do not count."""
    return np.ceil(SETTLING / np.asarray(motion.sample_time)).astype(int)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies that load the joints: a model with its parameters, often from a URDF file.

    Attributes:
        model: Model of the robot.
        parameters: Standard parameters.
        coupled: Whether inertial torques count, beside those of gravity.
    """

    model: Model
    parameters: Float[AnyArray, " standard"]
    coupled: bool = False

    def loads(
        self, motion: ServoMotion, q: np.ndarray | None = None, v: np.ndarray | None = None
    ) -> ServoMotion:
        """Return the motions with the loads between two samples.

        Args:
            motion: Motions.
            q: Positions; the measured ones if None.
            v: Velocities of a simulation, whose changes are the mean accelerations; smoothed
                derivatives of the positions if None. Simulations may have several steps in each
                sample time.
        """
        q = np.asarray(motion.positions if q is None else q)
        load, inertia = np.zeros_like(q), np.zeros_like(q)
        model, p = self.model, np.asarray(self.parameters)
        steps = (q.shape[-1] - 1) // (motion.positions.shape[-1] - 1)
        for k, dt in enumerate(map(float, np.asarray(motion.sample_time) / steps)):
            if v is None:
                rates = smooth_rates(q[k].T, dt)
                path, qd, qdd = (0.5 * (x[1:] + x[:-1]) for x in rates)
            else:
                path, qd = (0.5 * (x[k].T[1:] + x[k].T[:-1]) for x in (q, v))
                qdd = np.diff(v[k].T, axis=0) / dt
            if self.coupled:
                M = in_numpy(model, model.inertia, path, shared=(p,))
                own = np.diagonal(M, axis1=1, axis2=2)
                forces = in_numpy(model, model.forces, path, qd, qdd, shared=(p,)) - own * qdd
                inertia[k, :, :-1] = own.T
            else:
                forces = in_numpy(model, model.forces, path, 0 * qd, 0 * qd, shared=(p,))
            load[k, :, :-1] = forces.T
        return motion.replace(load=load, inertia=inertia)


def smooth_rates(q: np.ndarray, dt: float, cutoff: float = 8.0) -> tuple[np.ndarray, ...]:
    """Return positions below a frequency [Hz] with their first and second derivatives."""
    from scipy.signal import butter, sosfiltfilt

    if cutoff < 0.4 / dt:
        q = sosfiltfilt(butter(2, 2.0 * cutoff * dt, output="sos"), q, axis=0)
    qd = np.gradient(q, dt, axis=0)
    return q, qd, np.gradient(qd, dt, axis=0)
