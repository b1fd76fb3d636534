"""Filters: from measured angles to the motion, and the same low-pass for forces and columns.

A regressor's columns are not band-limited (friction has edges), so whoever filters the forces must
filter the columns alike, or biases what friction is coupled with. Hence a filter has two sides
that belong together: `motion` for the angles, `smooth` for everything that stands in the equation.
"""

import abc
import math

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.low_pass import (
    LowPass,
    butterworth,
    first_order,
    lag,
    refuse_above_nyquist,
    refuse_unsettled,
)
from jaxid.measurement.whole import whole

SETTLED = 1e-4
"""Part of the impulse response's peak below which the start of a log no longer matters.

At a hundredth, what the ends do to accelerations takes estimates some standard deviations away.
"""
HIGHEST = 20
"""Order above which a Butterworth filter rings for long, and rounding spoils it."""


class AbstractFilter(eqx.Module):
    """How a log becomes a motion, and which part of forces and columns is compared."""

    @abc.abstractmethod
    def motion(
        self,
        angles: Float[np.ndarray, "samples joints"],
        velocities: Float[np.ndarray, "samples joints"] | None,
        sample_time: float,
    ) -> Motion:
        """Angles, velocities and accelerations at every sample of one segment.

        Args:
            angles: Measured, joint side [rad or m].
            velocities: Measured, joint side [rad/s or m/s]; None if not measured.
            sample_time: Time between two samples [s].
        """

    @property
    def uses_velocities(self) -> bool:
        """Whether measured velocities, where there are any, enter the motion."""
        return True

    @abc.abstractmethod
    def low_pass(self, sample_time: float) -> LowPass:
        """The zero-phase filter of forces and columns."""

    @abc.abstractmethod
    def edge(self, sample_time: float) -> int:
        """Samples to drop at both ends of a segment, where the filters have not settled."""

    def said(self, measured_velocities: bool) -> list[str]:
        """What a user should know who gives this filter a log, in sentences."""
        if not measured_velocities or self.uses_velocities:
            return []
        name = type(self).__name__
        return [f"the measured velocities are not used: `{name}` takes them from the angles"]

    def smooth(
        self, x: Float[AnyArray, "samples *columns"], sample_time: float
    ) -> Float[np.ndarray, "samples *columns"]:
        """Filters forces or columns of one segment: linear, without phase, constants unchanged."""
        return self.low_pass(sample_time)(x)

    def memory(self, sample_time: float) -> int:
        """Samples after which `smooth` has forgotten: the overlap of chunks."""
        return self.low_pass(sample_time).memory()


def _optional(value: float | int | None) -> float | None:
    return None if value is None else float(value)


def _positive(owner: str, **values: float | int | None) -> None:
    for name, value in values.items():
        if value is not None and not value > 0:
            raise InputError(f"`{name}` of `{owner}` must be positive, but is {value:g}.")


def _refuse_order(owner: str, order: int) -> None:
    if order > HIGHEST:
        raise InputError(
            f"`order` of `{owner}` must be {HIGHEST} at most, but is {order}: steeper filters ring "
            "for longer than they help; 2 to 8 are usual."
        )


def _margin(margin: float | None, sample_time: float, *filters: LowPass) -> int:
    if margin is None:
        return max(f.memory(SETTLED) for f in filters)
    return round(margin / sample_time)


class ZeroPhaseButterworth(AbstractFilter):
    """A Butterworth low-pass, forward and backward, then central differences of fourth order.

    Measured velocities, where there are any, are filtered like the angles and differentiated once;
    otherwise the angles are differentiated twice.

    Attributes:
        cutoff: Of angles and velocities, of one direction as scipy counts it [Hz].
        order: Of one direction.
        force_cutoff: Of forces and columns [Hz]; `cutoff` if None; infinite if decimation alone
            shall limit their band.
        margin: Time to drop at both ends of a segment [s]; until the filter has settled if None.
    """

    cutoff: float = eqx.field(static=True, converter=float)
    order: int = eqx.field(static=True, converter=whole("order"), default=4)
    force_cutoff: float | None = eqx.field(static=True, converter=_optional, default=None)
    margin: float | None = eqx.field(static=True, converter=_optional, default=None)

    def __check_init__(self) -> None:
        _positive("ZeroPhaseButterworth", cutoff=self.cutoff, order=self.order)
        _positive("ZeroPhaseButterworth", force_cutoff=self.force_cutoff)
        _refuse_order("ZeroPhaseButterworth", self.order)
        _refuse_negative_margin(self.margin)

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        smooth = butterworth(self.cutoff, self.order, sample_time)
        # From the first sample on: what stands still does so exactly, and no rounding moves it.
        way = smooth(angles - angles[0])
        q = angles[0] + way
        if velocities is None:
            qd = first_difference(way, sample_time)
            return Motion(q, qd, second_difference(way, sample_time))
        change = smooth(velocities - velocities[0])
        return Motion(q, velocities[0] + change, first_difference(change, sample_time))

    def low_pass(self, sample_time: float) -> LowPass:  # noqa: D102
        if self.force_cutoff is None:
            return butterworth(self.cutoff, self.order, sample_time)
        return butterworth(self.force_cutoff, self.order, sample_time, "force_cutoff")

    def edge(self, sample_time: float) -> int:  # noqa: D102
        own = butterworth(self.cutoff, self.order, sample_time)
        return _margin(self.margin, sample_time, own, self.low_pass(sample_time))


class PaperFilter(AbstractFilter):
    r"""The paper's differentiating filter $G(s) = s / (s / \omega_f + 1)$ (Eq. 25).

    Velocities are $G q$ with the cut-off `velocity`: causal, so they lag by about $1/\omega_f$.
    Accelerations are filtered forward and backward with the cut-off `acceleration`; since
    $G(s) G(-s) = -s^2 / (1 - s^2 / \omega_f^2)$, the result on $q$ is *minus* the acceleration and
    its sign is turned. Forces and columns see the low-pass $1 / (s / \omega_f + 1)$ forward and
    backward with the cut-off `acceleration`, since the paper is silent about them. Angles stay as
    measured, and measured velocities are not used.

    The paper does not say how it made $G$ discrete. Here it is the bilinear transform: its delay is
    the analogue filter's at every sampling rate (backward differences add half a sample), it is
    stable, and below half of the sampling rate it does not ring.

    Attributes:
        velocity: Cut-off of the velocities [rad/s].
        acceleration: Cut-off of accelerations, forces and columns [rad/s].
        margin: Time to drop at both ends of a segment [s]; until the filter has settled if None.
    """

    velocity: float = eqx.field(static=True, converter=float, default=1200.0)
    acceleration: float = eqx.field(static=True, converter=float, default=100.0)
    margin: float | None = eqx.field(static=True, converter=_optional, default=None)

    def __check_init__(self) -> None:
        _positive("PaperFilter", velocity=self.velocity, acceleration=self.acceleration)
        _refuse_negative_margin(self.margin)

    @property
    def uses_velocities(self) -> bool:
        """Never."""
        return False

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        self._refuse_slow_logs(sample_time)
        way = angles - angles[0]
        b, a = differentiator(self.velocity, sample_time)
        qd = np.asarray(signal.lfilter(b, a, way, axis=0))
        b, a = differentiator(self.acceleration, sample_time)
        padding = min(len(angles) - 1, self.low_pass(sample_time).memory(SETTLED))
        minus = signal.filtfilt(b, a, way, axis=0, padtype="odd", padlen=padding)
        return Motion(angles, qd, -minus)

    def low_pass(self, sample_time: float) -> LowPass:  # noqa: D102
        self._refuse_slow_logs(sample_time)
        return first_order(self.acceleration, sample_time)

    def edge(self, sample_time: float) -> int:  # noqa: D102
        self._refuse_slow_logs(sample_time)
        own = first_order(self.velocity, sample_time)
        return _margin(self.margin, sample_time, own, self.low_pass(sample_time))

    def _refuse_slow_logs(self, sample_time: float) -> None:
        refuse_above_nyquist("velocity", 0.0, sample_time)
        for name, omega in (("velocity", self.velocity), ("acceleration", self.acceleration)):
            refuse_unsettled(name, omega / (2 * math.pi), sample_time)
            if omega * sample_time >= math.pi:
                raise InputError(
                    f"`{name}` of `PaperFilter` is {omega:g} rad/s, which needs samples at more "
                    f"than {omega / math.pi:.0f} Hz, but the log has {1 / sample_time:.6g} Hz: "
                    f"take a cut-off below {math.pi / sample_time:.0f} rad/s (a third of that is "
                    "safe), or `ZeroPhaseButterworth`."
                )


class PeriodicFourier(AbstractFilter):
    """A Fourier series, fitted to the angles of a periodic motion and differentiated exactly.

    One series for each segment, by least squares over all of its samples, which must span at least
    one period. Forces and columns are not averaged over the periods: least squares do that, and the
    scatter between the periods tells the uncertainty. They see a zero-phase Butterworth low-pass.
    Measured velocities are not used.

    Attributes:
        period: Of the motion [s].
        harmonics: Of the series; that of the planned trajectory or a few more.
        force_harmonics: Cut-off of forces and columns, in harmonics; ten times `harmonics` if None,
            infinite if decimation alone shall limit their band.
        order: Of the low-pass, of one direction.
        margin: Time to drop at both ends of a segment [s]; until the filter has settled if None.
    """

    period: float = eqx.field(static=True, converter=float)
    harmonics: int = eqx.field(static=True, converter=whole("harmonics"))
    force_harmonics: float | None = eqx.field(static=True, converter=_optional, default=None)
    order: int = eqx.field(static=True, converter=whole("order"), default=4)
    margin: float | None = eqx.field(static=True, converter=_optional, default=None)

    def __check_init__(self) -> None:
        _positive("PeriodicFourier", period=self.period, harmonics=self.harmonics)
        _positive("PeriodicFourier", force_harmonics=self.force_harmonics, order=self.order)
        _refuse_order("PeriodicFourier", self.order)
        if math.isinf(self.period):
            raise InputError(
                "`period` of `PeriodicFourier` must be a time [s], but is infinite: give the "
                "motion's own, or use another filter."
            )
        _refuse_negative_margin(self.margin)

    @property
    def uses_velocities(self) -> bool:
        """Never."""
        return False

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        samples = len(angles)
        if samples * sample_time < (1 - 1e-9) * self.period:
            raise InputError(
                f"`period` of `PeriodicFourier` is {self.period:g} s, but a segment of the log "
                f"lasts {samples * sample_time:g} s: record whole periods, or use another filter."
            )
        refuse_above_nyquist("harmonics", self.harmonics / self.period, sample_time)
        t = sample_time * np.arange(samples)
        w = 2 * math.pi / self.period * np.arange(1, self.harmonics + 1)
        s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        basis = np.hstack([np.ones((samples, 1)), s, c])
        series = np.linalg.lstsq(basis, angles - angles[0], rcond=None)[0]
        q = angles[0] + basis @ series
        self._refuse_misfit(angles, q)
        a, b = series[1 : self.harmonics + 1], series[self.harmonics + 1 :]
        W = w[:, None]
        return Motion(q, c @ (W * a) - s @ (W * b), -s @ (W**2 * a) - c @ (W**2 * b))

    def _refuse_misfit(self, angles: np.ndarray, fitted: np.ndarray) -> None:
        moved = angles.std(axis=0)
        left = np.sqrt(np.mean((angles - fitted) ** 2, axis=0))
        wrong = np.flatnonzero(left > 0.05 * np.maximum(moved, 0.05 * moved.max()))
        if wrong.size:
            j = int(wrong[0])
            raise InputError(
                f"the angles of joint {j + 1} leave a Fourier series of period {self.period:g} s "
                f"and {self.harmonics} harmonics by {100 * left[j] / moved[j]:.0f} % of their "
                "motion (RMS): correct `period` or `harmonics`, or crop what is not periodic."
            )

    def low_pass(self, sample_time: float) -> LowPass:  # noqa: D102
        lines = 10.0 * self.harmonics if self.force_harmonics is None else self.force_harmonics
        name = "force_harmonics / period"
        return butterworth(lines / self.period, self.order, sample_time, name)

    def edge(self, sample_time: float) -> int:  # noqa: D102
        return _margin(self.margin, sample_time, self.low_pass(sample_time))


def _refuse_negative_margin(margin: float | None) -> None:
    if margin is not None and not 0 <= margin < math.inf:
        raise InputError(f"`margin` must be a time [s] of zero or more, but is {margin:g}.")


def differentiator(omega: float, sample_time: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Numerator and denominator of $s / (s / \omega + 1)$ by the bilinear transform (Eq. 25)."""
    _, a = lag(omega, sample_time)
    return omega / (1 + 0.5 * omega * sample_time) * np.array([1.0, -1.0]), a


def first_difference(
    x: Float[np.ndarray, "samples joints"], sample_time: float
) -> Float[np.ndarray, "samples joints"]:
    """Central differences of fourth order; of second order next to the ends.

    At 125 Hz those of second order would lose 1 % of a velocity at 5 Hz.
    """
    d = np.gradient(x, sample_time, axis=0, edge_order=2)
    d[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * sample_time)
    return d


def second_difference(
    x: Float[np.ndarray, "samples joints"], sample_time: float
) -> Float[np.ndarray, "samples joints"]:
    """Central differences of fourth order, of second next to the ends, at which it stays."""
    d = np.empty_like(x)
    d[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / sample_time**2
    inner = 16 * (x[3:-1] + x[1:-3]) - (x[4:] + x[:-4]) - 30 * x[2:-2]
    d[2:-2] = inner / (12 * sample_time**2)
    d[0], d[-1] = d[1], d[-2]
    return d
