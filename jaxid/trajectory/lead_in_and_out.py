"""Leads: from standstill into a periodic motion, and out of it."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Joints, double_precision, is_traced, namespace
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits, complete_limits
from jaxid.robot.robot import Robot

from .fourier import PeriodsBasis
from .trajectory import (
    AbstractTrajectory,
    Time,
    as_scalar,
    stand_outside,
)

LEAD_DEGREE = 4
"""Degree of a lead's position as a polynomial of time."""
ENVELOPE_PIECES = 8
"""Pieces of a lead that are bounded by their own control points."""
PHASES = 360
"""Instants of the period at which `with_leads` tries to enter and leave it."""
LEAD_DURATIONS = np.geomspace(0.02, 10.0, 120)[:, None, None]
"""Durations of leads that `with_leads` tries [s]."""


def _lead(state: Any, duration: Any, x: Any, sign: int = 1):
    r"""Return position and three derivatives of a lead, x after standstill [s].

    The velocity is $\alpha x^2 + \beta x^3$. The lead meets a motion in a state (q, qd,
    qdd). A lead-out (`sign` -1) is a lead-in (1) that is run backwards.
    """
    q, qd, qdd = state
    alpha, beta = _velocity_coefficients(sign * qd, qdd, duration)
    square_part = alpha * (x**3 - duration**3) / 3
    cube_part = beta * (x**4 - duration**4) / 4
    position = q + square_part + cube_part
    velocity = alpha * x**2 + beta * x**3
    acceleration = 2 * alpha * x + 3 * beta * x**2
    jerk = 2 * alpha + 6 * beta * x
    return [
        position,
        sign * velocity,
        acceleration,
        sign * jerk,
    ]


def _velocity_coefficients(qd: Any, qdd: Any, duration: Any):
    """Return the coefficients of the square and the cube of time in the velocity."""
    alpha = 3 * qd / duration**2 - qdd / duration
    beta = qdd / duration**2 - 2 * qd / duration**3
    return alpha, beta


class LeadsBasis(PeriodsBasis):
    """Fourier series with a lead-in and a lead-out.

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

    lead: AnyArray = eqx.field(converter=as_scalar, default=0.5, kw_only=True)

    def __check_init__(self):
        if not is_traced(self.lead) and not 0 < self.lead < math.inf:
            raise InputError(
                f"`lead` must be a positive time [s], but is {self.lead:g}."
            )

    @property
    def duration(self) -> Time:
        """Time from standstill to standstill [s]."""
        return self.periods * self.series.duration + 2 * self.lead

    def rows(self, t):
        """Return the series, or the polynomials that lead into it and out of it."""

        def moving(t):
            xp = namespace(t, self.omega, self.lead)
            time = t[None, :, None]
            is_early = time < self.lead
            is_late = time > self.duration - self.lead
            lead_in = self._lead_rows(t, 1)
            series = self.series.rows(t - self.lead)
            lead_out = self._lead_rows(self.duration - t, -1)
            rows = xp.where(is_late, lead_out, series)
            return xp.where(is_early, lead_in, rows)

        return stand_outside(moving, t, self.duration)

    def _lead_rows(self, x: AnyArray, sign: int):
        """Return the rows of the lead-in (1) or lead-out (-1), x from standstill."""
        xp = namespace(x, self.omega)
        state = self.series.rows(np.zeros(1))[:3]
        rows = _lead(state, self.lead, x[:, None], sign)
        return xp.stack(rows)

    def envelope(self, points):
        """Return samples of a period, and control points of the leads.

        A polynomial lies within the range of its control points (Bernstein). A lead is
        split into pieces, each of which is bounded by its own control points.
        """
        rows, factor = self.series.envelope(points)
        point_matrix = _to_control_points()
        fractions = np.linspace(0.0, 1.0, LEAD_DEGREE + 1)
        duration = self.lead / ENVELOPE_PIECES
        parts: list[Any] = [rows]
        for piece in range(ENVELOPE_PIECES):
            t = duration * (piece + fractions)
            for sign in (1, -1):
                lead_rows = self._lead_rows(t, sign)
                parts.append(point_matrix @ lead_rows)
        parts_of_orders = zip(*parts, strict=True)
        return tuple(np.concatenate(x) for x in parts_of_orders), factor

    def times(self, samples):
        """Return equidistant times over one period between the leads [s]."""
        return float(self.lead) + self.series.times(samples)

    def instants(self, points):
        """Return equidistant times over the leads and one period [s]."""
        period = float(self.series.duration)
        lead = float(self.lead)
        t = np.linspace(0.0, period + 2 * lead, points)
        # The lead-out follows the last period.
        other_periods = (self.periods - 1) * period
        return np.where(t > lead + period, t + other_periods, t)


def _to_control_points():
    """Return the matrix from values of a lead's polynomial to its control points."""
    orders = np.arange(LEAD_DEGREE + 1)
    u = np.linspace(0.0, 1.0, LEAD_DEGREE + 1)[:, None]
    powers = u**orders * (1 - u) ** orders[::-1]
    bernstein = scipy.special.comb(LEAD_DEGREE, orders) * powers
    return np.linalg.inv(bernstein)


class WithLeads(AbstractTrajectory):
    """A motion between a lead-in from standstill and a lead-out to standstill.

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
    start: Time = eqx.field(converter=as_scalar)
    length: Time = eqx.field(converter=as_scalar)
    lead_in: Joints
    lead_out: Joints

    @property
    def window(self) -> tuple[Time, Time]:
        """Times between which the inner motion is followed and measured [s]."""
        begin = jnp.max(jnp.asarray(self.lead_in))
        return begin, begin + self.length

    @property
    def duration(self) -> Time:
        """Time from standstill to standstill [s]."""
        return self.window[1] + jnp.max(jnp.asarray(self.lead_out))

    def states(self, t):
        """Return the motion between the leads, and the leads; standstill outside."""
        begin, end = self.window
        time = t[:, None]
        lead_in = jnp.asarray(self.lead_in)[None]
        lead_out = jnp.asarray(self.lead_out)[None]
        start = jnp.reshape(self.start, 1)
        first_state = self.inner.states(start)
        last_state = self.inner.states(start + self.length)
        lead_in_time = jnp.clip(time - begin + lead_in, 0.0, lead_in)
        remaining_time = jnp.clip(end + lead_out - time, 0.0, lead_out)

        entry = _lead(first_state, lead_in, lead_in_time)
        series = self.inner.states(self.start + t - begin)
        exit_ = _lead(last_state, lead_out, remaining_time, -1)
        is_early = time < begin
        is_late = time > end
        states = []
        for lead_in_part, series_part, lead_out_part in zip(
            entry, series, exit_, strict=False
        ):
            part = jnp.where(is_late, lead_out_part, series_part)
            states.append(jnp.where(is_early, lead_in_part, part))
        return tuple(states)


def with_leads(
    series: AbstractTrajectory,
    robot: Robot,
    *,
    periods: int = 1,
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
            f"`series` must move the robot's {robot.joints} "
            f"joints, but moves {series.joints}."
        )
    period = float(series.duration)
    phases = period * np.arange(PHASES) / PHASES
    with double_precision():
        motion = series.motion(phases)
    q, qd, qdd = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd))
    limits = complete_limits(robot)
    use_in = _use_of_limits((q, qd, qdd), limits)
    use_out = _use_of_limits((q, -qd, qdd), limits)
    lead_in = _shortest_durations(use_in)
    lead_out = _shortest_durations(use_out)
    total = lead_in.max(axis=1) + lead_out.max(axis=1)
    phase = int(np.argmin(total))
    if not np.isfinite(total[phase]):
        use = np.maximum(use_in.min(axis=0), use_out.min(axis=0))
        nearest_phase = int(np.argmin(use.max(axis=1)))
        joint = int(np.argmax(use[nearest_phase]))
        excess = use[nearest_phase, joint] - 1.0
        raise InputError(
            "no instant of the period can be reached from standstill within the "
            f"limits: at best, joint `{robot.joint_names[joint]}` exceeds one of them "
            f"by {100 * excess:.3g} %: use a motion that stays further from the "
            "limits."
        )
    return WithLeads(
        series,
        phases[phase],
        periods * period,
        lead_in[phase],
        lead_out[phase],
    )


def _shortest_durations(use: np.ndarray):
    """Return the shortest lead of each phase and joint; infinite if none is allowed."""
    durations = np.where(use <= 1.0 + 1e-9, LEAD_DURATIONS, np.inf)
    return durations.min(axis=0)


def _use_of_limits(state: tuple[np.ndarray, ...], limits: Limits):
    """Return the used fraction of a limit by leads [durations, phases, joints]."""
    T = LEAD_DURATIONS
    alpha, beta = _velocity_coefficients(state[1], state[2], T)
    # The extremes lie where the next derivative is zero, or at the ends.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = -alpha / beta
    low = limits.position_min
    high = limits.position_max
    middle = 0.5 * (high + low)
    half_range = 0.5 * (high - low)
    use = np.zeros(ratio.shape)
    for x in (0 * T, T, ratio, 2 * ratio / 3, ratio / 3):
        # NaN, where the next derivative is zero nowhere, is not within.
        is_within = (x >= 0) & (x < T)
        instants = np.where(is_within, x, T)
        position, velocity, acceleration, jerk = _lead(state, T, instants)
        uses = [
            (position - middle) / half_range,
            velocity / limits.velocity,
            acceleration / limits.acceleration,
            jerk / limits.jerk,
        ]
        largest_use = np.abs(uses).max(axis=0)
        use = np.maximum(use, largest_use)
    return use
