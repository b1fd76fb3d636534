"""Zero-phase low-passes: recursive filters that run forward and backward."""

import math

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix, Vector
from jaxid.errors import InputError

SETTLING_TOLERANCE = 1e-4
"""Fraction of the peak below which an impulse response no longer matters."""
MIN_CLEAR_TAIL = 2e-6
"""Fraction of the peak above which rounding does not hide the impulse response."""
BLOCK_SIZE = 2**22
"""Numbers that are filtered at once."""


class LowPass(eqx.Module):
    """Recursive filter that runs forward and backward, as scipy's `sosfiltfilt`.

    It has no phase, and gain one for constants.

    Attributes:
        sections: Second-order sections of one direction, as in scipy; without any,
            everything passes.
        cutoff: Frequency at which the gain of both directions falls below 1/2 [Hz];
            infinite if everything passes.
    """

    sections: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())
    cutoff: float = eqx.field(static=True, default=math.inf)

    @classmethod
    def of(cls, sos: Matrix, cutoff: float) -> "LowPass":
        """Return second-order sections as a filter whose gain for constants is one."""
        numerators = sos[:, :3].sum(axis=1)
        denominators = sos[:, 3:].sum(axis=1)
        sos = sos.copy()
        sos[0, :3] /= np.prod(numerators / denominators)
        return cls(tuple(tuple(row) for row in sos.tolist()), cutoff)

    def __call__(self, x: Float[AnyArray, "samples *columns"]) -> np.ndarray:
        """Filter along the first axis, in double precision."""
        x = np.asarray(x, np.float64)
        if x.size == 0 or not self.sections:
            return x
        sos = np.array(self.sections)
        taps = 2 * len(sos) + 1
        padding = min(3 * taps, len(x) - 1)  # as scipy's
        columns = x.reshape(len(x), -1)
        # By blocks of columns, which keep scipy's copies small.
        result = np.empty_like(columns)
        width = max(1, BLOCK_SIZE // len(columns))
        for start in range(0, columns.shape[1], width):
            block = slice(start, start + width)
            rows = np.ascontiguousarray(columns[:, block].T)
            smooth_rows = scipy.signal.sosfiltfilt(
                sos, rows, padtype="odd", padlen=padding
            )
            result[:, block] = smooth_rows.T
        return result.reshape(x.shape)

    def gain(self, frequency: Float[AnyArray, " lines"], sample_time: float) -> Vector:
        """Return the size of the gain for sinusoids of some frequencies [Hz]."""
        if not self.sections:
            return np.ones(np.shape(frequency))
        angular_frequency = 2 * math.pi * np.asarray(frequency) * sample_time
        _, response = scipy.signal.sosfreqz(np.array(self.sections), angular_frequency)
        return np.abs(response) ** 2

    def memory(self, tolerance: float = 1e-14) -> int:
        """Return the number of samples until the impulse response has decayed.

        From there on it stays below a fraction of its peak.
        """
        if not self.sections:
            return 0
        sos = np.array(self.sections)
        poles = np.concatenate([np.roots(denominator) for denominator in sos[:, 3:]])
        radius = np.abs(poles).max(initial=0.0)
        if radius == 0:
            return 2 * len(sos)
        clear_tail = max(tolerance, MIN_CLEAR_TAIL)
        memory = _impulse_memory(sos, radius, clear_tail)
        if tolerance < clear_tail:
            # Rounding hides smaller tails, which decay like the slowest pole. The
            # margin is for poles of that radius that are multiple.
            decay = math.log(tolerance / clear_tail) / math.log(radius)
            memory += math.ceil(1.1 * decay)
        return memory


def _impulse_memory(sos: Matrix, radius: float, tolerance: float) -> int:
    """Return the samples after which the impulse response stays below a tolerance.

    The slowest pole's radius tells how long the response must be simulated.
    """
    duration = math.log(1e-3 * tolerance) / math.log(radius)
    start_samples = 4 * len(sos)
    samples = math.ceil(duration) + start_samples
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    forward_response = scipy.signal.sosfilt(sos, impulse)
    response = scipy.signal.correlate(forward_response, forward_response, method="fft")
    tail = np.abs(response[samples - 1 :])
    is_clear = tail > tolerance * tail[0]
    last_sample = np.flatnonzero(is_clear)[-1]
    return int(last_sample) + 1


def butterworth(
    cutoff: float, order: int, sample_time: float, name: str = "cutoff"
) -> LowPass:
    """Return a Butterworth filter for forward and backward runs.

    `cutoff` [Hz] is scipy's.
    """
    if math.isinf(cutoff):
        return LowPass()
    require_cutoff(name, cutoff, sample_time)
    sos = scipy.signal.butter(order, cutoff, output="sos", fs=1.0 / sample_time)
    return LowPass.of(np.asarray(sos, np.float64), cutoff)


def require_cutoff(name: str, cutoff: float, sample_time: float) -> None:
    """Refuse a cut-off [Hz] that does not suit the sampling rate."""
    rate = 1 / sample_time
    if not 1e-5 * rate <= cutoff < 0.5 * rate:
        raise InputError(
            f"`{name}` of {cutoff:.6g} Hz must be below half of the sampling rate of "
            f"{rate:.6g} Hz (and above 1e-5 of it): lower it, or take only logs "
            f"faster than {2 * cutoff:.6g} Hz; if this one is, check `time_unit`."
        )
