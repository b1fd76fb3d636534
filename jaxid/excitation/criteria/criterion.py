"""Criteria of designs: each makes one number of a motion's information."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .functions_of_eigenvalues import (
    Scalar,
    Sharpness,
    log_condition,
    log_largest_inverse,
    log_mean_inverse,
    spectral,
)
from .information_matrix import BaseVector, Information, scale_to_unit_diagonal


class AbstractCriterion(eqx.Module):
    """A number that a design minimises.

    Attributes:
        name: Name of the number in tables.
        weighted: Whether the noise of the joints and earlier information count.
    """

    name: ClassVar[str]
    weighted: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, information: Information, sharpness: Sharpness = None) -> Scalar:
        """Return the logarithm of the number.

        Args:
            information: Information of one experiment.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
        """

    def value(self, information: Information) -> float:
        """Return the number itself, exact."""
        return float(jnp.exp(self(jax.tree.map(jnp.asarray, information))))


class ConditionNumber(AbstractCriterion):
    r"""Criterion of the paper: condition number of $\Theta_B^T \Theta_B$ (Eq. 36).

    It depends on the choice of base parameters, and a small one need not mean small
    standard deviations; use it for comparison.

    Attributes:
        weighted: Whether it is that of $\Theta_B^T W^2 \Theta_B$, the matrix of
            weighted least squares.
        scaled: Whether columns are scaled to unit length: then it does not depend on
            units, and measures how similar columns are.
    """

    weighted: bool = eqx.field(static=True, default=False)  # pyright: ignore
    scaled: bool = eqx.field(static=True, default=False)

    @property
    def name(self) -> str:  # pyright: ignore
        """Name of the number in tables."""
        name = "condition number"
        name += ", weighted" if self.weighted else " of Λ (Eq. 36)"
        return f"{name}, columns scaled" if self.scaled else name

    def __call__(self, information, sharpness=None):
        """Return the logarithm of the condition number."""
        matrix = information.weighted if self.weighted else information.plain
        if self.scaled:
            matrix, _ = scale_to_unit_diagonal(matrix)
        return jnp.asarray(spectral(log_condition, jnp.asarray(matrix), sharpness))


class DOptimal(AbstractCriterion):
    r"""Volume of the confidence ellipsoid: $(\det \Theta_B^T W^2 \Theta_B)^{-1/(2n)}$.

    The geometric mean of the ellipsoid's axes. It depends neither on units nor on the
    choice of base parameters, and makes standard deviations smallest on the whole: the
    default.
    """

    name: ClassVar[str] = "D: mean axis of the confidence ellipsoid"

    def __call__(self, information, sharpness=None):
        """Return the logarithm of the mean axis."""
        matrix = jnp.asarray(information.weighted)
        # The determinant does not depend on the scale that makes the factor accurate.
        _, scale = scale_to_unit_diagonal(matrix)
        scale = jax.lax.stop_gradient(scale)
        matrix = scale[:, None] * matrix * scale[None]
        # A small ridge keeps a singular matrix with ones on its diagonal positive.
        ridge = 1e-13 * np.eye(len(scale))
        L = jnp.linalg.cholesky(matrix + ridge)
        return -jnp.mean(jnp.log(jnp.diagonal(L)) - jnp.log(scale))


class AOptimal(AbstractCriterion):
    """Root mean square of the standard deviations, each over its parameter's size.

    Attributes:
        sizes: Sizes of the base parameters, in their units; by default the standard
            deviation that a parameter would have in a random motion if it were the only
            one.
    """

    name: ClassVar[str] = "A: rms of the scaled deviations"
    sizes: BaseVector | None = None

    def __call__(self, information, sharpness=None):
        """Return the logarithm of the root mean square."""
        matrix = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_mean_inverse, matrix, None))


class EOptimal(AbstractCriterion):
    """Longest axis of the confidence ellipsoid, in units of the parameters' sizes.

    Attributes:
        sizes: Sizes as in `AOptimal`.
    """

    name: ClassVar[str] = "E: longest axis of the scaled ellipsoid"
    sizes: BaseVector | None = None

    def __call__(self, information, sharpness=None):
        """Return the logarithm of the longest axis."""
        matrix = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_largest_inverse, matrix, sharpness))


CRITERIA: dict[str, AbstractCriterion] = {
    "condition_number": ConditionNumber(),
    "weighted_condition_number": ConditionNumber(weighted=True),
    "scaled_condition_number": ConditionNumber(weighted=True, scaled=True),
    "d_optimal": DOptimal(),
    "a_optimal": AOptimal(),
    "e_optimal": EOptimal(),
}
"""All criteria by the values of the key `criterion`, in the order of the tables."""


def _divide_by_sizes(information: Information, sizes: BaseVector | None):
    """Return the information about the parameters divided by their sizes."""
    sizes = jnp.asarray(information.sizes if sizes is None else sizes)
    return sizes[:, None] * jnp.asarray(information.weighted) * sizes[None]
