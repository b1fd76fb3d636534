"""Which single slip in an experiment file would explain a log that its model does not fit."""

import itertools
from collections.abc import Iterator

import numpy as np

from jaxid.dynamics import compiled
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.identification.streaming_log import LongLog
from jaxid.measurement.observations import Observations
from jaxid.types import Float

BAD = 0.1
"""Share of the forces that a model leaves unexplained, from which a slip is looked for, of 1."""
BETTER = 0.5
"""Part of it that may be left where a slip is undone."""
ALIKE = 1.05
"""How much more two slips may leave than the best one to be as good."""
ROWS = 150
"""Instants that are looked at."""
MOST_JOINTS = 12
"""Joints up to which pairs are tried: their number grows with the square."""


def likely_mistake(base: BaseParameters, observations: Observations | LongLog) -> tuple[str, ...]:
    """Finds the sign or the exchange of two columns that makes a model fit a log, if there is one.

    Every slip is undone in turn and the model is fitted anew to some instants of the log.

    Args:
        base: What is identified.
        observations: Of one log; a long one is not looked at.

    Returns:
        A sentence, or nothing where the model fits or no single slip explains why it does not.
    """
    if isinstance(observations, LongLog):
        return ()
    step = -(-observations.rows // ROWS)
    forces = observations.reduced_forces[::step]
    motion = observations.motion[observations.instants[::step]]
    left = _unexplained(base, motion, forces)
    if left < BAD:
        return ()
    tried = [
        (_unexplained(base, moved, felt), float(np.sum(felt * moved.qd)), said)
        for said, moved, felt in _undone(base, motion, forces)
    ]
    best = min(tried)[0]
    if best > BETTER * left:
        return ()
    # With all signs turned a model fits as well, with negative friction: the power tells.
    _, _, said = max((one for one in tried if one[0] <= ALIKE * best), key=lambda one: one[1])
    return (
        f"{said}: the model then misses {100 * best:.2g} % of the forces instead of "
        f"{100 * left:.2g} %.",
    )


def _undone(
    base: BaseParameters, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> Iterator[tuple[str, Motion, Float[np.ndarray, "rows joints"]]]:
    names = base.model.robot.joint_names
    n = len(names)
    for j, name in enumerate(names):
        signs = np.where(np.arange(n) == j, -1.0, 1.0)
        key = f"of joint `{name}` seems to be wrong (`recording."
        yield f"the sign of the force {key}force_signs`)", motion, forces * signs
        turned = Motion(motion.q * signs, motion.qd * signs, motion.qdd * signs)
        yield f"the sign of the angle {key}angle_signs`)", turned, forces
    if n > MOST_JOINTS:
        return
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        key = f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        yield f"the forces {key}forces`)", motion, forces[:, order]
        moved = Motion(motion.q[:, order], motion.qd[:, order], motion.qdd[:, order])
        yield f"the angles {key}angles`)", moved, forces


def _unexplained(
    base: BaseParameters, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> float:
    """What least squares leave of the forces where every joint counts alike, of 1."""
    wanted = forces - compiled.tool_forces(base, motion)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    scale = 1.0 / np.where(size > 0, size, np.inf)
    rows = compiled.regressor_rows(base, motion)
    theta = np.zeros((forces.shape[1], len(forces), base.size))
    for joint, columns in enumerate(compiled.acting_columns(base)):
        theta[joint][:, columns] = rows[joint] * scale[joint]
    theta = theta.reshape(-1, base.size)
    length = np.linalg.norm(theta, axis=0)
    theta = theta / np.where(length > 0, length, 1.0)
    target = (wanted * scale).T.ravel()
    found = np.linalg.lstsq(theta, target, rcond=1e-9)[0]
    return float(np.linalg.norm(theta @ found - target) / max(np.linalg.norm(target), 1e-300))
