r"""Pseudo-inertias: ten inertial parameters of a body as one symmetric 4x4 matrix.

A body with density $\rho$ has $\Pi = \int (r; 1)(r; 1)^T \rho\, dV$: second moments $\Sigma$, first
moment and mass. Ten numbers belong to some distribution of positive masses if and only if $\Pi$ is
positive semidefinite (Wensing, Kim, Slotine, 2018), which includes the triangle inequality of the
principal moments of inertia.
"""

import numpy as np

from jaxid.arrays import AnyArray, Float

TEN = 10


def _basis() -> np.ndarray:
    basis = np.zeros((TEN, 4, 4))
    basis[0, 3, 3] = 1.0
    for k in range(3):
        basis[1 + k, k, 3] = basis[1 + k, 3, k] = 1.0
        basis[4 + k, range(3), range(3)] = 0.5
        basis[4 + k, k, k] = -0.5
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        basis[7 + k, i, j] = basis[7 + k, j, i] = 1.0
    return basis


BASIS = _basis()
r"""What unit parameters $(m, m r_c, A, B, C, D, E, F)$ add to the pseudo-inertia."""


def pseudo_inertia(
    bodies: Float[AnyArray, "*batch 10"],
) -> Float[np.ndarray, "*batch 4 4"]:
    r"""The pseudo-inertia $\begin{pmatrix} \Sigma & m r_c \\ m r_c^T & m \end{pmatrix}$ of bodies.

    The second moments are $\Sigma = \frac12 \mathrm{tr}(J^o) I - J^o$ [kg m²].

    Args:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's frame.
    """
    return np.einsum("...i,iab->...ab", np.asarray(bodies), BASIS)


def inertial_parameters(
    pseudo: Float[AnyArray, "*batch 4 4"],
) -> Float[np.ndarray, "*batch 10"]:
    """The parameters $(m, m r_c, A, B, C, D, E, F)$ of pseudo-inertias.

    Args:
        pseudo: Pseudo-inertias about the origin of the body's frame.
    """
    P = np.asarray(pseudo)
    xx, yy, zz = P[..., 0, 0], P[..., 1, 1], P[..., 2, 2]
    return np.stack(
        [
            P[..., 3, 3],
            *(P[..., k, 3] for k in range(3)),
            yy + zz,
            xx + zz,
            xx + yy,
            P[..., 1, 2],
            P[..., 0, 2],
            P[..., 0, 1],
        ],
        axis=-1,
    )


def ball(
    mass: Float[AnyArray, "*batch"],
    centre: Float[AnyArray, "*batch 3"],
    radius: Float[AnyArray, "*batch"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """Pseudo-inertias of solid balls.

    Args:
        mass: Masses [kg].
        centre: Their centres in the body's frame [m].
        radius: Their radii [m].
    """
    m, c = np.asarray(mass, np.float64), np.asarray(centre, np.float64)
    spread = np.asarray(radius, np.float64)[..., None, None] ** 2 / 5.0 * np.eye(3)
    P = np.empty((*m.shape, 4, 4))
    P[..., :3, :3] = spread + c[..., :, None] * c[..., None, :]
    P[..., :3, 3] = P[..., 3, :3] = c
    P[..., 3, 3] = 1.0
    return P * m[..., None, None]


def share_of_a_body(bodies: Float[AnyArray, "*batch 10"]) -> Float[np.ndarray, "*batch"]:
    r"""How far bodies are from the boundary of what can exist; negative beyond it, of 1.

    It is the smallest eigenvalue of the pseudo-inertia in units of which its diagonal is one: free
    of units, 1 for a body whose axes do not mix, 0 for one that is flat.
    """
    P = pseudo_inertia(bodies)
    size = np.sqrt(np.abs(np.diagonal(P, axis1=-2, axis2=-1)))
    scale = 1.0 / np.where(size > 0, size, 1.0)
    return np.linalg.eigvalsh(P * scale[..., :, None] * scale[..., None, :])[..., 0]
