"""Shapes that keep robots out of collisions: capsules on bodies, planes and boxes in the world.

Distances are signed: negative where shapes overlap. They are differentiable everywhere. A square
root is rounded near zero, so that a distance comes out at most `ROUNDING` too small, never too
large. Where the closest points are not unique, the derivative is that at one pair of them.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Numbers
from jaxid.errors import InputError

GROUND = -1
"""The body of what does not move."""
ROUNDING = 1e-6
"""How much too small a distance may come out, so that it is smooth at zero [m]."""
PARALLEL = 1e-12
"""Square of the sine between axes that count as parallel."""
HALVINGS = 40
"""Bisections of a segment on the way to its point nearest to a box."""


class Capsule(eqx.Module):
    """All points within a radius of a segment on a body; a sphere if its ends are one point.

    Attributes:
        name: As it reads in messages.
        body: Index of the body that carries it; -1 is the ground.
        start: One end of the axis, in the body's frame [m].
        end: The other end [m].
        radius: Of the capsule [m].
    """

    name: str = eqx.field(static=True)
    body: int = eqx.field(static=True)
    start: Float[AnyArray, "3"]
    end: Float[AnyArray, "3"]
    radius: Float[AnyArray, ""]

    @classmethod
    def of(
        cls, name: str, body: int, *, start: Numbers, end: Numbers | None = None, radius: float
    ) -> "Capsule":
        """Builds a capsule and checks it.

        Args:
            name: As it reads in messages.
            body: Index of the body that carries it; -1 is the ground.
            start: One end of the axis, in the body's frame [m].
            end: The other end [m]; a sphere about `start` if None.
            radius: Of the capsule [m].

        Raises:
            InputError: If the ends are no points, or the radius is not positive.
        """
        first = _point(f"the start of capsule `{name}`", start)
        last = first if end is None else _point(f"the end of capsule `{name}`", end)
        if not 0 < radius < np.inf:
            raise InputError(
                f"the radius of capsule `{name}` must be positive [m], not {radius:g}."
            )
        return cls(name, body, first, last, np.array(radius, np.float64))


class AbstractObstacle(eqx.Module):
    """A convex solid that stands in the world.

    Attributes:
        name: As it reads in messages.
    """

    name: eqx.AbstractVar[str]

    @abstractmethod
    def distance(
        self, start: Float[AnyArray, "*batch 3"], end: Float[AnyArray, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Signed distance between segments and the solid's surface [m].

        Args:
            start: Ends of the segments, in the frame of the ground [m].
            end: The other ends [m].
        """


class HalfSpace(AbstractObstacle):
    """All that lies on one side of a plane: the floor, a wall, a ceiling.

    Attributes:
        name: As it reads in messages.
        normal: Unit vector out of the solid.
        height: Of the plane along the normal [m].
    """

    name: str = eqx.field(static=True)
    normal: Float[AnyArray, "3"]
    height: Float[AnyArray, ""]

    @classmethod
    def of(
        cls, name: str = "ground", *, normal: Numbers = (0.0, 0.0, 1.0), height: float = 0.0
    ) -> "HalfSpace":
        """Builds a half-space: the floor z = 0 if nothing is given.

        Args:
            name: As it reads in messages.
            normal: Direction out of the solid.
            height: Of the plane along the normal [m].

        Raises:
            InputError: If the normal is zero or the height not finite.
        """
        n = _point(f"the normal of `{name}`", normal)
        length = np.linalg.norm(n)
        if length < 1e-9 or not np.isfinite(height):
            raise InputError(f"`{name}` needs a normal that is not zero, and a finite height [m].")
        return cls(name, n / length, np.array(height, np.float64))

    def distance(
        self, start: Float[AnyArray, "*batch 3"], end: Float[AnyArray, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Height of the lower end above the plane [m]."""
        n, start, end = (jnp.asarray(x) for x in (self.normal, start, end))
        return jnp.minimum(start @ n, end @ n) - self.height


class Box(AbstractObstacle):
    """A box that stands in the world.

    Attributes:
        name: As it reads in messages.
        centre: In the frame of the ground [m].
        rotation: Columns are the box's axes.
        half: Half of its edges [m].
    """

    name: str = eqx.field(static=True)
    centre: Float[AnyArray, "3"]
    rotation: Float[AnyArray, "3 3"]
    half: Float[AnyArray, "3"]

    @classmethod
    def of(
        cls, name: str, *, centre: Numbers, size: Numbers, rotation: Numbers | None = None
    ) -> "Box":
        """Builds a box and checks it.

        Args:
            name: As it reads in messages.
            centre: In the frame of the ground [m].
            size: Its edges [m].
            rotation: Columns are the box's axes; those of the ground if None.

        Raises:
            InputError: If an edge is not positive, or the rotation is none.
        """
        edges = _point(f"the size of box `{name}`", size)
        R = np.eye(3) if rotation is None else np.array(rotation, np.float64)
        if (edges <= 0).any():
            raise InputError(f"the edges of box `{name}` must be positive [m].")
        if R.shape != (3, 3) or not np.abs(R.T @ R - np.eye(3)).max() < 1e-6:
            raise InputError(f"the rotation of box `{name}` is no rotation matrix.")
        return cls(name, _point(f"the centre of box `{name}`", centre), R, edges / 2)

    def distance(
        self, start: Float[AnyArray, "*batch 3"], end: Float[AnyArray, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Signed distance of the segment's deepest or nearest point [m]."""
        start, end = jnp.asarray(start), jnp.asarray(end)
        first, along = self._local(start), (end - start) @ jnp.asarray(self.rotation)
        # The distance is convex along the segment. Where it stops falling is found without
        # derivatives: that place's own adds nothing to that of the distance.
        origin, direction = jax.lax.stop_gradient((first, along))

        def slope(place: Array) -> Array:
            return jax.jvp(self._signed, (origin + place * direction,), (direction,))[1][..., None]

        def halve(_: int | Array, interval: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = interval
            middle = 0.5 * (low + high)
            falls = slope(middle) < 0
            return jnp.where(falls, middle, low), jnp.where(falls, high, middle)

        zero = jnp.zeros_like(origin[..., :1])
        low, high = jax.lax.fori_loop(0, HALVINGS, halve, (zero, zero + 1.0))
        # In the box the deepest point lies where two faces are equally near. The derivative is then
        # that mean of both sides' which a shift along the segment leaves as it is.
        falling, rising = slope(low), slope(high)
        turns = rising - falling
        share = jnp.clip(rising / jnp.where(turns > 0, turns, 1.0), 0.0, 1.0)[..., 0]
        before, after = (self._signed(first + place * along) for place in (low, high))
        return share * before + (1.0 - share) * after

    def _local(self, point: Array) -> Array:
        R = jnp.asarray(self.rotation)
        return point @ R - jnp.broadcast_to(self.centre @ self.rotation, point.shape)

    def _signed(self, point: Array) -> Array:
        beyond = jnp.abs(point) - jnp.broadcast_to(self.half, point.shape)
        inside = jnp.minimum(jnp.max(beyond, -1), 0.0)
        return rounded_norm(jnp.maximum(beyond, 0.0)) + inside


def rounded_norm(vector: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch"]:
    """Length of vectors, smooth at zero and there at most `ROUNDING` too small [m]."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + ROUNDING**2) - ROUNDING


def segment_distance(
    start: Float[AnyArray, "*batch 3"],
    end: Float[AnyArray, "*batch 3"],
    other_start: Float[AnyArray, "*batch 3"],
    other_end: Float[AnyArray, "*batch 3"],
) -> Float[Array, "*batch"]:
    """Distance between segments, which may be parallel, touch, or be points [m].

    Args:
        start: Ends of the first segments [m].
        end: Their other ends [m].
        other_start: Ends of the second segments [m].
        other_end: Their other ends [m].
    """
    start, end = jnp.asarray(start), jnp.asarray(end)
    other_start, other_end = jnp.asarray(other_start), jnp.asarray(other_end)
    u, v = end - start, other_end - other_start
    # Where the closest points are is found without derivatives: theirs add nothing to that of
    # the distance, and they have none at parallel axes.
    a, b = jax.lax.stop_gradient(_closest(u, v, start - other_start))
    return rounded_norm(start + a * u - other_start - b * v)


def _closest(u: Array, v: Array, r: Array) -> tuple[Array, Array]:
    """Places of the closest points along two segments, from 0 to 1."""

    def dot(x: Array, y: Array) -> Array:
        return jnp.sum(x * y, axis=-1, keepdims=True)

    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    area = uu * vv - uv * uv
    a = _share(uv * vr - ur * vv, area, area > PARALLEL * uu * vv)
    b = _share(uv * a + vr, vv, vv > 0)
    # The nearest point to a clipped one; for parallel axes any start will do.
    a = _share(uv * b - ur, uu, uu > 0)
    return a, _share(uv * a + vr, vv, vv > 0)


def _share(part: Array, whole: Array, usable: Array) -> Array:
    return jnp.where(usable, jnp.clip(part / jnp.where(usable, whole, 1.0), 0.0, 1.0), 0.0)


def _point(what: str, value: Numbers) -> np.ndarray:
    point = np.array(value, np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"{what} must hold three finite numbers, but came as {value}.")
    return point
