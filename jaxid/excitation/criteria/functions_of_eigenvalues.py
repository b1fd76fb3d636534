"""Functions of eigenvalues, differentiable where these are equal."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Float

Scalar = Float[Array, ""]
Sharpness = Scalar | float | None
"""Closeness of a smooth maximum to the exact one: larger is closer; None is exact."""

MIN_EIGENVALUE = 1e-15
"""Eigenvalue, relative to the largest one, below which there is only rounding."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def spectral(
    function: Callable[[Array, Sharpness], Array],
    matrix: Array,
    sharpness: Sharpness,
) -> Scalar:
    r"""Return a symmetric function of the logarithms of a matrix's eigenvalues.

    For $f(\Lambda) = \varphi(\lambda)$ with $\Lambda = U \operatorname{diag}(\lambda)
    U^T$ the gradient is $U \operatorname{diag}(\varphi'(\lambda)) U^T$: it needs no
    derivatives of eigenvectors, also where eigenvalues are equal. The sharpness is a
    constant.
    """
    eigenvalues, _ = _eigenvalues(matrix)
    return function(jnp.log(eigenvalues), sharpness)


@spectral.defjvp
def _spectral_derivative(function: Callable, primals: tuple, tangents: tuple):
    matrix, sharpness = primals
    eigenvalues, U = _eigenvalues(matrix)
    value, slopes = jax.value_and_grad(function)(jnp.log(eigenvalues), sharpness)
    gradient = (U * (slopes / eigenvalues)[None]) @ U.T
    return value, jnp.sum(gradient * tangents[0])


def _eigenvalues(matrix: Array):
    """Return eigenvalues and eigenvectors; what is below rounding is raised to it."""
    eigenvalues, U = jnp.linalg.eigh(matrix)
    return jnp.maximum(eigenvalues, MIN_EIGENVALUE * eigenvalues[-1]), U


def log_condition(logs: Array, sharpness: Sharpness) -> Scalar:
    r"""Return the logarithm of the condition number.

    A smooth one is above it: $\log(\sum\lambda^p \sum\lambda^{-p})/p$.
    """
    if sharpness is None:
        return logs[-1] - logs[0]
    return _softmax(logs, sharpness) + _softmax(-logs, sharpness)


def log_largest_inverse(logs: Array, sharpness: Sharpness) -> Scalar:
    """Return the logarithm of the inverse's largest eigenvalue."""
    return -logs[0] if sharpness is None else _softmax(-logs, sharpness)


def log_mean_inverse(logs: Array, sharpness: Sharpness) -> Scalar:
    """Return the logarithm of the inverse's mean eigenvalue."""
    return jax.nn.logsumexp(-logs) - np.log(logs.shape[-1])


def _softmax(x: Array, sharpness: Scalar | float):
    """Return a smooth maximum, which is never below the exact one."""
    return jax.nn.logsumexp(sharpness * x) / sharpness
