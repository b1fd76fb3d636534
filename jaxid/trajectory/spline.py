"""Clamped quintic B-splines between standstills: motions with a continuous jerk."""

import functools
import math

import equinox as eqx
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from jaxid.arrays import AnyArray, Float, Numbers, as_array, is_traced
from jaxid.errors import InputError
from jaxid.trajectory.basis import AbstractBasis, Envelope, LinearTrajectory
from jaxid.trajectory.trajectory import as_scalar, evaluate_polynomials

DEGREE = 5


class RestToRestSplineBasis(AbstractBasis):
    """Quintic B-splines that stand still at both ends.

    The coefficients of a joint are its start, the handles that attract the motion, and its end
    [rad or m]: the motion stays within their range. Start and end are three control points each, so
    that velocity and acceleration are zero there. The knots are equidistant.

    Attributes:
        points: Number of coefficients of a joint.
        duration: Time from standstill to standstill [s].

    Raises:
        InputError: If there are fewer than two points, or the duration is not positive.
    """

    points: int = eqx.field(static=True)
    duration: Float[AnyArray, ""] = eqx.field(converter=as_scalar)

    def __check_init__(self):
        if self.points < 2:
            raise InputError(f"`points` must be at least 2, but is {self.points}.")
        if not is_traced(self.duration) and not 0 < self.duration < np.inf:
            raise InputError(f"`duration` must be positive [s], but is {self.duration:g}.")

    def rows(self, t: Float[AnyArray, " samples"]) -> Float[AnyArray, "4 samples variables"]:
        """Return the motions of unit coefficients."""
        starts, coefficients = _unit_polynomials(self.points)
        derivatives = evaluate_polynomials(starts, coefficients, t / self.duration)
        return derivatives / (self.duration ** np.arange(4.0))[:, None, None]

    def envelope(self, points: int) -> Envelope:
        """Return the control points of each derivative: a spline lies within their range.

        The more knots it is written with, the closer they lie to it.
        """
        spans = self.points + 4 - DEGREE
        finer = max(1, round(points / max(spans, 1)))
        rows = []
        for order in range(4):
            degree = DEGREE - order
            knots = _clamped_knots(spans * finer, degree)
            count = len(knots) - degree - 1
            # A spline of the coarse knots is one of the fine knots as well: interpolation finds its
            # fine control points. At Greville's abscissae the system is well conditioned.
            abscissae = np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(count)])
            fine = BSpline.design_matrix(abscissae, knots, degree).toarray()
            values = np.asarray(self.rows(abscissae * self.duration)[order])
            rows.append(np.linalg.solve(fine, values))
        return tuple(rows), 1.0


def spline_through(points: Numbers, duration: float) -> LinearTrajectory:
    """Return a quintic spline through points at equal times that stands still at both ends.

    Args:
        points: Start, way points and end, one row each [rad or m].
        duration: Time from standstill to standstill [s].

    Raises:
        InputError: If there are not at least two points, or the duration is not positive.
    """
    way = np.asarray(as_array("points", points), np.float64)
    if way.ndim != 2 or len(way) < 2 or not np.isfinite(way).all():
        raise InputError(
            "`points` must hold at least two rows of finite numbers, one column for each joint, "
            f"but has shape {way.shape}."
        )
    rest = [(order, np.zeros(way.shape[1])) for order in (1, 2)]
    spline = make_interp_spline(np.linspace(0.0, 1.0, len(way)), way, DEGREE, bc_type=(rest, rest))
    # The first three control points are the start, and the last three are the end.
    handles = np.concatenate([way[:1], spline.c[3:-3], way[-1:]])
    return RestToRestSplineBasis(len(handles), duration).trajectory(handles.T)


def spline_polynomials(spline: BSpline) -> Float[np.ndarray, "powers pieces columns"]:
    """Return the coefficients of a quintic spline's pieces in powers of the time since their start.

    Args:
        spline: Clamped spline of degree 5.
    """
    knots = spline.t[DEGREE:-DEGREE]
    lower = [spline.derivative(k)(knots[:-1]) / math.factorial(k) for k in range(1, DEGREE)]
    # The highest derivative jumps at the knots: rounding would decide which piece is evaluated.
    middle = 0.5 * (knots[:-1] + knots[1:])
    highest = spline.derivative(DEGREE)(middle) / math.factorial(DEGREE)
    return np.stack([highest, *lower[::-1], spline(knots[:-1])])


@functools.cache
def _unit_polynomials(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts over [0, 1] and coefficients of the splines whose coefficients are units."""
    unit = np.eye(points)
    control_points = np.concatenate([unit[:1], unit[:1], unit, unit[-1:], unit[-1:]])
    knots = _clamped_knots(points + 4 - DEGREE, DEGREE)
    return knots[DEGREE:-DEGREE], spline_polynomials(BSpline(knots, control_points, DEGREE))


def _clamped_knots(spans: int, degree: int) -> np.ndarray:
    """Return equidistant knots of a clamped spline over [0, 1]."""
    return np.concatenate([np.zeros(degree), np.linspace(0.0, 1.0, spans + 1), np.ones(degree)])
