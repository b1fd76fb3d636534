"""Forces that stay at their largest value: a drive at its limit or a clipped sensor."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.model import Model
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot

from .descriptions import DescribedLog
from .filtered_log import FilteredLog
from .row_fits import Judge
from .torque_errors import REST_SHARE

MIN_SHARE = 0.005
"""Fraction (0 to 1) of the samples at one value, from which that is a limit."""
ROW_SHARE = 0.3
"""Share of the samples around a row that makes it one at a limit."""
MIN_ROWS = 3
"""Number of rows, at least, over which what is missing is averaged."""
MAX_EXCESS = 12.0
"""Force that a model misses at a limit, over its RMS error, for which a drive accounts.

Drives of ten simulated machines at their true limits: at most 11, twice above 5.2;
sensors that clip at 75 to 90 % of the peaks: nine of ten above 12. The limit was chosen
after all ten had been seen.
"""


class LimitedForce(NamedTuple):
    """Force that stays at its largest or smallest value in many samples.

    Attributes:
        joint: Index of its joint.
        value: The value [N m or N].
        samples: Number of samples in which the joint moves.
    """

    joint: int
    value: float
    samples: int

    def sentence(self, robot: Robot) -> str:
        """Return where the force stays."""
        return (
            f"the forces of joint `{robot.joint_names[self.joint]}` stay at "
            f"{self.value:.3g} in {self.samples} samples in which it moves"
        )


def limited_forces(recording: Recording) -> Iterator[LimitedForce]:
    """Yield the forces that are cut off.

    Many samples lie on the last value then, and few on the three beside it, which
    coarse steps would reach as often.
    """
    if recording.forces is None:
        return
    angles = np.asarray(recording.angles)
    for joint, channel in enumerate(np.asarray(recording.forces).T):
        speed = np.abs(np.gradient(angles[:, joint]))
        is_moving = speed > REST_SHARE * speed.max(initial=0.0)
        values, counts = np.unique(channel[is_moving], return_counts=True)
        if len(values) < 2:
            continue
        yield from _at_end(joint, channel.size, values, counts)
        yield from _at_end(joint, channel.size, values[::-1], counts[::-1])


def _at_end(
    joint: int, size: int, values: np.ndarray, counts: np.ndarray
) -> Iterator[LimitedForce]:
    """Yield the first of some values if it is a limit of a channel of that size."""
    count = int(counts[0])
    if count > MIN_SHARE * size and count > 3.0 * counts[1:4].sum():
        yield LimitedForce(joint, float(values[0]), count)


def clipped_forces(
    model: Model, recording: Recording, forces: list[LimitedForce]
) -> list[LimitedForce]:
    """Return those of the forces at a limit where a model needs clearly more.

    The samples at the limits are left out of the fit.
    """
    log = FilteredLog(model.robot, [recording])
    if not forces or not log.is_long_enough:
        return []
    rows = DescribedLog(model, log).rows
    measured_forces = np.asarray(recording.forces)
    is_limited = np.zeros(rows.forces.shape, bool)
    rows_at_limits = []
    for force in forces:
        samples = measured_forces[:, force.joint] == force.value
        shares = np.interp(log.times, recording.time, samples)
        rows_at_limit = log.rows_of(shares) > ROW_SHARE
        rows_at_limits.append(rows_at_limit)
        is_limited[:, force.joint] |= rows_at_limit

    judge = Judge(log.is_moving & ~is_limited, log.folds)
    missing_forces = rows.columns @ judge.fit(rows).parameters - rows.forces
    clipped = []
    for force, rows_at_limit in zip(forces, rows_at_limits, strict=True):
        j = force.joint
        limit_forces = rows.forces[rows_at_limit, j]
        missing_force = np.sum(missing_forces[rows_at_limit, j] * np.sign(limit_forces))
        error = np.sqrt(np.mean(missing_forces[judge.mask[:, j], j] ** 2))
        if missing_force > MAX_EXCESS * error * max(len(limit_forces), MIN_ROWS):
            clipped.append(force)
    return clipped
