"""Joint motion: coordinates, velocities and accelerations."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, ManyJoints, as_array
from jaxid.errors import InputError


def _coordinates(value: Any):
    """Return a list as an array."""
    # Only lists: trees of what is no array, such as `in_axes` of `vmap`, stay as they
    # are.
    return as_array("motion", value) if isinstance(value, list | tuple) else value


class Motion(eqx.Module):
    """Joint coordinates and their derivatives at one or many instants.

    Attributes:
        q: Joint coordinates [rad or m].
        qd: Velocities [rad/s or m/s].
        qdd: Accelerations [rad/s² or m/s²].
        state: States of friction with memory; None where they follow from the path `q`.
        contacts: Entries of $X$ of feet that stand (`robot.contacts`), zero for others;
            None if no foot stands.
    """

    q: ManyJoints = eqx.field(converter=_coordinates)
    qd: ManyJoints = eqx.field(converter=_coordinates)
    qdd: ManyJoints = eqx.field(converter=_coordinates)
    state: Float[AnyArray, "*batch states"] | None = None
    contacts: Float[AnyArray, "*batch entries"] | None = None

    def __getitem__(self, index) -> "Motion":
        """Return the motion at some instants, by an index of the leading axis."""
        return jax.tree.map(lambda x: x[index], self)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[-1]


def floating_motion(
    q: Any,
    qd: Any,
    qdd: Any,
    accelerations: Any,
    rates: Any,
    angular_accelerations: Any,
) -> Motion:
    """Return the motion of a robot with a floating base, along the axes of its base.

    Args:
        q: Coordinates of the driven joints [rad or m].
        qd: Their velocities [rad/s or m/s].
        qdd: Their accelerations [rad/s² or m/s²].
        accelerations: Acceleration of the base's origin less gravity, which an
            accelerometer measures there [m/s²].
        rates: Angular velocity of the base, which a gyroscope measures [rad/s].
        angular_accelerations: Its derivative [rad/s²].
    """
    x, y, z = np.moveaxis(np.asarray(rates), -1, 0)
    # Three joints in a row turn the base: the first ones turn the axes of the others.
    turned_rates = np.stack([y * z, -x * z, x * y], axis=-1)
    at_rest = np.zeros_like(accelerations)
    base_accelerations = [accelerations, angular_accelerations - turned_rates]
    return Motion(
        np.concatenate([at_rest, at_rest, q], axis=-1),
        np.concatenate([at_rest, rates, qd], axis=-1),
        np.concatenate([*base_accelerations, qdd], axis=-1),
    )


def as_motion(*motion: Any) -> Motion:
    """Return a motion that is given as such, or as its three arrays.

    Raises:
        InputError: If there is neither a motion nor three arrays.
    """
    if isinstance(motion[0], Motion) and len(motion) == 1:
        return motion[0]
    if len(motion) != 3:
        raise InputError(
            "`motion` must be a `Motion`, or coordinates, velocities and "
            f"accelerations, but {len(motion)} arrays are given."
        )
    return Motion(*motion)


def as_state(*state: Any) -> tuple[Any, Any]:
    """Return coordinates and velocities, given as such or in a motion.

    Raises:
        InputError: If there is neither a motion nor two arrays.
    """
    if isinstance(state[0], Motion) and len(state) == 1:
        return state[0].q, state[0].qd
    if len(state) != 2:
        raise InputError(
            "`state` must be a `Motion`, or coordinates and velocities, "
            f"but {len(state)} arrays are given."
        )
    q, qd = state
    return q, qd
