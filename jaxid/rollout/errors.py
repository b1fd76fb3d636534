"""Errors of simulations, beside those of simple baselines."""

import dataclasses
from collections.abc import Sequence
from itertools import cycle

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.result_table import Column, Summarised, Table

Paths = tuple[np.ndarray, ...]
"""Positions in each motion [joints, samples] [rad or m]."""


@dataclasses.dataclass(frozen=True)
class RolloutErrors(Summarised):
    """Errors of simulations, beside those of simple baselines [rad or m].

    Attributes:
        joint_names: Names of the joints.
        motions: Name of the log of each motion.
        time: Instants of the samples of each motion, by the clock of the log [s].
        measured: Measured positions.
        simulated: Simulated positions.
        counted: Whether a sample counts: 1, or 0 within contacts that were given.
        baselines: Positions of each baseline by its name: `linear` joints and the
            copied `command`, or the `fit_of_torques`.
        manner: How the robot is simulated, like `free-running`.
    """

    joint_names: Texts
    motions: Texts
    time: tuple[np.ndarray, ...]
    measured: Paths
    simulated: Paths
    counted: Paths
    baselines: dict[str, Paths]
    manner: str = "free-running"

    def rms(self, kind: str = "simulated") -> Matrix:
        """Return RMS errors of `simulated` or of a baseline."""
        paths = {"simulated": self.simulated, **self.baselines}[kind]
        rows = zip(paths, self.measured, self.counted, strict=True)
        squares = [np.sum(c * (y - q) ** 2, axis=1) for y, q, c in rows]
        return np.sqrt(squares / self._sizes)

    def total(self, kind: str = "simulated") -> Vector:
        """Return root mean square errors over all motions together."""
        squares = self._sizes * self.rms(kind) ** 2
        return np.sqrt(squares.sum(axis=0) / self._sizes.sum(axis=0))

    @property
    def _sizes(self) -> Matrix:
        """Number of samples that count, one at least [motions, joints]."""
        return np.maximum([counted.sum(axis=1) for counted in self.counted], 1.0)

    @property
    def is_counted(self) -> np.ndarray:
        """Which samples of all motions, one behind the other, count."""
        return np.concatenate(self.counted, axis=1)[0] > 0.0

    @property
    def sample_words(self) -> str:
        """Which samples count, in words."""
        left_out = int(np.sum(~self.is_counted))
        if not left_out:
            return "every sample"
        return f"every sample but {left_out} within the given contacts"

    def summary(self, units: Sequence[str] = ("mrad or mm",)) -> Table:
        """Return a table of the errors of all motions.

        Args:
            units: Units of the joints' errors, or one for all.
        """
        columns = map(Column, self.joint_names, 1e3 * self.rms().T, cycle(units))
        title = f"errors {self.manner}, {self.sample_words} (RMS)"
        return Table(title, Column("motion", self.motions), *columns)
