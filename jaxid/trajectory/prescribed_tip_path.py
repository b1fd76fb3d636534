"""Paths of the end-effector, and the joints' motion along a path."""

import itertools
import math
from typing import ClassVar

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.robot import Robot

from .spline import (
    DEGREE,
    PiecewisePolynomial,
    interpolate_at_rest,
    spline_polynomials,
)
from .trajectory import Times

SAMPLE_TIME = 0.01
"""Largest time between two poses of the inverse kinematics [s]."""
MIN_SPANS = 12
"""Smallest number of spans of the spline along one piece."""


class Line(eqx.Module):
    """A straight line.

    Attributes:
        start: Start of the line [m].
        end: End of the line [m].
        radius: Radius of curvature: infinite [m].
    """

    radius: ClassVar[float] = np.inf
    start: Float[AnyArray, "3"]
    end: Float[AnyArray, "3"]

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(np.linalg.norm(np.asarray(self.end) - np.asarray(self.start)))

    def at(self, fraction: Times) -> Float[np.ndarray, "samples 3"]:
        """Return places at fractions of the length, from 0 to 1 [m]."""
        start = np.asarray(self.start)
        return start + np.asarray(fraction)[:, None] * (np.asarray(self.end) - start)


class Circle(eqx.Module):
    """A whole circle.

    Attributes:
        centre: Centre of the circle [m].
        first: Vector from the centre to the start and end [m].
        second: Vector from the centre to the point after a quarter of the circle:
            equally long, at a right angle to `first` [m].
    """

    centre: Float[AnyArray, "3"]
    first: Float[AnyArray, "3"]
    second: Float[AnyArray, "3"]

    @property
    def length(self) -> float:
        """Circumference [m]."""
        return 2 * np.pi * self.radius

    @property
    def radius(self) -> float:
        """Radius of the circle [m]."""
        return float(np.linalg.norm(np.asarray(self.first)))

    def at(self, fraction: Times) -> Float[np.ndarray, "samples 3"]:
        """Return places at fractions of the length, from 0 to 1 [m]."""
        angle = 2 * np.pi * np.asarray(fraction)[:, None]
        first, second = np.asarray(self.first), np.asarray(self.second)
        return np.asarray(self.centre) + np.cos(angle) * first + np.sin(angle) * second


UNIT_SPEED = 15.0 / 8.0
UNIT_ACCELERATION = 10.0 / np.sqrt(3.0)
"""Largest speed and acceleration of the polynomial over a unit length in unit time."""


class TipPath(eqx.Module):
    """Curves that the end-effector follows in turn, at rest where they meet.

    The attitude stays constant. Along a curve the fraction of the length is the
    polynomial $10 u^3 - 15 u^4 + 6 u^5$ of the fraction $u$ of its time: speed and
    acceleration are zero at both ends and continuous between.

    Attributes:
        pieces: Curves in the order in which they are run.
        rotation: Attitude of the end-effector: columns are its axes in the frame of the
            ground.
        speed: Largest speed [m/s].
        acceleration: Largest acceleration along the path, and largest across it [m/s²].

    Raises:
        InputError: If there is no piece, one has no length or does not start where the
            one before it ends, or a limit is not positive.
    """

    pieces: tuple[Line | Circle, ...] = eqx.field(converter=tuple)
    rotation: Float[AnyArray, "3 3"] = eqx.field(
        converter=lambda x: as_array("rotation", x)
    )
    speed: float = eqx.field(converter=float, default=1.0)
    acceleration: float = eqx.field(converter=float, default=4.0)

    def __check_init__(self):
        for name, limit in (("speed", self.speed), ("acceleration", self.acceleration)):
            if not 0 < limit < np.inf:
                raise InputError(f"`{name}` must be positive, but is {limit:g}.")
        if not self.pieces:
            raise InputError("`pieces` must hold at least one piece, but is empty.")
        previous_end = None
        for number, piece in enumerate(self.pieces, 1):
            start, end = piece.at(np.array([0.0, 1.0]))
            gap = 0.0
            if previous_end is not None:
                gap = float(np.linalg.norm(start - previous_end))
            if gap > 1e-9:
                raise InputError(
                    f"piece {number} of `pieces` starts "
                    f"{gap:.3g} m from where the one before ends."
                )
            if not 0 < piece.length < np.inf:
                raise InputError(
                    f"piece {number} of `pieces` must have a length, "
                    f"but it is {piece.length:g} m."
                )
            previous_end = end

    @property
    def durations(self) -> tuple[float, ...]:
        """Time of each piece [s]: the shortest that keeps speed and acceleration."""
        durations = []
        for piece in self.pieces:
            max_speed = min(self.speed, np.sqrt(self.acceleration * piece.radius))
            by_speed = UNIT_SPEED * piece.length / max_speed
            by_acceleration = UNIT_ACCELERATION * piece.length / self.acceleration
            durations.append(max(by_speed, np.sqrt(by_acceleration)))
        return tuple(durations)

    @property
    def duration(self) -> float:
        """Total time [s]."""
        return float(sum(self.durations))

    def positions(self, t: Times) -> Float[np.ndarray, "samples 3"]:
        """Return positions of the end-effector [m] at times [s]."""
        t = np.asarray(t)
        ends = np.cumsum(self.durations)
        starts = ends - self.durations
        pieces = np.searchsorted(starts[1:], t, side="right")
        places = np.empty((len(t), 3))
        for number, curve in enumerate(self.pieces):
            is_on_curve = pieces == number
            time = t[is_on_curve] - starts[number]
            u = np.clip(time / self.durations[number], 0.0, 1.0)
            places[is_on_curve] = curve.at(u**3 * (10.0 + u * (6.0 * u - 15.0)))
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
    c = as_array("centre", centre)
    if c.shape != (3,):
        raise InputError("`centre` must hold three numbers [m].")
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
    lines = [Line(start, end) for start, end in itertools.pairwise(corners)]
    pieces = (
        *lines,
        Circle(c, large_radius * up, large_radius * level_axis),
        Line(top, small_top),
        Circle(c, small_radius * up, small_radius * level_axis),
        Line(small_top, c),
    )
    return TipPath(pieces, rotation, speed, acceleration)


def joint_path(
    robot: Robot, path: TipPath, *, posture: Numbers | None = None
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
    q = inverse_kinematics_along(robot, path.positions(times), path.rotation, posture)
    knots = []
    polynomials = []
    begin = 0
    for t in instants:
        nodes = q[begin : begin + len(t)]
        spline = interpolate_at_rest(t - t[0], nodes)
        knots.append(t[0] + spline.t[DEGREE : -DEGREE - 1])
        polynomials.append(spline_polynomials(spline))
        begin += len(t) - 1
    coefficients = np.concatenate(polynomials, axis=1)
    _require_speeds(robot, path, coefficients)
    return PiecewisePolynomial(np.concatenate([*knots, times[-1:]]), coefficients)


def _instants(path: TipPath) -> list[np.ndarray]:
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
    coefficients: Float[np.ndarray, "powers pieces joints"],
) -> None:
    """Reject a path on which a joint would have to move faster than it can."""
    # Velocities and accelerations at the knots are coefficients.
    speeds = np.abs(coefficients[-2]).max(axis=0)
    accelerations = np.abs(2 * coefficients[-3]).max(axis=0)
    used_speed = speeds / np.asarray(robot.limits.velocity)
    used_acceleration = accelerations / np.asarray(robot.limits.acceleration)
    # A path that is run f times slower needs a fraction 1/f of speeds and 1/f² of
    # accelerations.
    slowdowns = np.maximum(used_speed, np.sqrt(used_acceleration))
    joint = int(slowdowns.argmax())
    if slowdowns[joint] <= 1.001:
        return
    is_speed = used_speed[joint] == slowdowns[joint]
    quantity = "speed" if is_speed else "acceleration"
    excess = max(used_speed[joint], used_acceleration[joint])
    slowdown = 1.01 * slowdowns[joint]
    raise InputError(
        f"joint `{robot.joint_names[joint]}` would need {excess:.2f} times "
        f"its largest {quantity}: give the path a `speed` "
        f"of {path.speed / slowdown:.3g} m/s and an `acceleration` "
        f"of {path.acceleration / slowdown**2:.3g} m/s², or choose another posture."
    )
