"""Turn of a sensor that is not mounted as described, told by what it measures.

The vectors that it measures are along turned axes. Along the right axes, a linear model
explains them, whose unknowns are parameters of bodies, or biases. For each turn the
best unknowns are known in closed form, so that only the turn is searched.
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Float, Matrix3, Vector
from jaxid.robot.rotations import skew

Vectors = Float[np.ndarray, "rows 2 3"]
"""Forces and moments, or angular velocities and accelerations."""


class TurnSettings(NamedTuple):
    """How a turn is searched."""

    rank: float = 1e-6  # least singular value of the columns, over the largest one
    rounding: float = 1e-12  # share of the vectors that is rounding only
    steps: int = 30  # of Gauss and Newton, from each start


SETTINGS = TurnSettings()


class TurnedVectors(NamedTuple):
    """Vectors that a sensor measures along turned axes, and what explains them.

    With the right turn, `turn @ measured` is the known part plus the columns times the
    unknowns, for each of two vectors in a row.

    Attributes:
        solution: Best unknowns, as columns for the nine entries of the turn and for the
            known part.
        unexplained: What the best unknowns leave, as columns for the same.
    """

    solution: Float[np.ndarray, "unknowns 10"]
    unexplained: Float[np.ndarray, "rows 10"]

    @classmethod
    def of(
        cls,
        measured: Vectors,
        known: Vectors,
        columns: Float[np.ndarray, "rows 2 3 unknowns"],
        deviations: Float[np.ndarray, "2"],
        prior: Vector | None = None,
    ) -> "TurnedVectors":
        """Eliminate the unknowns.

        Args:
            measured: Vectors along the axes of the sensor.
            known: Known part of them along the axes of the description.
            columns: Columns of the unknowns along the same axes.
            deviations: Standard deviations of the errors of the two vectors.
            prior: Inverse of the standard deviations of the unknowns, of which zero is
                the best guess.
        """
        row_weights = np.repeat(1.0 / deviations, 3)
        weights = np.tile(row_weights, len(measured))[:, None]
        # Entry (i, j) of the turn brings axis j of the sensor to axis i.
        axes = np.einsum("ai,nbj->nbaij", np.eye(3), measured)
        entries = axes.reshape(-1, 9)
        sides = np.column_stack([entries, -known.ravel()])
        sides = sides * weights
        A = columns.reshape(len(sides), -1)
        A = A * weights
        if prior is not None:
            A = np.vstack([A, np.diag(prior)])
            zeros = np.zeros((len(prior), 10))
            sides = np.vstack([sides, zeros])
        solution, *_ = np.linalg.lstsq(A, sides, rcond=SETTINGS.rank)
        remainders = sides - A @ solution
        R = np.linalg.qr(remainders, mode="r")
        # A turn that nothing determines must not follow rounding.
        is_rounding = np.abs(R) < SETTINGS.rounding * np.linalg.norm(sides)
        R = np.where(is_rounding, 0.0, R)
        return cls(solution, R)

    def unknowns(self, turn: Matrix3) -> Vector:
        """Return the unknowns that explain the turned vectors best."""
        return self.solution @ np.append(turn, 1.0)

    def error(self, turn: Matrix3) -> float:
        """Return the norm of what the best unknowns leave."""
        return float(np.linalg.norm(self.unexplained @ np.append(turn, 1.0)))

    def turn_near(self, start: Matrix3) -> Matrix3:
        """Return the best turn near another one."""
        turn = start
        for _ in range(SETTINGS.steps):
            changes = np.stack([skew(axis) @ turn for axis in np.eye(3)])
            slopes = self.unexplained[:, :9] @ changes.reshape(3, 9).T
            errors = self.unexplained @ np.append(turn, 1.0)
            step, *_ = np.linalg.lstsq(slopes, -errors, rcond=None)
            turn = scipy.spatial.transform.Rotation.from_rotvec(step).as_matrix() @ turn
        return turn

    def least_turn(self, tie: float) -> Matrix3:
        """Return the smallest of the best turns from 24 starts.

        Args:
            tie: Largest ratio of the errors of turns that are equally good.
        """
        starts = scipy.spatial.transform.Rotation.create_group("O").as_matrix()
        turns = [self.turn_near(start) for start in starts]
        max_error = tie * min(map(self.error, turns))
        equals = [turn for turn in turns if self.error(turn) <= max_error]
        # The trace of a turn falls with its angle.
        return max(equals, key=np.trace)
