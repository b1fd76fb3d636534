"""Stacks of small symmetric matrices, for NumPy and JAX alike: Cholesky factors written out.

Loops over four rows are unrolled, so that a stack is handled by a few dozen operations on whole
arrays: no calls of LAPACK for matrices of sixteen numbers.
"""

from types import ModuleType

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.identification.consistency.cone_program import Values


def _cholesky(xp: ModuleType, P: Values) -> list[list[Values]]:
    """Entries of the lower triangles; not numbers where a matrix is not positive definite."""
    n = P.shape[-1]
    L: list[list[Values]] = [[P[..., 0, 0]] * n for _ in range(n)]
    for j in range(n):
        pivot = P[..., j, j]
        for k in range(j):
            pivot = pivot - L[j][k] ** 2
        L[j][j] = xp.sqrt(pivot)
        for i in range(j + 1, n):
            entry = P[..., i, j]
            for k in range(j):
                entry = entry - L[i][k] * L[j][k]
            L[i][j] = entry / L[j][j]
    return L


def definite(xp: ModuleType, P: Float[AnyArray, "stack n n many"]) -> Bool[AnyArray, "stack many"]:
    """Which matrices are positive definite; many for each of a stack, side by side."""
    good = P[:, 0, 0] > 0
    for _ in range(P.shape[1] - 1):
        column = P[:, 1:, 0]
        P = P[:, 1:, 1:] - column[:, :, None] * (column / P[:, :1, 0])[:, None]
        good = good & (P[:, 0, 0] > 0)
    return good


def log_determinant(xp: ModuleType, P: Float[AnyArray, "*stack n n"]) -> Float[AnyArray, "*stack"]:
    """Logarithms of the determinants of positive definite matrices."""
    L = _cholesky(xp, P)
    total = xp.log(L[0][0])
    for j in range(1, P.shape[-1]):
        total = total + xp.log(L[j][j])
    return 2.0 * total


def inverse(xp: ModuleType, P: Float[AnyArray, "*stack n n"]) -> Float[AnyArray, "*stack n n"]:
    """Inverses of positive definite matrices."""
    L = _cholesky(xp, P)
    n = P.shape[-1]
    zero = xp.zeros_like(P[..., 0, 0])
    rows = [[zero] * n for _ in range(n)]
    for j in range(n):
        rows[j][j] = 1.0 / L[j][j]
        for i in range(j + 1, n):
            total = zero
            for k in range(j, i):
                total = total + L[i][k] * rows[k][j]
            rows[i][j] = -total / L[i][i]
    M = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    return xp.swapaxes(M, -1, -2) @ M


def symmetric(xp: ModuleType, P: Float[AnyArray, "*stack n n"]) -> Float[AnyArray, "*stack n n"]:
    """The symmetric parts."""
    return 0.5 * (P + xp.swapaxes(P, -1, -2))
