r"""Pseudo-inertias: the ten inertial parameters of a body as one symmetric 4x4 matrix.

A body with density $\rho$ has $\Pi = \int (r; 1)(r; 1)^T \rho\, dV$: second moments
$\Sigma$, first moment and mass. Ten numbers belong to some distribution of positive
masses if and only if $\Pi$ is positive semidefinite (Wensing, Kim, Slotine, 2018),
which includes the triangle inequality of the principal moments of inertia.

The last part of the file is arithmetic on stacks of such matrices, for NumPy and JAX
alike. The loops over four rows are unrolled: a stack takes a few dozen array operations
and no call of LAPACK.
"""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array, is_traced, namespace
from jaxid.errors import InputError

Values = Any
"""Arrays of NumPy or JAX, and NumPy scalars."""


BASIS = np.zeros((10, 4, 4))
r"""Pseudo-inertias of unit parameters $(m, m r_c, A, B, C, D, E, F)$."""
BASIS[0, 3, 3] = 1.0
for _k, (_i, _j) in enumerate(((1, 2), (0, 2), (0, 1))):
    BASIS[1 + _k, _k, 3] = BASIS[1 + _k, 3, _k] = 1.0
    BASIS[4 + _k, range(3), range(3)] = 0.5
    BASIS[4 + _k, _k, _k] = -0.5
    BASIS[7 + _k, _i, _j] = BASIS[7 + _k, _j, _i] = 1.0
_ROWS, _COLUMNS = np.triu_indices(4, 1)


def pseudo_inertia(
    bodies: Float[AnyArray, "*batch 10"],
) -> Float[AnyArray, "*batch 4 4"]:
    r"""Return the pseudo-inertia $\begin{pmatrix} \Sigma & m r_c \\ m r_c^T & m \end{pmatrix}$.

    The second moments are $\Sigma = \frac12 \mathrm{tr}(J^o) I - J^o$ [kg m²].

    Args:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's
            frame.
    """
    p = as_array("bodies", bodies)
    return namespace(p).tensordot(p, BASIS.astype(p.dtype), 1)


def inertial_parameters(
    pseudo: Float[AnyArray, "*batch 4 4"],
) -> Float[AnyArray, "*batch 10"]:
    """Return the parameters $(m, m r_c, A, B, C, D, E, F)$ of pseudo-inertias."""
    P, xp = pseudo, namespace(pseudo)
    xx, yy, zz = P[..., 0, 0], P[..., 1, 1], P[..., 2, 2]
    first_moments = (P[..., k, 3] for k in range(3))
    products = P[..., 1, 2], P[..., 0, 2], P[..., 0, 1]
    return xp.stack(
        [P[..., 3, 3], *first_moments, yy + zz, xx + zz, xx + yy, *products], axis=-1
    )


def ball(mass: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertias [*batch, 4, 4] of solid balls [kg, m]."""
    P = np.empty((*mass.shape, 4, 4))
    P[..., :3, :3] = radius[..., None, None] ** 2 / 5.0 * np.eye(3)
    P[..., :3, :3] += centre[..., :, None] * centre[..., None, :]
    P[..., :3, 3] = P[..., 3, :3] = centre
    P[..., 3, 3] = 1.0
    return P * mass[..., None, None]


def consistency_margin(
    bodies: Float[AnyArray, "*batch 10"],
) -> Float[np.ndarray, "*batch"]:
    r"""Return the distances of bodies from the boundary of physical consistency.

    It is the smallest eigenvalue of the pseudo-inertia after its diagonal is scaled to
    one: at most 1, independent of units, 0 for a flat body, negative for a body that
        cannot exist.
    """
    P = pseudo_inertia(np.asarray(bodies))
    size = np.sqrt(np.abs(np.diagonal(P, axis1=-2, axis2=-1)))
    scale = 1.0 / np.where(size > 0, size, 1.0)
    return np.linalg.eigvalsh(P * scale[..., :, None] * scale[..., None, :])[..., 0]


class LogCholesky(eqx.Module):
    r"""Log-Cholesky coordinates of bodies: any ten numbers are a body that can exist.

    The pseudo-inertia of a body is $U U^T$ with an upper triangle $U$ whose diagonal is
    positive (Rucker, Wensing, Smooth Parameterization of Rigid-Body Inertia, 2022). Its
    logarithms and its other entries are free: an optimiser of any kind stays within the
    possible bodies.

    Attributes:
        coordinates: For each body the logarithms of the diagonal of $U$, then the
            entries above it row by row; any real numbers.
    """

    coordinates: Float[AnyArray, "*batch 10"]

    @classmethod
    def of(cls, bodies: Numbers) -> "LogCholesky":
        """Return the coordinates of bodies that can exist, with $(m, m r_c, A, ..., F)$ each.

        Args:
            bodies: Parameters of each body along the last axis, or of all bodies in a
                row.

        Raises:
            InputError: If there are not ten numbers for each body, or a body cannot
                exist, or is flat: points and plates lie at infinity.
        """
        p = as_array("bodies", bodies)
        if p.shape[-1:] != (10,):
            if p.ndim != 1 or p.size % 10:
                raise InputError(
                    f"`bodies` must hold ten numbers each, but has shape {p.shape}."
                )
            p = p.reshape(-1, 10)
        if not is_traced(p) and not np.all(
            np.asarray(consistency_margin(np.asarray(p))) > 0
        ):
            raise InputError(
                "`bodies` must be able to exist, with a volume: use "
                "`PhysicallyConsistent`, or the "
                "bodies of a URDF file."
            )
        # The upper triangle is a lower one with the axes in reverse order.
        reverse = (Ellipsis, slice(None, None, -1), slice(None, None, -1))
        U = jnp.linalg.cholesky(jnp.asarray(pseudo_inertia(p))[reverse])[reverse]
        diagonal = jnp.diagonal(U, axis1=-2, axis2=-1)
        above = U[..., _ROWS, _COLUMNS]
        return cls(jnp.concatenate([jnp.log(diagonal), above], axis=-1))

    @property
    def parameters(self) -> Float[AnyArray, "*batch 10"]:
        """Parameters $(m, m r_c, A, B, C, D, E, F)$ of each body."""
        x = jnp.asarray(self.coordinates)
        U = jnp.exp(x[..., :4, None]) * jnp.eye(4, dtype=x.dtype).reshape(
            (1,) * (x.ndim - 1) + (4, 4)
        )
        U = U.at[..., _ROWS, _COLUMNS].set(x[..., 4:])
        return inertial_parameters(U @ jnp.swapaxes(U, -1, -2))


def _cholesky(xp: ModuleType, P: Values) -> list[list[Values]]:
    """Return the entries of the lower triangles; NaN where a matrix is not positive definite."""
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


def pivots(xp: ModuleType, P: Values) -> Values:
    """Return the pivots of matrices [matrices, 4, 4, *more] on a leading axis.

    All of them are positive where a matrix is positive definite; their product is the
    determinant.
    """
    found = [P[:, 0, 0]]
    for _ in range(P.shape[1] - 1):
        column = P[:, 1:, 0]
        P = P[:, 1:, 1:] - column[:, :, None] * (column / P[:, :1, 0])[:, None]
        found.append(P[:, 0, 0])
    return xp.stack(found)


def inverse(xp: ModuleType, P: Values) -> Values:
    """Return the inverses of positive definite matrices."""
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


def symmetric_part(xp: ModuleType, P: Values) -> Values:
    """Return the symmetric parts of matrices."""
    return 0.5 * (P + xp.swapaxes(P, -1, -2))
