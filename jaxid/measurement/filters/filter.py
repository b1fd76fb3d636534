"""The two sides that every filter has, the checks of its settings, and the rows.

A regressor's columns are not band-limited (friction has edges), so the columns must be
filtered like the forces, or parameters that are coupled with friction are biased. Hence
a filter has two sides that belong together: `motion` for the angles, `smooth` for
forces and columns.
"""

import abc
import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, JointSamples
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

from .low_pass import SETTLING_TOLERANCE, LowPass

DIFFERENCE_SAMPLES = 2
"""Samples on each side that differences of fourth order need."""
MOTION_TAIL = 1e-17
"""Tail of an impulse response that is left out; accelerations magnify it most."""


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
        angles: JointSamples,
        velocities: JointSamples | None,
        sample_time: float,
    ) -> Motion:
        """Return the motion at all samples of a segment.

        `velocities` are None if they were not measured.
        """

    @abc.abstractmethod
    def low_pass(self, sample_time: float) -> LowPass:
        """Return the zero-phase filter of forces and columns."""

    def edge(self, sample_time: float) -> int:
        """Return the number of samples to drop at both ends, where filters settle.

        By default they are those of the filter of forces and columns.
        """
        return self.low_pass(sample_time).memory(SETTLING_TOLERANCE)

    def memory(self, sample_time: float) -> int | None:
        """Return for how many samples the motion depends on an angle or velocity.

        None if it depends on all samples of a segment, which then must be in memory.
        By default it is the memory of the filter of forces and columns, and the two
        samples that differences need.
        """
        return self.low_pass(sample_time).memory(MOTION_TAIL) + DIFFERENCE_SAMPLES

    def smooth(
        self, x: Float[AnyArray, "samples *columns"], sample_time: float
    ) -> np.ndarray:
        """Filter forces or columns of one segment.

        The filter is linear and has no phase; it leaves constants unchanged.
        """
        return self.low_pass(sample_time)(x)


def integer(name: str) -> Callable[[float | int], int]:
    """Return a converter that accepts integers only, as `int` or `float`."""

    def convert(value: float | int) -> int:
        if not float(value).is_integer():
            raise InputError(f"`{name}` must be a whole number, but is {value:g}.")
        return int(value)

    return convert


def require_positive(filter: AbstractFilter, *names: str) -> None:
    """Refuse settings that are not positive; None is allowed."""
    for name in names:
        require(filter, name, lambda x: x > 0, "positive")


def require_order(filter: AbstractFilter) -> None:
    """Refuse an order that no filter has in practice."""
    require(
        filter, "order", lambda x: 1 <= x <= 20, "between 1 and 20 (2 to 8 are usual)"
    )


def require(
    filter: AbstractFilter, name: str, is_valid: Callable[[float], bool], words: str
) -> None:
    """Refuse a setting that is neither None nor valid."""
    value = getattr(filter, name)
    if value is not None and not is_valid(value):
        owner = type(filter).__name__
        raise InputError(f"`{name}` of `{owner}` must be {words}, but is {value:g}.")


class Subsample(eqx.Module):
    """Every n-th sample becomes a row; the filter must leave less than half that rate.

    Attributes:
        step: Number of samples for each row.
    """

    step: int = eqx.field(static=True, converter=integer("step"), default=1)

    def __check_init__(self) -> None:
        if self.step < 1:
            raise InputError(
                f"`step` must be a whole number from 1 on, but is {self.step}."
            )

    def check(self, cutoff: float, sample_time: float) -> None:
        """Refuse a signal of band `cutoff` [Hz] that would be aliased."""
        rate = 1.0 / (sample_time * self.step)
        if self.step == 1 or cutoff <= 0.5 * rate:
            return
        max_step = max(1, math.floor(0.5 / (cutoff * sample_time)))
        raise InputError(
            f"`Subsample({self.step})` leaves {rate:.6g} Hz, but a cut-off of "
            f"{cutoff:.6g} Hz needs more than {2 * cutoff:.6g} Hz: use a step of at "
            f"most {max_step} samples, or a lower `force_cutoff`."
        )


EVERY_SAMPLE = Subsample()
"""No sample is left out."""
