"""Fourier series: periodic excitation whose derivatives are exact (Eqs. 34, 35)."""

import math

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory

ASSUMED_RANGE = (1.0, math.pi)
"""Half of the range of a joint without limits: of a rail [m], of a joint that turns [rad]."""
ASSUMED_SPEED = (0.5, math.pi / 2)
"""Largest speed of a joint whose own is not known: of a rail [m/s], of one that turns [rad/s]."""
ASSUMED_RISE = 0.25
"""Time [s] in which a joint gathers its largest speed where its acceleration is not known."""
GRID = 512
"""Points of a period on which the peaks of a random series are measured."""


class FourierSeries(AbstractTrajectory):
    r"""A finite Fourier series for each joint about its offset (Eqs. 34, 35).

    $$q_i(t) = q_{i,0} + \sum_{l=1}^{N} \left( \frac{a_{i,l}}{\omega l} \sin(\omega l t)
    - \frac{b_{i,l}}{\omega l} \cos(\omega l t) \right)$$

    Attributes:
        offset: Centre $q_{i,0}$ of each joint's motion, its mean over a period [rad or m].
        a: Amplitudes of the velocity's cosines [rad/s or m/s].
        b: Amplitudes of the velocity's sines [rad/s or m/s].
        omega: Ground frequency [rad/s].
    """

    offset: Float[AnyArray, " joints"]
    a: Float[AnyArray, "joints harmonics"]
    b: Float[AnyArray, "joints harmonics"]
    omega: Float[AnyArray, ""] | float

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.a.shape[0]

    @property
    def harmonics(self) -> int:
        """Number of harmonics $N$."""
        return self.a.shape[1]

    @property
    def period(self) -> Float[AnyArray, ""] | float:
        """Time after which the motion repeats [s]."""
        return 2 * math.pi / self.omega

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """One period [s]."""
        return self.period

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]."""
        a, b, offset = (jnp.asarray(x) for x in (self.a, self.b, self.offset))
        w = jnp.asarray(self.omega, a.dtype) * jnp.arange(1, self.harmonics + 1, dtype=a.dtype)
        phase = jnp.tensordot(jnp.asarray(t, a.dtype), w, axes=0)
        sin, cos = jnp.sin(phase), jnp.cos(phase)
        swing = sin @ (a / w[None]).T - cos @ (b / w[None]).T
        return Motion(
            q=jnp.broadcast_to(offset, swing.shape) + swing,
            qd=cos @ a.T + sin @ b.T,
            qdd=cos @ (b * w[None]).T - sin @ (a * w[None]).T,
        )


def random_fourier_series(
    robot: Robot,
    *,
    omega: float,
    harmonics: int = 5,
    reach: float = 0.95,
    seed: int = 0,
) -> FourierSeries:
    """Draws a series that uses the limits of every joint: a start for designs, and for tests.

    The coefficients are normal numbers over their harmonic's order. Each joint is scaled until it
    meets its tightest limit, and its offset is uniform in the range that is left. Limits hold
    between the grid's points as well, by the bound for trigonometric polynomials.

    Where a limit is not known, one is assumed: half a turn or 1 m to either side; 90 degrees/s or
    0.5 m/s; the acceleration that gathers the largest speed in 0.25 s.

    Args:
        robot: Whose limits of position, velocity and acceleration hold. Forces are not looked at.
        omega: Ground frequency [rad/s].
        harmonics: Number of harmonics.
        reach: Share of every limit that may be used, of 1.
        seed: Of the coefficients and offsets.

    Raises:
        InputError: If `omega` or `harmonics` is not positive, or `reach` not between 0 and 1.
    """
    if not 0 < omega < math.inf:
        raise InputError(f"`omega` must be a positive frequency [rad/s], but is {omega:g}.")
    if not 1 <= harmonics <= GRID // 8:
        raise InputError(f"`harmonics` must be from 1 to {GRID // 8}, but is {harmonics}.")
    if not 0 < reach <= 1:
        raise InputError(f"`reach` must be above 0 and at most 1, but is {reach:g}.")
    low, high, velocity, acceleration = assumed_bounds(robot)
    centre, half = 0.5 * (low + high), reach * 0.5 * (high - low)

    random = np.random.default_rng(seed)
    order = np.arange(1, harmonics + 1)
    a, b = random.standard_normal((2, robot.joints, harmonics)) / order
    angle = 2 * np.pi / GRID * np.outer(order, np.arange(GRID))
    sin, cos = np.sin(angle), np.cos(angle)
    # max |p| <= max over M points / cos(pi n / M) for every trigonometric polynomial of degree n.
    between = 1.0 / math.cos(math.pi * harmonics / GRID)
    w = omega * order
    q, qd, qdd = (
        (a / w) @ sin - (b / w) @ cos,
        a @ cos + b @ sin,
        (b * w) @ cos - (a * w) @ sin,
    )
    middle, swing = 0.5 * (q.max(1) + q.min(1)), 0.5 * between * np.ptp(q, axis=1)
    scale = np.min(
        [
            half / swing,
            reach * velocity / (between * np.abs(qd).max(1)),
            reach * acceleration / (between * np.abs(qdd).max(1)),
        ],
        axis=0,
    )
    left = np.maximum(half - scale * swing, 0.0)
    offset = centre - scale * middle + random.uniform(-1.0, 1.0, robot.joints) * left
    return FourierSeries(offset, scale[:, None] * a, scale[:, None] * b, float(omega))


def assumed_bounds(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ends of ranges, speeds and accelerations, with assumptions where they are not known."""
    turns, limits = np.array(robot.revolute, int), robot.limits
    half, speed = np.array(ASSUMED_RANGE)[turns], np.array(ASSUMED_SPEED)[turns]
    low, high = np.asarray(limits.position_min), np.asarray(limits.position_max)
    ends_low, ends_high = np.isfinite(low), np.isfinite(high)
    # A range that is open on one side reaches as far from its end as a free one in all.
    lowest = np.where(ends_low, low, np.where(ends_high, high - 2 * half, -half))
    highest = np.where(ends_high, high, np.where(ends_low, low + 2 * half, half))
    velocity = np.where(np.isfinite(limits.velocity), limits.velocity, speed)
    known = np.isfinite(limits.acceleration)
    return lowest, highest, velocity, np.where(known, limits.acceleration, velocity / ASSUMED_RISE)
