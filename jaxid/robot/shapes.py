"""Shapes of collision models: capsules on bodies, planes and boxes in the world.

Distances are signed: negative where shapes overlap. They are differentiable everywhere.
A square root is rounded near zero, so that a distance comes out at most `ROUNDING` too
small, never too large. Where the closest points are not unique, the derivative is that
at one pair of them.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Float,
    Matrix3,
    Numbers,
    Vector3,
    as_finite_array,
)
from jaxid.errors import InputError

from .rotations import Vectors, as_rotations

GROUND = -1
"""Index of the ground among the bodies."""
ROUNDING = 1e-6
"""Largest error of a distance, by which it is smooth at zero [m]."""

Lengths = Float[AnyArray, "*batch"]


class Capsule(eqx.Module):
    """All points within a radius of a segment; a sphere if its ends are one point.

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
    start: Vector3
    end: Vector3
    radius: AnyArray

    def __init__(
        self,
        name: str,
        body: int,
        *,
        start: Numbers,
        end: Numbers | None = None,
        radius: Numbers,
    ):
        self.name = name
        self.body = body
        self.start = as_finite_array(f"`start` of capsule `{name}`", start, (3,))
        self.end = self.start
        if end is not None:
            self.end = as_finite_array(f"`end` of capsule `{name}`", end, (3,))
        self.radius = np.array(radius, np.float64)
        if not 0 < self.radius < np.inf:
            raise InputError(
                f"`radius` of capsule `{name}` must be positive [m], not {radius}."
            )


class HalfSpace(eqx.Module):
    """The solid on one side of a plane: the floor (z = 0), a wall, a ceiling.

    Args:
        name: Name of the obstacle in messages.
        normal: Direction out of the solid, of any length.
        height: Height of the plane along the normal [m].

    Raises:
        InputError: If the normal is zero or the height not finite.
    """

    name: str = eqx.field(static=True)
    normal: Vector3
    height: AnyArray

    def __init__(
        self,
        name: str = "ground",
        *,
        normal: Numbers = (0.0, 0.0, 1.0),
        height: Numbers = 0.0,
    ):
        direction = as_finite_array(f"`normal` of `{name}`", normal, (3,))
        length = np.linalg.norm(direction)
        if length < 1e-9 or not np.isfinite(height).all():
            raise InputError(
                f"`{name}` needs a `normal` that is not zero, and a finite `height`."
            )
        self.name = name
        self.normal = direction / length
        self.height = np.array(height, np.float64)

    def distance(self, start: Vectors, end: Vectors) -> Lengths:
        """Return the signed distances of segments' lower ends from the plane [m]."""
        return _smaller(start @ self.normal, end @ self.normal) - self.height


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
    centre: Vector3
    size: Vector3
    rotation: Matrix3

    def __init__(
        self,
        name: str,
        *,
        centre: Numbers,
        size: Numbers,
        rotation: Numbers | None = None,
    ):
        R = np.eye(3) if rotation is None else rotation
        self.name = name
        self.rotation = as_rotations(f"`rotation` of box `{name}`", R, (3, 3))
        self.centre = as_finite_array(f"`centre` of box `{name}`", centre, (3,))
        self.size = as_finite_array(f"`size` of box `{name}`", size, (3,))
        if (self.size <= 0).any():
            raise InputError(
                f"`size` of box `{name}` must be positive [m], but is {size}."
            )

    def distance(self, start: Vectors, end: Vectors) -> Lengths:
        """Return the signed distances of segments' deepest or nearest points [m]."""
        R = jnp.asarray(self.rotation)
        # Everything in the frame of the box.
        centre = self.centre @ self.rotation
        local_start = start @ R - jnp.broadcast_to(centre, start.shape)
        extent = (end - start) @ R
        # The minimum is found without derivatives: those of its place add nothing to
        # that of the distance.
        origin, direction = jax.lax.stop_gradient((local_start, extent))

        def slope(place):
            point = origin + place * direction
            _, derivative = jax.jvp(self._signed, (point,), (direction,))
            return derivative[..., None]

        low, high = _bisect(slope, jnp.zeros_like(origin[..., :1]))
        # In the box the deepest point lies where two faces are equally near. The
        # derivative is then that mean of both sides' which a shift extent the segment
        # leaves as it is.
        end_slope = slope(high)
        turn = end_slope - slope(low)
        positive_turn = jnp.where(turn > 0, turn, 1.0)
        ratio = end_slope / positive_turn
        share = jnp.clip(ratio, 0.0, 1.0)[..., 0]
        point_before = local_start + low * extent
        point_after = local_start + high * extent
        distance_before = self._signed(point_before)
        distance_after = self._signed(point_after)
        return share * distance_before + (1.0 - share) * distance_after

    def _signed(self, point: Vectors):
        """Return the signed distances of points in the frame of the box [m]."""
        half_size = jnp.broadcast_to(0.5 * self.size, point.shape)
        excess = jnp.abs(point) - half_size
        x, y, z = jnp.unstack(-excess, axis=-1)
        depth = _smaller(_smaller(x, y), z)
        outside_part = jnp.where(excess > 0, excess, 0.0)
        inside_depth = jnp.where(depth > 0, depth, 0.0)
        return _rounded_norm(outside_part) - inside_depth


def segment_distance(
    start: Vectors,
    end: Vectors,
    other_start: Vectors,
    other_end: Vectors,
) -> Lengths:
    """Return the distance between segments, which may touch or be points [m]."""
    u = end - start
    v = other_end - other_start
    r = start - other_start
    # Derivatives of the closest places add nothing to that of the distance, and they
    # have none at parallel axes.
    a, b = _closest_places(*jax.lax.stop_gradient((u, v, r)))
    return _rounded_norm(r + a * u - b * v)


def _closest_places(u: Vectors, v: Vectors, r: Vectors):
    """Return the places of the closest points along two segments, from 0 to 1.

    The segments have the directions u and v, and r is the difference of their starts.
    """
    uu = _dot(u, u)
    vv = _dot(v, v)
    uv = _dot(u, v)
    ur = _dot(u, r)
    vr = _dot(v, r)
    determinant = uu * vv - uv * uv
    # Axes count as parallel below this square of the sine between them.
    is_crossing = determinant > 1e-12 * uu * vv
    has_u = uu > 0
    has_v = vv > 0
    a = _fraction(uv * vr - ur * vv, determinant, is_crossing)
    b = _fraction(uv * a + vr, vv, has_v)
    # The nearest point to a clipped one; for parallel axes any start will do.
    a = _fraction(uv * b - ur, uu, has_u)
    b = _fraction(uv * a + vr, vv, has_v)
    return a, b


def _dot(x: Vectors, y: Vectors):
    """Return scalar products, with an axis of length one."""
    # Products of three columns run faster than a contraction of so short an axis.
    products = x * y
    return products[..., :1] + products[..., 1:2] + products[..., 2:]


def _fraction(numerator: AnyArray, denominator: AnyArray, usable: AnyArray):
    """Return a ratio clipped to the range from 0 to 1; zero where it is not usable."""
    divisor = jnp.where(usable, denominator, 1.0)
    ratio = jnp.clip(numerator / divisor, 0.0, 1.0)
    return jnp.where(usable, ratio, 0.0)


def _bisect(slope: Callable[[Array], Array], zero: Array):
    """Return both ends of short intervals around the minima of convex functions.

    Args:
        slope: Derivative of the functions, whose arguments lie between 0 and 1.
        zero: Zeros in the shape and type of the arguments.
    """

    def halve(_, interval):
        low, high = interval
        middle = 0.5 * (low + high)
        # A convex function that still falls has its minimum further on.
        is_falling = slope(middle) < 0
        return jnp.where(is_falling, middle, low), jnp.where(is_falling, high, middle)

    # 40 halvings leave 1e-12 of the interval.
    return jax.lax.fori_loop(0, 40, halve, (zero, zero + 1.0))


def _smaller(x: AnyArray, y: AnyArray):
    """Return the smaller of two numbers, with its derivative.

    Derivatives of `jnp.minimum` ask which argument equals the result. None does where a
    compiler rounds the two in different ways.
    """
    return jnp.where(x < y, x, y)


def _rounded_norm(vector: Vectors):
    """Return lengths of vectors, smooth at zero and up to `ROUNDING` too small [m]."""
    square = _dot(vector, vector)[..., 0]
    return jnp.sqrt(square + ROUNDING**2) - ROUNDING
