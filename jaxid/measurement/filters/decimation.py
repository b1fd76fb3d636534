"""Decimation of filtered forces and columns."""

import abc
import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

from .filter import LowPass, integer, unit_gain_sections


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
