"""Piecewise polynomials, and quintic B-splines between standstills."""

import functools
import math

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix, is_traced, namespace
from jaxid.errors import InputError

from .trajectory import (
    AbstractBasis,
    AbstractTrajectory,
    Time,
    Times,
    as_scalar,
)

DEGREE = 5
"""Degree of the polynomials of a spline."""
Knots = Float[AnyArray, " knots"]
"""Times at which polynomials meet, with both ends [s]."""
PolynomialCoefficients = Float[AnyArray, "powers pieces joints"]
"""Coefficients of the powers of the time since a piece's start, highest power first."""


class PiecewisePolynomial(AbstractTrajectory):
    """Polynomials of time that follow one another; standstill outside.

    Attributes:
        times: Start of each polynomial, and the end of the last one [s].
        coefficients: Coefficients of the powers of the time since a polynomial's start,
            highest power first.
    """

    times: Knots
    coefficients: PolynomialCoefficients

    @property
    def duration(self) -> Time:
        """Time of the end [s]."""
        return self.times[-1]

    def states(self, t):
        """Return the polynomials and two derivatives."""
        return tuple(_evaluate(self.times, self.coefficients, t)[:3])


def _evaluate(times: Knots, coefficients: PolynomialCoefficients, t: Times):
    """Return a `PiecewisePolynomial` and three derivatives at times [s]."""
    xp = namespace(times, coefficients, t)
    times = xp.asarray(times)
    coefficients = xp.asarray(coefficients)
    t = xp.asarray(t)
    start = times[0]
    end = times[-1]
    # Written with `where`, because the derivative of `clip` at its ends is one half.
    clipped_times = xp.where(t > end, end, t)
    clipped_times = xp.where(t < start, start, clipped_times)
    pieces = xp.searchsorted(times, clipped_times, side="right") - 1
    pieces = xp.clip(pieces, 0, len(times) - 2)

    # Horner's scheme for the polynomial and its derivatives.
    x = (clipped_times - times[pieces])[:, None]
    powers = coefficients[:, pieces]
    value = powers[0]
    first_derivative = xp.zeros_like(value)
    second_derivative = first_derivative
    third_derivative = first_derivative
    for coefficient in powers[1:]:
        third_derivative = third_derivative * x + 3 * second_derivative
        second_derivative = second_derivative * x + 2 * first_derivative
        first_derivative = first_derivative * x + value
        value = value * x + coefficient
    is_moving = (t >= start) & (t <= end)
    derivatives = xp.stack([first_derivative, second_derivative, third_derivative])
    derivatives = xp.where(is_moving[:, None], derivatives, 0.0)
    return xp.concatenate([value[None], derivatives])


class RestToRestSplineBasis(AbstractBasis):
    """Quintic B-splines that stand still at both ends.

    The coefficients of a joint are its start, the handles that attract the motion, and
    its end [rad or m]: the motion stays within their range. Start and end are three
    control points each, so that velocity and acceleration are zero there. The knots are
    equidistant.

    Attributes:
        points: Number of coefficients of a joint.
        duration: Time from standstill to standstill [s].

    Raises:
        InputError: If there are fewer than two points, or the duration is not positive.
    """

    points: int = eqx.field(static=True, default=12)
    # Experiment files are decoded by this annotation.
    duration: Float[AnyArray, ""] = eqx.field(converter=as_scalar, default=8.0)

    def __check_init__(self):
        if self.points < 2:
            raise InputError(f"`points` must be at least 2, but is {self.points}.")
        if not is_traced(self.duration) and not 0 < self.duration < np.inf:
            raise InputError(
                f"`duration` must be positive [s], but is {self.duration:g}."
            )

    def rows(self, t):
        """Return the motions of unit coefficients."""
        starts, coefficients = _unit_polynomials(self.points)
        derivatives = _evaluate(starts, coefficients, t / self.duration)
        return derivatives / (self.duration ** np.arange(4.0))[:, None, None]

    def envelope(self, points):
        """Return rows that give the control points of each derivative.

        A spline never leaves the range of its control points, so that the factor of the
        envelope is one. The more knots it is written with, the closer they lie to it.
        """
        spans = self.points + 4 - DEGREE
        refinement = max(1, round(points / max(spans, 1)))
        control_points = []
        for order in range(4):
            degree = DEGREE - order
            knots = _clamped_knots(spans * refinement, degree)
            # A spline of the coarse knots is one of the fine knots as well:
            # interpolation finds its fine control points. At Greville's abscissae, the
            # means of `degree` knots, the system is well conditioned.
            windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
            abscissae = windows.mean(axis=1)
            matrix = scipy.interpolate.BSpline.design_matrix(
                abscissae, knots, degree
            ).toarray()
            values = np.asarray(self.rows(abscissae * self.duration)[order])
            control_points.append(np.linalg.solve(matrix, values))
        return tuple(control_points), 1.0


def interpolate_at_rest(t: Times, points: Matrix) -> "scipy.interpolate.BSpline":
    """Return the quintic spline through points at times, at rest at both ends."""
    conditions = [(order, np.zeros(points.shape[1])) for order in (1, 2)]
    return scipy.interpolate.make_interp_spline(
        t, points, DEGREE, bc_type=(conditions, conditions)
    )


def spline_polynomials(spline: "scipy.interpolate.BSpline") -> PolynomialCoefficients:
    """Return the pieces of a clamped spline in powers of time since their start."""
    knots = spline.t[DEGREE:-DEGREE]
    starts = knots[:-1]
    middles = 0.5 * (knots[:-1] + knots[1:])
    powers = []
    for order in reversed(range(DEGREE + 1)):
        # The highest derivative jumps at the knots: rounding would decide which piece
        # is evaluated.
        instants = middles if order == DEGREE else starts
        powers.append(spline(instants, order) / math.factorial(order))
    return np.stack(powers)


@functools.cache
def _unit_polynomials(points: int):
    """Return starts and polynomials of the splines with unit coefficients."""
    unit = np.eye(points)
    control_points = np.concatenate([unit[:1], unit[:1], unit, unit[-1:], unit[-1:]])
    knots = _clamped_knots(points + 4 - DEGREE, DEGREE)
    return knots[DEGREE:-DEGREE], spline_polynomials(
        scipy.interpolate.BSpline(knots, control_points, DEGREE)
    )


def _clamped_knots(spans: int, degree: int):
    """Return equidistant knots of a clamped spline over [0, 1]."""
    return np.concatenate(
        [np.zeros(degree), np.linspace(0.0, 1.0, spans + 1), np.ones(degree)]
    )
