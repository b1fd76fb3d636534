r"""Log-Cholesky coordinates of bodies: any ten numbers are a body that can exist.

The pseudo-inertia of a body is $U U^T$ with an upper triangle $U$ whose diagonal is positive
(Rucker, Wensing, Smooth Parameterization of Rigid-Body Inertia, 2022). Its logarithms and its other
entries are free: an optimiser of any kind stays within the possible bodies.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array, is_traced
from jaxid.errors import InputError

from .pseudo_inertia import consistency_margin, inertial_parameters, pseudo_inertia

_ROWS, _COLUMNS = np.triu_indices(4, 1)


class LogCholesky(eqx.Module):
    r"""Bodies by their log-Cholesky coordinates.

    Attributes:
        coordinates: For each body the logarithms of the diagonal of $U$, then the entries above it
            row by row; any real numbers.
    """

    coordinates: Float[AnyArray, "*batch 10"]

    @classmethod
    def of(cls, bodies: Numbers) -> "LogCholesky":
        """Return the coordinates of bodies that can exist, with $(m, m r_c, A, ..., F)$ each.

        Args:
            bodies: Parameters of each body along the last axis, or of all bodies in a row.

        Raises:
            InputError: If there are not ten numbers for each body, or a body cannot exist, or is
                flat: points and plates lie at infinity.
        """
        p = as_array("bodies", bodies)
        if p.shape[-1:] != (10,):
            if p.ndim != 1 or p.size % 10:
                raise InputError(f"`bodies` must hold ten numbers each, but has shape {p.shape}.")
            p = p.reshape(-1, 10)
        if not is_traced(p) and not np.all(np.asarray(consistency_margin(np.asarray(p))) > 0):
            raise InputError(
                "`bodies` must be able to exist, with a volume: use `PhysicallyConsistent`, or the "
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
