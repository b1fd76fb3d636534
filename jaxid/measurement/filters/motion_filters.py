"""Filters that find angles, velocities and accelerations from measured angles."""

import math
from typing import ClassVar

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Matrix, Vector, optional
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

from .filter import (
    DIFFERENCE_SAMPLES,
    MOTION_TAIL,
    AbstractFilter,
    integer,
    require,
    require_order,
    require_positive,
)
from .low_pass import (
    SETTLING_TOLERANCE,
    LowPass,
    butterworth,
    require_cutoff,
)

MAX_SERIES_ERROR = 0.05
"""Largest error of a Fourier series, relative to the motion (RMS)."""
FORCE_BAND = 10
"""Cut-off of the forces of a periodic motion, over its highest harmonic."""
FORCE_ORDER = 4
"""Order of that filter, of one direction."""


class ZeroPhaseButterworth(AbstractFilter):
    """Butterworth low-pass, forward and backward, then fourth-order differences.

    The differences are central ones. Measured velocities, if there are any, are
    filtered like the angles and differentiated once; otherwise the angles are
    differentiated twice. With an infinite `cutoff` nothing is filtered.

    Attributes:
        cutoff: Cut-off of angles and velocities for one of the two passes, as in scipy
            [Hz], like `10.0`.
        order: Order of one pass.
        force_cutoff: Cut-off of forces and columns [Hz], like `20.0`; `cutoff` if None;
            infinite for none.
        margin: Time to drop at both ends of a segment [s], like `0.1`; until the filter
            has settled if None.
    """

    cutoff: float = eqx.field(static=True, converter=float)
    order: int = eqx.field(static=True, converter=integer("order"), default=4)
    force_cutoff: float | None = eqx.field(
        static=True, converter=optional, default=None
    )
    margin: float | None = eqx.field(static=True, converter=optional, default=None)

    def __check_init__(self) -> None:
        require_positive(self, "cutoff", "force_cutoff")
        require_order(self)
        words = "a time [s] of zero or more"
        require(self, "margin", lambda x: 0 <= x < math.inf, words)

    def motion(self, angles, velocities, sample_time):  # noqa: D102
        low_pass = butterworth(self.cutoff, self.order, sample_time)
        # From the first sample on, so that a joint at rest stays exactly at rest.
        path = low_pass(angles - angles[0])
        q = angles[0] + path
        if velocities is None:
            qd = first_difference(path, sample_time)
            qdd = second_difference(path, sample_time)
            return Motion(q, qd, qdd)
        change = low_pass(velocities - velocities[0])
        qd = velocities[0] + change
        return Motion(q, qd, first_difference(change, sample_time))

    def low_pass(self, sample_time):  # noqa: D102
        if self.force_cutoff is None:
            return butterworth(self.cutoff, self.order, sample_time)
        return butterworth(self.force_cutoff, self.order, sample_time, "force_cutoff")

    def memory(self, sample_time):  # noqa: D102
        low_pass = butterworth(self.cutoff, self.order, sample_time)
        return low_pass.memory(MOTION_TAIL) + DIFFERENCE_SAMPLES

    def edge(self, sample_time):  # noqa: D102
        if self.margin is not None:
            return round(self.margin / sample_time)
        motion = butterworth(self.cutoff, self.order, sample_time)
        return max(motion.memory(SETTLING_TOLERANCE), super().edge(sample_time))


class PaperFilter(AbstractFilter):
    r"""The paper's differentiating filter $G(s) = s / (s / \omega_f + 1)$ (Eq. 25).

    Velocities are $G q$ with the cut-off `velocity`: causal, so they lag by about
    $1/\omega_f$. Accelerations are filtered forward and backward with the cut-off
    `acceleration`; since $G(s) G(-s) = -s^2 / (1 - s^2 / \omega_f^2)$, the result on
    $q$ is *minus* the acceleration and its sign is changed. Forces and columns are
    filtered by the low-pass $1 / (s / \omega_f + 1)$ forward and backward with the
    cut-off `acceleration`, since the paper is silent about them. Angles stay as
    measured, and measured velocities are not used.

    The paper does not say how $G$ was made discrete. Here it is the bilinear transform:
    its delay is the analogue filter's at every sampling rate (backward differences add
    half a sample), it is stable, and below half of the sampling rate it does not ring.

    Attributes:
        velocity: Cut-off of the velocities [rad/s].
        acceleration: Cut-off of accelerations, forces and columns [rad/s].
    """

    uses_velocities: ClassVar[bool] = False
    velocity: float = eqx.field(static=True, converter=float, default=1200.0)
    acceleration: float = eqx.field(static=True, converter=float, default=100.0)

    def __check_init__(self) -> None:
        require_positive(self, "velocity", "acceleration")

    def motion(self, angles, velocities, sample_time):  # noqa: D102
        path = angles - angles[0]
        b, a = _bilinear("velocity", [1.0, 0.0], self.velocity, sample_time)
        qd = np.asarray(scipy.signal.lfilter(b, a, path, axis=0))
        b, a = _bilinear("acceleration", [1.0, 0.0], self.acceleration, sample_time)
        padding = min(
            len(angles) - 1, self.low_pass(sample_time).memory(SETTLING_TOLERANCE)
        )
        negative_acceleration = scipy.signal.filtfilt(
            b, a, path, axis=0, padtype="odd", padlen=padding
        )
        return Motion(angles, qd, -negative_acceleration)

    def low_pass(self, sample_time):  # noqa: D102
        return _first_order("acceleration", self.acceleration, sample_time)

    def memory(self, sample_time):  # noqa: D102
        velocities = _first_order("velocity", self.velocity, sample_time)
        accelerations = self.low_pass(sample_time)
        return max(x.memory(MOTION_TAIL) for x in (velocities, accelerations))

    def edge(self, sample_time):  # noqa: D102
        motion = _first_order("velocity", self.velocity, sample_time)
        return max(motion.memory(SETTLING_TOLERANCE), super().edge(sample_time))


class PeriodicFourier(AbstractFilter):
    """Fourier series, fitted to angles of a periodic motion and differentiated exactly.

    Each segment has a series of its own, by least squares over all of its samples,
    which must span at least one period. Forces and columns are not averaged over the
    periods: least squares do that, and the scatter between the periods tells the
    uncertainty. They are filtered by a zero-phase Butterworth low-pass at ten times the
    highest harmonic. Measured velocities are not used.

    Attributes:
        period: Period of the motion [s], like `10.0`.
        harmonics: Number of harmonics, like `5`; that of the planned trajectory or a
            few more.
    """

    uses_velocities: ClassVar[bool] = False
    period: float = eqx.field(static=True, converter=float)
    harmonics: int = eqx.field(static=True, converter=integer("harmonics"))

    def __check_init__(self) -> None:
        require_positive(self, "period", "harmonics")

    def motion(self, angles, velocities, sample_time):  # noqa: D102
        t = sample_time * np.arange(len(angles))
        duration = len(t) * sample_time
        if duration < (1 - 1e-9) * self.period:
            raise InputError(
                f"`period` of `PeriodicFourier` is {self.period:g} s, but a segment of "
                f"the log lasts {duration:g} s: record whole periods, or use another "
                "filter."
            )
        require_cutoff("harmonics / period", self.harmonics / self.period, sample_time)
        multiples = np.arange(1, self.harmonics + 1)
        omega = 2 * math.pi / self.period * multiples
        phases = np.outer(t, omega)
        sines = np.sin(phases)
        cosines = np.cos(phases)
        constant = np.ones((len(t), 1))
        basis = np.hstack([constant, sines, cosines])
        path = angles - angles[0]
        series = np.linalg.lstsq(basis, path, rcond=None)[0]
        q = angles[0] + basis @ series
        _require_series(angles, q)

        _, a, b = np.split(series, [1, self.harmonics + 1])
        factors = omega[:, None]
        speed_a = factors * a
        speed_b = factors * b
        qd = cosines @ speed_a - sines @ speed_b
        acceleration_a = factors * speed_a
        acceleration_b = factors * speed_b
        qdd = -sines @ acceleration_a - cosines @ acceleration_b
        return Motion(q, qd, qdd)

    def low_pass(self, sample_time):  # noqa: D102
        cutoff = FORCE_BAND * self.harmonics / self.period
        name = f"{FORCE_BAND} harmonics / period"
        return butterworth(cutoff, FORCE_ORDER, sample_time, name)

    def memory(self, sample_time):  # noqa: D102
        return None


def _require_series(angles: AnyArray, q: AnyArray) -> None:
    """Refuse angles that are no Fourier series of the period."""
    motion = angles.std(axis=0)
    error = np.sqrt(np.mean((angles - q) ** 2, axis=0))
    # A joint that hardly moves shows nothing but the steps of its encoder.
    reference = np.maximum(motion, MAX_SERIES_ERROR * motion.max())
    wrong_joints = np.flatnonzero(error > MAX_SERIES_ERROR * reference).tolist()
    if wrong_joints:
        j = wrong_joints[0]
        raise InputError(
            f"the angles of joint {j + 1} deviate from a Fourier series by "
            f"{error[j] / motion[j]:.0%} of their motion (RMS): correct `period` or "
            "`harmonics`, or crop the log."
        )


def _bilinear(
    name: str, numerator: list[float], omega: float, sample_time: float
) -> tuple[Vector, Vector]:
    r"""Return $(b s + c) / (s / \omega + 1)$ by the bilinear transform.

    It is returned as coefficients.
    """
    require_cutoff(name, omega / (2 * math.pi), sample_time)
    b, a = scipy.signal.bilinear(numerator, [1 / omega, 1.0], 1 / sample_time)
    return np.asarray(b), np.asarray(a)


def _first_order(name: str, omega: float, sample_time: float) -> LowPass:
    r"""Return $1 / (s / \omega + 1)$, forward and backward."""
    sos = scipy.signal.tf2sos(*_bilinear(name, [1.0], omega, sample_time))
    return LowPass.of(np.asarray(sos), omega / (2 * math.pi))


def first_difference(x: Matrix, sample_time: float) -> Matrix:
    """Return central differences of fourth order; of second order next to the ends."""
    d = np.gradient(x, sample_time, axis=0, edge_order=2)
    # At 125 Hz those of second order would lose 1 % of a velocity at 5 Hz.
    error = np.diff(d[1:-1], 2, axis=0) / 6
    d[2:-2] -= error
    return d


def second_difference(x: Matrix, sample_time: float) -> Matrix:
    """Return second differences of fourth order, constant at the ends.

    Next to the ends they are of second order.
    """
    previous_samples = x[1:-3]
    centre_samples = x[2:-2]
    next_samples = x[3:-1]
    nearest_samples = next_samples + previous_samples
    second_nearest_samples = x[4:] + x[:-4]
    difference = 16 * nearest_samples - second_nearest_samples - 30 * centre_samples

    squared_time = sample_time**2
    d = np.empty_like(x)
    d[1:-1] = np.diff(x, 2, axis=0) / squared_time
    d[2:-2] = difference / (12 * squared_time)
    d[0] = d[1]
    d[-1] = d[-2]
    return d
