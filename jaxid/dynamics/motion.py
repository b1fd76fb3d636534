"""Joint motion: coordinates, velocities and accelerations."""

from typing import Any

import equinox as eqx

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
    """

    q: ManyJoints = eqx.field(converter=_coordinates)
    qd: ManyJoints = eqx.field(converter=_coordinates)
    qdd: ManyJoints = eqx.field(converter=_coordinates)
    state: Float[AnyArray, "*batch states"] | None = None

    def __getitem__(self, index) -> "Motion":
        """Return the motion at some instants, by an index of the leading axis."""
        state = None if self.state is None else self.state[index]
        return Motion(self.q[index], self.qd[index], self.qdd[index], state)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[-1]


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
