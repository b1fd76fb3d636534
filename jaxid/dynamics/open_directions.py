"""Combinations of parameters that are left open, judged by other motions.

What a log leaves open, and what a designed motion will leave open, is judged by one
rule: a combination is not determined if its 95 % interval makes more than a tenth of
the forces of random motions uncertain.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Indices, Matrix
from jaxid.result_table import Status
from jaxid.robot.limits_and_drives import complete_limits
from jaxid.robot.loop_closing import reachable

from .base import BaseParameters
from .motion import Motion

SAMPLES = 400
"""Number of random motions on which parameters are judged."""
MIN_SAMPLES = 40
"""Number of motions of which the drives are able, without which all are taken."""


class OpenShares(NamedTuple):
    """Fractions of the forces of random motions that 95 % intervals leave open.

    Logs of five simulated machines on which a joint rested, or which were too slow, too
    small, too short or of one pose, leave at least 0.17 open; clean logs of good
    motions, whose plain least squares predict another motion well, at most 0.04.
    """

    doubtful: float = 0.1
    bad: float = 0.5  # the expected error is half of it: a quarter of the forces


OPEN_SHARES = OpenShares()
STANDARD_GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""
MIN_SHARE = 0.3
"""Share of the largest parameter of a combination from which another one is named."""


class UndeterminedDirection(eqx.Module):
    """A combination of base parameters that the observations leave open.

    Attributes:
        parts: Indices of the base parameters in it, the largest first.
        shares: Their fractions, as they count in the forces of the observations; the
            largest is 1.
        singular_value: Singular value of the scaled observation matrix, relative to the
            largest.
        uncertainty: Half the width of its 95 % interval, as forces on random motions
            relative to all forces there; infinite if the combination was not moved.
    """

    parts: Indices = eqx.field(static=True)
    shares: tuple[float, ...] = eqx.field(static=True)
    singular_value: float
    uncertainty: float

    def sentence(self, base: BaseParameters) -> str:
        """Return the combination in words, with at most five base parameters."""
        names = [base.names[k] for k in self.parts]
        if len(names) == 1:
            return f"{names[0]} is not determined"
        if len(names) > 5:
            names = [*names[:4], f"{len(names) - 4} others"]
        return f"{', '.join(names[:-1])} and {names[-1]} cannot be distinguished"


def status_of(open_share: float) -> Status:
    """Return the severity of a share of the forces that is left open."""
    if open_share > OPEN_SHARES.bad:
        return Status.BAD
    return Status.DOUBTFUL if open_share > OPEN_SHARES.doubtful else Status.GOOD


def random_rows(
    base: BaseParameters,
    parameters: AnyArray | None,
    largest_forces: AnyArray | None = None,
) -> Matrix:
    """Return rows of the base regressor on random motions within the robot's limits.

    Poses, velocities and accelerations are uniform within the limits, at a random pace;
    motions for which the drives are too weak are left out. The norm of the rows times a
    change of the parameters is the change of the forces relative to the forces: the
    root of the mean square over the joints.

    Args:
        base: Base parameters.
        parameters: Their values, which tell the forces; None if nothing is known.
        largest_forces: Forces by joint to which those of unknown parameters are
            compared [N m or N].
    """
    robot = base.model.robot
    motion = _random_motion(base)
    rows = np.zeros((robot.joints, SAMPLES, base.size))
    joint_rows = base.regressor_rows(motion)
    for j, columns in enumerate(base.acting_columns):
        rows[j][:, list(columns)] = joint_rows[j]

    count = rows.shape[0] * rows.shape[1]
    if parameters is None:
        scale = np.asarray(largest_forces)[:, None, None]
        return (rows / scale).reshape(count, base.size) / np.sqrt(count)
    max_forces = robot.known_max_forces[:, None]
    forces = rows @ np.asarray(parameters)
    is_possible = np.all(np.abs(forces) <= max_forces, axis=0)
    if np.count_nonzero(is_possible) >= MIN_SAMPLES:
        rows = rows[:, is_possible]
        forces = forces[:, is_possible]
    # Wrong estimates of what was not moved ask for forces that no drive has.
    forces = np.clip(forces, -max_forces, max_forces)
    force_rms = np.sqrt(np.mean(forces**2, axis=1))
    # Finite also for joints without any force.
    largest_rms = float(force_rms.max()) or 1.0
    scale = np.maximum(force_rms, 1e-9 * largest_rms)[:, None, None]
    count = rows.shape[0] * rows.shape[1]
    return (rows / scale).reshape(count, base.size) / np.sqrt(count)


def _random_motion(base: BaseParameters) -> Motion:
    """Return random motions within the limits of the robot's joints."""
    robot = base.model.robot
    limits = complete_limits(robot)
    rng = np.random.default_rng(0)
    shape = (SAMPLES, robot.joints)
    low = limits.position_min
    high = limits.position_max
    pace = rng.uniform(0.0, 1.0, (SAMPLES, 1))
    q = reachable(robot, rng.uniform(low, high, shape))
    qd = pace * rng.uniform(-1.0, 1.0, shape) * limits.velocity
    qdd = pace**2 * rng.uniform(-1.0, 1.0, shape) * limits.acceleration
    if robot.floating:
        # Its accelerometer measures gravity as well.
        qdd[:, 2] += STANDARD_GRAVITY
    law = base.model.memory
    return Motion(q, qd, qdd, None if law is None else law.settled(qd))


def open_directions(
    directions: Matrix,
    scale: AnyArray,
    values: AnyArray,
    half_widths: AnyArray,
    rows: Matrix,
) -> tuple[UndeterminedDirection, ...]:
    """Return the directions of the parameters that are left open, the weakest first.

    Args:
        directions: Singular directions of the scaled parameters, as rows.
        scale: Number by which each parameter is multiplied in them.
        values: Singular values.
        half_widths: Half the 95 % intervals of the directions' coefficients.
        rows: Rows of other motions, as `random_rows` returns them.
    """
    steps = directions / scale
    forces = np.linalg.norm(rows @ steps.T, axis=0)
    uncertainty = np.full_like(half_widths, np.inf)
    is_visible = np.isfinite(half_widths)
    uncertainty[is_visible] = half_widths[is_visible] * forces[is_visible]

    open_ones = []
    is_open = uncertainty > OPEN_SHARES.doubtful
    for k in sorted(np.flatnonzero(is_open), key=lambda k: values[k]):
        direction = directions[k]
        order = np.argsort(-np.abs(direction), kind="stable")
        shares = direction[order] / direction[order[0]]
        is_part = np.abs(shares) >= MIN_SHARE
        open_ones.append(
            UndeterminedDirection(
                parts=tuple(order[is_part].tolist()),
                shares=tuple(shares[is_part].tolist()),
                singular_value=float(values[k] / values.max()),
                uncertainty=float(uncertainty[k]),
            )
        )
    return tuple(open_ones)
