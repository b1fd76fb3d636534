"""Criterion of several motions and its derivatives, by the regressor's own programs.

In NumPy nothing is compiled: a search asks for these thousands of times, of few
samples. In JAX the same formulas take half of the time of XLA's reverse mode.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, namespace
from jaxid.program.gradient import pull_back

from .coefficient_limits import ScaledMotion, ScaledMotions
from .criteria.functions_of_eigenvalues import Scalar, Sharpness
from .criteria.information_matrix import gram_matrices

if TYPE_CHECKING:
    from .problem import ExcitationProblem


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def criterion_value(
    problem: "ExcitationProblem", samples: int, x: ScaledMotion, sharpness: Sharpness
) -> Scalar:
    """Return the logarithm of the criterion of one motion, in JAX."""
    motion = motion_at_samples(problem, x[None], samples)
    columns = problem.regressor.evaluate(*motion)
    plain_matrices, weighted_matrices = _matrices(problem, columns, samples)
    return problem.criterion_of(plain_matrices[0], weighted_matrices[0], sharpness)


@criterion_value.defjvp
def _criterion_derivative(problem, samples, primals, tangents):
    x, sharpness = primals
    values, gradients = value_and_gradient(problem, x[None], sharpness, samples)
    return values[0], jnp.sum(gradients[0] * tangents[0])


def value_and_gradient(
    problem: "ExcitationProblem",
    x: ScaledMotions,
    sharpness: Sharpness,
    samples: int,
) -> tuple[AnyArray, ScaledMotions]:
    """Return the logarithms of the criterion and their derivatives by each motion.

    Motions are evaluated at `samples`, which stand for all that will be measured.
    """
    motion = motion_at_samples(problem, x, samples)
    columns = problem.regressor.evaluate(*motion)
    matrices = _matrices(problem, columns, samples)
    values, slopes = _criterion_and_slopes(problem, *matrices, sharpness)
    column_slopes = _slopes_by_columns(problem, columns, samples, *slopes)
    motion_slopes = pull_back(problem.regressor.program, column_slopes, *motion)

    xp = namespace(x)
    slopes_by_coefficients = []
    rows = problem.sample_rows(samples)
    for slopes, part in zip(motion_slopes, rows, strict=True):
        # [joints, starts, samples] @ [samples, coefficients]
        slopes_by_coefficients.append(xp.swapaxes(slopes @ part, 0, 1))
    gradient = sum(slopes_by_coefficients) * np.asarray(problem.limits.scale)[None]
    return values, gradient.reshape(x.shape)


def criterion_at_samples(
    problem: "ExcitationProblem", x: ScaledMotions, sharpness: Sharpness, samples: int
) -> AnyArray:
    """Return the logarithms of the criterion of some motions, without derivatives."""
    if namespace(x) is jnp:
        return jax.vmap(lambda y: criterion_value(problem, samples, y, sharpness))(x)
    motion = motion_at_samples(problem, x, samples)
    matrices = _matrices(problem, problem.regressor.evaluate(*motion), samples)
    return _criterion_and_slopes(problem, *matrices, sharpness)[0]


def motion_at_samples(
    problem: "ExcitationProblem", x: ScaledMotions, samples: int
) -> list[AnyArray]:
    """Return positions, velocities and accelerations [joints, starts, samples]."""
    coefficients = namespace(x).swapaxes(problem.limits.coefficients(x), 0, 1)
    return [coefficients @ part.T for part in problem.sample_rows(samples)]


def _matrices(
    problem: "ExcitationProblem", columns: Sequence[AnyArray], samples: int
) -> tuple[AnyArray, AnyArray]:
    """Return the plain and the weighted matrix of all samples that are measured."""
    columns_by_motion = [joint_columns.swapaxes(0, 1) for joint_columns in columns]
    plain_matrices, weighted_matrices = gram_matrices(
        problem.regressor, columns_by_motion, problem.weights
    )
    weight = problem.samples / samples
    return weight * plain_matrices, weight * weighted_matrices + problem.prior[None]


def _criterion_and_slopes(
    problem: "ExcitationProblem",
    plain_matrices: AnyArray,
    weighted_matrices: AnyArray,
    sharpness: Sharpness,
):
    """Return the criterion of each motion, and its derivatives by both matrices."""
    evaluate = problem.criterion_and_slopes
    if namespace(plain_matrices) is jnp:
        evaluate_all = jax.vmap(evaluate, in_axes=(0, 0, None))
        return evaluate_all(plain_matrices, weighted_matrices, sharpness)
    values = np.zeros(len(plain_matrices))
    plain_slopes = np.zeros_like(plain_matrices)
    weighted_slopes = np.zeros_like(weighted_matrices)
    for k, matrices in enumerate(zip(plain_matrices, weighted_matrices, strict=True)):
        values[k], slopes = evaluate(*matrices, sharpness)
        plain_slopes[k], weighted_slopes[k] = slopes
    return values, (plain_slopes, weighted_slopes)


def _slopes_by_columns(
    problem: "ExcitationProblem",
    columns: Sequence[AnyArray],
    samples: int,
    plain_slopes: AnyArray,
    weighted_slopes: AnyArray,
) -> AnyArray:
    """Return derivatives by the packed regressor's entries [out, starts, samples]."""
    xp = namespace(plain_slopes)
    regressor = problem.regressor
    weight = problem.samples / samples
    slopes = []
    for numbers, joint_columns, joint_weight in zip(
        regressor.columns, columns, problem.weights, strict=True
    ):
        gram_slopes = plain_slopes + joint_weight**2 * weighted_slopes
        # Each column is in the product twice.
        symmetric_slopes = weight * (gram_slopes + gram_slopes.swapaxes(1, 2))
        # Zeros where a column does not act on the joint: nothing depends on those.
        factors = symmetric_slopes[:, :, list(numbers)]
        products = factors @ joint_columns.swapaxes(0, 1)
        slopes.append(products.swapaxes(0, 1))
    return xp.concatenate(slopes)
