"""Dry friction of a joint in one stage of a simulation, exact at rest and reversals."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxid.arrays import AnyArray, Array


class Slip(NamedTuple):
    """How a joint slips in a stage.

    The balance of forces is `force + inertia w - friction direction = resistance u`,
    with the velocity `w` before the stage and `u` in it.

    Attributes:
        is_moving: Whether the joint moves at the end of the stage.
        direction: Mean sign of the velocity: -1 or 1, or between them if the joint
            turns around.
    """

    is_moving: Array
    direction: Array


def slip_of(
    force: Array,
    inertia: Array,
    friction: Array,
    resistance: Array,
    w: Array,
    ahead: AnyArray,
) -> Slip:
    """Return how a joint slips that a force acts on.

    A joint that comes to rest stays there if the force is less than the friction.
    Otherwise the force turns it around, and friction acts in both directions, in each
    for its part of the time.

    Args:
        force: Force on the joint, without friction.
        inertia: Inertia over the time of the stage.
        friction: Dry friction.
        resistance: Decrease of the force with the velocity in the stage, with that of
            inertia.
        w: Velocity before the stage.
        ahead: Change of the velocity behind the stage over that in it.
    """
    sign = jnp.where(w == 0.0, jnp.sign(force), jnp.sign(w))
    momentum = inertia - (1.0 - 1.0 / ahead) * resistance
    braking_force = friction - sign * force
    speed = jnp.abs(w)
    is_continuing = speed * momentum > braking_force
    is_turning = ~is_continuing & (braking_force > 2.0 * friction)

    # Part of the time until a joint that turns around is at rest.
    divisor = jnp.where(is_turning, braking_force, 1.0)
    time_share = jnp.maximum(speed * momentum / divisor, 0.0)
    turning_direction = sign * (2.0 * time_share - 1.0)
    direction = jnp.where(is_turning, turning_direction, sign)
    return Slip(is_continuing | is_turning, direction)
