"""Filters and decimation as matrix products: their impulse responses, stage by stage."""

import dataclasses
import math

import numpy as np
from scipy import signal

from jaxid.arrays import Float
from jaxid.measurement.decimation import AbstractDecimation
from jaxid.measurement.filters import AbstractFilter, LowPass


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """A filter without phase of which every n-th result is kept.

    Attributes:
        response: Of the filter to an impulse in its middle; of odd length.
        factor: The n.
    """

    response: Float[np.ndarray, " lags"]
    factor: int

    @property
    def half(self) -> int:
        """Samples before, and after, the middle of the response."""
        return len(self.response) // 2

    def matrix(self, rows: int) -> Float[np.ndarray, "rows samples"]:
        """What leads from consecutive samples to some rows."""
        lags = len(self.response)
        H = np.zeros((rows, (rows - 1) * self.factor + lags))
        for i in range(rows):
            H[i, i * self.factor : i * self.factor + lags] = self.response
        return H


def stages(
    filter: AbstractFilter, decimation: AbstractDecimation, sample_time: float
) -> tuple[Stage, ...]:
    """The filter and all stages of decimation; the filter is part of the first stage.

    Stages that change nothing are left out.

    Args:
        filter: Of forces and columns.
        decimation: Of forces and columns.
        sample_time: Time between two samples [s].
    """
    before, found = response(filter.low_pass(sample_time)), []
    for k, factor in enumerate(decimation.stages):
        whole = np.convolve(before, response(decimation.low_pass(k)))
        if factor > 1 or len(whole) > 1:
            found.append(Stage(whole, factor))
        before = np.ones(1)
    return tuple(found)


def response(low_pass: LowPass) -> Float[np.ndarray, " lags"]:
    """The response to an impulse in the middle, until it has faded on both sides."""
    if not low_pass.sections:
        return np.ones(1)
    half = low_pass.memory()
    sos = np.array(low_pass.sections)
    impulse = np.zeros(2 * half + 1)
    impulse[0] = 1.0
    backward = signal.sosfilt(sos, impulse)[::-1]
    two_way = signal.sosfilt(sos, np.concatenate([backward, np.zeros(half)]))
    # The tail that the first pass cut off has faded: the middle of the response is symmetric.
    right = two_way[2 * half :]
    return np.concatenate([right[:0:-1], right])


def centre(chain: tuple[Stage, ...]) -> int:
    """Samples before, and after, a row's instant that the row depends on."""
    rates = [math.prod(s.factor for s in chain[:i]) for i in range(len(chain))]
    return sum(rate * stage.half for rate, stage in zip(rates, chain, strict=True))
