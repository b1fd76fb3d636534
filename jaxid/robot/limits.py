"""Joint limits: ranges, speeds, accelerations, jerks and forces."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError


class Limits(eqx.Module):
    """Limits of every joint, in the joint's own unit ([rad] or [m]); infinite where unknown.

    Limits that are not given are infinite. JAX arrays are taken as they are, so that limits can be
    traced and batched; all others are checked and copied.

    Args:
        joints: Number of joints; that of the given limits if None.
        position_min: Lower end of each range [rad or m].
        position_max: Upper end of each range [rad or m].
        velocity: Largest speeds [rad/s or m/s].
        acceleration: Largest accelerations [rad/s² or m/s²].
        jerk: Largest jerks [rad/s³ or m/s³].
        force: Largest generalised forces [N m or N].
        assumed: Names of fields whose numbers nobody published, or `field of joint` where only one
            joint's number is assumed.

    Raises:
        InputError: If a limit has the wrong length, is not positive although it is a magnitude, or
            leaves a joint no range.
    """

    position_min: Float[AnyArray, " joints"]
    position_max: Float[AnyArray, " joints"]
    velocity: Float[AnyArray, " joints"]
    acceleration: Float[AnyArray, " joints"]
    jerk: Float[AnyArray, " joints"]
    force: Float[AnyArray, " joints"]
    assumed: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        joints: int | None = None,
        *,
        position_min: Numbers | None = None,
        position_max: Numbers | None = None,
        velocity: Numbers | None = None,
        acceleration: Numbers | None = None,
        jerk: Numbers | None = None,
        force: Numbers | None = None,
        assumed: tuple[str, ...] = (),
    ):
        magnitudes = (velocity, acceleration, jerk, force)
        n = count_joints(joints, position_min, position_max, *magnitudes)
        self.position_min = per_joint("position_min", position_min, n, -np.inf)
        self.position_max = per_joint("position_max", position_max, n, np.inf)
        self.velocity = per_joint("velocity", velocity, n, np.inf)
        self.acceleration = per_joint("acceleration", acceleration, n, np.inf)
        self.jerk = per_joint("jerk", jerk, n, np.inf)
        self.force = per_joint("force", force, n, np.inf)
        self.assumed = assumed
        for name in ("velocity", "acceleration", "jerk", "force"):
            require(name, getattr(self, name), lambda x: x > 0, "positive")
        low, high = self.position_min, self.position_max
        if isinstance(low, np.ndarray) and isinstance(high, np.ndarray) and (low >= high).any():
            j = int(np.flatnonzero(low >= high)[0])
            raise InputError(
                f"`position_min` must be below `position_max`, but joint {j + 1} ranges "
                f"from {low[j]:g} to {high[j]:g}."
            )


def count_joints(joints: int | None, *values: Numbers | None) -> int:
    """Return the number of joints: as given, or as many as the first of the values holds.

    Raises:
        InputError: If neither a number nor a value is given.
    """
    given = [np.shape(x) for x in values if x is not None]
    if joints is None and not any(given):
        raise InputError("`joints` must be given where no list with one number for each joint is.")
    return next(shape[0] for shape in given if shape) if joints is None else joints


def per_joint(name: str, value: Numbers | None, joints: int, unknown: float) -> Any:
    """Check and copy one number for each joint; JAX arrays are taken as they are.

    Args:
        name: Name of the values in messages.
        value: One number for each joint, or None if unknown.
        joints: Number of joints.
        unknown: Number in place of None; NaN allows NaN among the values.

    Raises:
        InputError: If there is not one number for each joint, or one is not a number.
    """
    if isinstance(value, jax.Array):
        return value
    array = np.full(joints, unknown) if value is None else np.array(value, dtype=np.float64)
    if array.shape != (joints,):
        raise InputError(
            f"`{name}` must hold one number for each joint ({joints}), but has shape {array.shape}."
        )
    if not np.isnan(unknown):
        require(name, array, lambda x: ~np.isnan(x), "a number")
    return array


def require(name: str, values: AnyArray, rule: Any, words: str) -> None:
    """Check a rule for each of the values of the joints, unless they are a JAX array.

    Args:
        name: Name of the values in messages.
        values: One number for each joint.
        rule: Function from the values to truth values.
        words: The rule as it reads after "must be".

    Raises:
        InputError: If a value breaks the rule.
    """
    if isinstance(values, np.ndarray) and not np.all(rule(values)):
        j = int(np.flatnonzero(~rule(values))[0])
        raise InputError(f"`{name}` must be {words}, but that of joint {j + 1} is {values[j]:g}.")
