r"""Pseudo-inertias: the ten inertial parameters of a body as one symmetric 4x4 matrix.

A body with density $\rho$ has $\Pi = \int (r; 1)(r; 1)^T \rho\, dV$: second moments
$\Sigma$, first moment and mass. Ten numbers belong to some distribution of positive
masses if and only if $\Pi$ is positive semidefinite (Wensing, Kim, Slotine, 2018),
which includes the triangle inequality of the principal moments of inertia.

The last part of the file is arithmetic on stacks of such matrices, for NumPy and JAX
alike. Its loops over four rows take a few dozen array operations for a whole stack:
calls of LAPACK for each matrix would make batches half as fast.
"""

from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float, Vector, as_array, namespace

Values = Any
"""Arrays of NumPy or JAX, and NumPy scalars."""
Bodies = Float[AnyArray, "*batch 10"]
r"""Parameters $(m, m r_c, A, B, C, D, E, F)$ of bodies."""
PseudoInertias = Float[AnyArray, "*batch 4 4"]
"""Pseudo-inertias of bodies."""


def _unit_pseudo_inertias() -> np.ndarray:
    """Return the pseudo-inertias of unit parameters [parameter, row, column]."""
    basis = np.zeros((10, 4, 4))
    basis[0, 3, 3] = 1.0
    for axis in range(3):
        basis[1 + axis, axis, 3] = 1.0
        basis[1 + axis, 3, axis] = 1.0
        # A moment of inertia is the sum of two second moments.
        basis[4 + axis, range(3), range(3)] = 0.5
        basis[4 + axis, axis, axis] = -0.5
        # The product of inertia of an axis belongs to both others.
        other_axes = [k for k in range(3) if k != axis]
        basis[7 + axis, other_axes, other_axes[::-1]] = 1.0
    return basis


BASIS = _unit_pseudo_inertias()
r"""Pseudo-inertias of unit parameters $(m, m r_c, A, B, C, D, E, F)$."""


def pseudo_inertia(bodies: Bodies) -> PseudoInertias:
    r"""Return the pseudo-inertias of bodies.

    They are $\begin{pmatrix} \Sigma & m r_c \\ m r_c^T & m \end{pmatrix}$ with the
    second moments $\Sigma = \frac12 \mathrm{tr}(J^o) I - J^o$ [kg m²].

    Args:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's
            frame.
    """
    p = as_array("bodies", bodies)
    return namespace(p).tensordot(p, BASIS.astype(p.dtype), 1)


def inertial_parameters(pseudo: PseudoInertias) -> Bodies:
    """Return the parameters $(m, m r_c, A, B, C, D, E, F)$ of pseudo-inertias."""
    xx, yy, zz = (pseudo[..., k, k] for k in range(3))
    mass = pseudo[..., 3, 3]
    first_moments = [pseudo[..., k, 3] for k in range(3)]
    moments = [yy + zz, xx + zz, xx + yy]
    products = [pseudo[..., 1, 2], pseudo[..., 0, 2], pseudo[..., 0, 1]]
    parameters = [mass, *first_moments, *moments, *products]
    return namespace(pseudo).stack(parameters, axis=-1)


def ball(mass: Vector, radius: Vector) -> np.ndarray:
    """Return the pseudo-inertias [*batch, 4, 4] of balls about the origin [kg, m]."""
    P = np.zeros((*mass.shape, 4, 4))
    # The second moment of a ball about its centre is m r² / 5 in each direction.
    P[..., :3, :3] = radius[..., None, None] ** 2 / 5.0 * np.eye(3)
    P[..., 3, 3] = 1.0
    return P * mass[..., None, None]


def consistency_margin(bodies: Bodies) -> np.ndarray:
    r"""Return the distances of bodies from the boundary of physical consistency.

    It is the smallest eigenvalue of the pseudo-inertia after its diagonal is scaled to
    one: at most 1, independent of units, 0 for a flat body, negative for a body that
        cannot exist.
    """
    P = pseudo_inertia(np.asarray(bodies))
    # Estimates that cannot exist may have negative masses.
    size = np.sqrt(np.abs(np.diagonal(P, axis1=-2, axis2=-1)))
    scale = 1.0 / np.where(size > 0, size, 1.0)
    scaled_matrix = P * scale[..., :, None] * scale[..., None, :]
    return np.linalg.eigvalsh(scaled_matrix)[..., 0]


def pivots(P: Values) -> Values:
    """Return the pivots of matrices [matrices, 4, 4, *more] on a leading axis.

    All of them are positive where a matrix is positive definite; their product is the
    determinant.
    """
    pivots = []
    for _ in range(P.shape[1]):
        pivot = P[:, 0, 0]
        column = P[:, 1:, 0]
        multiples = column / pivot[:, None]
        P = P[:, 1:, 1:] - column[:, :, None] * multiples[:, None]
        pivots.append(pivot)
    return namespace(P).stack(pivots)


def inverse(P: Values) -> Values:
    """Return the inverses of positive definite matrices, by one sweep for each row."""
    # A sweep exchanges one variable and its right-hand side; after all of them the
    # matrix is the negative inverse.
    for k, unit_vector in enumerate(np.eye(4)):
        pivot = P[:, k, k]
        other_mask = 1.0 - unit_vector
        vector = P[:, k] * other_mask[None] + unit_vector[None]
        multiples = vector / pivot[:, None]
        pairs = np.outer(other_mask, other_mask)
        block = P * pairs[None]
        P = block - vector[:, :, None] * multiples[:, None]
    return -P


def symmetric_part(P: Values) -> Values:
    """Return the symmetric parts of matrices."""
    return 0.5 * (P + namespace(P).swapaxes(P, -1, -2))
