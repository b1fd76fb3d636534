"""Evaluation in NumPy: float64 whatever JAX's precision, and nothing to compile."""

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import in_numpy, machines, program_of
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed import PackedRegressor


def regressor_rows(
    base: BaseParameters, motion: Motion
) -> list[Float[np.ndarray, "samples columns"]]:
    """For each joint its row of the base regressor, in the columns that can act on it (Eq. 23).

    The other columns are zero for every motion: a joint feels only the bodies beyond it.
    """
    n = (base.model.robot.joints,)
    machine = machines(base, base.columns, n, n, n)
    result = machine.packed(False, *(x.T for x in _arrays(motion)))
    packed = PackedRegressor.of_result(result, motion.q.shape[0])
    return [np.asarray(packed.rows(joint)).T for joint in range(packed.joints)]


def acting_columns(base: BaseParameters) -> list[tuple[int, ...]]:
    """For each joint the base parameters that can act on it."""
    n = (base.model.robot.joints,)
    nonzero = np.asarray(program_of(base, base.columns, n, n, n).nonzeros)
    return [tuple(int(k) for k in np.flatnonzero(row)) for row in nonzero]


def forces(
    base: BaseParameters, p: Float[AnyArray, " base"], motion: Motion
) -> Float[np.ndarray, "samples joints"]:
    r"""The generalized forces $\Theta_B p_B$ [N m or N] (Eq. 39)."""
    return in_numpy(base, base.forces, *_arrays(motion), shared=(p,))


def tool_forces(base: BaseParameters, motion: Motion) -> Float[np.ndarray, "samples joints"]:
    """What the known tool adds to the measured forces [N m or N]."""
    if base.model.robot.tool is None:
        return np.zeros(motion.q.shape)
    return in_numpy(base.model, base.model.known_forces, *_arrays(motion))


def mass_matrices(
    base: BaseParameters, p: Float[AnyArray, " base"], q: Float[AnyArray, "samples joints"]
) -> Float[np.ndarray, "samples joints joints"]:
    """The mass matrices of some poses (Eq. 38)."""
    return in_numpy(base, base.inertia, q, shared=(p,))


def _arrays(motion: Motion) -> list[np.ndarray]:
    return [np.asarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
