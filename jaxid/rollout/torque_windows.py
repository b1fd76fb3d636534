"""Windows of logs with torques that are simulated."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations

MARGIN = 0.05
"""Time before and behind a window for which its torques are known, for delays [s]."""
SLIDING_SPEED = 0.05
"""Speed at which friction by torque has about its full size [rad/s or m/s]."""
BLOCKS = 40
"""Contiguous parts of the logs whose scatter gives the uncertainty."""


class Windows(NamedTuple):
    """Windows of logs, all of one length.

    The windows are the last axis, which makes the loops over them fast.

    Attributes:
        q: Initial positions [joints, windows].
        qd: Initial velocities.
        forces: Torques, with a margin at both ends [samples, joints, windows].
        measured: Measured positions behind the first sample [steps, joints, windows].
        starts: Sample at which each window starts, counted through all logs.
        blocks: Part of the logs to which each window belongs.
    """

    q: AnyArray
    qd: AnyArray
    forces: AnyArray
    measured: AnyArray
    starts: np.ndarray
    blocks: np.ndarray

    @classmethod
    def of(
        cls, logs: Sequence[Observations], horizon: float, spacing: float
    ) -> "Windows":
        """Return windows of a horizon [s], whose starts are `spacing` [s] apart."""
        dt = logs[0].sample_time
        if any(abs(o.sample_time - dt) > 0.01 * dt for o in logs):
            raise InputError("`observations` must have one sample time.")
        steps = max(1, round(horizon / dt))
        margin = round(MARGIN / dt)
        parts = []
        count = 0
        for o in logs:
            q, qd, forces = (np.asarray(x) for x in (o.motion.q, o.motion.qd, o.forces))
            edge = o.filter.edge(dt) + margin
            for a, b in o.segments:
                starts = np.arange(
                    a + edge, b - edge - steps, max(1, round(spacing / dt))
                )
                parts += [
                    (
                        q[k],
                        qd[k],
                        forces[k - margin : k + steps + margin + 1],
                        q[k + 1 : k + steps + 1],
                        count + k - a,
                    )
                    for k in starts
                ]
                count += b - a
        if not parts:
            raise InputError(
                f"`observations` hold no window of {horizon:g} s: shorten `horizon`."
            )
        q0, qd0, u, measured_positions, place = (
            np.stack(x, axis=-1) for x in zip(*parts, strict=True)
        )
        return cls(
            q0, qd0, u, measured_positions, place, place * BLOCKS // max(count, 1)
        )
