"""Least squares of the rows of a log, and how well one description beats another."""

from typing import NamedTuple

import numpy as np
import scipy

from .filtered_log import FOLDS

RIDGE = 3e-5
"""Damping of columns of length one, for those that depend on others."""
ERROR_FLOOR = 0.01
"""Error of a joint, over its RMS force, below which smaller ones do not count."""
MIN_MOVING_SHARE = 0.25
"""Share of rows in which a joint must move to be judged."""


class Rows(NamedTuple):
    """Columns and forces of a log, both filtered twice.

    Attributes:
        columns: Columns of bodies, then of friction [rows, joints, columns].
        forces: Forces [rows, joints].
    """

    columns: np.ndarray
    forces: np.ndarray

    @property
    def force_sizes(self) -> np.ndarray:
        """RMS forces of the joints; for joints without force that of all."""
        squares = np.mean(self.forces**2, axis=0)
        mean_square = squares.mean()
        typical_square = mean_square if mean_square > 0 else 1.0
        return np.sqrt(np.where(squares > 0, squares, typical_square))

    def relative_errors(self, squares: np.ndarray) -> np.ndarray:
        """Return the RMS errors of the joints over their RMS forces."""
        return np.sqrt(squares) / self.force_sizes


class RowFit(NamedTuple):
    """Least-squares fit of rows.

    Attributes:
        parameters: Parameters of the columns.
        errors: Measured minus fitted forces; zero where a joint rests [rows, joints].
        weights: Weights of the joints in this fit.
        squares: Mean squared errors of the joints, not below the floor.
        score: Sum of the logarithms of the joints' RMS errors.
        factor: Cholesky factor of the scaled normal equations.
        scales: Lengths of the columns, by which the equations are scaled.
    """

    parameters: np.ndarray
    errors: np.ndarray
    weights: np.ndarray
    squares: np.ndarray
    score: float
    factor: tuple[np.ndarray, bool]
    scales: np.ndarray


class Judge:
    """Rows that count, and the score of a description of the log.

    The score is the sum, over the joints that move, of the logarithms of their RMS
    errors: halving the error of one joint lowers it by 0.69, whatever its unit.
    """

    def __init__(self, is_moving: np.ndarray, folds: np.ndarray):
        self.mask = is_moving
        self.folds = folds
        self._row_counts = np.maximum(is_moving.sum(axis=0), 1)
        self.is_judged = is_moving.mean(axis=0) > MIN_MOVING_SHARE

    def fit(self, rows: Rows) -> RowFit:
        """Fit the parameters with weights from the errors of a first fit."""
        first_fit = self.weighted_fit(rows, self.force_weights(rows))
        return self.weighted_fit(rows, 1 / np.sqrt(first_fit.squares))

    def force_weights(self, rows: Rows) -> np.ndarray:
        """Return weights of the joints before any error is known."""
        return 1 / rows.force_sizes

    def weighted_fit(self, rows: Rows, weights: np.ndarray) -> RowFit:
        """Fit the parameters with given weights of the joints."""
        parameters, factor, scales = _solution(rows, self.mask * weights)
        errors = (rows.forces - rows.columns @ parameters) * self.mask
        squares = self.mean_squares(errors, rows)
        score = self.score(squares)
        return RowFit(parameters, errors, weights, squares, score, factor, scales)

    def unseen_squares(self, rows: Rows) -> np.ndarray:
        """Return the mean squared errors in parts that were left out of the fit."""
        weights = self.mask * self.fit(rows).weights
        errors = np.zeros_like(rows.forces)
        for fold in range(FOLDS):
            is_unseen = self.folds == fold
            training_rows = Rows(*(x[~is_unseen] for x in rows))
            parameters, *_ = _solution(training_rows, weights[~is_unseen])
            predictions = rows.columns[is_unseen] @ parameters
            errors[is_unseen] = rows.forces[is_unseen] - predictions
        return self.mean_squares(errors * self.mask, rows)

    def mean_squares(self, errors: np.ndarray, rows: Rows) -> np.ndarray:
        """Return the mean squared error of each joint, not below the floor."""
        floors = (ERROR_FLOOR * rows.force_sizes) ** 2
        return np.sum(errors**2, axis=0) / self._row_counts + floors

    def score(self, squares: np.ndarray) -> float:
        """Return the score of mean squared errors."""
        return 0.5 * float(np.sum(np.log(squares) * self.is_judged))


def _solution(
    rows: Rows, weights: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, bool], np.ndarray]:
    """Return parameters, the factor of the scaled normal equations, and the scales."""
    columns = rows.columns * weights[..., None]
    matrix = columns.reshape(-1, columns.shape[-1])
    vector = (rows.forces * weights).ravel()
    products = matrix.T @ matrix
    scales = np.sqrt(np.diag(products))
    # Columns of zeros get the parameter zero.
    scales[scales < 1e-9 * scales.max()] = np.inf
    products = products / scales[:, None] / scales
    diagonal = np.diag_indices(len(scales))
    products[diagonal] += RIDGE + ~np.isfinite(scales)
    factor = scipy.linalg.cho_factor(products, check_finite=False)
    scaled = scipy.linalg.cho_solve(
        factor, matrix.T @ vector / scales, check_finite=False
    )
    return scaled / scales, factor, scales


def promise(judge: Judge, rows: Rows, fit: RowFit, columns: np.ndarray) -> float:
    """Return by how much more columns [rows, joints, columns] would lower the score."""
    weights = judge.mask * fit.weights
    vectors = _flat(columns * weights[..., None])
    remainders = vectors - imitations(rows, weights, fit, vectors)
    # What the fit can imitate tells nothing.
    remainder_squares = np.sum(remainders**2, axis=0)
    column_squares = np.sum(vectors**2, axis=0)
    remainders = remainders[:, remainder_squares > 1e-6 * column_squares]

    errors = (fit.errors * weights).ravel()
    amounts, *_ = np.linalg.lstsq(remainders, errors, rcond=1e-6)
    remaining_errors = (errors - remainders @ amounts).reshape(rows.forces.shape)
    squares = judge.mean_squares(remaining_errors / fit.weights, rows)
    return fit.score - judge.score(squares)


def imitations(
    rows: Rows, weights: np.ndarray, fit: RowFit, vectors: np.ndarray
) -> np.ndarray:
    """Return what the columns of a fit explain of weighted vectors [:, columns]."""
    matrix = _flat(rows.columns * weights[..., None])
    scales = fit.scales[:, None]
    products = matrix.T @ vectors / scales
    multiples = scipy.linalg.cho_solve(fit.factor, products, check_finite=False)
    return matrix @ (multiples / scales)


def _flat(columns: np.ndarray) -> np.ndarray:
    """Return columns [rows, joints, columns] with the rows of all joints together."""
    return columns.reshape(-1, columns.shape[-1])
