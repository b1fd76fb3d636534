"""The verification path (Fig. 8): lines, a rectangle and circles on an inclined plane in a cube.

The paper takes it from the standard ISO 9283. As it is done here: the plane leans through two
opposite horizontal edges of a cube whose edges are along x, y and z. On it lie the cube's centre P1
and, a tenth of the plane's diagonal inside of its corners, the points P2 to P5.
"""

import numpy as np

from jaxid.arrays import Numbers, as_array
from jaxid.errors import InputError
from jaxid.trajectory.tip_path import Circle, Line, TipPath

INSIDE = 0.1
"""How far P2 to P5 lie inside of the plane's corners, as a share of its diagonal."""
LARGE = 0.8
"""Diameter of the large circle, as a share of the cube's edge."""
SMALL = 0.1
"""Diameter of the small circle, as a share of the large one's."""


def iso9283_path(
    centre: Numbers,
    edge: float,
    rotation: Numbers,
    *,
    leans_along: int = 0,
    rounds: int = 1,
    speed: float = 1.0,
    acceleration: float = 4.0,
) -> TipPath:
    """The path on which a model is verified: straight lines, a rectangle and two circles (Fig. 8).

    From P1 to P2, round the rectangle P2 P3 P4 P5, along the diagonal to P4 and back to P1; then
    the large and the small circle about P1. At every corner, and before and after each circle, the
    end-effector is at rest.

    Args:
        centre: Of the cube on the ground [m].
        edge: Of the cube [m].
        rotation: Attitude of the end-effector on the ground, held along the path.
        leans_along: Horizontal axis along which the plane rises: 0 for x, 1 for y.
        rounds: How often each circle is run without a stop.
        speed: Largest speed [m/s].
        acceleration: Largest acceleration along the way, and largest across it [m/s²].

    Raises:
        InputError: If the cube has no size, a limit is not positive, or there is no round.
    """
    if not 0 < edge < np.inf:
        raise InputError(f"`edge` of the cube must be positive [m], but is {edge:g}.")
    if leans_along not in (0, 1):
        raise InputError(f"`leans_along` must be 0 (x) or 1 (y), but is {leans_along}.")
    c = as_array("centre", centre)
    if c.shape != (3,) or not np.isfinite(c).all():
        raise InputError("`centre` must hold three finite numbers [m].")
    rising = np.eye(3)[leans_along] + np.eye(3)[2]
    level = np.eye(3)[1 - leans_along]
    half, way = edge / 2, 1.0 - 2 * INSIDE
    u, v = half * way * rising, half * way * level
    p2, p3, p4, p5 = c + u + v, c - u + v, c - u - v, c + u - v
    large = LARGE * edge / 2
    up, side = rising / np.sqrt(2.0), level
    begin, near = c + large * up, c + SMALL * large * up
    pieces = (
        Line(c, p2),
        *(Line(a, b) for a, b in ((p2, p3), (p3, p4), (p4, p5), (p5, p2))),
        Line(p2, p4),
        Line(p4, c),
        Line(c, begin),
        Circle(c, large * up, large * side, rounds),
        Line(begin, near),
        Circle(c, SMALL * large * up, SMALL * large * side, rounds),
        Line(near, c),
    )
    return TipPath.of(pieces, rotation, speed=speed, acceleration=acceleration)
