r"""The regressor at random motions, stacked: what the rank decisions look at (Eq. 20)."""

import math

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.dimensions import length_power
from jaxid.dynamics.machine import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion

SAMPLES = 25
ROWS_PER_COLUMN = 3.0
SLOWEST = 1e-3
"""Speed of the slowest random motions, of that of the others."""


def observation_matrix(
    model: Model, seed: int
) -> tuple[Float[np.ndarray, "rows standard"], Float[np.ndarray, " standard"]]:
    r"""The regressor at random motions, stacked and free of units: $\Theta_{QR}$ (Eq. 20).

    Lengths are measured in the robot's own size, so that metres or millimetres make no difference.
    It is computed in float64, whatever the precision in which JAX runs.

    Returns:
        The matrix, and for each parameter the factor that its column was multiplied with.
    """
    samples = max(SAMPLES, math.ceil(ROWS_PER_COLUMN * model.size / model.robot.joints))
    motion = random_motion(model, samples, seed)
    theta = in_numpy(model, model.columns, motion.q, motion.qd, motion.qdd)
    rows, columns = row_units(model), column_units(model)
    return (theta * rows[:, None] * columns).reshape(-1, model.size), columns


def random_motion(model: Model, samples: int, seed: int) -> Motion:
    """Uniformly random coordinates, velocities and accelerations; every second sample is slow.

    Slow by any factor up to `SLOWEST`: some friction shows itself only there.
    """
    rng = np.random.default_rng(seed)
    shape = (samples, model.robot.joints)
    q, qd, qdd = (rng.uniform(-s, s, shape) * row_units(model) for s in (3.0, 3.0, 6.0))
    qd[1::2] *= SLOWEST ** rng.uniform(0.0, 1.0, qd[1::2].shape)
    return Motion(q, qd, qdd)


def row_units(model: Model) -> Float[np.ndarray, " joints"]:
    """The unit of each joint's coordinate: 1 rad, or the size of the robot [m]."""
    return np.where(np.array(model.robot.revolute), 1.0, characteristic_length(model))


def column_units(model: Model) -> Float[np.ndarray, " standard"]:
    """The unit of each parameter: as many sizes of the robot as there are lengths in its unit."""
    size = characteristic_length(model)
    return np.array([size ** length_power(unit) for unit in model.parameter_units])


def characteristic_length(model: Model) -> float:
    """The size of the robot: the largest distance between neighbouring joints [m], or 1."""
    distances = np.linalg.norm(np.asarray(model.robot.offset), axis=-1)
    return float(distances.max()) if distances.any() else 1.0
