"""From standstill into a periodic motion and out of it, within the limits of the joints."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import FourierSeries, assumed_bounds
from jaxid.trajectory.trajectory import AbstractTrajectory, each_time

PHASES = 360
"""Instants of a period at which the lead-in may hand over."""
DURATIONS = np.geomspace(0.02, 10.0, 120)
"""Durations [s] that are tried for the lead of a joint."""
ROUNDING = 1e-9


class WithLeads(AbstractTrajectory):
    r"""A motion with a lead-in from standstill and a lead-out to standstill, smooth throughout.

    In a lead the velocity of a joint is the cubic polynomial $\alpha \tau^2 + \beta \tau^3$ of the
    time since the joint started, which meets velocity and acceleration of the motion; so position,
    velocity and acceleration are continuous. Every joint takes its own time; all arrive together.
    `with_leads` chooses the times within limits.

    Attributes:
        inner: The motion between the leads.
        start: Time of `inner` at which the lead-in hands over [s].
        length: Time that `inner` is followed [s].
        lead_in: Time that each joint needs before it [s].
        lead_out: Time that each joint needs after it [s].
    """

    inner: AbstractTrajectory
    start: Float[AnyArray, ""] | float
    length: Float[AnyArray, ""] | float
    lead_in: Float[AnyArray, " joints"]
    lead_out: Float[AnyArray, " joints"]

    @property
    def window(self) -> tuple[Float[AnyArray, ""], Float[AnyArray, ""]]:
        """Times between which the inner motion is followed [s]: the part that a log needs."""
        begin = jnp.max(self.lead_in)
        return begin, begin + self.length

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """From standstill to standstill [s]."""
        return self.window[1] + jnp.max(self.lead_out)

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]: standstill before the start and after the end."""
        return each_time(self._at, t)

    def _at(self, time: Float[Array, ""]) -> Motion:
        begin, end = self.window
        lead_in, lead_out = jnp.asarray(self.lead_in), jnp.asarray(self.lead_out)
        first = self.inner.motion(self.start)
        last = self.inner.motion(self.start + self.length)
        inner = self.inner.motion(self.start + time - begin)
        rise = _lead(first.qd, first.qdd, lead_in, time - begin + lead_in)
        # A lead-out is a lead-in that is run backwards.
        fall = _lead(-last.qd, last.qdd, lead_out, end + lead_out - time)
        early = Motion(first.q + rise.q, rise.qd, rise.qdd)
        late = Motion(last.q + fall.q, -fall.qd, fall.qdd)
        return jax.tree.map(
            lambda x, y, z: jnp.where(time < begin, x, jnp.where(time > end, z, y)),
            early,
            inner,
            late,
        )


def with_leads(
    series: FourierSeries, robot: Robot, *, periods: int = 1, reach: float = 1.0
) -> WithLeads:
    """Lets a periodic motion start from standstill and end there, within the robot's limits.

    The motion enters the period at the instant that makes the leads shortest. Limits of position,
    velocity, acceleration and jerk hold in the leads for all times: extremes of polynomials are
    computed, not sampled. Where a limit is not known, one is assumed as in
    `random_fourier_series`. The robot must be brought to the start of the lead-in,
    `motion(0.0).q`; whether the leads are free of collisions is for the constraints to say.

    Args:
        series: The periodic motion.
        robot: Whose limits hold.
        periods: Number of periods between the leads.
        reach: Share of every limit that may be used, of 1.

    Raises:
        InputError: If there is no period, the series is not one of this robot, or no instant of
            the period can be reached within the limits; the message names the joint.
    """
    if periods < 1:
        raise InputError(f"`periods` must be at least 1, but is {periods}.")
    if series.joints != robot.joints:
        raise InputError(
            f"`series` must move the robot's {robot.joints} joints, but moves {series.joints}."
        )
    period = float(series.period)
    phases = period * np.arange(PHASES) / PHASES
    with double_precision():
        at = series.motion(phases)
    q, qd, qdd = (np.asarray(x) for x in (at.q, at.qd, at.qdd))
    bounds = _Bounds.of(robot, reach)
    lead_in, excess_in = _shortest(q, qd, qdd, bounds)
    lead_out, excess_out = _shortest(q, -qd, qdd, bounds)
    total = lead_in.max(axis=1) + lead_out.max(axis=1)
    best = int(np.argmin(total))
    if not np.isfinite(total[best]):
        excess = np.maximum(excess_in, excess_out)
        nearest = int(np.argmin(excess.max(axis=1)))
        joint = int(np.argmax(excess[nearest]))
        raise InputError(
            "no instant of the period can be reached from standstill within the limits: at best "
            f"joint `{robot.joint_names[joint]}` exceeds one of them by "
            f"{100 * excess[nearest, joint]:.3g} %: take a motion that uses less of the limits, or "
            "one that starts and ends at rest."
        )
    return WithLeads(series, phases[best], periods * period, lead_in[best], lead_out[best])


class _Bounds(NamedTuple):
    """What the joints may do in a lead."""

    low: np.ndarray
    high: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray

    @classmethod
    def of(cls, robot: Robot, reach: float) -> "_Bounds":
        low, high, velocity, acceleration = assumed_bounds(robot)
        centre, half = 0.5 * (low + high), 0.5 * reach * (high - low)
        jerk = reach * np.asarray(robot.limits.jerk)
        return cls(centre - half, centre + half, reach * velocity, reach * acceleration, jerk)


def _lead(qd: AnyArray, qdd: AnyArray, duration: AnyArray, time: AnyArray) -> Motion:
    """The motion of a lead, its positions counted from where it ends."""
    alpha, beta = _cubic(qd, qdd, duration)
    x = jnp.clip(time, 0.0, duration)
    travelled = alpha * x**3 / 3 + beta * x**4 / 4
    whole = alpha * duration**3 / 3 + beta * duration**4 / 4
    return Motion(travelled - whole, alpha * x**2 + beta * x**3, 2 * alpha * x + 3 * beta * x**2)


def _cubic(qd: Any, qdd: Any, duration: Any) -> tuple[Any, Any]:
    """Coefficients of the velocity that has these values at the end of a duration."""
    return 3 * qd / duration**2 - qdd / duration, qdd / duration**2 - 2 * qd / duration**3


def _shortest(
    q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, bounds: _Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """For every phase and joint the shortest lead within the bounds, and the least excess.

    An infinite duration says that there is none.
    """
    T = DURATIONS[:, None, None]
    alpha, beta = _cubic(qd, qdd, T)

    def between(x: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(x) & (x > 0) & (x < T), x, T)

    with np.errstate(divide="ignore", invalid="ignore"):
        turning, steepest = between(-alpha / beta), between(-alpha / (3 * beta))
        fastest = between(-2 * alpha / (3 * beta))
    # The extremes lie where the next derivative is zero, or at the ends.
    travel = np.stack([alpha * x**3 / 3 + beta * x**4 / 4 for x in (0 * T, turning, T)])
    place = q + travel - travel[-1]
    speed = np.stack([np.abs(alpha * x**2 + beta * x**3) for x in (fastest, T)])
    force = np.stack([np.abs(2 * alpha * x + 3 * beta * x**2) for x in (steepest, T)])
    jerk = np.stack([np.abs(2 * alpha), np.abs(2 * alpha + 6 * beta * T)])
    half = 0.5 * (bounds.high - bounds.low)
    excess = np.max(
        [
            (place.max(0) - bounds.high) / half,
            (bounds.low - place.min(0)) / half,
            speed.max(0) / bounds.velocity - 1,
            force.max(0) / bounds.acceleration - 1,
            jerk.max(0) / bounds.jerk - 1,
        ],
        axis=0,
    )
    allowed = excess <= ROUNDING
    durations = np.where(allowed, T, np.inf).min(axis=0)
    return durations, excess.min(axis=0)
