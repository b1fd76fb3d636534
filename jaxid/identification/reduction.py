"""From motion to rows: columns and forces of a chunk, filtered and decimated alike."""

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import regressor_rows, tool_forces
from jaxid.dynamics.motion import Motion
from jaxid.measurement.observations import Chunk


def reduced(
    base: BaseParameters, motion: Motion, forces: Float[AnyArray, "samples joints"], chunk: Chunk
) -> tuple[list[Float[np.ndarray, "rows columns"]], Float[np.ndarray, "rows joints"]]:
    """The rows of one chunk: the columns of each joint, and forces without a known tool's.

    Args:
        base: The base parameters.
        motion: At the chunk's samples.
        forces: Measured at the chunk's samples [N m or N].
        chunk: How samples become rows.
    """
    forces = np.asarray(forces)
    if base.model.robot.tool is not None:
        forces = forces - tool_forces(base, motion)
    columns = [chunk.reduce(theta) for theta in regressor_rows(base, motion)]
    return columns, chunk.reduce(forces)
