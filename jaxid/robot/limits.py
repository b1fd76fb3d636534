"""What the joints can do: ranges, speeds, accelerations, jerks and forces."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError


def per_joint(name: str, value: Numbers | None, joints: int, unknown: float) -> np.ndarray:
    """Checks and copies one number for each joint; None stands for unknown everywhere.

    Raises:
        InputError: If there is not one number for each joint, or one is not a number.
    """
    if value is None:
        return np.full(joints, unknown)
    array = np.array(value, dtype=np.float64)
    if array.shape != (joints,):
        raise InputError(
            f"`{name}` must hold one number for each joint ({joints}), but has shape {array.shape}."
        )
    if np.isnan(array).any() and not np.isnan(unknown):
        raise InputError(f"`{name}` must hold numbers, but joint {_first(np.isnan(array))} is NaN.")
    return array


def _first(where: np.ndarray) -> int:
    return int(np.flatnonzero(where)[0]) + 1


class Limits(eqx.Module):
    """Limits of every joint, in the joint's own unit ([rad] or [m]); infinite where unknown.

    Attributes:
        position_min: Lower end of the range [rad or m].
        position_max: Upper end of the range [rad or m].
        velocity: Largest speed [rad/s or m/s].
        acceleration: Largest acceleration [rad/s² or m/s²].
        jerk: Largest jerk [rad/s³ or m/s³].
        force: Largest generalized force [N m or N].
        assumed: Names of those fields whose numbers nobody published, or `field of joint` where
            only one joint's number is assumed.
    """

    position_min: Float[AnyArray, " joints"]
    position_max: Float[AnyArray, " joints"]
    velocity: Float[AnyArray, " joints"]
    acceleration: Float[AnyArray, " joints"]
    jerk: Float[AnyArray, " joints"]
    force: Float[AnyArray, " joints"]
    assumed: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        joints: int,
        *,
        position_min: Numbers | None = None,
        position_max: Numbers | None = None,
        velocity: Numbers | None = None,
        acceleration: Numbers | None = None,
        jerk: Numbers | None = None,
        force: Numbers | None = None,
        assumed: tuple[str, ...] = (),
    ) -> "Limits":
        """Builds limits from what is known; the rest is infinite.

        Raises:
            InputError: If a limit has the wrong length, is negative where it is a magnitude, or
                leaves a joint no range.
        """
        low = per_joint("position_min", position_min, joints, -np.inf)
        high = per_joint("position_max", position_max, joints, np.inf)
        if (low >= high).any():
            j = _first(low >= high)
            raise InputError(
                f"`position_min` must be below `position_max`, but joint {j} ranges "
                f"from {low[j - 1]:g} to {high[j - 1]:g}."
            )
        magnitudes = {
            "velocity": velocity,
            "acceleration": acceleration,
            "jerk": jerk,
            "force": force,
        }
        checked = {k: per_joint(k, v, joints, np.inf) for k, v in magnitudes.items()}
        for name, array in checked.items():
            if (array <= 0).any():
                j = _first(array <= 0)
                raise InputError(f"`{name}` must be positive, but joint {j} has {array[j - 1]:g}.")
        return cls(low, high, **checked, assumed=assumed)
