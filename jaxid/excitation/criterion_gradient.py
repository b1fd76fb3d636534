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
    columns = [np.swapaxes(each, 0, 1) for each in regressor.in_numpy(*motion)]
    weight = problem.samples / samples

    plain, weighted = gram_matrices(regressor, columns, problem.weights)
    values, by_plain, by_weighted = _criterion_and_slopes(
        problem,
        weight * plain,
        weight * weighted + problem.prior,
        sharpness,
    )
    by_columns = _slopes_by_columns(problem, columns, weight, by_plain, by_weighted)
    packed_slopes = by_columns.reshape(-1, *by_columns.shape[2:])
    by_motion = pull_back(regressor.program, packed_slopes, *motion)

    by_coefficients = np.zeros_like(coefficients)
    for slopes, part in zip(by_motion, rows, strict=True):
        by_coefficients += np.einsum("jbs,sk->bjk", slopes, part)
    gradient = by_coefficients * np.asarray(problem.limits.scale)
    return values, gradient.reshape(x.shape)


def _criterion_and_slopes(
    problem: ExcitationProblem,
    plain: np.ndarray,
    weighted: np.ndarray,
    sharpness: float | None,
):
    """Return the criterion of each motion, and its derivatives by both matrices."""
    values = np.zeros(len(plain))
    by_plain = np.zeros_like(plain)
    by_weighted = np.zeros_like(weighted)
    for k, matrices in enumerate(zip(plain, weighted, strict=True)):
        value, slopes = problem.criterion_and_slopes(*matrices, sharpness)
        values[k] = value
        by_plain[k] = slopes[0]
        by_weighted[k] = slopes[1]
    return values, by_plain, by_weighted


def _slopes_by_columns(
    problem: ExcitationProblem,
    columns: list[np.ndarray],
    weight: float,
    by_plain: np.ndarray,
    by_weighted: np.ndarray,
):
    """Return derivatives by the regressor's entries [joints, base, starts, samples]."""
    starts, _, samples = columns[0].shape
    slopes = np.zeros((len(columns), problem.base.size, starts, samples))
    numbers_by_joint = problem.regressor.columns
    for joint, each in enumerate(columns):
        numbers = numbers_by_joint[joint]
        place = np.ix_(numbers, numbers)
        by_gram = by_plain[:, *place]
        by_gram = by_gram + problem.weights[joint] ** 2 * by_weighted[:, *place]
        # Each column is in the product twice.
        symmetric = weight * (by_gram + np.swapaxes(by_gram, 1, 2))
        slopes[joint, list(numbers)] = np.swapaxes(symmetric @ each, 0, 1)
    return slopes
