"""Criteria: one number that says how well a motion determines the base parameters (Eq. 36)."""

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.excitation.information import Information

Sharpness = Float[Array, ""] | float | None
"""Closeness of a smooth maximum to the exact one: larger is closer; None is exact."""


class AbstractCriterion(eqx.Module):
    """A number that a design minimises.

    Attributes:
        name: Name of the number in tables.
        weighted: Whether the noise of the joints and earlier information count.
        extreme: Whether it has an extreme of eigenvalues, which can be made smooth.
    """

    name: ClassVar[str]
    weighted: ClassVar[bool] = True
    extreme: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the number.

        Args:
            information: Information of one experiment.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
        """

    def value(self, information: Information) -> float:
        """Return the number itself, exact."""
        return float(jnp.exp(self(jax.tree.map(jnp.asarray, information))))


class ConditionNumber(AbstractCriterion):
    r"""Criterion of the paper: condition number of $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).

    It depends on the units and on the choice of base parameters, and a small one need not mean
    small standard deviations; use it for comparison.
    """

    name: ClassVar[str] = "condition number of Λ (Eq. 36)"
    weighted: ClassVar[bool] = False

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the condition number."""
        return jnp.asarray(spectral(log_condition, information.plain, sharpness))


class WeightedConditionNumber(AbstractCriterion):
    r"""Condition number of $\Theta_B^T W^2 \Theta_B$, the matrix of weighted least squares."""

    name: ClassVar[str] = "condition number, weighted"

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the condition number."""
        return jnp.asarray(spectral(log_condition, information.weighted, sharpness))


class ScaledConditionNumber(AbstractCriterion):
    """Condition number of the weighted information after scaling its columns to unit length.

    It does not depend on units. Without the scales it measures how similar columns are.
    """

    name: ClassVar[str] = "condition number, weighted, columns scaled"

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the condition number."""
        scaled = _unit_diagonal(jnp.asarray(information.weighted))[0]
        return jnp.asarray(spectral(log_condition, scaled, sharpness))


class DOptimal(AbstractCriterion):
    r"""Volume of the confidence ellipsoid: $(\det \Theta_B^T W^2 \Theta_B)^{-1/(2n)}$.

    The geometric mean of the ellipsoid's axes. It depends neither on units nor on the choice of
    base parameters, and makes standard deviations smallest on the whole: the default.
    """

    name: ClassVar[str] = "D: mean axis of the confidence ellipsoid"
    extreme: ClassVar[bool] = False

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the mean axis."""
        size = information.weighted.shape[-1]
        return -0.5 / size * jnp.asarray(_log_determinant(jnp.asarray(information.weighted)))


class AOptimal(AbstractCriterion):
    """Root mean square of the standard deviations, each divided by its parameter's size.

    Attributes:
        sizes: Sizes of the base parameters, in their units; by default the standard deviation that
            a parameter would have in a random motion if it were the only one.
    """

    name: ClassVar[str] = "A: rms of the scaled deviations"
    extreme: ClassVar[bool] = False
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the root mean square."""
        scaled = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(_log_mean_inverse, scaled, None))


class EOptimal(AbstractCriterion):
    """Longest axis of the confidence ellipsoid, in units of the parameters' sizes.

    Attributes:
        sizes: Sizes as in `AOptimal`.
    """

    name: ClassVar[str] = "E: longest axis of the scaled ellipsoid"
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Return the logarithm of the longest axis."""
        scaled = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_largest_inverse, scaled, sharpness))


CRITERIA = (
    ConditionNumber(),
    WeightedConditionNumber(),
    ScaledConditionNumber(),
    DOptimal(),
    AOptimal(),
    EOptimal(),
)
"""All criteria, in the order of the tables."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def spectral(
    function: Callable[[Array, Sharpness], Array],
    matrix: Float[Array, "size size"],
    sharpness: Sharpness,
) -> Float[Array, ""]:
    r"""Return a function of the logarithms of a positive matrix's eigenvalues.

    For $f(\Lambda) = \varphi(\lambda)$ with $\Lambda = U \operatorname{diag}(\lambda) U^T$ the
    gradient is $U \operatorname{diag}(\varphi'(\lambda)) U^T$: it needs no derivatives of
    eigenvectors, also where eigenvalues are equal.

    Args:
        function: Symmetric function of the logarithms, in ascending order, and the sharpness.
        matrix: Symmetric positive matrix.
        sharpness: Argument of the function.
    """
    return _spectral_forward(function, matrix, sharpness)[0]


def _spectral_forward(
    function: Callable, matrix: Array, sharpness: Sharpness
) -> tuple[Array, Array]:
    eigenvalues, U = jnp.linalg.eigh(matrix)
    # Eigenvalues below this fraction of the largest one are rounding errors.
    kept = jnp.maximum(eigenvalues, 1e-15 * eigenvalues[-1])
    value, slopes = jax.value_and_grad(function)(jnp.log(kept), sharpness)
    return value, (U * (slopes / kept)[None]) @ U.T


def _spectral_backward(function: Callable, gradient: Array, g: Array) -> tuple[Array, None]:
    return g * gradient, None


spectral.defvjp(_spectral_forward, _spectral_backward)


def log_condition(logs: Float[Array, " size"], sharpness: Sharpness) -> Float[Array, ""]:
    r"""Return the log condition number, or above it $\log(\sum\lambda^p \sum\lambda^{-p})/p$."""
    if sharpness is None:
        return logs[-1] - logs[0]
    return _softmax(logs, sharpness) + _softmax(-logs, sharpness)


def log_largest_inverse(logs: Float[Array, " size"], sharpness: Sharpness) -> Float[Array, ""]:
    """Return the logarithm of the inverse's largest eigenvalue."""
    return -logs[0] if sharpness is None else _softmax(-logs, sharpness)


def _log_mean_inverse(logs: Array, sharpness: Sharpness) -> Array:
    """Return the logarithm of the inverse's mean eigenvalue."""
    return jax.nn.logsumexp(-logs) - np.log(logs.shape[-1])


def _softmax(x: Array, sharpness: Float[Array, ""] | float) -> Array:
    return jax.nn.logsumexp(sharpness * x) / sharpness


def _divide_by_sizes(information: Information, sizes: Float[AnyArray, " base"] | None) -> Array:
    """Return the information about the parameters divided by their sizes."""
    sizes = jnp.asarray(information.sizes if sizes is None else sizes)
    return sizes[:, None] * jnp.asarray(information.weighted) * sizes[None]


def _unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    square = jnp.diagonal(matrix)
    scale = 1.0 / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return scale[:, None] * matrix * scale[None], scale


@jax.custom_vjp
def _log_determinant(matrix: Float[Array, "size size"]) -> Float[Array, ""]:
    return _log_determinant_forward(matrix)[0]


def _log_determinant_forward(matrix: Array) -> tuple[Array, Array]:
    size = matrix.shape[-1]
    scaled, scale = _unit_diagonal(matrix)
    # A small ridge keeps a singular matrix with ones on its diagonal positive.
    L = jnp.linalg.cholesky(scaled + 1e-13 * np.eye(size))
    value = 2 * jnp.sum(jnp.log(jnp.diagonal(L))) - 2 * jnp.sum(jnp.log(scale))
    inverse = jax.lax.linalg.triangular_solve(L, jnp.eye(size), left_side=True, lower=True)
    inverse = inverse * scale[None]
    return value, inverse.T @ inverse


def _log_determinant_backward(inverse: Array, g: Array) -> tuple[Array]:
    return (g * inverse,)


_log_determinant.defvjp(_log_determinant_forward, _log_determinant_backward)
