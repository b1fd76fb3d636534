"""Leads: from standstill into a periodic motion and out of it, within the limits of the joints."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, double_precision, is_traced, namespace
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot

from .fourier import PeriodsBasis, complete_limits
from .trajectory import AbstractTrajectory, Envelope, States, as_scalar, stand_outside


def _lead(state: Any, duration: Any, x: Any, sign: int = 1) -> tuple:
    r"""Return position, velocity, acceleration and jerk of a lead at times x from standstill [s].

    The velocity is $\alpha x^2 + \beta x^3$. The lead meets a motion in a state (q, qd,
    qdd). A lead-out (`sign` -1) is a lead-in (1) that is run backwards.
    """
    q, qd, qdd = state
    alpha, beta = _cubic(sign * qd, qdd, duration)
    return (
        q + alpha * (x**3 - duration**3) / 3 + beta * (x**4 - duration**4) / 4,
        sign * (alpha * x**2 + beta * x**3),
        2 * alpha * x + 3 * beta * x**2,
        sign * (2 * alpha + 6 * beta * x),
    )


def _cubic(qd: Any, qdd: Any, duration: Any) -> tuple[Any, Any]:
    return (
        3 * qd / duration**2 - qdd / duration,
        qdd / duration**2 - 2 * qd / duration**3,
    )


class LeadsBasis(PeriodsBasis):
    """Fourier series with a lead-in and a lead-out; the coefficients are those of the series.

    All joints start together and take the time `lead` into the series, and out of it at
    the end. Limits and constraints hold in the leads as well, unlike with `with_leads`,
    which finds leads for a given motion. One period between the leads is measured.

    Attributes:
        harmonics: Number of harmonics.
        omega: Ground frequency [rad/s].
        lead: Time of a lead [s].
        periods: Number of periods between the leads.

    Raises:
        InputError: If one of them is not positive.
    """

    lead: Float[AnyArray, ""] = eqx.field(
        converter=as_scalar, default=0.5, kw_only=True
    )

    def __check_init__(self):
        if not is_traced(self.lead) and not 0 < self.lead < math.inf:
            raise InputError(
                f"`lead` must be a positive time [s], but is {self.lead:g}."
            )

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Time from standstill to standstill [s]."""
        return self.periods * self.series.duration + 2 * self.lead

    def rows(
        self, t: Float[AnyArray, " samples"]
    ) -> Float[AnyArray, "4 samples variables"]:
        """Return the series, or the polynomials that lead into it and out of it."""

        def inside(t: AnyArray) -> AnyArray:
            xp = namespace(t, self.omega, self.lead)
            early, late = t < self.lead, t > self.duration - self.lead
            inner = self.series.rows(t - self.lead)
            outer = xp.where(
                late[None, :, None], self._lead_rows(self.duration - t, -1), inner
            )
            return xp.where(early[None, :, None], self._lead_rows(t, 1), outer)

        return stand_outside(inside, t, self.duration)

    def _lead_rows(self, x: AnyArray, sign: int) -> AnyArray:
        """Return the rows of the lead-in (1) or lead-out (-1) at times from standstill."""
        state = self.series.rows(np.zeros(1))[:3]
        return namespace(x, self.omega).stack(_lead(state, self.lead, x[:, None], sign))

    def envelope(self, points: int) -> Envelope:
        """Return samples of a period, as for any series, and control points of the leads.

        A polynomial lies within the range of its control points (Bernstein). A lead is
        split into pieces, each of which is bounded by its own control points.
        """
        degree, pieces = 4, 8
        rows, factor = self.series.envelope(points)
        u, order = np.linspace(0.0, 1.0, degree + 1), np.arange(degree + 1)
        binomials = np.array([math.comb(degree, k) for k in order])
        to_points = np.linalg.inv(
            binomials * u[:, None] ** order * (1 - u[:, None]) ** (degree - order)
        )
        starts = self.lead / pieces * np.arange(pieces)[:, None]
        t = starts + self.lead / pieces * u
        leads = [to_points @ self._lead_rows(x, sign) for x in t for sign in (1, -1)]
        return tuple(
            np.concatenate(parts) for parts in zip(rows, *leads, strict=True)
        ), factor

    def times(self, samples: int) -> Float[np.ndarray, " samples"]:
        """Return equidistant times over one period between the leads [s]."""
        return float(self.lead) + self.series.times(samples)

    def instants(self, points: int) -> Float[np.ndarray, " points"]:
        """Return equidistant times over the leads and one period [s]."""
        period, lead = float(self.series.duration), float(self.lead)
        t = np.arange(points) * ((period + 2 * lead) / (points - 1))
        return np.where(t > lead + period, t + (self.periods - 1) * period, t)


class WithLeads(AbstractTrajectory):
    """A motion between a lead-in from standstill and a lead-out to standstill, smooth throughout.

    Position, velocity and acceleration are continuous. Every joint takes its own time;
    all arrive together. `with_leads` chooses the times within limits.

    Attributes:
        inner: Motion between the leads.
        start: Time of `inner` at which the lead-in ends [s].
        length: Time for which `inner` is followed [s].
        lead_in: Time of each joint's lead-in [s].
        lead_out: Time of each joint's lead-out [s].
    """

    inner: AbstractTrajectory
    start: Float[AnyArray, ""] = eqx.field(converter=as_scalar)
    length: Float[AnyArray, ""] = eqx.field(converter=as_scalar)
    lead_in: Float[AnyArray, " joints"]
    lead_out: Float[AnyArray, " joints"]

    @property
    def window(self) -> tuple[Float[AnyArray, ""], Float[AnyArray, ""]]:
        """Times between which the inner motion is followed [s]: the part to be measured."""
        begin = jnp.max(jnp.asarray(self.lead_in))
        return begin, begin + self.length

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Time from standstill to standstill [s]."""
        return self.window[1] + jnp.max(jnp.asarray(self.lead_out))

    def states(self, t: Float[AnyArray, " samples"]) -> States:
        """Return the motion between the leads, and the leads; standstill outside."""
        begin, end = self.window
        time = t[:, None]
        lead_in, lead_out = (
            jnp.asarray(x)[None] for x in (self.lead_in, self.lead_out)
        )
        first = self.inner.states(jnp.reshape(self.start, 1))
        last = self.inner.states(jnp.reshape(self.start + self.length, 1))
        since = jnp.clip(time - begin + lead_in, 0.0, lead_in)
        left = jnp.clip(end + lead_out - time, 0.0, lead_out)
        early, late = _lead(first, lead_in, since), _lead(last, lead_out, left, -1)
        inner = self.inner.states(self.start + t - begin)
        parts = zip(early, inner, late, strict=False)
        return tuple(
            jnp.where(time < begin, x, jnp.where(time > end, z, y)) for x, y, z in parts
        )


def with_leads(
    series: AbstractTrajectory, robot: Robot, *, periods: int = 1
) -> WithLeads:
    """Add a lead-in and a lead-out to a periodic motion, within the robot's limits.

    The motion enters the period at the instant that makes the leads shortest. Limits of
    position, velocity, acceleration and jerk hold in the leads at all times: extremes
    of the polynomials are computed, not sampled. Unknown limits are assumed as in
    `random_fourier_series`. The robot must be brought to the start of the lead-in,
    `motion(0.0).q`. Collisions in the leads are not checked.

    Args:
        series: Periodic motion, for instance of a `FourierBasis`.
        robot: Robot whose limits hold.
        periods: Number of periods between the leads.

    Raises:
        InputError: If there is no period, the motion is not one of this robot, or no
            instant of the period can be reached within the limits; the message names
            the joint.
    """
    if periods < 1:
        raise InputError(f"`periods` must be at least 1, but is {periods}.")
    if series.joints != robot.joints:
        raise InputError(
            f"`series` must move the robot's {robot.joints} joints, but moves "
            f"{series.joints}."
        )
    period = float(series.duration)
    phases = period * np.arange(360) / 360
    with double_precision():
        at = series.motion(phases)
    q, qd, qdd = (np.asarray(x) for x in (at.q, at.qd, at.qdd))
    limits = complete_limits(robot)
    lead_in, excess_in = _shortest_leads(q, qd, qdd, limits)
    lead_out, excess_out = _shortest_leads(q, -qd, qdd, limits)
    total = lead_in.max(axis=1) + lead_out.max(axis=1)
    best = int(np.argmin(total))
    if not np.isfinite(total[best]):
        excess = np.maximum(excess_in, excess_out)
        nearest = int(np.argmin(excess.max(axis=1)))
        joint = int(np.argmax(excess[nearest]))
        raise InputError(
            "no instant of the period can be reached from standstill within the "
            "limits: at best "
            f"joint `{robot.joint_names[joint]}` exceeds one of them by "
            f"{100 * excess[nearest, joint]:.3g} %: take a motion that uses less of "
            "the limits."
        )
    return WithLeads(
        series, phases[best], periods * period, lead_in[best], lead_out[best]
    )


def _shortest_leads(
    q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, limits: Limits
) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest lead of every phase and joint within the limits, and the least excess.

    The duration is infinite where there is none.
    """
    T = np.geomspace(0.02, 10.0, 120)[:, None, None]
    alpha, beta = _cubic(qd, qdd, T)
    # The extremes lie where the next derivative is zero, or at the ends.
    with np.errstate(divide="ignore", invalid="ignore"):
        instants = [-alpha / beta, -2 * alpha / (3 * beta), -alpha / (3 * beta)]
    inner = [np.where(np.isfinite(x) & (x > 0) & (x < T), x, T) for x in instants]
    found = [_lead((q, qd, qdd), T, x) for x in (0 * T, *inner, T)]
    place, speed, rate, jerk = (np.stack(values) for values in zip(*found, strict=True))
    low, high = np.asarray(limits.position_min), np.asarray(limits.position_max)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    use = np.max(
        [
            (place.max(0) - middle) / half,
            (middle - place.min(0)) / half,
            np.abs(speed).max(0) / limits.velocity,
            np.abs(rate).max(0) / limits.acceleration,
            np.abs(jerk).max(0) / limits.jerk,
        ],
        axis=0,
    )
    durations = np.where(use - 1.0 <= 1e-9, T, np.inf).min(axis=0)
    return durations, use.min(axis=0) - 1.0
