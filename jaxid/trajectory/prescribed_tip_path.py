"""Paths of the end-effector in space, the path of ISO 9283, and the joints' motion along a path."""

import itertools
from typing import ClassVar

import equinox as eqx
import numpy as np
from scipy.interpolate import make_interp_spline

from jaxid.arrays import AnyArray, Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.robot import Robot

from .spline import PiecewisePolynomial, spline_polynomials


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

    def at(
        self, fraction: Float[AnyArray, " samples"]
    ) -> Float[np.ndarray, "samples 3"]:
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

    def at(
        self, fraction: Float[AnyArray, " samples"]
    ) -> Float[np.ndarray, "samples 3"]:
        """Return places at fractions of the length, from 0 to 1 [m]."""
        angle = 2 * np.pi * np.asarray(fraction)[:, None]
        first, second = np.asarray(self.first), np.asarray(self.second)
        return np.asarray(self.centre) + np.cos(angle) * first + np.sin(angle) * second


class TipPath(eqx.Module):
    """Curves that the end-effector follows one after the other, at rest where they meet.

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
        ends = [piece.at(np.array([0.0, 1.0])) for piece in self.pieces]
        for k, piece in enumerate(self.pieces):
            gap = float(np.linalg.norm(ends[k][0] - ends[k - 1][1])) if k else 0.0
            if gap > 1e-9:
                raise InputError(
                    f"piece {k + 1} of `pieces` starts {gap:.3g} m from where the one "
                    "before ends."
                )
            if not 0 < piece.length < np.inf:
                raise InputError(
                    f"piece {k + 1} of `pieces` must have a length, but it is "
                    f"{piece.length:g} m."
                )

    @property
    def durations(self) -> tuple[float, ...]:
        """Time of each piece [s]: the shortest that keeps speed and acceleration."""
        # Largest speed and acceleration of the polynomial, over a unit length in unit
        # time.
        speed, acceleration = 15.0 / 8.0, 10.0 / np.sqrt(3.0)
        return tuple(
            max(
                speed
                * p.length
                / min(self.speed, np.sqrt(self.acceleration * p.radius)),
                np.sqrt(acceleration * p.length / self.acceleration),
            )
            for p in self.pieces
        )

    @property
    def duration(self) -> float:
        """Total time [s]."""
        return float(sum(self.durations))

    def positions(
        self, t: Float[AnyArray, " samples"]
    ) -> Float[np.ndarray, "samples 3"]:
        """Return positions of the end-effector [m] at times [s]; it stands still outside."""
        t = np.asarray(t)
        starts = np.concatenate([[0.0], np.cumsum(self.durations)[:-1]])
        piece = np.clip(
            np.searchsorted(starts, t, side="right") - 1, 0, len(starts) - 1
        )
        places = np.empty((len(t), 3))
        for k, curve in enumerate(self.pieces):
            u = np.clip((t[piece == k] - starts[k]) / self.durations[k], 0.0, 1.0)
            places[piece == k] = curve.at(u**3 * (10.0 + u * (6.0 * u - 15.0)))
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
    """Return the verification path: straight lines, a rectangle and two circles (Fig. 8).

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
    rising = np.eye(3)[leans_along] + np.eye(3)[2]
    level = np.eye(3)[1 - leans_along]
    # The corners lie a tenth of the diagonal inside, so that 80 % of the half edges are
    # left.
    large, small = 0.8 * edge / 2, 0.08 * edge / 2
    u, v = large * rising, large * level
    p2, p3, p4, p5 = c + u + v, c - u + v, c - u - v, c + u - v
    up = rising / np.sqrt(2.0)
    corners = (c, p2, p3, p4, p5, p2, p4, c, c + large * up)
    pieces = (
        *(Line(a, b) for a, b in itertools.pairwise(corners)),
        Circle(c, large * up, large * level),
        Line(c + large * up, c + small * up),
        Circle(c, small * up, small * level),
        Line(c + small * up, c),
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
    counts = [max(12, int(np.ceil(time / 0.01))) for time in path.durations]
    ends = np.concatenate([[0.0], np.cumsum(path.durations)])
    pairs = zip(itertools.pairwise(ends), counts, strict=True)
    instants = [np.linspace(a, b, count + 1) for (a, b), count in pairs]
    times = np.concatenate([*(t[:-1] for t in instants), ends[-1:]])
    q = inverse_kinematics_along(robot, path.positions(times), path.rotation, posture)
    rest = [(order, np.zeros(robot.joints)) for order in (1, 2)]
    knots, polynomials, begin = [], [], 0
    for t, count in zip(instants, counts, strict=True):
        nodes = q[begin : begin + count + 1]
        spline = make_interp_spline(t - t[0], nodes, 5, bc_type=(rest, rest))
        knots.append(t[0] + spline.t[5:-6])
        polynomials.append(spline_polynomials(spline))
        begin += count
    coefficients = np.concatenate(polynomials, axis=1)
    # Velocities and accelerations at the knots are coefficients.
    speed = np.abs(coefficients[-2]).max(axis=0) / np.asarray(robot.limits.velocity)
    acceleration = np.abs(2 * coefficients[-3]).max(axis=0) / np.asarray(
        robot.limits.acceleration
    )
    # A path that is run f times slower needs a fraction 1/f of speeds and 1/f² of
    # accelerations.
    slower = np.maximum(speed, np.sqrt(acceleration))
    j = int(slower.argmax())
    if slower[j] > 1.001:
        name = "speed" if speed[j] == slower[j] else "acceleration"
        f = 1.01 * slower[j]
        raise InputError(
            f"joint `{robot.joint_names[j]}` would need "
            f"{max(speed[j], acceleration[j]):.2f} times "
            f"its largest {name}: give the path a `speed` of {path.speed / f:.3g} m/s "
            "and an "
            f"`acceleration` of {path.acceleration / f**2:.3g} m/s², or choose "
            "another posture."
        )
    return PiecewisePolynomial(np.concatenate([*knots, ends[-1:]]), coefficients)
