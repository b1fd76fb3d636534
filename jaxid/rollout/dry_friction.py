"""Dry friction of a joint in one stage of a simulation, exact at rest and reversals."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxid.arrays import AnyArray, Array


class Slip(NamedTuple):
    """How joints slip in a stage, and how the balance of forces depends on its terms.

    The balance is `force + inertia w - friction direction = resistance u`.

    Attributes:
        free: Whether a joint moves at the end of the stage: 1 or 0.
        direction: Mean sign of the velocity: -1 or 1, or between them if the joint
            turns around.
        by_force: Derivative of the balance by the force.
        by_friction: Derivative by the friction.
        by_w: Derivative by the velocity before the stage.
        by_inertia: Derivative by the inertia, which is part of the resistance, without
            that of `u`.
        by_resistance: Derivative by the resistance alone, without that of `u`.
    """

    free: Array
    direction: Array
    by_force: Array
    by_friction: Array
    by_w: Array
    by_inertia: Array
    by_resistance: Array

    @classmethod
    def of(
        cls,
        force: Array,
        inertia: Array,
        friction: Array,
        resistance: Array,
        w: Array,
        ahead: AnyArray,
    ) -> "Slip":
        """Return how joints slip that a force acts on.

        A joint that comes to rest stays there if the force is less than the friction.
        Otherwise the force turns it around, and friction acts in both directions, in
        each for its part of the time.

        Args:
            force: Force on the joint, without friction.
            inertia: Inertia over the time of the stage.
            friction: Dry friction.
            resistance: Decrease of the force with the velocity in the stage, with that
                of inertia.
            w: Velocity before the stage.
            ahead: Change of the velocity behind the stage over that in it.
        """
        sign = jnp.where(w == 0.0, jnp.sign(force), jnp.sign(w))
        speed_share = 1.0 - 1.0 / ahead
        momentum = inertia - speed_share * resistance
        braking_force = friction - sign * force
        is_continuing = jnp.abs(w) * momentum > braking_force
        is_turning = ~is_continuing & (braking_force > 2.0 * friction)
        divisor = jnp.where(is_turning, braking_force, 1.0)
        # Part of the time until a joint that turns around is at rest.
        time_share = jnp.where(
            is_turning, jnp.maximum(jnp.abs(w) * momentum / divisor, 0.0), 0.0
        )
        factor = jnp.where(is_turning & (momentum > 0.0), 2.0 * friction / divisor, 0.0)
        direction = sign * jnp.where(is_turning, 2.0 * time_share - 1.0, 1.0)
        return cls(
            jnp.where(is_continuing | is_turning, 1.0, 0.0),
            direction,
            1.0 - factor * time_share,
            factor * sign * time_share - direction,
            inertia - factor * momentum,
            w * (1.0 - factor / ahead),
            w * factor * speed_share,
        )
