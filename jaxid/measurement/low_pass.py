"""Zero-phase low-pass filters along the samples, for any number of columns."""

import math

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

BLOCK = 2**22
"""Numbers that are filtered at once: what scipy copies stays small."""

SLOWEST, FASTEST = 10.0, 1e6
"""Samples in a second outside of which the unit of the time is wrong or doubtful [Hz]."""
HASTY = 2e4
"""Samples in a second above which a filter that does not suit the log hints at a wrong unit."""
LOWEST = 1e-5
"""Cut-offs over the sampling rate below which no log is long enough for a filter to settle."""
Sections = tuple[tuple[float, ...], ...]


class LowPass(eqx.Module):
    """A recursive filter that runs forward and backward: no phase, gain one for constants.

    Attributes:
        sections: Second-order sections of one direction, as in scipy; none: everything passes.
        cutoff: Frequency at which the gain of both directions falls below 1/2 [Hz].
    """

    sections: Sections = eqx.field(static=True)
    cutoff: float = eqx.field(static=True)

    def __call__(
        self, x: Float[AnyArray, "samples *columns"]
    ) -> Float[np.ndarray, "samples *columns"]:
        """Filters along the first axis, by blocks of columns."""
        x = np.asarray(x, np.float64)
        if not self.sections or x.size == 0:
            return x
        sos = np.array(self.sections)
        flat = x.reshape(len(x), -1)
        padding = min(3 * (2 * len(sos) + 1), len(x) - 1)
        out = np.empty_like(flat)
        width = max(1, BLOCK // len(flat))
        for start in range(0, flat.shape[1], width):
            block = np.ascontiguousarray(flat[:, start : start + width].T)
            block = signal.sosfiltfilt(sos, block, axis=1, padtype="odd", padlen=padding)
            out[:, start : start + width] = block.T
        return out.reshape(x.shape)

    def gain(self, frequency: Float[AnyArray, " lines"], sample_time: float) -> np.ndarray:
        """Factor by which sinusoids of some frequencies [Hz] pass."""
        if not self.sections:
            return np.ones_like(frequency)
        sos = np.array(self.sections)
        points = np.exp(-2j * math.pi * np.asarray(frequency) * sample_time)
        one_way = np.prod(
            [np.polyval(s[2::-1], points) / np.polyval(s[:2:-1], points) for s in sos], axis=0
        )
        return np.abs(one_way) ** 2

    def memory(self, tolerance: float = 1e-14) -> int:
        """Samples after which the impulse response stays below `tolerance` of its peak."""
        return memory(self.sections, tolerance)


def memory(sections: Sections, tolerance: float) -> int:
    """Samples after which the two-way impulse response stays below `tolerance` of its peak."""
    if not sections:
        return 0
    sos = np.array(sections)
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
    near = memory(sections, 2e-6)
    return near + math.ceil(1.1 * math.log(tolerance / 2e-6) / math.log(slowest))


def butterworth(cutoff: float, order: int, sample_time: float, name: str = "cutoff") -> LowPass:
    """A Butterworth filter, run forward and backward; `cutoff` [Hz] as scipy counts it, one way.

    Raises:
        InputError: If the cut-off, which is called `name`, does not suit the sampling rate.
    """
    if math.isinf(cutoff):
        return LowPass((), math.inf)
    refuse_above_nyquist(name, cutoff, sample_time)
    refuse_unsettled(name, cutoff, sample_time)
    sos = signal.butter(order, cutoff, output="sos", fs=1.0 / sample_time)
    return LowPass(as_sections(np.asarray(sos, np.float64)), cutoff)


def first_order(omega: float, sample_time: float) -> LowPass:
    r"""$1 / (s / \omega + 1)$, forward and backward, by the bilinear transform."""
    return LowPass(as_sections(signal.tf2sos(*lag(omega, sample_time))), omega / (2 * math.pi))


def lag(omega: float, sample_time: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Numerator and denominator of $1 / (s / \omega + 1)$ by the bilinear transform."""
    half = 0.5 * omega * sample_time
    return np.array([half, half]) / (1 + half), np.array([1.0, (half - 1) / (half + 1)])


def as_sections(sos: np.ndarray) -> Sections:
    """Second-order sections with gain one for constants, hashable."""
    gain = np.prod(sos[:, :3].sum(axis=1) / sos[:, 3:].sum(axis=1))
    sos = sos.copy()
    sos[0, :3] /= gain
    return tuple(tuple(float(c) for c in row) for row in sos)


def refuse_above_nyquist(name: str, cutoff: float, sample_time: float) -> None:
    """Raises ValueError unless `cutoff` [Hz] can be told apart at this sampling rate."""
    rate = 1 / sample_time
    if rate > FASTEST:
        raise InputError(
            f"the log has {rate:.3g} samples in a second, as no robot's has: check the unit of its "
            "time, or `sample_time`."
        )
    if cutoff >= 0.5 * rate:
        slow = " Few robots log so slowly: check `time_unit`, or `sample_time`."
        raise InputError(
            f"`{name}` of {cutoff:.6g} Hz must be below half of the sampling rate of "
            f"{rate:.6g} Hz: take a lower one, or log faster than {2 * cutoff:.6g} Hz."
            f"{slow if rate <= SLOWEST else ''}"
        )


def refuse_unsettled(name: str, cutoff: float, sample_time: float) -> None:
    """Raises ValueError if a filter with this `cutoff` [Hz] would settle in no log."""
    lowest = LOWEST / sample_time
    if cutoff < lowest:
        raise InputError(
            f"`{name}` of {cutoff:.6g} Hz is too low for a sampling rate of {1 / sample_time:.6g} "
            f"Hz, since no log is long enough for such a filter to settle: take one above "
            f"{lowest:.2g} Hz (about five times the highest frequency of the motion)."
            f"{said_hasty(sample_time)}"
        )


def said_hasty(sample_time: float) -> str:
    """A hint at a wrong unit of time, where a log is too short for its filter."""
    rate = 1 / sample_time
    if rate <= HASTY:
        return ""
    return (
        f" The log has {rate:.3g} samples in a second, as few robots' have: check `time_unit`, or "
        "`sample_time`."
    )
