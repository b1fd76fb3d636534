"""Decimation: fewer rows, of forces and columns alike."""

import abc
import math
from collections.abc import Iterable

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.measurement.low_pass import LowPass, as_sections
from jaxid.measurement.whole import whole


class AbstractDecimation(eqx.Module):
    """Which samples become rows, and what keeps their band below half of the new rate."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[int, ...]:
        """Factors, one after the other."""

    @abc.abstractmethod
    def low_pass(self, stage: int) -> LowPass:
        """The filter before a stage, at that stage's own rate."""

    @abc.abstractmethod
    def check(self, cutoff: float, sample_time: float) -> None:
        """Raises ValueError if a signal of band `cutoff` [Hz] would be aliased."""

    @property
    def factor(self) -> int:
        """Samples for each row."""
        return math.prod(self.stages)

    def __call__(
        self, x: Float[AnyArray, "samples *columns"]
    ) -> Float[np.ndarray, "rows *columns"]:
        """Decimates along the first axis: the first row is that of the first sample."""
        x = np.asarray(x, np.float64)
        for i, factor in enumerate(self.stages):
            x = self.low_pass(i)(x)[::factor]
        return x

    def memory(self) -> int:
        """Samples (before decimation) after which the filters have forgotten."""
        rates = [math.prod(self.stages[:i]) for i in range(len(self.stages))]
        return sum(rate * self.low_pass(i).memory() for i, rate in enumerate(rates))


class Subsample(AbstractDecimation):
    """Takes every n-th sample: for filters whose cut-off lies below half of the new rate.

    Attributes:
        step: Number of samples for each row.
    """

    step: int = eqx.field(static=True, converter=whole("step"), default=1)

    def __check_init__(self) -> None:
        _refuse_factors("step", (self.step,))

    @property
    def stages(self) -> tuple[int, ...]:  # noqa: D102
        return (self.step,)

    def low_pass(self, stage: int) -> LowPass:  # noqa: D102
        return LowPass((), math.inf)

    def check(self, cutoff: float, sample_time: float) -> None:  # noqa: D102
        rate = 1.0 / (sample_time * self.step)
        if self.step > 1 and cutoff > 0.5 * rate:
            raise InputError(
                f"`Subsample({self.step})` leaves {rate:.6g} Hz, but the filter lets forces and "
                f"columns pass up to {cutoff:.6g} Hz, which must be below half of that: take "
                f"one of {max(1, math.floor(0.5 / (cutoff * sample_time)))} samples at most, a "
                "lower cut-off, or `Decimation`."
            )


def _factors(values: Iterable[float | int]) -> tuple[int, ...]:
    return tuple(map(whole("factors"), values))


class Decimation(AbstractDecimation):
    """Low-pass filters without phase before every stage: for any filter, or none.

    Chebyshev filters of order eight with 0.05 dB ripple at 0.8 of half of the new rate, forward and
    backward, with gain one for constants (where scipy's `decimate` keeps the ripple's 0.989).

    Attributes:
        factors: Of the stages; each should be 13 or less.
    """

    factors: tuple[int, ...] = eqx.field(static=True, converter=_factors)

    def __check_init__(self) -> None:
        _refuse_factors("factors", self.factors)

    @property
    def stages(self) -> tuple[int, ...]:  # noqa: D102
        return self.factors

    def low_pass(self, stage: int) -> LowPass:  # noqa: D102
        factor = self.factors[stage]
        if factor == 1:
            return LowPass((), math.inf)
        sos = np.asarray(signal.cheby1(8, 0.05, 0.8 / factor, output="sos"), np.float64)
        return LowPass(as_sections(sos), 0.4 / factor)

    def check(self, cutoff: float, sample_time: float) -> None:
        """Never refuses: it brings its own filters."""


def _refuse_factors(name: str, factors: tuple[int, ...]) -> None:
    if not factors or any(f < 1 for f in factors):
        raise InputError(f"`{name}` must be whole numbers from 1 on, but is {factors}.")
    if any(f > 13 for f in factors) and name == "factors":
        raise InputError(
            f"`factors` must be 13 or less each, or the filters lose their accuracy, but are "
            f"{factors}: decimate in several stages."
        )
