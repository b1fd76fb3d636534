r"""Functions of eigenvalues, differentiated without derivatives of eigenvectors.

For $f(\Lambda) = \varphi(\lambda)$ with $\Lambda = U \operatorname{diag}(\lambda) U^T$ the gradient
is $U \operatorname{diag}(\varphi'(\lambda)) U^T$, from one decomposition and however close
eigenvalues are, where $\varphi$ is symmetric in them.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxid.arrays import Array, Float

FLOOR = 1e-15
"""Share of the largest eigenvalue below which eigenvalues are rounding."""
Sharpness = Float[Array, ""] | float | None
"""How close a smooth maximum is to the exact one; None is exact."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def spectral(
    function: Callable[[Array, Sharpness], Array],
    matrix: Float[Array, "size size"],
    sharpness: Sharpness,
) -> Float[Array, ""]:
    """A function of the logarithms of a positive matrix's eigenvalues.

    Args:
        function: Of the logarithms, in ascending order, and the sharpness.
        matrix: Symmetric, positive.
        sharpness: Handed to the function.
    """
    return _forward(function, matrix, sharpness)[0]


def _forward(function: Callable, matrix: Array, sharpness: Sharpness) -> tuple[Array, Array]:
    eigenvalues, U = jnp.linalg.eigh(matrix)
    kept = jnp.maximum(eigenvalues, FLOOR * eigenvalues[-1])
    value, slopes = jax.value_and_grad(function)(jnp.log(kept), sharpness)
    return value, (U * (slopes / kept)[None]) @ U.T


def _backward(function: Callable, gradient: Array, g: Array) -> tuple[Array, None]:
    return g * gradient, None


spectral.defvjp(_forward, _backward)


def log_condition(logs: Float[Array, " size"], sharpness: Sharpness) -> Float[Array, ""]:
    r"""Log of the condition number, or above it $\log(\sum\lambda^p \sum\lambda^{-p})/p$."""
    if sharpness is None:
        return logs[-1] - logs[0]
    return _softmax(logs, sharpness) + _softmax(-logs, sharpness)


def log_largest_inverse(logs: Float[Array, " size"], sharpness: Sharpness) -> Float[Array, ""]:
    """Log of the largest eigenvalue of the inverse."""
    return -logs[0] if sharpness is None else _softmax(-logs, sharpness)


def _softmax(x: Array, sharpness: Float[Array, ""] | float) -> Array:
    return jax.nn.logsumexp(sharpness * x) / sharpness
