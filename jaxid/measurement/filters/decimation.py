"""Ways to thin out rows: with a low-pass before it, or without."""

import abc
import math
from collections.abc import Iterable

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

from .filter import integer
from .low_pass import LowPass

MAX_FACTOR = 13
"""Largest factor of a stage: the poles of its low-pass are still exact enough."""


Factors = tuple[int, ...]
"""Factors of the stages, one after the other."""


class AbstractDecimation(eqx.Module):
    """Choice of the samples that become rows, with filters that prevent aliasing."""

    @property
    @abc.abstractmethod
    def stages(self) -> Factors:
        """Factors, one after the other."""

    @abc.abstractmethod
    def low_pass(self, stage: int) -> LowPass:
        """Return the filter before a stage, at that stage's own rate."""

    def check(self, cutoff: float, sample_time: float) -> None:
        """Refuse a signal of band `cutoff` [Hz] that would be aliased.

        By default none is refused.
        """

    @property
    def factor(self) -> int:
        """Number of samples for each row."""
        return math.prod(self.stages)

    def __call__(self, x: Float[AnyArray, "samples *columns"]) -> np.ndarray:
        """Decimate along the first axis: the first row is that of the first sample."""
        x = np.asarray(x, np.float64)
        for i, factor in enumerate(self.stages):
            x = self.low_pass(i)(x)[::factor]
        return x

    def memory(self) -> int:
        """Return the memory of the filters, in samples before decimation."""
        samples = 0
        sample_factor = 1
        for i, factor in enumerate(self.stages):
            samples += sample_factor * self.low_pass(i).memory()
            sample_factor *= factor
        return samples


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
    def stages(self):  # noqa: D102
        return (self.step,)

    def low_pass(self, stage):  # noqa: D102
        return LowPass()

    def check(self, cutoff, sample_time):  # noqa: D102
        rate = 1.0 / (sample_time * self.step)
        if self.step == 1 or cutoff <= 0.5 * rate:
            return
        max_step = max(1, math.floor(0.5 / (cutoff * sample_time)))
        raise InputError(
            f"`Subsample({self.step})` leaves {rate:.6g} Hz, but a cut-off of "
            f"{cutoff:.6g} Hz needs more than {2 * cutoff:.6g} Hz: use a step of at "
            f"most {max_step} samples, a lower cut-off, or `Decimation`."
        )


def _whole_factors(values: Iterable[float | int]) -> Factors:
    return tuple(map(integer("factors"), values))


class Decimation(AbstractDecimation):
    """Decimation in stages, each behind a zero-phase low-pass, for any filter or none.

    The low-pass filters are Chebyshev filters of order eight with 0.05 dB ripple at 0.8
    of half of the new rate, forward and backward, with gain one for constants (where
    scipy's `decimate` keeps the ripple's 0.989).

    Attributes:
        factors: Factors of the stages, 13 or less each.
    """

    factors: Factors = eqx.field(static=True, converter=_whole_factors)

    def __check_init__(self) -> None:
        is_valid = all(1 <= factor <= MAX_FACTOR for factor in self.factors)
        if not self.factors or not is_valid:
            raise InputError(
                f"`factors` must be from 1 to {MAX_FACTOR} each, but are "
                f"{self.factors}: use several stages."
            )

    @property
    def stages(self):  # noqa: D102
        return self.factors

    def low_pass(self, stage):  # noqa: D102
        factor = self.factors[stage]
        if factor == 1:
            return LowPass()
        sos = scipy.signal.cheby1(8, 0.05, 0.8 / factor, output="sos")
        return LowPass.of(np.asarray(sos, np.float64), 0.4 / factor)
