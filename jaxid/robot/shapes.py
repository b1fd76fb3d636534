"""Shapes of collision models: capsules on bodies, planes and boxes in the world.

Distances are signed: negative where shapes overlap. They are differentiable everywhere.
A square root is rounded near zero, so that a distance comes out at most `ROUNDING` too
small, never too large. Where the closest points are not unique, the derivative is that
at one pair of them.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Numbers, namespace
from jaxid.errors import InputError

GROUND = -1
"""Index of the ground among the bodies."""
ROUNDING = 1e-6
"""Largest error of a distance, by which it is smooth at zero [m]."""

Vectors = Float[AnyArray, "*batch 3"]
Lengths = Float[AnyArray, "*batch"]


class Capsule(eqx.Module):
    """All points within a radius of a segment on a body; a sphere if its ends are one point.

    Args:
        name: Name of the capsule in messages.
        body: Index of the body that carries it; -1 is the ground.
        start: One end of the axis, in the body's frame [m].
        end: The other end [m]; `start` if None, which makes a sphere.
        radius: Radius [m].

    Raises:
        InputError: If the ends are no points, or the radius is not positive.
    """

    name: str = eqx.field(static=True)
    body: int = eqx.field(static=True)
    start: Float[AnyArray, "3"]
    end: Float[AnyArray, "3"]
    radius: Float[AnyArray, ""]

    def __init__(
        self,
        name: str,
        body: int,
        *,
        start: Numbers,
        end: Numbers | None = None,
        radius: Numbers,
    ):
        self.name, self.body = name, body
        self.start = _point(f"`start` of capsule `{name}`", start)
        self.end = (
            self.start if end is None else _point(f"`end` of capsule `{name}`", end)
        )
        self.radius = np.array(radius, np.float64)
        if not 0 < self.radius < np.inf:
            raise InputError(
                f"`radius` of capsule `{name}` must be positive [m], not {radius}."
            )


class HalfSpace(eqx.Module):
    """The solid on one side of a plane: the floor (z = 0 by default), a wall, a ceiling.

    Args:
        name: Name of the obstacle in messages.
        normal: Direction out of the solid, of any length.
        height: Height of the plane along the normal [m].

    Raises:
        InputError: If the normal is zero or the height not finite.
    """

    name: str = eqx.field(static=True)
    normal: Float[AnyArray, "3"]
    height: Float[AnyArray, ""]

    def __init__(
        self,
        name: str = "ground",
        *,
        normal: Numbers = (0.0, 0.0, 1.0),
        height: Numbers = 0.0,
    ):
        n = _point(f"`normal` of `{name}`", normal)
        length = np.linalg.norm(n)
        if length < 1e-9 or not np.isfinite(height).all():
            raise InputError(
                f"`{name}` needs a `normal` that is not zero, and a finite `height`."
            )
        self.name = name
        self.normal = n / length
        self.height = np.array(height, np.float64)

    def distance(self, start: Vectors, end: Vectors) -> Lengths:
        """Return the signed distances of segments from the plane [m]: those of the lower ends."""
        return _smaller(start @ self.normal, end @ self.normal) - self.height

    def slopes(
        self, ends: Float[np.ndarray, "segments 2 3"]
    ) -> Float[np.ndarray, "segments 2 3"]:
        """Return the derivatives of the distances of segments by their ends, in NumPy."""
        heights = ends @ self.normal
        lower = heights[:, 0] < heights[:, 1]
        return np.stack([lower, ~lower], axis=1)[:, :, None] * self.normal


class Box(eqx.Module):
    """A box in the world.

    Args:
        name: Name of the obstacle in messages.
        centre: Centre in the frame of the ground [m].
        size: Lengths of the edges [m].
        rotation: Attitude, whose columns are the box's axes; that of the ground if
            None.

    Raises:
        InputError: If an edge is not positive, or the attitude is no rotation.
    """

    name: str = eqx.field(static=True)
    centre: Float[AnyArray, "3"]
    size: Float[AnyArray, "3"]
    rotation: Float[AnyArray, "3 3"]

    def __init__(
        self,
        name: str,
        *,
        centre: Numbers,
        size: Numbers,
        rotation: Numbers | None = None,
    ):
        R = np.eye(3) if rotation is None else np.array(rotation, np.float64)
        self.name, self.rotation = name, R
        self.centre = _point(f"`centre` of box `{name}`", centre)
        self.size = _point(f"`size` of box `{name}`", size)
        if (self.size <= 0).any():
            raise InputError(
                f"`size` of box `{name}` must be positive [m], but is {size}."
            )
        if R.shape != (3, 3) or not np.abs(R.T @ R - np.eye(3)).max() < 1e-6:
            raise InputError(f"`rotation` of box `{name}` is no rotation matrix.")

    def distance(self, start: Vectors, end: Vectors) -> Lengths:
        """Return the signed distances of segments' deepest or nearest points [m]."""
        start, end = jnp.asarray(start), jnp.asarray(end)
        R = jnp.asarray(self.rotation)
        centre = jnp.broadcast_to(self.centre @ self.rotation, start.shape)
        first, along = start @ R - centre, (end - start) @ R
        # The distance is convex along the segment. Its minimum is found without
        # derivatives: those of the place add nothing to that of the distance.
        origin, direction = jax.lax.stop_gradient((first, along))

        def slope(place: Array) -> Array:
            return jax.jvp(self._signed, (origin + place * direction,), (direction,))[
                1
            ][..., None]

        def halve(_: int | Array, interval: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = interval
            middle = 0.5 * (low + high)
            falls = slope(middle) < 0
            return jnp.where(falls, middle, low), jnp.where(falls, high, middle)

        zero = jnp.zeros_like(origin[..., :1])
        low, high = jax.lax.fori_loop(0, 40, halve, (zero, zero + 1.0))
        # In the box the deepest point lies where two faces are equally near. The
        # derivative is then that mean of both sides' which a shift along the segment
        # leaves as it is.
        falling, rising = slope(low), slope(high)
        turns = rising - falling
        share = jnp.clip(rising / jnp.where(turns > 0, turns, 1.0), 0.0, 1.0)[..., 0]
        before, after = (self._signed(first + place * along) for place in (low, high))
        return share * before + (1.0 - share) * after

    def slopes(
        self, ends: Float[np.ndarray, "segments 2 3"]
    ) -> Float[np.ndarray, "segments 2 3"]:
        """Return the derivatives of the distances of segments by their ends, in NumPy."""
        count = -(-len(ends) // 64) * 64  # few sizes, so that little is compiled
        padded = np.resize(ends, (count, 2, 3))
        found = _box_slopes(self, jnp.asarray(padded[:, 0]), jnp.asarray(padded[:, 1]))
        return np.stack([np.asarray(x) for x in found], axis=1)[: len(ends)]

    def _signed(self, point: Array) -> Any:
        beyond = jnp.abs(point) - jnp.broadcast_to(0.5 * self.size, point.shape)
        x, y, z = jnp.unstack(-beyond, axis=-1)
        depth = _smaller(_smaller(x, y), z)
        outside = jnp.where(beyond > 0, beyond, 0.0)
        return _rounded_norm(outside) - jnp.where(depth > 0, depth, 0.0)


@eqx.filter_jit
def _box_slopes(box: Box, start: Array, end: Array) -> tuple[Array, ...]:
    distance, pull = jax.vjp(box.distance, start, end)
    return pull(jnp.ones_like(distance))


def _smaller(x: AnyArray, y: AnyArray) -> Any:
    """Return the smaller numbers, with the derivatives of one of both.

    Derivatives of `jnp.minimum` ask which argument equals the result. None does where a
    compiler rounds the two in different ways.
    """
    return namespace(x, y).where(x < y, x, y)


def _rounded_norm(vector: Vectors) -> Any:
    """Return lengths of vectors, smooth at zero and there at most `ROUNDING` too small [m]."""
    xp = namespace(vector)
    return xp.sqrt(xp.einsum("...i,...i->...", vector, vector) + ROUNDING**2) - ROUNDING


def segment_distance(
    start: Vectors, end: Vectors, other_start: Vectors, other_end: Vectors
) -> Lengths:
    """Return the distance between segments, which may be parallel, touch, or be points [m]."""
    u, v = end - start, other_end - other_start
    a, b = closest_places(start, end, other_start, other_end)
    return _rounded_norm(start + a * u - other_start - b * v)


def closest_places(
    start: Vectors, end: Vectors, other_start: Vectors, other_end: Vectors
) -> tuple[AnyArray, AnyArray]:
    """Return the places of the closest points along two segments, from 0 to 1, as constants.

    Their derivatives add nothing to that of the distance, and they have none at
    parallel axes.
    """
    xp = namespace(start, end, other_start, other_end)
    ends = (start, end, other_start, other_end)
    if xp is jnp:
        ends = jax.lax.stop_gradient(tuple(map(jnp.asarray, ends)))
    start, end, other_start, other_end = ends
    u, v, r = end - start, other_end - other_start, start - other_start

    def dot(x: AnyArray, y: AnyArray) -> AnyArray:
        return xp.einsum("...i,...i->...", x, y)[..., None]

    def share(part: AnyArray, whole: AnyArray, usable: AnyArray) -> AnyArray:
        return xp.where(
            usable, xp.clip(part / xp.where(usable, whole, 1.0), 0.0, 1.0), 0.0
        )

    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    area = uu * vv - uv * uv
    # Axes count as parallel below this square of the sine between them.
    a = share(uv * vr - ur * vv, area, area > 1e-12 * uu * vv)
    b = share(uv * a + vr, vv, vv > 0)
    # The nearest point to a clipped one; for parallel axes any start will do.
    a = share(uv * b - ur, uu, uu > 0)
    return a, share(uv * a + vr, vv, vv > 0)


def _point(name: str, value: Numbers) -> np.ndarray:
    point = np.array(value, np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"{name} must hold three finite numbers, but is {value}.")
    return point
