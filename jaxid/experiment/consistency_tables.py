"""Keys of `[estimator]` about bodies that could exist become bounds and an estimator."""

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.experiment.tables import EstimatorTable
from jaxid.identification.consistency import BodyBounds, EntropicPull, PhysicallyConsistent
from jaxid.identification.weights import AbstractWeights
from jaxid.robot.robot import Robot

VECTORS = ("centre_min", "centre_max", "ellipsoid_centre", "ellipsoid_axes")
"""Keys with three numbers for all bodies, or for each."""
BOUNDS = ("mass_min", "mass_max", "radius", *VECTORS, "total_mass")
"""Keys that replace bounds from the robot's geometry."""


def build_consistent(
    table: EstimatorTable,
    robot: Robot,
    weights: AbstractWeights,
    bodies: Float[np.ndarray, "bodies 10"] | None,
) -> PhysicallyConsistent:
    """The estimator of `kind = "consistent"`.

    Args:
        table: `[estimator]`.
        robot: Whose bodies they are.
        weights: Of the joints' rows.
        bodies: Of the prior, if the file asks for one.

    Raises:
        InputError: If lists have other lengths than they must, or no body satisfies all bounds.
    """
    pull = None
    if table.pull is not None or bodies is not None:
        pull = EntropicPull(bodies, 1.0 if table.pull is None else table.pull)
    margin = 0.0 if table.margin is None else table.margin
    return PhysicallyConsistent(weights, _bounds(table, robot), margin, pull)


def _bounds(table: EstimatorTable, robot: Robot) -> BodyBounds | None:
    given = {key: getattr(table, key) for key in BOUNDS if getattr(table, key) is not None}
    if not given:
        return None
    if "ellipsoid_centre" in given and "ellipsoid_axes" not in given:
        raise InputError("`ellipsoid_centre` needs `ellipsoid_axes`: the half axes [m].")
    for key in VECTORS:
        if key in given:
            _require_vectors(key, given[key], robot)
    return BodyBounds.from_geometry(robot).replace(**given)


def _require_vectors(key: str, value: list, robot: Robot) -> None:
    rows = value if any(isinstance(row, list) for row in value) else [value]
    if len(rows) != (robot.joints if rows is value else 1) or not all(
        isinstance(row, list) and len(row) == 3 for row in rows
    ):
        raise InputError(
            f"`{key}` must hold three numbers for all bodies, or a list of three for each of the "
            f"{robot.joints} bodies."
        )
