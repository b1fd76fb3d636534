"""What a constraint is: numbers of each sample of a motion that must not be positive."""

import math
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.motion import Motion
from jaxid.robot.robot import Robot


class Entry(NamedTuple):
    """What one value of a constraint stands for.

    Attributes:
        name: What is limited, as it reads in a sentence: `torque of joint 3`.
        size: By what a value is multiplied to get the physical excess.
        unit: Of the excess.
        limit: What the physical quantity must not pass, in the same unit; NaN if it has no name.
        least: Whether it must not fall below the limit, rather than not rise above it.
        note: What the limit was made of, as it reads behind it: `12 less a margin of 50 %`.
    """

    name: str
    size: float
    unit: str
    limit: float = math.nan
    least: bool = False
    note: str = ""


class Finding(NamedTuple):
    """How far one value of a constraint is from its limit.

    Attributes:
        name: What is limited.
        value: Relative excess over the limit; negative or zero where it is kept.
        excess: The same in physical units.
        unit: Of the excess.
        limit: In the same unit; NaN if it has no name.
        least: Whether the limit is the least that must be reached, rather than the most.
        note: What the limit was made of.
        used: Share of the limit that is used, of 1; NaN where that means nothing.
    """

    name: str
    value: float
    excess: float
    unit: str
    limit: float = math.nan
    least: bool = False
    note: str = ""
    used: float = math.nan

    @property
    def reached(self) -> float:
        """The physical quantity where it is nearest to its limit, or furthest beyond it."""
        return self.limit - self.excess if self.least else self.limit + self.excess

    @property
    def bound(self) -> str:
        """The limit in words; empty if it has no name."""
        if math.isnan(self.limit):
            return ""
        made = f" ({self.note})" if self.note else ""
        return f"{'at least' if self.least else 'at most'} {self.limit:.4g} {self.unit}{made}"

    def __str__(self) -> str:
        """One sentence."""
        bound = f": {self.bound}" if self.bound else ""
        if self.value > 0 and self.least:
            return f"{self.name} falls short of its limit by {self.excess:.3g} {self.unit}{bound}"
        if self.value > 0:
            return (
                f"{self.name} exceeds its limit by {self.excess:.3g} {self.unit} "
                f"({100 * self.value:.3g} %){bound}"
            )
        return f"{self.name} keeps its limit with {-self.excess:.3g} {self.unit} to spare{bound}"


class AbstractConstraint(eqx.Module):
    """Limits on a motion that are not linear in the joints' motion.

    Each sample of a motion is judged by itself, so that solvers can ask for values and derivatives
    at any instants. Values are smooth wherever they can be, and relative: in units of the limit, or
    of another size that stands in the entry.
    """

    @abstractmethod
    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """How far each limit is exceeded at each sample; zero or negative where it is kept.

        Runs under `jit`, `vmap` and derivatives with respect to the motion.

        Args:
            robot: Whose motion it is.
            motion: Joint motion with any leading axes.
        """

    @abstractmethod
    def entries(self, robot: Robot) -> tuple[Entry, ...]:
        """What the values stand for, in their order."""

    def describe(self, robot: Robot, values: Float[AnyArray, "*batch values"]) -> list[Finding]:
        """The largest value of each entry in words and physical units.

        Args:
            robot: Whose motion it is.
            values: As the constraint gave them.
        """
        entries = self.entries(robot)
        peaks = np.asarray(values).reshape(-1, len(entries)).max(axis=0)
        return [
            Finding(
                e.name,
                float(v),
                float(v) * e.size,
                e.unit,
                e.limit,
                e.least,
                e.note,
                self.used(e, float(v)),
            )
            for e, v in zip(entries, peaks, strict=True)
        ]

    def used(self, entry: Entry, value: float) -> float:
        """Share of a limit that is used, of 1, where values count in units of the limit.

        Args:
            entry: What is limited.
            value: Its relative excess.
        """
        return 1.0 + value
