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
        counted: Whether a sample counts: behind the first half second.
    """

    joint_names: tuple[str, ...]
    motions: tuple[str, ...]
    time: tuple[np.ndarray, ...]
    measured: tuple[np.ndarray, ...]
    simulated: tuple[np.ndarray, ...]
    command: tuple[np.ndarray, ...]
    linear: tuple[np.ndarray, ...]
    counted: tuple[np.ndarray, ...]

    def rms(self, kind: str = "simulated") -> Matrix:
        """Return RMS errors of `simulated`, `command` or `linear`; NaN without any."""
        rows = zip(getattr(self, kind), self.measured, self.counted, strict=True)
        sums = np.array([np.sum((y - q) ** 2, axis=1, where=k) for y, q, k in rows])
        sizes = np.array([k.sum(axis=1) for k in self.counted])
        return np.sqrt(np.where(sizes > 0, sums / np.maximum(sizes, 1), np.nan))

    def total(self, kind: str = "simulated") -> Vector:
        """Return root mean square errors over all motions together."""
        sizes = np.array([k.sum(axis=1) for k in self.counted])
        squares = np.where(sizes > 0, sizes * self.rms(kind) ** 2, 0.0)
        return np.sqrt(squares.sum(axis=0) / sizes.sum(axis=0))

    def summary(self) -> Table:
        """Return a table of the errors of all motions."""
        rms = 1e3 * self.rms()
        columns = [Column(name, rms[:, j]) for j, name in enumerate(self.joint_names)]
        title = (
            "errors of free-running simulations, behind the first half second "
            "[mrad or mm]"
        )
        return Table(title, Column("motion", self.motions), *columns)

    def __str__(self) -> str:
        return self.summary().text()
