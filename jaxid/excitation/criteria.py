"""Information of a motion about the base parameters, and criteria that make one number of it."""

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, namespace
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.trajectory.trajectory import AbstractBasis

Sharpness = Float[Array, ""] | float | None
"""Closeness of a smooth maximum to the exact one: larger is closer; None is exact."""


class Information(eqx.Module):
    r"""Information of an experiment, as criteria need it.

    Attributes:
        plain: The paper's $\Lambda = \Theta_B^T \Theta_B$ (Eq. 36).
        weighted: The same in units of the noise, $\Theta_B^T W^2 \Theta_B$, plus prior
            information; its inverse is the covariance of weighted least squares.
        sizes: Typical size of each parameter, in its unit.
    """

    plain: Float[AnyArray, "*batch base base"]
    weighted: Float[AnyArray, "*batch base base"]
    sizes: Float[AnyArray, " base"]


def information(
    base: BaseParameters,
    motion: Motion,
    weights: Float[AnyArray, " joints"],
    prior: Float[AnyArray, "base base"] | None = None,
    sizes: Float[AnyArray, " base"] | None = None,
) -> Information:
    """Return the information of one motion, computed in NumPy (Eq. 36).

    Args:
        base: Base parameters.
        motion: All samples that will be measured.
        weights: Inverse standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments; none if None.
        sizes: Typical size of each parameter; one if None.
    """
    plain = np.zeros((base.size, base.size))
    weighted = plain.copy() if prior is None else np.array(prior, np.float64)
    rows = base.regressor_rows(motion)
    for own, theta, w in zip(
        base.acting_columns, rows, np.asarray(weights), strict=True
    ):
        gram = theta.T @ theta
        place = np.ix_(own, own)
        plain[place] += gram
        weighted[place] += w**2 * gram
    return Information(plain, weighted, np.ones(base.size) if sizes is None else sizes)


def informations(
    base: BaseParameters,
    basis: AbstractBasis,
    x: Float[AnyArray, "starts joints variables"],
    *,
    samples: int,
    measured: int,
    weights: Float[AnyArray, " joints"],
    prior: Float[AnyArray, "base base"],
) -> tuple[Array, Array]:
    """Return plain and weighted information of many trajectories from their coefficients.

    Motions are evaluated at `samples`, which stand for those that are `measured`.
    """
    regressor = base.joint_regressor
    rows = np.asarray(basis.rows(basis.times(samples)))
    q, qd, qdd = (jnp.einsum("sk,bjk->jbs", part, x) for part in rows[:3])
    columns_by_joint = regressor(q, qd, qdd)

    plain = jnp.zeros((x.shape[0], regressor.size, regressor.size), x.dtype)
    weighted = plain
    for joint, columns in enumerate(columns_by_joint):
        place = np.ix_(regressor.columns[joint], regressor.columns[joint])
        gram = measured / samples * _gram(columns)
        plain = plain.at[:, *place].add(gram)
        weighted = weighted.at[:, *place].add(weights[joint] ** 2 * gram)
    return plain, weighted + prior[None]


@jax.custom_jvp
def _gram(
    columns: Float[Array, "starts columns samples"],
) -> Float[Array, "starts columns columns"]:
    """Return products of columns; the derivative takes one product instead of two."""
    return jnp.einsum("bis,bjs->bij", columns, columns)


@_gram.defjvp
def _gram_derivative(primals: tuple, tangents: tuple) -> tuple:
    (columns,), (change,) = primals, tangents
    half = jnp.einsum("bis,bjs->bij", change, columns)
    return _gram(columns), half + jnp.swapaxes(half, 1, 2)


def standard_deviations(
    weighted: Float[AnyArray, "base base"],
) -> Float[np.ndarray, " base"]:
    """Return standard deviations from weighted information; infinite where undetermined."""
    scaled, scale = _unit_diagonal(np.asarray(weighted, np.float64))
    values, U = np.linalg.eigh(scaled)
    lost = values < 1e-12 * values[-1]
    variances = (U[:, ~lost] ** 2 / values[None, ~lost]).sum(axis=1)
    # A parameter is undetermined if it takes part in a direction without information.
    undetermined = (np.abs(U[:, lost]) > 1e-3).any(axis=1)
    return np.where(undetermined, np.inf, scale * np.sqrt(variances))


class AbstractCriterion(eqx.Module):
    """A number that a design minimises.

    Attributes:
        name: Name of the number in tables.
        weighted: Whether the noise of the joints and earlier information count.
    """

    name: ClassVar[str]
    weighted: ClassVar[bool] = True

    @abstractmethod
    def __call__(
        self, information: Information, sharpness: Sharpness = None
    ) -> Float[Array, ""]:
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
        of = ", weighted" if self.weighted else " of Λ (Eq. 36)"
        return f"condition number{of}{', columns scaled' if self.scaled else ''}"

    def __call__(
        self, information: Information, sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """Return the logarithm of the condition number."""
        matrix = jnp.asarray(
            information.weighted if self.weighted else information.plain
        )
        matrix = _unit_diagonal(matrix)[0] if self.scaled else matrix
        return jnp.asarray(spectral(log_condition, matrix, sharpness))


class DOptimal(AbstractCriterion):
    r"""Volume of the confidence ellipsoid: $(\det \Theta_B^T W^2 \Theta_B)^{-1/(2n)}$.

    The geometric mean of the ellipsoid's axes. It depends neither on units nor on the
    choice of base parameters, and makes standard deviations smallest on the whole: the
    default.
    """

    name: ClassVar[str] = "D: mean axis of the confidence ellipsoid"

    def __call__(
        self, information: Information, sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """Return the logarithm of the mean axis."""
        matrix = jnp.asarray(information.weighted)
        # The determinant does not depend on the scale that makes the factor accurate.
        scale = jax.lax.stop_gradient(_unit_diagonal(matrix)[1])
        scaled = scale[:, None] * matrix * scale[None]
        # A small ridge keeps a singular matrix with ones on its diagonal positive.
        L = jnp.linalg.cholesky(scaled + 1e-13 * np.eye(len(scale)))
        return -jnp.mean(jnp.log(jnp.diagonal(L)) - jnp.log(scale))


class AOptimal(AbstractCriterion):
    """Root mean square of the standard deviations, each divided by its parameter's size.

    Attributes:
        sizes: Sizes of the base parameters, in their units; by default the standard
            deviation that a parameter would have in a random motion if it were the only
            one.
    """

    name: ClassVar[str] = "A: rms of the scaled deviations"
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(
        self, information: Information, sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """Return the logarithm of the root mean square."""
        scaled = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_mean_inverse, scaled, None))


class EOptimal(AbstractCriterion):
    """Longest axis of the confidence ellipsoid, in units of the parameters' sizes.

    Attributes:
        sizes: Sizes as in `AOptimal`.
    """

    name: ClassVar[str] = "E: longest axis of the scaled ellipsoid"
    sizes: Float[AnyArray, " base"] | None = None

    def __call__(
        self, information: Information, sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """Return the logarithm of the longest axis."""
        scaled = _divide_by_sizes(information, self.sizes)
        return 0.5 * jnp.asarray(spectral(log_largest_inverse, scaled, sharpness))


CRITERIA: dict[str, AbstractCriterion] = {
    "condition_number": ConditionNumber(),
    "weighted_condition_number": ConditionNumber(weighted=True),
    "scaled_condition_number": ConditionNumber(weighted=True, scaled=True),
    "d_optimal": DOptimal(),
    "a_optimal": AOptimal(),
    "e_optimal": EOptimal(),
}
"""All criteria by the values of the key `criterion`, in the order of the tables."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def spectral(
    function: Callable[[Array, Sharpness], Array],
    matrix: Float[Array, "size size"],
    sharpness: Sharpness,
) -> Float[Array, ""]:
    r"""Return a symmetric function of the logarithms of a positive matrix's eigenvalues.

    For $f(\Lambda) = \varphi(\lambda)$ with $\Lambda = U \operatorname{diag}(\lambda)
    U^T$ the gradient is $U \operatorname{diag}(\varphi'(\lambda)) U^T$: it needs no
    derivatives of eigenvectors, also where eigenvalues are equal. The sharpness is a
    constant.
    """
    return function(jnp.log(_eigenvalues(matrix)[0]), sharpness)


@spectral.defjvp
def _spectral_derivative(function: Callable, primals: tuple, tangents: tuple) -> tuple:
    matrix, sharpness = primals
    eigenvalues, U = _eigenvalues(matrix)
    value, slopes = jax.value_and_grad(function)(jnp.log(eigenvalues), sharpness)
    gradient = (U * (slopes / eigenvalues)[None]) @ U.T
    return value, jnp.sum(gradient * tangents[0])


def _eigenvalues(matrix: Float[Array, "size size"]) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors; below a fraction of the largest is rounding."""
    eigenvalues, U = jnp.linalg.eigh(matrix)
    return jnp.maximum(eigenvalues, 1e-15 * eigenvalues[-1]), U


def log_condition(
    logs: Float[Array, " size"], sharpness: Sharpness
) -> Float[Array, ""]:
    r"""Return the log condition number, or above it $\log(\sum\lambda^p \sum\lambda^{-p})/p$."""
    if sharpness is None:
        return logs[-1] - logs[0]
    return _softmax(logs, sharpness) + _softmax(-logs, sharpness)


def log_largest_inverse(
    logs: Float[Array, " size"], sharpness: Sharpness
) -> Float[Array, ""]:
    """Return the logarithm of the inverse's largest eigenvalue."""
    return -logs[0] if sharpness is None else _softmax(-logs, sharpness)


def log_mean_inverse(
    logs: Float[Array, " size"], sharpness: Sharpness
) -> Float[Array, ""]:
    """Return the logarithm of the inverse's mean eigenvalue."""
    return jax.nn.logsumexp(-logs) - np.log(logs.shape[-1])


def _softmax(x: Array, sharpness: Float[Array, ""] | float) -> Array:
    return jax.nn.logsumexp(sharpness * x) / sharpness


def _divide_by_sizes(
    information: Information, sizes: Float[AnyArray, " base"] | None
) -> Array:
    """Return the information about the parameters divided by their sizes."""
    sizes = jnp.asarray(information.sizes if sizes is None else sizes)
    return sizes[:, None] * jnp.asarray(information.weighted) * sizes[None]


def _unit_diagonal(matrix: AnyArray) -> tuple[Any, Any]:
    """Return the matrix scaled to ones on its diagonal, and the factor of each row and column."""
    xp = namespace(matrix)
    square = xp.diagonal(matrix)
    scale = 1.0 / xp.sqrt(xp.where(square > 0, square, 1.0))
    return scale[:, None] * matrix * scale[None], scale
