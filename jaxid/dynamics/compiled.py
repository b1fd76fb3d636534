"""Former functions that are now methods of `BaseParameters`."""

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.motion import Motion


def regressor_rows(base: BaseParameters, motion: Motion):
    """Return `base.regressor_rows(motion)`."""
    return base.regressor_rows(motion)


def acting_columns(base: BaseParameters):
    """Return `base.acting_columns`."""
    return base.acting_columns


def forces(base: BaseParameters, p, motion: Motion):
    """Return `base.forces_in_numpy(p, motion)`."""
    return base.forces_in_numpy(p, motion)


def tool_forces(base: BaseParameters, motion: Motion):
    """Return `base.tool_forces(motion)`."""
    return base.tool_forces(motion)


def mass_matrices(base: BaseParameters, p, q):
    """Return the mass matrices of some poses in NumPy."""
    return in_numpy(base, base.inertia, q, shared=(p,))
