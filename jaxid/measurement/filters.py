"""Filters: motion from measured angles, one low-pass for forces and columns, and decimation.

A regressor's columns are not band-limited (friction has edges), so the columns must be filtered
like the forces, or parameters that are coupled with friction are biased. Hence a filter has two
sides that belong together: `motion` for the angles, `smooth` for forces and columns.
"""

import abc
import math
from collections.abc import Callable, Iterable
from typing import ClassVar

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

SETTLED = 1e-4
"""Fraction of the impulse response's peak below which the start of a log no longer matters."""


def optional(value: float | int | None) -> float | None:
    """Convert a number, unless it is None."""
    return None if value is None else float(value)


def integer(name: str) -> Callable[[float | int], int]:
    """Return a converter that accepts integers only, as `int` or `float`."""

    def convert(value: float | int) -> int:
        if not float(value).is_integer():
            raise InputError(f"`{name}` must be a whole number, but is {value:g}.")
        return int(value)

    return convert


class LowPass(eqx.Module):
    """Recursive filter that runs forward and backward: no phase, gain one for constants.

    Attributes:
        sections: Second-order sections of one direction, as in scipy; everything passes if empty.
        cutoff: Frequency at which the gain of both directions falls below 1/2 [Hz].
    """

    sections: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    cutoff: float = eqx.field(static=True)

    def __call__(
        self, x: Float[AnyArray, "samples *columns"]
    ) -> Float[np.ndarray, "samples *columns"]:
        """Filter along the first axis, by blocks of columns that keep scipy's copies small."""
        x = np.asarray(x, np.float64)
        if not self.sections or x.size == 0:
            return x
        sos = np.array(self.sections)
        flat = x.reshape(len(x), -1)
        padding = min(3 * (2 * len(sos) + 1), len(x) - 1)
        out = np.empty_like(flat)
        width = max(1, 2**22 // len(flat))
        for start in range(0, flat.shape[1], width):
            block = np.ascontiguousarray(flat[:, start : start + width].T)
            block = signal.sosfiltfilt(sos, block, axis=1, padtype="odd", padlen=padding)
            out[:, start : start + width] = block.T
        return out.reshape(x.shape)

    def gain(self, frequency: Float[AnyArray, " lines"], sample_time: float) -> np.ndarray:
        """Return the gain for sinusoids of some frequencies [Hz]."""
        if not self.sections:
            return np.ones_like(frequency)
        angular = 2 * math.pi * np.asarray(frequency) * sample_time
        return np.abs(signal.sosfreqz(np.array(self.sections), angular)[1]) ** 2

    def memory(self, tolerance: float = 1e-14) -> int:
        """Return after how many samples the impulse response stays below a fraction of its peak."""
        if not self.sections:
            return 0
        sos = np.array(self.sections)
        slowest = max(np.abs(np.roots(s[3:])).max(initial=0.0) for s in sos)
        if slowest == 0:
            return 2 * len(sos)
        if tolerance > 1e-6:
            samples = math.ceil(math.log(1e-3 * tolerance) / math.log(slowest)) + 4 * len(sos)
            impulse = np.zeros(samples)
            impulse[0] = 1.0
            one_way = signal.sosfilt(sos, impulse)
            two_way = np.abs(signal.correlate(one_way, one_way, method="fft"))[samples - 1 :]
            return int(np.flatnonzero(two_way > tolerance * two_way[0])[-1]) + 1
        # Rounding hides smaller tails: continue the slowest pole (multiplied by the time it lasts).
        near = self.memory(2e-6)
        return near + math.ceil(1.1 * math.log(tolerance / 2e-6) / math.log(slowest))


def butterworth(cutoff: float, order: int, sample_time: float, name: str = "cutoff") -> LowPass:
    """Return a Butterworth filter, to be run forward and backward; `cutoff` [Hz] is scipy's.

    Raises:
        InputError: If the cut-off does not suit the sampling rate.
    """
    if math.isinf(cutoff):
        return LowPass((), math.inf)
    _require_cutoff(name, cutoff, sample_time)
    sos = signal.butter(order, cutoff, output="sos", fs=1.0 / sample_time)
    return LowPass(unit_gain_sections(np.asarray(sos, np.float64)), cutoff)


def unit_gain_sections(sos: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return second-order sections scaled to gain one for constants, hashable."""
    gain = np.prod(sos[:, :3].sum(axis=1) / sos[:, 3:].sum(axis=1))
    sos = sos.copy()
    sos[0, :3] /= gain
    return tuple(tuple(float(c) for c in row) for row in sos)


def _require_cutoff(name: str, cutoff: float, sample_time: float) -> None:
    """Refuse a cut-off [Hz] that does not suit the sampling rate."""
    rate = 1 / sample_time
    if not 1e-5 * rate <= cutoff < 0.5 * rate:
        raise InputError(
            f"`{name}` of {cutoff:.6g} Hz must be below half of the sampling rate of {rate:.6g} Hz "
            f"(and above 1e-5 of it): log faster than {2 * cutoff:.6g} Hz, or check `time_unit`."
        )


class AbstractFilter(eqx.Module):
    """Filter of a log: motion from the angles, and the band of forces and columns.

    Attributes:
        uses_velocities: Whether measured velocities, if there are any, enter the motion.
    """

    uses_velocities: ClassVar[bool] = True

    @abc.abstractmethod
    def motion(
        self,
        angles: Float[np.ndarray, "samples joints"],
        velocities: Float[np.ndarray, "samples joints"] | None,
        sample_time: float,
    ) -> Motion:
        """Return the motion at every sample of a segment; `velocities` are None if not measured."""

    @abc.abstractmethod
    def low_pass(self, sample_time: float) -> LowPass:
        """Return the zero-phase filter of forces and columns."""

    @abc.abstractmethod
    def edge(self, sample_time: float) -> int:
        """Return the number of samples to drop at both ends of a segment, until filters settle."""

    def smooth(
        self, x: Float[AnyArray, "samples *columns"], sample_time: float
    ) -> Float[np.ndarray, "samples *columns"]:
        """Filter forces or columns of one segment: linear, without phase, constants unchanged."""
        return self.low_pass(sample_time)(x)


def _check(filter: AbstractFilter, *positive: str) -> None:
    """Check the settings that filters share, and that others are positive."""
    owner = type(filter).__name__
    rules: dict[str, tuple[Callable[[float], bool], str]]
    rules = dict.fromkeys(positive, (lambda x: x > 0, "positive"))
    rules["order"] = lambda x: 0 < x <= 20, "between 1 and 20 (2 to 8 are usual)"
    rules["margin"] = lambda x: 0 <= x < math.inf, "a time [s] of zero or more"
    for name, (rule, words) in rules.items():
        value = getattr(filter, name, None)
        if value is not None and not rule(value):
            raise InputError(f"`{name}` of `{owner}` must be {words}, but is {value:g}.")


def _edge(margin: float | None, sample_time: float, *filters: LowPass) -> int:
    if margin is None:
        return max(f.memory(SETTLED) for f in filters)
    return round(margin / sample_time)


class ZeroPhaseButterworth(AbstractFilter):
    """Butterworth low-pass, forward and backward, then central differences of fourth order.

    Measured velocities, if there are any, are filtered like the angles and differentiated once;
    otherwise the angles are differentiated twice. With an infinite `cutoff` nothing is filtered.

    Attributes:
        cutoff: Cut-off of angles and velocities, of one direction as in scipy [Hz].
        order: Order of one direction.
        force_cutoff: Cut-off of forces and columns [Hz], like `20.0`; `cutoff` if None; infinite if
            decimation alone shall limit their band.
        margin: Time to drop at both ends of a segment [s], like `0.1`; until the filter has settled
            if None.
    """

    cutoff: float = eqx.field(static=True, converter=float)
    order: int = eqx.field(static=True, converter=integer("order"), default=4)
    force_cutoff: float | None = eqx.field(static=True, converter=optional, default=None)
    margin: float | None = eqx.field(static=True, converter=optional, default=None)

    def __check_init__(self) -> None:
        _check(self, "cutoff", "force_cutoff")

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        smooth = butterworth(self.cutoff, self.order, sample_time)
        # From the first sample on, so that a joint at rest stays exactly at rest.
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
        motion = butterworth(self.cutoff, self.order, sample_time)
        return _edge(self.margin, sample_time, motion, self.low_pass(sample_time))


class PaperFilter(AbstractFilter):
    r"""The paper's differentiating filter $G(s) = s / (s / \omega_f + 1)$ (Eq. 25).

    Velocities are $G q$ with the cut-off `velocity`: causal, so they lag by about $1/\omega_f$.
    Accelerations are filtered forward and backward with the cut-off `acceleration`; since
    $G(s) G(-s) = -s^2 / (1 - s^2 / \omega_f^2)$, the result on $q$ is *minus* the acceleration and
    its sign is changed. Forces and columns are filtered by the low-pass $1 / (s / \omega_f + 1)$
    forward and backward with the cut-off `acceleration`, since the paper is silent about them.
    Angles stay as measured, and measured velocities are not used.

    The paper does not say how $G$ was made discrete. Here it is the bilinear transform: its delay
    is the analogue filter's at every sampling rate (backward differences add half a sample), it is
    stable, and below half of the sampling rate it does not ring.

    Attributes:
        velocity: Cut-off of the velocities [rad/s].
        acceleration: Cut-off of accelerations, forces and columns [rad/s].
        margin: Time to drop at both ends of a segment [s], like `0.1`; until the filter has settled
            if None.
    """

    uses_velocities: ClassVar[bool] = False
    velocity: float = eqx.field(static=True, converter=float, default=1200.0)
    acceleration: float = eqx.field(static=True, converter=float, default=100.0)
    margin: float | None = eqx.field(static=True, converter=optional, default=None)

    def __check_init__(self) -> None:
        _check(self, "velocity", "acceleration")

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        way = angles - angles[0]
        b, a = _bilinear("velocity", [1.0, 0.0], self.velocity, sample_time)
        qd = np.asarray(signal.lfilter(b, a, way, axis=0))
        b, a = _bilinear("acceleration", [1.0, 0.0], self.acceleration, sample_time)
        padding = min(len(angles) - 1, self.low_pass(sample_time).memory(SETTLED))
        minus = signal.filtfilt(b, a, way, axis=0, padtype="odd", padlen=padding)
        return Motion(angles, qd, -minus)

    def low_pass(self, sample_time: float) -> LowPass:  # noqa: D102
        return _first_order("acceleration", self.acceleration, sample_time)

    def edge(self, sample_time: float) -> int:  # noqa: D102
        motion = _first_order("velocity", self.velocity, sample_time)
        return _edge(self.margin, sample_time, motion, self.low_pass(sample_time))


class PeriodicFourier(AbstractFilter):
    """Fourier series, fitted to the angles of a periodic motion and differentiated exactly.

    Each segment has a series of its own, by least squares over all of its samples, which must span
    at least one period. Forces and columns are not averaged over the periods: least squares do
    that, and the scatter between the periods tells the uncertainty. They are filtered by a
    zero-phase Butterworth low-pass. Measured velocities are not used.

    Attributes:
        period: Period of the motion [s], like `10.0`.
        harmonics: Number of harmonics, like `5`; that of the planned trajectory or a few more.
        force_harmonics: Cut-off of forces and columns, in harmonics, like `50`; ten times
            `harmonics` if None, infinite if decimation alone shall limit their band.
        order: Order of the low-pass, of one direction.
        margin: Time to drop at both ends of a segment [s], like `0.1`; until the filter has settled
            if None.
    """

    uses_velocities: ClassVar[bool] = False
    period: float = eqx.field(static=True, converter=float)
    harmonics: int = eqx.field(static=True, converter=integer("harmonics"))
    force_harmonics: float | None = eqx.field(static=True, converter=optional, default=None)
    order: int = eqx.field(static=True, converter=integer("order"), default=4)
    margin: float | None = eqx.field(static=True, converter=optional, default=None)

    def __check_init__(self) -> None:
        _check(self, "period", "harmonics", "force_harmonics")

    def motion(self, angles, velocities, sample_time) -> Motion:  # noqa: D102
        t = sample_time * np.arange(len(angles))
        if len(t) * sample_time < (1 - 1e-9) * self.period:
            raise InputError(
                f"`period` of `PeriodicFourier` is {self.period:g} s, but a segment of the log "
                f"lasts {len(t) * sample_time:g} s: record whole periods, or use another filter."
            )
        _require_cutoff("harmonics / period", self.harmonics / self.period, sample_time)
        w = 2 * math.pi / self.period * np.arange(1, self.harmonics + 1)
        s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        basis = np.hstack([np.ones((len(t), 1)), s, c])
        series = np.linalg.lstsq(basis, angles - angles[0], rcond=None)[0]
        q = angles[0] + basis @ series
        moved = angles.std(axis=0)
        left = np.sqrt(np.mean((angles - q) ** 2, axis=0))
        wrong = np.flatnonzero(left > 0.05 * np.maximum(moved, 0.05 * moved.max()))
        if wrong.size:
            j = int(wrong[0])
            raise InputError(
                f"the angles of joint {j + 1} leave a Fourier series by {left[j] / moved[j]:.0%} "
                "of their motion (RMS): correct `period` or `harmonics`, or crop the log."
            )
        a = series[1 : self.harmonics + 1]
        b = series[self.harmonics + 1 :]
        W = w[:, None]
        return Motion(q, c @ (W * a) - s @ (W * b), -s @ (W**2 * a) - c @ (W**2 * b))

    def low_pass(self, sample_time: float) -> LowPass:  # noqa: D102
        lines = 10.0 * self.harmonics if self.force_harmonics is None else self.force_harmonics
        name = "force_harmonics / period"
        return butterworth(lines / self.period, self.order, sample_time, name)

    def edge(self, sample_time: float) -> int:  # noqa: D102
        return _edge(self.margin, sample_time, self.low_pass(sample_time))


def _bilinear(
    name: str, numerator: list[float], omega: float, sample_time: float
) -> tuple[np.ndarray, np.ndarray]:
    r"""Return $(b s + c) / (s / \omega + 1)$ by the bilinear transform, as coefficients."""
    _require_cutoff(name, omega / (2 * math.pi), sample_time)
    b, a = signal.bilinear(numerator, [1 / omega, 1.0], 1 / sample_time)
    return np.asarray(b), np.asarray(a)


def _first_order(name: str, omega: float, sample_time: float) -> LowPass:
    r"""Return $1 / (s / \omega + 1)$, forward and backward."""
    sos = signal.tf2sos(*_bilinear(name, [1.0], omega, sample_time))
    return LowPass(unit_gain_sections(sos), omega / (2 * math.pi))


def first_difference(
    x: Float[np.ndarray, "samples joints"], sample_time: float
) -> Float[np.ndarray, "samples joints"]:
    """Return central differences of fourth order; of second order next to the ends."""
    # At 125 Hz those of second order would lose 1 % of a velocity at 5 Hz.
    d = np.gradient(x, sample_time, axis=0, edge_order=2)
    d[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * sample_time)
    return d


def second_difference(
    x: Float[np.ndarray, "samples joints"], sample_time: float
) -> Float[np.ndarray, "samples joints"]:
    """Return second differences of fourth order; of second next to the ends, constant at them."""
    d = np.empty_like(x)
    d[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / sample_time**2
    inner = 16 * (x[3:-1] + x[1:-3]) - (x[4:] + x[:-4]) - 30 * x[2:-2]
    d[2:-2] = inner / (12 * sample_time**2)
    d[0], d[-1] = d[1], d[-2]
    return d


class AbstractDecimation(eqx.Module):
    """Choice of the samples that become rows, with filters that prevent aliasing."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[int, ...]:
        """Factors, one after the other."""

    @abc.abstractmethod
    def low_pass(self, stage: int) -> LowPass:
        """Return the filter before a stage, at that stage's own rate."""

    def check(self, cutoff: float, sample_time: float) -> None:
        """Refuse a signal of band `cutoff` [Hz] that would be aliased; none is unless told."""

    @property
    def factor(self) -> int:
        """Number of samples for each row."""
        return math.prod(self.stages)

    def __call__(
        self, x: Float[AnyArray, "samples *columns"]
    ) -> Float[np.ndarray, "rows *columns"]:
        """Decimate along the first axis: the first row is that of the first sample."""
        x = np.asarray(x, np.float64)
        for i, factor in enumerate(self.stages):
            x = self.low_pass(i)(x)[::factor]
        return x

    def memory(self) -> int:
        """Return the memory of the filters, in samples before decimation."""
        rates = [math.prod(self.stages[:i]) for i in range(len(self.stages))]
        return sum(rate * self.low_pass(i).memory() for i, rate in enumerate(rates))


class Subsample(AbstractDecimation):
    """Every n-th sample, without a filter: for cut-offs below half of the new rate.

    Attributes:
        step: Number of samples for each row.
    """

    step: int = eqx.field(static=True, converter=integer("step"), default=1)

    def __check_init__(self) -> None:
        if self.step < 1:
            raise InputError(f"`step` must be a whole number from 1 on, but is {self.step}.")

    @property
    def stages(self) -> tuple[int, ...]:  # noqa: D102
        return (self.step,)

    def low_pass(self, stage: int) -> LowPass:  # noqa: D102
        return LowPass((), math.inf)

    def check(self, cutoff: float, sample_time: float) -> None:  # noqa: D102
        rate = 1.0 / (sample_time * self.step)
        if self.step > 1 and cutoff > 0.5 * rate:
            raise InputError(
                f"`Subsample({self.step})` leaves {rate:.6g} Hz, but a cut-off of {cutoff:.6g} Hz "
                f"needs more than {2 * cutoff:.6g} Hz: take one of "
                f"{max(1, math.floor(0.5 / (cutoff * sample_time)))} samples at most, "
                "a lower cut-off, or `Decimation`."
            )


def _factors(values: Iterable[float | int]) -> tuple[int, ...]:
    return tuple(map(integer("factors"), values))


class Decimation(AbstractDecimation):
    """Decimation in stages with a zero-phase low-pass before each: for any filter, or none.

    The low-pass filters are Chebyshev filters of order eight with 0.05 dB ripple at 0.8 of half of
    the new rate, forward and backward, with gain one for constants (where scipy's `decimate` keeps
    the ripple's 0.989).

    Attributes:
        factors: Factors of the stages, 13 or less each.
    """

    factors: tuple[int, ...] = eqx.field(static=True, converter=_factors)

    def __check_init__(self) -> None:
        if not self.factors or min(self.factors) < 1 or max(self.factors) > 13:
            raise InputError(
                f"`factors` must be from 1 to 13 each, but are {self.factors}: take several stages."
            )

    @property
    def stages(self) -> tuple[int, ...]:  # noqa: D102
        return self.factors

    def low_pass(self, stage: int) -> LowPass:  # noqa: D102
        factor = self.factors[stage]
        if factor == 1:
            return LowPass((), math.inf)
        sos = np.asarray(signal.cheby1(8, 0.05, 0.8 / factor, output="sos"), np.float64)
        return LowPass(unit_gain_sections(sos), 0.4 / factor)
