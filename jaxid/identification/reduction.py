"""From motion to rows: columns and forces of a chunk, filtered and decimated alike."""

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import regressor_rows, tool_forces
from jaxid.measurement.observations import Chunk, Observations
from jaxid.types import Float


def reduced(
    base: BaseParameters, observations: Observations, chunk: Chunk
) -> tuple[list[Float[np.ndarray, "rows columns"]], Float[np.ndarray, "rows joints"]]:
    """The rows of one chunk: the columns of each joint, and forces without a known tool's."""
    part = slice(*chunk.samples)
    motion = observations.motion[part]
    forces = np.asarray(observations.forces)[part]
    if base.model.robot.tool is not None:
        forces = forces - tool_forces(base, motion)
    columns = [chunk.reduce(theta) for theta in regressor_rows(base, motion)]
    return columns, chunk.reduce(forces)
