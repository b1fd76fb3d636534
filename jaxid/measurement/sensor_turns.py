"""Turn of a sensor that is not mounted as described, told by what it measures.

The vectors that it measures are along turned axes. Along the right axes, a linear model
explains them, whose unknowns are parameters of bodies, a displacement, or biases. For
each turn the best unknowns are known in closed form, so that only the turn is searched.
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix, Matrix3, Vector
from jaxid.robot.rotations import skew

Vectors = Float[np.ndarray, "rows 2 3"]
"""Forces and moments, or angular velocities and accelerations."""


class TurnSettings(NamedTuple):
    """How a turn is searched."""

    rank: float = 1e-6  # least singular value of the columns, over the largest one
    rounding: float = 1e-12  # share of the vectors that is rounding only
    tie: float = 1.1  # ratio of the errors of turns that are equally good
    steps: int = 30  # of Gauss and Newton, from each start
    student: float = 2.2  # 95 % interval over the deviation, of some ten blocks


SETTINGS = TurnSettings()


class TurnEstimate(NamedTuple):
    """Best turn of a sensor, and best unknowns.

    Attributes:
        turn: Rotation from the axes of the sensor to those of the description.
        unknowns: Best unknowns.
        errors: RMS of what is unexplained of each of the two vectors.
        covariance: Covariance of a small turn about the axes of the description, and of
            the unknowns.
    """

    turn: Matrix3
    unknowns: Vector
    errors: Float[np.ndarray, "2"]
    covariance: Matrix

    @property
    def angles(self) -> Float[np.ndarray, "3"]:
        """The turn as a rotation vector [rad]."""
        return scipy.spatial.transform.Rotation.from_matrix(self.turn).as_rotvec()


class SensorRows(NamedTuple):
    """Vectors that a sensor measures along turned axes, and what explains them.

    With the right turn, `turn @ measured` is the known part plus the columns times the
    unknowns, for each of two vectors in a row.

    Attributes:
        measured: Vectors along the axes of the sensor.
        known: Known part of them along the axes of the description.
        columns: Columns of the unknowns along the same axes.
        prior: Inverse of the standard deviations of the unknowns, of which zero is the
            best guess.
        blocks: Number of the block of time of each row; errors of different blocks are
            independent.
    """

    measured: Vectors
    known: Vectors
    columns: Float[np.ndarray, "rows 2 3 unknowns"]
    prior: Vector
    blocks: AnyArray

    def turned(self, turn: AnyArray) -> "SensorRows":
        """Return the rows along other axes, the same ones or others in each row."""
        return self._replace(measured=self.measured @ np.swapaxes(turn, -1, -2))

    def beside(self, columns: Float[np.ndarray, "rows 2 3 others"]) -> "SensorRows":
        """Return the rows with more unknowns, which come last."""
        zeros = np.zeros(columns.shape[3])
        return self._replace(
            columns=np.concatenate([self.columns, columns], axis=3),
            prior=np.append(self.prior, zeros),
        )

    @property
    def sizes(self) -> Float[np.ndarray, "2"]:
        """RMS of the two vectors without their means."""
        variances = np.var(self.measured, axis=0)
        return np.maximum(np.sqrt(np.mean(variances, axis=1)), 1e-300)

    def estimate(
        self, errors: Float[np.ndarray, "2"] | None = None, tie: float = SETTINGS.tie
    ) -> TurnEstimate:
        """Find the smallest of the best turns.

        Args:
            errors: Guess of the errors of the two vectors; in proportion to their sizes
                if None.
            tie: Largest ratio of the errors of turns that are equally good.
        """
        vectors = self._vectors(self.sizes if errors is None else errors)
        turn = vectors.least_turn(tie)
        # The final estimate uses the errors that are found.
        errors = self._errors(turn, vectors.unknowns(turn))
        vectors = self._vectors(errors)
        turn = vectors.turn_near(turn)
        unknowns = vectors.unknowns(turn)
        covariance = self._covariance(turn, unknowns, errors)
        return TurnEstimate(turn, unknowns, self._errors(turn, unknowns), covariance)

    def unknowns(self) -> Vector:
        """Return the best unknowns of vectors that are not turned."""
        return self._vectors(self.sizes).unknowns(np.eye(3))

    def _vectors(self, errors: Float[np.ndarray, "2"]) -> "_TurnedVectors":
        """Eliminate the unknowns."""
        row_weights = np.repeat(1.0 / errors, 3)
        weights = np.tile(row_weights, len(self.measured))[:, None]
        # Entry (i, j) of the turn brings axis j of the sensor to axis i.
        axes = np.einsum("ai,nbj->nbaij", np.eye(3), self.measured)
        entries = axes.reshape(-1, 9)
        sides = np.column_stack([entries, -self.known.ravel()])
        sides = sides * weights
        A = self.columns.reshape(len(sides), -1)
        A = A * weights
        A = np.vstack([A, np.diag(self.prior)])
        zeros = np.zeros((len(self.prior), 10))
        sides = np.vstack([sides, zeros])
        solution, *_ = np.linalg.lstsq(A, sides, rcond=SETTINGS.rank)
        remainders = sides - A @ solution
        R = np.linalg.qr(remainders, mode="r")
        # A turn that nothing determines must not follow rounding.
        is_rounding = np.abs(R) < SETTINGS.rounding * np.linalg.norm(sides)
        R = np.where(is_rounding, 0.0, R)
        return _TurnedVectors(solution, R)

    def _remainders(self, turn: Matrix3, unknowns: Vector) -> Vectors:
        """Return what is unexplained of turned vectors."""
        return self.measured @ turn.T - self.known - self.columns @ unknowns

    def _errors(self, turn: Matrix3, unknowns: Vector) -> Float[np.ndarray, "2"]:
        """Return the RMS of what is unexplained, above rounding."""
        errors = np.sqrt(np.mean(self._remainders(turn, unknowns) ** 2, axis=(0, 2)))
        sizes = np.sqrt(np.mean(self.measured**2, axis=(0, 2)))
        return np.maximum(errors, SETTINGS.rounding * sizes + 1e-300)

    def _covariance(
        self, turn: Matrix3, unknowns: Vector, errors: Float[np.ndarray, "2"]
    ) -> Matrix:
        """Return the covariance, by the scatter of blocks of time."""
        predicted = self.known + self.columns @ unknowns
        turn_columns = [np.cross(predicted, axis)[..., None] for axis in np.eye(3)]
        slopes = np.concatenate([*turn_columns, self.columns], axis=3)
        slopes = slopes / errors[:, None, None]
        remainders = self._remainders(turn, unknowns) / errors[:, None]
        gradients = np.einsum("nbai,nba->ni", slopes, remainders)
        blocks = self.blocks.max() + 1
        sums = np.zeros((blocks, gradients.shape[1]))
        np.add.at(sums, self.blocks, gradients)

        prior = np.diag(np.append(np.zeros(3), self.prior**2))
        products = np.einsum("nbai,nbaj->ij", slopes, slopes)
        inverse = np.linalg.pinv(
            products + prior, rcond=SETTINGS.rank**2, hermitian=True
        )
        variation = sums.T @ sums + prior
        return inverse @ variation @ inverse


class _TurnedVectors(NamedTuple):
    """Vectors of a sensor as functions of its turn alone.

    Attributes:
        solution: Best unknowns, as columns for the nine entries of the turn and for the
            known part.
        unexplained: What the best unknowns leave, as columns for the same.
    """

    solution: Float[np.ndarray, "unknowns 10"]
    unexplained: Float[np.ndarray, "rows 10"]

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


def half_widths(covariance: Matrix) -> Vector:
    """Return half of the 95 % intervals of estimates from some blocks of time."""
    return SETTINGS.student * np.sqrt(np.diag(covariance))
