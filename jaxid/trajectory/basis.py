"""Trajectories that are linear in their numbers: what a design can choose from."""

import math
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.trajectory.fourier import FourierSeries
from jaxid.trajectory.trajectory import AbstractTrajectory

ORDERS = 4
"""Position, velocity, acceleration and jerk."""
SHIFTS = 40
"""Parts of a motion's time by which it is tried to begin it later."""
ANEW = 1e-9
"""How well a motion must be met when it is begun later or run backwards, relative."""


class Envelope(NamedTuple):
    """Rows whose largest value bounds a motion at all times, between samples as well.

    For numbers x of a joint, |f(t) - c| <= factor * max |rows[k] @ x - c| at every time t, where f
    is the k-th derivative of the joint's motion and c any constant.

    Attributes:
        rows: For each order of derivative a matrix [rows, variables].
        factor: At least 1.
    """

    rows: tuple[Float[np.ndarray, "rows variables"], ...]
    factor: float


class AbstractBasis(eqx.Module):
    """A family of trajectories: each joint's motion is linear in the joint's numbers.

    All joints have the same functions of time. Their numbers are a matrix x of shape
    [joints, variables]; limits of position, velocity, acceleration and jerk are linear in them.

    Attributes:
        duration: Time from the start of the motion to its end, for a periodic one its period [s].
    """

    duration: eqx.AbstractVar[float]

    @abstractmethod
    def rows(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "4 samples variables"]:
        """Position, velocity, acceleration and jerk of a joint at some times, by its numbers.

        Args:
            t: Times [s].
        """

    @abstractmethod
    def envelope(self, points: int) -> Envelope:
        """Rows that bound the motion at all times.

        Args:
            points: About how many rows for each order; more rows, tighter bounds.
        """

    @abstractmethod
    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> AbstractTrajectory:
        """The trajectory of some numbers.

        Args:
            x: One row for each joint.
        """

    @property
    def variables(self) -> int:
        """Numbers of each joint."""
        return self.rows(np.zeros(1)).shape[2]

    def times(self, samples: int) -> Float[np.ndarray, " samples"]:
        """Equidistant times at which a run is measured, without their end [s].

        Args:
            samples: How many.
        """
        return np.arange(samples) * (self.duration / samples)

    @property
    def retimings(self) -> Float[np.ndarray, "retimings variables variables"]:
        """Maps of a joint's numbers to those of the same motion begun later, or run backwards.

        Those that stay in the family: a periodic motion may begin at any time, one between
        standstills may run backwards. The first changes nothing. All keep the limits of the joint.
        """
        part = -(-4 * self.variables // SHIFTS)
        step = self.duration / (SHIFTS * part)
        rows = self.rows((np.arange(SHIFTS * part) + 0.5) * step)[0]
        inverse, size = np.linalg.pinv(rows), np.abs(rows).max()
        moved = [np.roll(r, k * part, axis=0) for r in (rows, rows[::-1]) for k in range(SHIFTS)]
        maps = [inverse @ wanted for wanted in moved]
        return np.array(
            [
                T
                for T, wanted in zip(maps, moved, strict=True)
                if np.abs(rows @ T - wanted).max() <= ANEW * size
            ]
        )

    def instants(self, points: int) -> Float[np.ndarray, " points"]:
        """Equidistant times over everything that is moved, for what must hold all along [s].

        Args:
            points: How many.
        """
        return self.times(points)


class FourierBasis(AbstractBasis):
    r"""Finite Fourier series: numbers are the offset, then all a, then all b (Eqs. 34, 35).

    Attributes:
        harmonics: Number of harmonics.
        omega: Ground frequency [rad/s].
        duration: The period [s].
    """

    harmonics: int = eqx.field(static=True)
    omega: float = eqx.field(static=True)
    duration: float = eqx.field(static=True)

    def __init__(self, harmonics: int, omega: float):
        if harmonics < 1:
            raise InputError(f"`harmonics` must be at least 1, but is {harmonics}.")
        if not 0 < omega < math.inf:
            raise InputError(f"`omega` must be a positive frequency [rad/s], but is {omega:g}.")
        self.harmonics, self.omega = harmonics, float(omega)
        self.duration = 2 * math.pi / omega

    def rows(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "4 samples variables"]:
        """Sines and cosines and their derivatives."""
        w = self.omega * np.arange(1, self.harmonics + 1)
        phase = np.outer(np.asarray(t, np.float64), w)
        sin, cos = np.sin(phase), np.cos(phase)
        one, zero = np.ones((len(phase), 1)), np.zeros((len(phase), 1))
        return np.stack(
            [
                np.hstack([one, sin / w, -cos / w]),
                np.hstack([zero, cos, sin]),
                np.hstack([zero, -sin * w, cos * w]),
                np.hstack([zero, -cos * w**2, -sin * w**2]),
            ]
        )

    def envelope(self, points: int) -> Envelope:
        r"""Samples of a period: $\max |p| \le \max_k |p(t_k)| / \cos(\pi n / M)$.

        The bound holds for every trigonometric polynomial of degree n at M > 2 n equidistant points
        (Ehlich and Zeller).
        """
        points = max(points, 2 * self.harmonics + 1)
        return Envelope(
            tuple(self.rows(self.times(points))),
            1.0 / math.cos(math.pi * self.harmonics / points),
        )

    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> FourierSeries:
        """The series with these offsets and coefficients."""
        n = self.harmonics
        return FourierSeries(x[:, 0], x[:, 1 : n + 1], x[:, n + 1 :], self.omega)
