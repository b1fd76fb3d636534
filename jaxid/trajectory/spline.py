"""Clamped quintic B-splines: motions through points, with a continuous jerk."""

import functools
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from jaxid.arrays import AnyArray, Array, Float, Numbers
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.trajectory.basis import ORDERS, AbstractBasis, Envelope
from jaxid.trajectory.trajectory import AbstractTrajectory, each_time

DEGREE = 5
AT_REST = 3
"""Equal control points at an end that make position, speed and acceleration stand there."""


class Spline(AbstractTrajectory):
    """A quintic B-spline for each joint, from its first to its last control point.

    The knots lie evenly between the ends, and the ends are clamped. Position and derivatives are
    linear in the control points. The motion lies within the range of its control points.

    Attributes:
        control_points: Of all joints, one row after the other in time [rad or m].
        length: From the first to the last control point [s]. Beyond its ends the motion is that of
            the ends.
    """

    control_points: Float[AnyArray, "points joints"]
    length: Float[AnyArray, ""] | float

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """From the first to the last control point [s]."""
        return self.length

    @classmethod
    def at_rest(cls, points: Numbers, duration: float) -> "Spline":
        """A spline that stands still at both ends, with the inner points as handles.

        Args:
            points: Start, handles and end [rad or m]; the handles draw the motion towards them.
            duration: Of the motion [s].

        Raises:
            InputError: If there are not at least two points, or the duration is not positive.
        """
        handles = _checked(points, duration)
        return cls(_spread(len(handles)) @ handles, float(duration))

    @classmethod
    def through(cls, points: Numbers, duration: float) -> "Spline":
        """A spline through points at equal times, that stands still at both ends.

        Args:
            points: Start, way points and end [rad or m].
            duration: Of the motion [s].

        Raises:
            InputError: If there are not at least two points, or the duration is not positive.
        """
        way = _checked(points, duration)
        still = [(1, np.zeros(way.shape[1])), (2, np.zeros(way.shape[1]))]
        times = np.linspace(0.0, 1.0, len(way))
        interpolant = make_interp_spline(times, way, DEGREE, bc_type=(still, still))
        return cls(interpolant.c, float(duration))

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]."""
        return each_time(self._at, t)

    def _at(self, time: Float[Array, ""]) -> Motion:
        points, length = jnp.asarray(self.control_points), self.length
        table = jnp.asarray(_polynomials(len(points)), points.dtype)
        pieces = table.shape[1]
        place = time / length
        # Written with `where`, for the derivative of a clip is half of it at the ends.
        u = jnp.where(place < 0.0, 0.0, jnp.where(place > 1.0, 1.0, place)) * pieces
        piece = jnp.clip(jnp.floor(u), 0, pieces - 1)
        x = u - piece
        c = table[:, piece.astype(int)] @ points
        rate = pieces / length
        q, qd, qdd = c[0], jnp.zeros_like(c[0]), jnp.zeros_like(c[0])
        for coefficient in c[1:]:
            qdd = qdd * x + 2 * qd
            qd = qd * x + q
            q = q * x + coefficient
        return Motion(q, qd * rate, qdd * rate**2)


class RestToRestSplineBasis(AbstractBasis):
    """Quintic B-splines that stand still at both ends: numbers are start, handles and end.

    Attributes:
        points: Numbers of a joint: `Spline.at_rest` of as many points.
        duration: From standstill to standstill [s].
    """

    points: int = eqx.field(static=True)
    duration: float = eqx.field(static=True)

    def __init__(self, points: int, duration: float):
        if points < 2:
            raise InputError(f"`points` must be at least 2, but is {points}.")
        if not 0 < duration < np.inf:
            raise InputError(f"`duration` must be positive [s], but is {duration:g}.")
        self.points, self.duration = points, float(duration)

    def rows(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "4 samples variables"]:
        """Motions of unit numbers."""
        place = np.clip(np.asarray(t, np.float64) / self.duration, 0.0, 1.0)
        spread = _spread(self.points)
        units = _units(len(spread))
        return np.stack(
            [
                (units.derivative(k) if k else units)(place) @ spread / self.duration**k
                for k in range(ORDERS)
            ]
        )

    def envelope(self, points: int) -> Envelope:
        """Control points of each derivative: a spline lies within their range.

        The more knots it is written with, the closer they lie to it.
        """
        spans = self.points + 2 * (AT_REST - 1) - DEGREE
        finer = max(1, round(points / max(spans, 1)))
        rows = []
        for order in range(ORDERS):
            degree = DEGREE - order
            knots = _knots(spans * finer, degree)
            count = len(knots) - degree - 1
            # A spline of the coarse knots is one of the fine ones: what agrees at as many places is
            # the same. Greville's places are those at which that system is well conditioned.
            places = np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(count)])
            fine = BSpline.design_matrix(places, knots, degree).toarray()
            rows.append(np.linalg.solve(fine, self.rows(places * self.duration)[order]))
        return Envelope(tuple(rows), 1.0)

    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> Spline:
        """The spline with these numbers."""
        return Spline(_spread(self.points) @ x.T, self.duration)


def _spread(points: int) -> np.ndarray:
    """Control points of unit numbers: the ends stand thrice."""
    eye = np.eye(points)
    return np.concatenate([eye[:1], eye[:1], eye, eye[-1:], eye[-1:]])


def _knots(spans: int, degree: int) -> np.ndarray:
    """Even knots of a clamped spline over [0, 1]."""
    return np.concatenate([np.zeros(degree), np.linspace(0.0, 1.0, spans + 1), np.ones(degree)])


def _units(count: int) -> BSpline:
    """What each control point contributes, over [0, 1]."""
    return BSpline(_knots(count - DEGREE, DEGREE), np.eye(count), DEGREE)


@functools.cache
def _polynomials(count: int) -> np.ndarray:
    """The same as polynomials over each piece, whose length counts as 1: [power, piece, point].

    The highest power comes first.
    """
    pieces, units = count - DEGREE, _units(count)
    starts = np.arange(pieces) / pieces
    powers = [units(starts)]
    powers += [units.derivative(k)(starts) / (math.factorial(k) * pieces**k) for k in (1, 2, 3, 4)]
    # The highest derivative jumps at the starts, where rounding would decide which piece is meant.
    highest = units.derivative(DEGREE)(starts + 0.5 / pieces)
    return np.stack([highest / (math.factorial(DEGREE) * pieces**DEGREE), *powers[::-1]])


def _checked(points: Numbers, duration: float) -> np.ndarray:
    rows = np.array(points, np.float64)
    if rows.ndim != 2 or len(rows) < 2 or not np.isfinite(rows).all():
        raise InputError(
            "`points` must hold at least two rows of finite numbers, one for each joint, but has "
            f"shape {rows.shape}."
        )
    if not 0 < duration < np.inf:
        raise InputError(f"`duration` must be positive [s], but is {duration:g}.")
    return rows
