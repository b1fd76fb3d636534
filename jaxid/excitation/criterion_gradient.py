"""Criterion of several motions and its derivatives, in NumPy: nothing is compiled.

A search asks for these thousands of times, of few samples.
"""

import numpy as np

from jaxid.program.gradient import pull_back

from .coefficient_limits import ScaledMotions
from .criteria.information_matrix import gram_matrices
from .problem import ExcitationProblem


def value_and_gradient(
    problem: ExcitationProblem,
    x: ScaledMotions,
    sharpness: float | None,
    samples: int,
) -> tuple[np.ndarray, ScaledMotions]:
    """Return the logarithms of the criterion and their derivatives by each motion.

    Motions are evaluated at `samples`, which stand for all that will be measured.
    """
    rows = problem.sample_rows(samples)
    coefficients = problem.limits.coefficients(x)
    motion = [np.einsum("sk,bjk->jbs", part, coefficients) for part in rows]
    regressor = problem.regressor
    columns = [
        np.swapaxes(columns_of_joint, 0, 1)
        for columns_of_joint in regressor.in_numpy(*motion)
    ]
    weight = problem.samples / samples

    plain_matrices, weighted_matrices = gram_matrices(
        regressor, columns, problem.weights
    )
    values, plain_slopes, weighted_slopes = _criterion_and_slopes(
        problem,
        weight * plain_matrices,
        weight * weighted_matrices + problem.prior,
        sharpness,
    )
    column_slopes = _slopes_by_columns(
        problem, columns, weight, plain_slopes, weighted_slopes
    )
    packed_slopes = column_slopes.reshape(-1, *column_slopes.shape[2:])
    motion_slopes = pull_back(regressor.program, packed_slopes, *motion)

    coefficient_slopes = np.zeros_like(coefficients)
    for slopes, part in zip(motion_slopes, rows, strict=True):
        coefficient_slopes += np.einsum("jbs,sk->bjk", slopes, part)
    gradient = coefficient_slopes * np.asarray(problem.limits.scale)
    return values, gradient.reshape(x.shape)


def _criterion_and_slopes(
    problem: ExcitationProblem,
    plain_matrices: np.ndarray,
    weighted_matrices: np.ndarray,
    sharpness: float | None,
):
    """Return the criterion of each motion, and its derivatives by both matrices."""
    values = np.zeros(len(plain_matrices))
    plain_slopes = np.zeros_like(plain_matrices)
    weighted_slopes = np.zeros_like(weighted_matrices)
    for k, matrices in enumerate(zip(plain_matrices, weighted_matrices, strict=True)):
        value, slopes = problem.criterion_and_slopes(*matrices, sharpness)
        values[k] = value
        plain_slopes[k] = slopes[0]
        weighted_slopes[k] = slopes[1]
    return values, plain_slopes, weighted_slopes


def _slopes_by_columns(
    problem: ExcitationProblem,
    columns: list[np.ndarray],
    weight: float,
    plain_slopes: np.ndarray,
    weighted_slopes: np.ndarray,
):
    """Return derivatives by the regressor's entries [joints, base, starts, samples]."""
    starts, _, samples = columns[0].shape
    slopes = np.zeros((len(columns), problem.base.size, starts, samples))
    numbers_by_joint = problem.regressor.columns
    for joint, joint_columns in enumerate(columns):
        numbers = numbers_by_joint[joint]
        place = np.ix_(numbers, numbers)
        weight_of_joint = problem.weights[joint] ** 2
        weighted_part = weight_of_joint * weighted_slopes[:, *place]
        gram_slopes = plain_slopes[:, *place] + weighted_part
        # Each column is in the product twice.
        symmetric_slopes = weight * (gram_slopes + np.swapaxes(gram_slopes, 1, 2))
        products = symmetric_slopes @ joint_columns
        slopes[joint, list(numbers)] = np.swapaxes(products, 0, 1)
    return slopes
