"""The weighted system: weights of joints, decomposition, solutions (Eqs. 29-33)."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    BaseMatrix,
    BaseVector,
    Float,
    Joints,
    Vector,
    one_or_each,
)
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from ..factors import Blocks, Factors
from ..problem import cross_validation_folds

MIN_SINGULAR_VALUE = 1e-11
"""Relative singular value below which a direction is only rounding."""
RIDGE = 64 * np.finfo(float).eps
"""Ridge of the products of columns of length one, which may depend on each other."""


class Decomposition(eqx.Module):
    """Singular value decomposition of the weighted observation matrix.

    Columns are scaled to length one, which makes the result independent of units;
    columns of zeros or of rounding stay zero.
    """

    scale: BaseVector  # lengths of the columns
    values: BaseVector  # singular values, in falling order
    # right singular vectors of the scaled parameters, as rows
    directions: BaseMatrix
    forces: BaseVector  # weighted forces along the left singular vectors
    rest: float  # norm of the forces that the columns cannot explain

    @classmethod
    def of(cls, R: AnyArray, z: AnyArray) -> "Decomposition":
        """Decompose a weighted factor and its right-hand side."""
        R = np.asarray(R)
        z = np.asarray(z)
        # Of fewer rows than columns there are as many singular values as columns.
        missing_rows = max(0, R.shape[1] - len(R))
        R = np.pad(R, ((0, missing_rows), (0, 0)))
        z = np.pad(z, (0, missing_rows))
        norms = np.linalg.norm(R, axis=0)
        # Shorter columns are rounding: units may differ by less.
        is_visible = norms > 1e-13 * norms.max(initial=0.0)
        scale = np.where(is_visible, norms, 1.0)
        scaled_matrix = np.where(is_visible, R / scale, 0.0)
        U, values, directions = np.linalg.svd(scaled_matrix, full_matrices=False)
        forces = U.T @ z
        rest = float(np.sqrt(max(z @ z - forces @ forces, 0.0)))
        return cls(scale, values, directions, forces, rest)

    @property
    def unknown(self) -> np.ndarray:
        """Which parameters take part in directions that are only rounding."""
        is_rounding = self.values <= MIN_SINGULAR_VALUE * self.values.max(initial=0.0)
        return np.sum(self.directions[is_rounding] ** 2, axis=0) > 1e-8

    def solve(self, inverse: BaseVector | None = None) -> BaseVector:
        """Return the parameters, by a substitute of 1 / value² for each direction.

        The substitute is that of `Complete` if none is given.
        """
        if inverse is None:
            inverse = Complete().inverse(self.values)
        coefficients = inverse * self.values * self.forces
        return self.directions.T @ coefficients / self.scale

    def inverse_information(self, inverse: BaseVector | None = None) -> BaseMatrix:
        """Return the inverse information in the parameters' units; see `solve`."""
        if inverse is None:
            inverse = Complete().inverse(self.values)
        directions = self.directions / self.scale
        return (directions.T * inverse) @ directions


def inverse_information(
    information: Float[Array, "base base"], ridge: float = RIDGE
) -> tuple[Array, Array]:
    """Return the inverse of an information, and a bound of its root's condition number.

    Columns are scaled to length one, and a ridge of rounding's size keeps the factor
    from failing.
    """
    size = information.shape[-1]
    squares = jnp.diagonal(information)
    scale = 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
    scaled_matrix = scale[:, None] * information * scale[None]
    L = jnp.linalg.cholesky(scaled_matrix + ridge * np.eye(size))
    scaled_root = jax.lax.linalg.triangular_solve(
        L,
        jnp.eye(size),
        left_side=True,
        lower=True,
    )
    condition_bound = jnp.sqrt(size * jnp.sum(scaled_root**2))
    # The factor of a singular information is NaN.
    condition_bound = jnp.where(jnp.isfinite(condition_bound), condition_bound, jnp.inf)
    root = scaled_root * scale[None]
    return root.T @ root, condition_bound


class AbstractSolution(eqx.Module):
    """A solution of a weighted least-squares system (Eq. 33)."""

    @abstractmethod
    def choose(self, blocks: Blocks, weights: AnyArray) -> "AbstractSpectralSolution":
        """Return the solution for these observations, all its settings determined."""


class AbstractSpectralSolution(AbstractSolution):
    r"""A solution that treats each direction by its singular value.

    The parameters are $B \Theta^T W^2 Q$, where $B$ is a substitute of the inverse
    information.
    """

    @abstractmethod
    def inverse(self, values: BaseVector) -> BaseVector:
        """Return the substitute of 1 / value² for each singular value."""

    def choose(self, blocks, weights):
        """Return this solution."""
        return self


class Complete(AbstractSpectralSolution):
    """Ordinary least squares: all directions except those of rounding (Eq. 33)."""

    def inverse(self, values):
        """Return the inverse squares; zero for directions of rounding."""
        values = np.asarray(values)
        is_visible = values > MIN_SINGULAR_VALUE * values.max(initial=0.0)
        squares = np.where(is_visible, values, 1.0) ** 2
        return np.where(is_visible, 1.0 / squares, 0.0)


class Ridge(AbstractSpectralSolution):
    """Least squares that pull weak directions towards zero (Tikhonov).

    Attributes:
        strength: Singular value, relative to the largest and with scaled columns, at
            which parameters are halved.
    """

    strength: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if not 0.0 <= self.strength < np.inf:
            raise InputError(
                f"`strength` must be finite and at least 0, but is {self.strength}."
            )

    def inverse(self, values):
        """Return bounded inverse squares."""
        values = np.asarray(values)
        halving_value = max(self.strength, MIN_SINGULAR_VALUE) * values.max(initial=0.0)
        return 1.0 / (values**2 + halving_value**2)


class CrossValidated(AbstractSolution):
    """The strongest of several solutions whose held-out error is about the smallest.

    Each solution is computed without one contiguous block of time and tested on it. Of
    those whose error lies within one standard error of the smallest, the strongest is
    taken: neighbouring blocks are similar, and other motions are not.

    Attributes:
        candidates: Solutions, from the weakest to the strongest.
    """

    candidates: tuple[AbstractSpectralSolution, ...] = tuple(
        Ridge(float(strength)) for strength in np.geomspace(1e-4, 0.5, 25)
    )

    def choose(self, blocks, weights):
        """Test every candidate on every block; reject a single block."""
        squared_weights = weights**2
        count = len(blocks.parts)
        errors = np.empty((len(self.candidates), count))
        for k, (other_blocks, part) in enumerate(cross_validation_folds(blocks, count)):
            training_factors = blocks.select(other_blocks).total
            decomposition = Decomposition.of(*training_factors.weighted(weights))
            test_factors = blocks.select(part).total
            for i, candidate in enumerate(self.candidates):
                inverse = candidate.inverse(decomposition.values)
                p = decomposition.solve(inverse)
                errors[i, k] = squared_weights @ test_factors.residual_squares(p)
        total_errors = errors.sum(axis=1)
        best_number = np.argmin(total_errors)
        standard_error = errors[best_number].std(ddof=1) * np.sqrt(count)
        max_error = total_errors[best_number] + standard_error
        *_, strongest_number = np.flatnonzero(total_errors <= max_error)
        return self.candidates[strongest_number]


class AbstractWeights(eqx.Module):
    """A choice of one weight for each joint: the diagonal of W (Eq. 30)."""

    @abstractmethod
    def __call__(self, robot: Robot, factors: Factors) -> Vector:
        """Return the weights [1/(N m) or 1/N] for some observations of a robot."""


class GivenWeights(AbstractWeights):
    """Known weights.

    Attributes:
        weights: Weight of each joint [1/(N m) or 1/N].
    """

    weights: Joints = eqx.field(converter=one_or_each)

    def __call__(self, robot, factors):
        """Return the weights; reject those that are not one number for each joint."""
        weights = np.asarray(self.weights)
        is_one_each = weights.shape == (robot.joints,) and np.isfinite(weights).all()
        if not is_one_each or weights.min() < 0 or not weights.any():
            raise InputError(
                f"`weights` must be {robot.joints} numbers from 0, "
                f"not all zero: {weights}."
            )
        return weights


class ResidualVariances(AbstractWeights):
    """Reciprocals of the residuals' standard deviations, found iteratively.

    Attributes:
        iterations: Number of times that weights and parameters are computed in turn;
            with 0 the weights are the reciprocals of the RMS values of the forces.
    """

    iterations: int = eqx.field(static=True, default=5)

    def __call__(self, robot, factors):
        """Return the reciprocals; the iteration starts from the size of the forces."""
        weights = self._reciprocals(factors, factors.force_squares)
        for _ in range(self.iterations):
            p = Decomposition.of(*factors.weighted(weights)).solve()
            weights = self._reciprocals(factors, factors.residual_squares(p))
        return weights

    def _reciprocals(self, factors: Factors, squares: Joints) -> Vector:
        deviations = np.sqrt(squares / np.maximum(factors.rows, 1))
        # Finite also for a joint without any force or residual.
        floor = max(1e-9 * float(deviations.max()), 1e-100)
        return 1.0 / np.maximum(deviations, floor)


class MaximumForces(AbstractWeights):
    r"""Reciprocals of the largest forces, $1 / (i_{Gj} M_{j,max})$ (Eq. 30).

    If those of a joint are not known, joints are weighted by `ResidualVariances`.
    """

    def __call__(self, robot, factors):
        """Return the reciprocals, or weights by the residuals."""
        max_forces = np.asarray(robot.known_max_forces)
        if np.isfinite(max_forces).all():
            return 1.0 / max_forces
        return ResidualVariances()(robot, factors)
