"""Capsules around points: the smallest that a search finds, and large enough for certain."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

STARTS = 3
"""Principal directions from which the axis is sought."""


class Enclosing(NamedTuple):
    """A capsule around points.

    Attributes:
        start: One end of its axis [m].
        end: The other end [m].
        radius: Of the capsule [m].
    """

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radius: float

    @property
    def volume(self) -> float:
        """Of the capsule [m³]."""
        length = float(np.linalg.norm(self.end - self.start))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


def enclose(points: Float[AnyArray, "points 3"]) -> Enclosing:
    """Finds a small capsule around all points.

    The direction and the place of the axis are sought from each of the principal directions. For
    every axis the radius reaches the farthest point and the ends are as near as they can be, so all
    points are inside, whatever the search finds.

    Args:
        points: At least one [m].

    Raises:
        InputError: If there is none, or one is not finite.
    """
    cloud = np.asarray(points, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud) or not np.isfinite(cloud).all():
        raise InputError(f"`points` must be rows of three finite numbers, but are {cloud.shape}.")
    cloud = _hull(cloud)
    centre = 0.5 * (cloud.max(axis=0) + cloud.min(axis=0))
    _, _, directions = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=True)
    size = max(float(np.ptp(cloud, axis=0).max()), 1e-9)
    found = []
    for k in range(STARTS):
        frame = np.roll(directions, -k, axis=0)
        best = minimize(
            lambda x, frame=frame: _along(cloud, centre, frame, x, size).volume,
            np.zeros(4),
            method="Nelder-Mead",
            options={"maxiter": 400, "xatol": 1e-5, "fatol": 1e-6 * size**3},
        )
        found.append(_along(cloud, centre, frame, best.x, size))
    return min(found, key=lambda capsule: capsule.volume)


def _along(
    cloud: np.ndarray, centre: np.ndarray, frame: np.ndarray, x: np.ndarray, size: float
) -> Enclosing:
    """The capsule about an axis near the first of three directions, turned and shifted a little."""
    axis = frame[0] + x[0] * frame[1] + x[1] * frame[2]
    axis = axis / np.linalg.norm(axis)
    place = centre + size * (x[2] * frame[1] + x[3] * frame[2])
    along = (cloud - place) @ axis
    away = np.linalg.norm(cloud - place - along[:, None] * axis, axis=1)
    # Rounding must leave no point outside.
    radius = float(away.max()) * (1 + 1e-9) + 1e-12
    reach = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = (along + reach).min(), (along - reach).max()
    if low > high:
        low = high = 0.5 * (low + high)
    return Enclosing(place + low * axis, place + high * axis, radius)


def _hull(cloud: np.ndarray) -> np.ndarray:
    """The corners of a cloud; all of it where it is flat."""
    try:
        return cloud[ConvexHull(cloud).vertices] if len(cloud) > 4 else cloud
    except QhullError:
        return cloud
