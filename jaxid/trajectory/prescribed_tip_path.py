"""Paths of the end-effector, and the joints' motion along a path."""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Matrix3, Numbers, Vector3, as_finite_array
from jaxid.errors import InputError
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import as_rotations

from .spline import (
    DEGREE,
    PiecewisePolynomial,
    PolynomialCoefficients,
    interpolate_at_rest,
    spline_polynomials,
)
from .trajectory import Times

SAMPLE_TIME = 0.01
"""Largest time between two poses of the inverse kinematics [s]."""
MIN_SPANS = 12
"""Smallest number of spans of the spline along one piece."""


class Curve(NamedTuple):
    """A line or a circle.

    Attributes:
        at: Function that returns places at fractions of the length, from 0 to 1 [m].
        length: Length of the curve [m].
        radius: Radius of curvature; infinite for a line [m].
    """

    at: Callable[[np.ndarray], AnyArray]
    length: float
    radius: float


def line(start: Vector3, end: Vector3) -> Curve:
    """Return a straight line between two points [m]."""
    step = np.subtract(end, start)

    def at(fraction):
        return start + fraction[:, None] * step

    return Curve(at, float(np.linalg.norm(step)), np.inf)


def circle(centre: Vector3, first: Vector3, second: Vector3) -> Curve:
    """Return a whole circle.

    Args:
        centre: Centre of the circle [m].
        first: Vector from the centre to the start and end [m].
        second: Vector from the centre to the point after a quarter of the circle:
            equally long, at a right angle to `first` [m].
    """
    radius = float(np.linalg.norm(first))

    def at(fraction):
        angle = 2 * np.pi * fraction[:, None]
        return centre + np.cos(angle) * first + np.sin(angle) * second

    return Curve(at, 2 * np.pi * radius, radius)


UNIT_SPEED = 15.0 / 8.0
UNIT_ACCELERATION = 10.0 / np.sqrt(3.0)
"""Largest speed and acceleration of the polynomial over a unit length in unit time."""


class TipPath(eqx.Module):
    """Curves that the end-effector follows in turn, at rest where they meet.

    The attitude stays constant. Along a curve the fraction of the length is the
    polynomial $10 u^3 - 15 u^4 + 6 u^5$ of the fraction $u$ of its time: speed and
    acceleration are zero at both ends and continuous between.

    Attributes:
        pieces: Curves in the order in which they are run, each from the end of the one
            before.
        rotation: Attitude of the end-effector: columns are its axes in the frame of the
            ground.
        speed: Largest speed [m/s].
        acceleration: Largest acceleration along the path, and largest across it [m/s²].

    Raises:
        InputError: If there is no piece, one has no length or does not start where the
            one before ends, or a limit is not positive.
    """

    pieces: tuple[Curve, ...] = eqx.field(converter=tuple)
    rotation: Matrix3
    speed: float = 1.0
    acceleration: float = 4.0

    def __check_init__(self):
        for name in ("speed", "acceleration"):
            limit = getattr(self, name)
            if not 0 < limit < np.inf:
                raise InputError(f"`{name}` must be positive, but is {limit:g}.")
        lengths = [piece.length for piece in self.pieces]
        if not lengths or not 0 < min(lengths) <= max(lengths) < np.inf:
            raise InputError(
                "`pieces` must hold at least one piece, each of a finite length, "
                f"but their lengths are {lengths} m."
            )
        ends = [piece.at(np.array([0.0, 1.0])) for piece in self.pieces]
        for number, (previous_piece, piece) in enumerate(itertools.pairwise(ends), 2):
            gap = float(np.linalg.norm(piece[0] - previous_piece[1]))
            if gap > 1e-9:
                raise InputError(
                    f"piece {number} of `pieces` starts "
                    f"{gap:.3g} m from where the one before ends."
                )

    @property
    def durations(self) -> tuple[float, ...]:
        """Time of each piece [s]: the shortest that keeps speed and acceleration."""
        durations = []
        for _, length, radius in self.pieces:
            max_speed = min(self.speed, np.sqrt(self.acceleration * radius))
            speed_duration = UNIT_SPEED * length / max_speed
            acceleration_duration = np.sqrt(
                UNIT_ACCELERATION * length / self.acceleration
            )
            durations.append(max(speed_duration, acceleration_duration))
        return tuple(durations)

    @property
    def duration(self) -> float:
        """Total time [s]."""
        return float(sum(self.durations))

    def positions(self, t: Times) -> np.ndarray:
        """Return positions of the end-effector [m] at times [s]."""
        t = np.asarray(t)
        ends = np.cumsum(self.durations)
        starts = ends - self.durations
        pieces = np.searchsorted(starts[1:], t, side="right")
        places = np.empty((len(t), 3))
        for number, curve in enumerate(self.pieces):
            is_on_curve = pieces == number
            time = t[is_on_curve] - starts[number]
            duration = self.durations[number]
            u = np.clip(time / duration, 0.0, 1.0)
            fraction = 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5
            places[is_on_curve] = curve.at(fraction)
        return places


def iso9283_path(
    centre: Numbers,
    edge: float,
    rotation: Numbers,
    *,
    leans_along: int = 0,
    speed: float = 1.0,
    acceleration: float = 4.0,
) -> TipPath:
    """Return the verification path: lines, a rectangle and two circles (Fig. 8).

    The paper takes it from the standard ISO 9283. An inclined plane passes through two
    opposite horizontal edges of a cube whose edges are along x, y and z. On it lie the
    cube's centre P1 and, a tenth of the plane's diagonal inside its corners, the points
    P2 to P5. The path goes from P1 to P2, along the rectangle P2 P3 P4 P5, along the
    diagonal to P4 and back to P1; then along a large circle (80 % of the edge) and a
    small one (a tenth of that) about P1. At every corner, and before and after each
    circle, the end-effector is at rest.

    Args:
        centre: Centre of the cube in the frame of the ground [m].
        edge: Edge of the cube [m].
        rotation: Constant attitude of the end-effector in the frame of the ground.
        leans_along: Horizontal axis along which the plane rises: 0 for x, 1 for y.
        speed: Largest speed [m/s].
        acceleration: Largest acceleration along the path, and largest across it [m/s²].

    Raises:
        InputError: If the centre is no point, the cube has no size, or a limit is not
            positive.
    """
    c = as_finite_array("`centre`", centre, (3,))
    x, y, z = np.eye(3)
    rising_axis = (x, y)[leans_along] + z
    level_axis = (y, x)[leans_along]
    # The corners lie a tenth of the diagonal inside, so that 80 % of the half edges are
    # left.
    large_radius = 0.8 * edge / 2
    small_radius = 0.08 * edge / 2
    u = large_radius * rising_axis
    v = large_radius * level_axis
    p2 = c + u + v
    p3 = c - u + v
    p4 = c - u - v
    p5 = c + u - v
    up = rising_axis / np.sqrt(2.0)
    top = c + large_radius * up
    small_top = c + small_radius * up

    corners = (c, p2, p3, p4, p5, p2, p4, c, top)
    lines = itertools.starmap(line, itertools.pairwise(corners))
    pieces = (
        *lines,
        circle(c, large_radius * up, large_radius * level_axis),
        line(top, small_top),
        circle(c, small_radius * up, small_radius * level_axis),
        line(small_top, c),
    )
    attitude = as_rotations("`rotation`", rotation, (3, 3))
    return TipPath(pieces, attitude, speed, acceleration)


def joint_path(
    robot: Robot,
    path: TipPath,
    *,
    posture: Numbers | None = None,
) -> PiecewisePolynomial:
    """Return the joints' motion that takes the end-effector along a path.

    Inverse kinematics every 0.01 s; between them quintic splines that stand still where
    pieces of the path meet.

    Args:
        robot: Robot whose end-effector moves.
        path: Path of the end-effector.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.

    Raises:
        InputError: If the path cannot be followed, or a joint would have to move faster
            than it can.
    """
    instants = _instants(path)
    # Each piece ends where the next one starts.
    times = np.concatenate([*(t[:-1] for t in instants), instants[-1][-1:]])
    positions = path.positions(times)
    q = inverse_kinematics_along(robot, positions, path.rotation, posture)
    knots = []
    polynomials = []
    begin = 0
    for t in instants:
        end = begin + len(t)
        spline = interpolate_at_rest(t - t[0], q[begin:end])
        piece_knots = t[0] + spline.t[DEGREE:-DEGREE]
        knots.append(piece_knots[:-1])
        polynomials.append(spline_polynomials(spline))
        begin = end - 1
    knots.append(times[-1:])
    coefficients = np.concatenate(polynomials, axis=1)
    _require_speeds(robot, path, coefficients)
    return PiecewisePolynomial(np.concatenate(knots), coefficients)


def _instants(path: TipPath):
    """Return equidistant times over each piece of a path, its ends included [s]."""
    ends = np.cumsum([0.0, *path.durations])
    instants = []
    for start, end in itertools.pairwise(ends):
        count = max(MIN_SPANS, math.ceil((end - start) / SAMPLE_TIME))
        instants.append(np.linspace(start, end, count + 1))
    return instants


def _require_speeds(
    robot: Robot,
    path: TipPath,
    coefficients: PolynomialCoefficients,
):
    """Reject a path on which a joint would have to move faster than it can."""
    # Velocities and accelerations at the knots are coefficients.
    speeds = np.abs(coefficients[-2]).max(axis=0)
    accelerations = np.abs(2 * coefficients[-3]).max(axis=0)
    limits = robot.limits
    used_speed = speeds / np.asarray(limits.velocity)
    used_acceleration = accelerations / np.asarray(limits.acceleration)
    # A path that is run f times slower needs a fraction 1/f of speeds and 1/f² of
    # accelerations.
    slowdowns = np.maximum(used_speed, np.sqrt(used_acceleration))
    joint = int(slowdowns.argmax())
    if slowdowns[joint] <= 1.001:
        return
    slowdown = 1.01 * slowdowns[joint]
    raise InputError(
        f"joint `{robot.joint_names[joint]}` would need {used_speed[joint]:.2f} times "
        f"its largest speed and {used_acceleration[joint]:.2f} times its largest "
        f"acceleration: give the path a `speed` of {path.speed / slowdown:.3g} m/s and "
        f"an `acceleration` of {path.acceleration / slowdown**2:.3g} m/s², or choose "
        "another posture."
    )
