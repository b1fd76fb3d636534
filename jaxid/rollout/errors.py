"""Errors of free-running simulations, beside those of simple baselines."""

import dataclasses

import numpy as np

from jaxid.arrays import Matrix, Vector
from jaxid.result_table import Column, Table


@dataclasses.dataclass(frozen=True)
class RolloutErrors:
    """Errors of free-running simulations, beside those of simple baselines [rad or m].

    Attributes:
        joint_names: Names of the joints.
        motions: Name of the log of each motion.
        time: Instants of the samples of each motion, by the clock of the log [s].
        measured: Measured positions of each motion [joints, samples].
        simulated: Simulated positions.
        command: Commanded positions.
        linear: Simulation by the linear baseline.
    """

    joint_names: tuple[str, ...]
    motions: tuple[str, ...]
    time: tuple[np.ndarray, ...]
    measured: tuple[np.ndarray, ...]
    simulated: tuple[np.ndarray, ...]
    command: tuple[np.ndarray, ...]
    linear: tuple[np.ndarray, ...]

    def rms(self, kind: str = "simulated") -> Matrix:
        """Return RMS errors of `simulated`, `command` or `linear`."""
        pairs = zip(getattr(self, kind), self.measured, strict=True)
        return np.sqrt([np.mean((y - q) ** 2, axis=1) for y, q in pairs])

    def total(self, kind: str = "simulated") -> Vector:
        """Return root mean square errors over all motions together."""
        sizes = np.array([len(time) for time in self.time])
        squares = sizes[:, None] * self.rms(kind) ** 2
        return np.sqrt(squares.sum(axis=0) / sizes.sum())

    def summary(self) -> Table:
        """Return a table of the errors of all motions."""
        rms = 1e3 * self.rms()
        columns = [Column(name, rms[:, j]) for j, name in enumerate(self.joint_names)]
        title = "errors of free-running simulations, every sample [mrad or mm]"
        return Table(title, Column("motion", self.motions), *columns)

    def __str__(self) -> str:
        return self.summary().text()
