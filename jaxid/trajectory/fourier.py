"""Fourier series: periodic, or between standstills (Eqs. 34, 35)."""

import math

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, is_traced, namespace
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import complete_limits
from jaxid.robot.robot import Robot

from .trajectory import (
    AbstractBasis,
    LinearTrajectory,
    Time,
    as_scalar,
    stand_outside,
)


class FourierBasis(AbstractBasis):
    r"""Finite Fourier series about an offset (Eqs. 34, 35).

    $$q_i(t) = q_{i,0} + \sum_{l=1}^{N} \left( \frac{a_{i,l}}{\omega l} \sin(\omega l t)
    - \frac{b_{i,l}}{\omega l} \cos(\omega l t) \right)$$

    The coefficients of a joint are its offset $q_{i,0}$ [rad or m], all $a_{i,l}$ and
    all $b_{i,l}$ [rad/s or m/s]: with those of the paper as columns, the trajectory is
    `basis.trajectory(np.column_stack([offset, a, b]))`.

    Attributes:
        harmonics: Number of harmonics $N$.
        omega: Ground frequency $\omega$ [rad/s].

    Raises:
        InputError: If one of them is not positive.
    """

    harmonics: int = eqx.field(static=True)
    omega: AnyArray = eqx.field(converter=as_scalar)

    def __check_init__(self):
        if self.harmonics < 1:
            raise InputError(
                f"`harmonics` must be at least 1, but is {self.harmonics}."
            )
        if not is_traced(self.omega) and not 0 < self.omega < math.inf:
            raise InputError(
                f"`omega` must be a positive frequency [rad/s], not {self.omega:g}."
            )

    @property
    def duration(self) -> Time:
        """Period [s]."""
        return 2 * math.pi / self.omega

    def rows(self, t):
        """Return a constant, sines and cosines, and their derivatives."""
        xp = namespace(t, self.omega)
        w = self.omega * np.arange(1.0, self.harmonics + 1.0)[None]
        phase = t[:, None] * w
        sin = xp.sin(phase)
        cos = xp.cos(phase)
        one = xp.ones_like(phase[:, :1])
        zero = xp.zeros_like(one)
        orders = (
            [one, sin / w, -cos / w],
            [zero, cos, sin],
            [zero, -sin * w, cos * w],
            [zero, -cos * w**2, -sin * w**2],
        )
        return xp.stack([xp.concatenate(parts, axis=1) for parts in orders])

    def envelope(self, points):
        r"""Return samples of a period, which bound the series.

        The bound $\max |p| \le \max_k |p(t_k)| / \cos(\pi n / M)$ holds for every
        trigonometric polynomial of degree n at M > 2 n equidistant points (Ehlich and
        Zeller).
        """
        points = max(points, 2 * self.harmonics + 1)
        t = self.times(points)
        rows = np.asarray(self.rows(t))
        angle = math.pi * self.harmonics / points
        return tuple(rows), 1.0 / math.cos(angle)


class PeriodsBasis(AbstractBasis):
    """Periods of a Fourier series between two standstills: base of two bases."""

    harmonics: int = eqx.field(static=True)
    omega: AnyArray = eqx.field(converter=as_scalar)
    periods: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if self.periods < 1:
            raise InputError(f"`periods` must be at least 1, but is {self.periods}.")
        FourierBasis(self.harmonics, self.omega)

    @property
    def series(self) -> FourierBasis:
        """Fourier series without the conditions at the ends."""
        return FourierBasis(self.harmonics, self.omega)


class RestToRestBasis(PeriodsBasis):
    r"""Whole periods of a Fourier series between standstill and standstill.

    Velocity $\sum_l a_{i,l}$ and acceleration $\omega \sum_l l\, b_{i,l}$ at the start
    of a period are zero, which Eq. 34 as printed does not require. The coefficients of
    a joint are its offset and those along the directions that keep both conditions.
    Before the start and after the end the robot stands still.

    Attributes:
        harmonics: Number of harmonics, at least 2.
        omega: Ground frequency [rad/s].
        periods: Number of periods.

    Raises:
        InputError: If there is one harmonic only, or another number is not positive.
    """

    def __check_init__(self):
        if self.harmonics < 2:
            raise InputError(
                f"`harmonics` must be at least 2, but is {self.harmonics}."
            )

    @property
    def duration(self) -> Time:
        """Time from standstill to standstill [s]."""
        return self.periods * self.series.duration

    @property
    def directions(self) -> np.ndarray:
        """Orthonormal coefficients of the series that rest at both ends."""
        orders = np.arange(1.0, self.harmonics + 1.0)
        a = scipy.linalg.null_space(np.ones((1, self.harmonics)))
        b = scipy.linalg.null_space(orders[None])
        return np.asarray(scipy.linalg.block_diag(np.ones((1, 1)), a, b))

    def rows(self, t):
        """Return sines and cosines in the directions that rest at both ends."""

        def series_rows(t):
            return self.series.rows(t) @ self.directions

        return stand_outside(series_rows, t, self.duration)

    def envelope(self, points):
        """Return samples of a period, as for any series."""
        rows, factor = self.series.envelope(points)
        return tuple(x @ self.directions for x in rows), factor

    def times(self, samples):
        """Return equidistant times over one period [s]."""
        return self.series.times(samples)


def random_fourier_series(
    robot: Robot,
    *,
    omega: float,
    harmonics: int = 5,
    reach: float = 0.95,
    seed: int = 0,
) -> LinearTrajectory:
    """Draw a Fourier series that uses the limits of every joint.

    The coefficients are normal random numbers divided by the order of their harmonic.
    Each joint is scaled until it meets its tightest limit, and its offset is uniform in
    the range that is left. The limits hold at all times. Unknown limits are assumed,
    see `complete_limits`.

    Args:
        robot: Robot whose limits of position, velocity and acceleration hold; forces
            are ignored.
        omega: Ground frequency [rad/s].
        harmonics: Number of harmonics.
        reach: Fraction of every limit that may be used, from 0 to 1.
        seed: Seed of the coefficients and offsets.

    Raises:
        InputError: If `omega` or `harmonics` is not positive, or `reach` not between 0
            and 1.
    """
    if not 0 < reach <= 1:
        raise InputError(f"`reach` must be above 0 and at most 1, but is {reach:g}.")
    basis = FourierBasis(harmonics, omega)
    limits = complete_limits(robot)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    half_range = reach * 0.5 * (high - low)

    random = np.random.default_rng(seed)
    amplitudes = random.standard_normal((2, robot.joints, harmonics))
    orders = np.arange(1, harmonics + 1)
    a, b = amplitudes / orders
    offset = np.zeros((robot.joints, 1))
    x = np.hstack([offset, a, b])

    # The extreme values hold also between the points of the envelope.
    rows, factor = basis.envelope(512)
    q, qd, qdd = (x @ part.T for part in rows[:3])
    highest_q = q.max(axis=1)
    lowest_q = q.min(axis=1)
    centre = 0.5 * (highest_q + lowest_q)
    swing = 0.5 * factor * (highest_q - lowest_q)
    max_speed = factor * np.abs(qd).max(axis=1)
    max_acceleration = factor * np.abs(qdd).max(axis=1)

    # Each joint meets its tightest limit.
    scales = [
        half_range / swing,
        reach * limits.velocity / max_speed,
        reach * limits.acceleration / max_acceleration,
    ]
    scale = np.min(scales, axis=0)

    # The range that is left is used at random.
    max_shift = np.maximum(half_range - scale * swing, 0.0)
    shift = random.uniform(-1.0, 1.0, robot.joints) * max_shift
    middle_position = 0.5 * (low + high)
    x *= scale[:, None]
    x[:, 0] = middle_position - scale * centre + shift
    return basis.trajectory(x)
