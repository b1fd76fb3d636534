"""Criteria: one number that says how well a motion determines the base parameters (Eq. 36)."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.excitation.information import Information
from jaxid.excitation.spectral import Sharpness, log_condition, log_largest_inverse, spectral

RIDGE = 1e-13
"""Share that keeps a matrix with ones on its diagonal from being singular."""


class AbstractCriterion(eqx.Module):
    """A number that a design makes small.

    Attributes:
        name: What the number is, as it reads in a table.
        weighted: Whether the noise of the joints counts, and what was known before.
        extreme: Whether it has an extreme of eigenvalues, which can be made smooth.
    """

    name: ClassVar[str]
    weighted: ClassVar[bool] = True
    extreme: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """The logarithm of the number.

        Args:
            information: Of one experiment.
            sharpness: Of smooth extremes of eigenvalues, where the criterion has them; exact if
                None. Larger is closer to exact.
        """

    def value(self, information: Information) -> float:
        """The number itself, exact."""
        return float(jnp.exp(self(jax.tree.map(jnp.asarray, information))))


class ConditionNumber(AbstractCriterion):
    r"""The paper's criterion: the condition number of $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).

    It depends on the units and on which parameters lead, and a small one need not mean small
    deviations; it is here to compare with.
    """

    name: ClassVar[str] = "condition number of Λ (Eq. 36)"
    weighted: ClassVar[bool] = False

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the condition number."""
        return jnp.asarray(spectral(log_condition, information.plain, sharpness))


class WeightedConditionNumber(AbstractCriterion):
    r"""The condition number of $\Theta_B^T W^2 \Theta_B$, as weighted least squares see it."""

    name: ClassVar[str] = "condition number, weighted"

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the condition number."""
        return jnp.asarray(spectral(log_condition, information.weighted, sharpness))


class ScaledConditionNumber(AbstractCriterion):
    """The condition number of the weighted information whose columns have length one.

    It does not depend on units. Without its scales it measures how alike columns are.
    """

    name: ClassVar[str] = "condition number, weighted, columns scaled"

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the condition number."""
        return jnp.asarray(
            spectral(log_condition, _unit_diagonal(jnp.asarray(information.weighted))[0], sharpness)
        )


class DOptimal(AbstractCriterion):
    r"""The volume of the confidence ellipsoid: $(\det \Theta_B^T W^2 \Theta_B)^{-1/(2n)}$.

    The geometric mean of the ellipsoid's axes. It depends neither on units nor on the choice of
    base parameters, and makes standard deviations smallest on the whole: the default.
    """

    name: ClassVar[str] = "D: mean axis of the confidence ellipsoid"
    extreme: ClassVar[bool] = False

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the mean axis."""
        size = information.weighted.shape[-1]
        return -0.5 / size * jnp.asarray(_log_determinant(jnp.asarray(information.weighted)))


class AOptimal(AbstractCriterion):
    """The root mean square of the standard deviations, each over its parameter's size.

    Attributes:
        sizes: Of the base parameters, in their units; by default the deviation that a parameter
            would have in a random motion if it were the only one.
    """

    name: ClassVar[str] = "A: rms of the scaled deviations"
    extreme: ClassVar[bool] = False
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the root mean square."""
        scaled = _in_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(_log_mean_inverse, scaled, None))


class EOptimal(AbstractCriterion):
    """The longest axis of the confidence ellipsoid, in units of the parameters' sizes.

    Attributes:
        sizes: As in `AOptimal`.
    """

    name: ClassVar[str] = "E: longest axis of the scaled ellipsoid"
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(self, information: Information, sharpness: Sharpness = None) -> Float[Array, ""]:
        """Logarithm of the longest axis."""
        scaled = _in_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_largest_inverse, scaled, sharpness))


def _in_sizes(information: Information, own: Float[AnyArray, " base"] | None) -> Array:
    sizes = jnp.asarray(information.sizes if own is None else own)
    return sizes[:, None] * jnp.asarray(information.weighted) * sizes[None]


def _log_mean_inverse(logs: Array, sharpness: Sharpness) -> Array:
    """Log of the mean eigenvalue of the inverse."""
    return jax.nn.logsumexp(-logs) - np.log(logs.shape[-1])


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
    L = jnp.linalg.cholesky(scaled + RIDGE * np.eye(size))
    value = 2 * jnp.sum(jnp.log(jnp.diagonal(L))) - 2 * jnp.sum(jnp.log(scale))
    inverse = jax.lax.linalg.triangular_solve(L, jnp.eye(size), left_side=True, lower=True)
    inverse = inverse * scale[None]
    return value, inverse.T @ inverse


def _log_determinant_backward(inverse: Array, g: Array) -> tuple[Array]:
    return (g * inverse,)


_log_determinant.defvjp(_log_determinant_forward, _log_determinant_backward)
