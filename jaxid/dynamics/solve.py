"""A symmetric positive definite system, solved in scalars: so that programs can have it."""

import jax.numpy as jnp

from jaxid.arrays import AnyArray, Float


def solve_symmetric(
    A: Float[AnyArray, "joints joints"], b: Float[AnyArray, " joints"]
) -> Float[AnyArray, " joints"]:
    r"""Solves $A x = b$ by $A = L D L^T$, without square roots or choices.

    Only the lower triangle is read. Written out entry by entry, since a program has no loops and
    a robot few joints.

    Args:
        A: Symmetric and positive definite.
        b: Right side.
    """
    n = b.shape[0]
    scaled = [[A[i, j] for j in range(i + 1)] for i in range(n)]
    lower = [[A[i, j] for j in range(i)] for i in range(n)]
    for j in range(n):
        for i in range(j, n):
            for k in range(j):
                scaled[i][j] = scaled[i][j] - scaled[i][k] * lower[j][k]
            if i > j:
                lower[i][j] = scaled[i][j] / scaled[j][j]
    x = [b[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - lower[i][k] * x[k]
    x = [x[i] / scaled[i][i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - lower[k][i] * x[k]
    return jnp.stack(x)
