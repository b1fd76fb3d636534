"""Errors of simulations, beside those of simple baselines."""

import dataclasses

import numpy as np

from jaxid.arrays import Matrix, Vector
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
        baselines: Positions of each baseline by its name: `linear` joints and the
            copied `command`, or the `fit_of_torques`.
        manner: How the robot is simulated, like `free-running`.
    """

    joint_names: tuple[str, ...]
    motions: tuple[str, ...]
    time: tuple[np.ndarray, ...]
    measured: Paths
    simulated: Paths
    baselines: dict[str, Paths]
    manner: str = "free-running"

    def rms(self, kind: str = "simulated") -> Matrix:
        """Return RMS errors of `simulated` or of a baseline."""
        paths = {"simulated": self.simulated, **self.baselines}[kind]
        pairs = zip(paths, self.measured, strict=True)
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
        title = f"errors {self.manner}, every sample [mrad or mm]"
        return Table(title, Column("motion", self.motions), *columns)
