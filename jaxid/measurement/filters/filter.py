"""The two sides that every filter has, recursive low-passes, and decimation.

A regressor's columns are not band-limited (friction has edges), so the columns must be
filtered like the forces, or parameters that are coupled with friction are biased. Hence
a filter has two sides that belong together: `motion` for the angles, `smooth` for
forces and columns.
"""

import abc
import math
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

SETTLED = 1e-4
"""Fraction of the impulse response's peak below which the start of a log no longer matters."""


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
        sections: Second-order sections of one direction, as in scipy; everything passes
            if empty.
        cutoff: Frequency at which the gain of both directions falls below 1/2 [Hz].
    """

    sections: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    cutoff: float = eqx.field(static=True)

    def __call__(self, x: Float[AnyArray, "samples *columns"]) -> Any:
        """Filter along the first axis, by blocks of columns that keep scipy's copies small.

        Arrays of JAX stay such, and can be differentiated.
        """
        x = x if isinstance(x, jax.Array) else np.asarray(x, np.float64)
        if not self.sections or x.size == 0:
            return x
        sos = np.array(self.sections)
        flat = x.reshape(len(x), -1)
        padding = min(3 * (2 * len(sos) + 1), len(x) - 1)
        if isinstance(flat, jax.Array):
            return _filter_both_ways(sos, flat, padding).reshape(x.shape)
        out = np.empty_like(flat)
        width = max(1, 2**22 // len(flat))
        for start in range(0, flat.shape[1], width):
            block = np.ascontiguousarray(flat[:, start : start + width].T)
            block = signal.sosfiltfilt(
                sos, block, axis=1, padtype="odd", padlen=padding
            )
            out[:, start : start + width] = block.T
        return out.reshape(x.shape)

    def gain(
        self, frequency: Float[AnyArray, " lines"], sample_time: float
    ) -> np.ndarray:
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
            samples = math.ceil(
                math.log(1e-3 * tolerance) / math.log(slowest)
            ) + 4 * len(sos)
            impulse = np.zeros(samples)
            impulse[0] = 1.0
            one_way = signal.sosfilt(sos, impulse)
            two_way = np.abs(signal.correlate(one_way, one_way, method="fft"))[
                samples - 1 :
            ]
            return int(np.flatnonzero(two_way > tolerance * two_way[0])[-1]) + 1
        # Rounding hides smaller tails: continue the slowest pole (multiplied by the
        # time it lasts).
        near = self.memory(2e-6)
        return near + math.ceil(1.1 * math.log(tolerance / 2e-6) / math.log(slowest))


def _filter_both_ways(sos: np.ndarray, x: Array, padding: int) -> Array:
    """Filter forward and backward with odd extensions, as `scipy.signal.sosfiltfilt` does."""
    before = 2 * x[:1] - x[padding:0:-1]
    after = 2 * x[-1:] - x[-2 : -2 - padding : -1]
    extended = jnp.concatenate([before, x, after])
    steady = signal.sosfilt_zi(sos)

    def step(
        state: list[tuple[Array, Array]], x: Array
    ) -> tuple[list[tuple[Array, Array]], Array]:
        following = []
        for (b0, b1, b2, _, a1, a2), (first, second) in zip(sos, state, strict=True):
            y = b0 * x + first
            following.append((b1 * x - a1 * y + second, b2 * x - a2 * y))
            x = y
        return following, x

    def one_way(x: Array, reverse: bool) -> Array:
        first = x[-1 if reverse else 0]
        state = [(low * first, high * first) for low, high in steady]
        return jax.lax.scan(step, state, x, reverse=reverse, unroll=4)[1]

    return one_way(one_way(extended, False), True)[padding : padding + len(x)]


def butterworth(
    cutoff: float, order: int, sample_time: float, name: str = "cutoff"
) -> LowPass:
    """Return a Butterworth filter, to be run forward and backward; `cutoff` [Hz] is scipy's."""
    if math.isinf(cutoff):
        return LowPass((), math.inf)
    require_cutoff(name, cutoff, sample_time)
    sos = signal.butter(order, cutoff, output="sos", fs=1.0 / sample_time)
    return LowPass(unit_gain_sections(np.asarray(sos, np.float64)), cutoff)


def unit_gain_sections(sos: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return second-order sections scaled to gain one for constants, hashable."""
    gain = np.prod(sos[:, :3].sum(axis=1) / sos[:, 3:].sum(axis=1))
    sos = sos.copy()
    sos[0, :3] /= gain
    return tuple(tuple(float(c) for c in row) for row in sos)


def require_cutoff(name: str, cutoff: float, sample_time: float) -> None:
    """Refuse a cut-off [Hz] that does not suit the sampling rate."""
    rate = 1 / sample_time
    if not 1e-5 * rate <= cutoff < 0.5 * rate:
        raise InputError(
            f"`{name}` of {cutoff:.6g} Hz must be below half of the sampling rate of "
            f"{rate:.6g} Hz "
            f"(and above 1e-5 of it): log faster than {2 * cutoff:.6g} Hz, or check "
            "`time_unit`."
        )


class AbstractFilter(eqx.Module):
    """Filter of a log: motion from the angles, and the band of forces and columns.

    Attributes:
        uses_velocities: Whether measured velocities, if there are any, enter the
            motion.
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

    def smooth(self, x: Float[AnyArray, "samples *columns"], sample_time: float) -> Any:
        """Filter forces or columns of one segment: linear, without phase, constants unchanged."""
        return self.low_pass(sample_time)(x)


def check_settings(filter: AbstractFilter, *positive: str) -> None:
    """Check the settings that filters share, and that others are positive."""
    owner = type(filter).__name__
    rules: dict[str, tuple[Callable[[float], bool], str]]
    rules = dict.fromkeys(positive, (lambda x: x > 0, "positive"))
    rules["order"] = lambda x: 0 < x <= 20, "between 1 and 20 (2 to 8 are usual)"
    rules["margin"] = lambda x: 0 <= x < math.inf, "a time [s] of zero or more"
    for name, (rule, words) in rules.items():
        value = getattr(filter, name, None)
        if value is not None and not rule(value):
            raise InputError(
                f"`{name}` of `{owner}` must be {words}, but is {value:g}."
            )


def settled_edge(margin: float | None, sample_time: float, *filters: LowPass) -> int:
    """Return the samples to drop at both ends: those within `margin` [s], or until all settle."""
    if margin is None:
        return max(f.memory(SETTLED) for f in filters)
    return round(margin / sample_time)


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

    def __call__(self, x: Float[AnyArray, "samples *columns"]) -> Any:
        """Decimate along the first axis: the first row is that of the first sample."""
        x = x if isinstance(x, jax.Array) else np.asarray(x, np.float64)
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
            raise InputError(
                f"`step` must be a whole number from 1 on, but is {self.step}."
            )

    @property
    def stages(self) -> tuple[int, ...]:  # noqa: D102
        return (self.step,)

    def low_pass(self, stage: int) -> LowPass:  # noqa: D102
        return LowPass((), math.inf)

    def check(self, cutoff: float, sample_time: float) -> None:  # noqa: D102
        rate = 1.0 / (sample_time * self.step)
        if self.step > 1 and cutoff > 0.5 * rate:
            raise InputError(
                f"`Subsample({self.step})` leaves {rate:.6g} Hz, but a cut-off of "
                f"{cutoff:.6g} Hz "
                f"needs more than {2 * cutoff:.6g} Hz: take one of "
                f"{max(1, math.floor(0.5 / (cutoff * sample_time)))} samples at most, "
                "a lower cut-off, or `Decimation`."
            )


def _factors(values: Iterable[float | int]) -> tuple[int, ...]:
    return tuple(map(integer("factors"), values))


class Decimation(AbstractDecimation):
    """Decimation in stages with a zero-phase low-pass before each: for any filter, or none.

    The low-pass filters are Chebyshev filters of order eight with 0.05 dB ripple at 0.8
    of half of the new rate, forward and backward, with gain one for constants (where
    scipy's `decimate` keeps the ripple's 0.989).

    Attributes:
        factors: Factors of the stages, 13 or less each.
    """

    factors: tuple[int, ...] = eqx.field(static=True, converter=_factors)

    def __check_init__(self) -> None:
        if not self.factors or min(self.factors) < 1 or max(self.factors) > 13:
            raise InputError(
                f"`factors` must be from 1 to 13 each, but are {self.factors}: take "
                "several stages."
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
