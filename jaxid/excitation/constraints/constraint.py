"""What a constraint is: numbers of each sample of a motion that must not be positive."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.robot.robot import Robot
from jaxid.types import AnyArray, Array, Float


class Entry(NamedTuple):
    """What one value of a constraint stands for.

    Attributes:
        name: What is limited, as it reads in a sentence: `torque of joint 3`.
        size: By what a value is multiplied to get the physical excess.
        unit: Of the excess.
    """

    name: str
    size: float
    unit: str


class Finding(NamedTuple):
    """How far one value of a constraint is from its limit.

    Attributes:
        name: What is limited.
        value: Relative excess over the limit; negative or zero where it is kept.
        excess: The same in physical units.
        unit: Of the excess.
    """

    name: str
    value: float
    excess: float
    unit: str

    def __str__(self) -> str:
        """One sentence."""
        if self.value > 0:
            return (
                f"{self.name} exceeds its limit by {self.excess:.3g} {self.unit} "
                f"({100 * self.value:.3g} %)"
            )
        return f"{self.name} keeps its limit with {-self.excess:.3g} {self.unit} to spare"


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
            Finding(e.name, float(v), float(v) * e.size, e.unit)
            for e, v in zip(entries, peaks, strict=True)
        ]
