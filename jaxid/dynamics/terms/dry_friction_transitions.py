"""Transitions of dry friction between the directions of motion."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    JointMatrix,
    Joints,
    ManyJoints,
    matching,
    namespace,
    one_or_each,
)
from jaxid.errors import InputError

EachJoint = float | Float[AnyArray, "..."]
"""One number for all joints, or one for each."""
States = Float[AnyArray, " states"]
"""States of friction with memory."""
USUAL_SPEED = 0.01
"""Speed of a transition for which none is given, before logs tell [rad/s or m/s]."""


class AbstractTransition(Hashable):
    """Transition of dry friction from one direction of motion to the other."""

    @abstractmethod
    def __call__(self, qd: Joints) -> Joints:
        """Return a number between -1 and 1 for each speed [rad/s or m/s]."""

    def of_motors(self, speeds: Joints) -> Joints:
        """Return the same for the motors' speeds, on the side of their joints."""
        return self(speeds)


class Tanh(AbstractTransition):
    r"""The smooth transition $\tanh(\dot q / \epsilon_c)$ (Eq. 14).

    Attributes:
        epsilon: Speed of the transition, one for all joints or one for each, in the
            joint's own unit [rad/s or m/s]; by default it is found from the logs
            (`identify_transition_speeds`), and 0.01 before.
    """

    epsilon: EachJoint | None = eqx.field(converter=one_or_each, default=None)

    def __check_init__(self):
        speed = self.speed
        if not (isinstance(speed, jax.Array) or np.all(np.asarray(speed) > 0)):
            raise InputError(
                f"`epsilon` must be positive, but is {self.epsilon}: "
                "`HardSign` has no width."
            )

    @property
    def speed(self) -> EachJoint:
        """The speed, also where none is given."""
        return USUAL_SPEED if self.epsilon is None else self.epsilon

    def __call__(self, qd):
        """Return the smooth sign of the speed."""
        return jnp.tanh(qd / matching("epsilon", self.speed, qd))


def is_open(part: Any) -> bool:
    """Return whether a part of a term is a transition whose speed is to be found."""
    return isinstance(part, Tanh) and part.epsilon is None


def has_open_transition(terms: Any) -> bool:
    """Return whether terms have a transition whose speed is to be found."""
    return any(map(is_open, jax.tree.leaves(terms, is_leaf=is_open)))


class HardSign(AbstractTransition):
    """The sign of the speed; zero at standstill."""

    def __call__(self, qd):
        """Return the sign of the speed."""
        return jnp.sign(qd)


class Presliding(AbstractTransition):
    r"""Dry friction with memory: a state that follows the motion, and that rest keeps.

    A joint deforms its contacts before it slides: the state $s$ between -1 and 1 obeys
    Dahl's law $\mathrm{d}s = (\mathrm{d}q - s\,|\mathrm{d}q|) / \delta$ (Dahl, AIAA
    Journal 14(12), 1976). It depends on the path alone, not on time. Where no path is
    known, as at single samples and in the design of motions, the state is that of
    steady motion.

    Attributes:
        length: Length $\delta$ of the deformation, one for all joints or one for each
            [rad or m].
        steady: Transition that gives the state of steady motion, and that at the start
            of a path.
        motors: Turns of motors for those of joints, if motors turn several axes: they
            have states.
        state: State at one sample, where it is known.
    """

    length: EachJoint = eqx.field(converter=one_or_each, default=1e-3)
    steady: AbstractTransition = Tanh()
    motors: JointMatrix | None = None
    state: States | None = None

    def __check_init__(self):
        if not (
            isinstance(self.length, jax.Array) or np.all(np.asarray(self.length) > 0)
        ):
            raise InputError(f"`length` must be positive, but is {self.length}.")

    def __call__(self, qd):
        """Return the state: where it is not known, that of steady motion."""
        if self.state is None:
            return self.steady(qd)
        return self.state[..., : qd.shape[-1]]

    def of_motors(self, speeds: Joints) -> Joints:
        """Return the states of the motors, or those of steady motion."""
        if self.motors is None or self.state is None:
            return self.steady(speeds)
        return self.state[..., speeds.shape[-1] :]

    def settled(self, qd: ManyJoints) -> AnyArray:
        """Return the states of steady motion."""
        return self._with_motors(qd, self.steady)

    def _with_motors(self, x: AnyArray, function: Any):
        """Return a function of the joints, followed by that of their motors."""
        if self.motors is None:
            return function(x)
        parts = [function(x), function(x @ self.motors.T)]
        return namespace(x).concatenate(parts, axis=-1)

    def _strain(self, change: AnyArray):
        """Return steps of joints and motors, relative to their lengths [1]."""
        length = namespace(change).broadcast_to(self.length, change.shape)
        return self._with_motors(change, lambda x: x / length)

    def advance(self, q_before: Joints, q: Joints, s: States) -> States:
        """Return the state behind a step of one direction [rad or m]."""
        strain = self._strain(q - q_before)
        direction = jnp.sign(strain)
        return direction + (s - direction) * jnp.exp(-jnp.abs(strain))

    def states(self, q: AnyArray, start: AnyArray) -> AnyArray:
        """Return the states along a path, from that at its first sample."""
        xp = namespace(q)
        samples_first = xp.moveaxis(q, -2, 0)
        steps = xp.diff(samples_first, axis=0)
        strain = self._strain(steps)
        # A step maps the state s before it to memory * s + s_behind.
        memory = xp.exp(-xp.abs(strain))
        s_behind = xp.sign(strain) * (1 - memory)
        s = xp.concatenate([xp.asarray(start)[None], s_behind])
        memory = xp.concatenate([xp.zeros_like(s[:1]), memory])
        # Each turn joins twice as many steps to one.
        reach = 1
        while reach < len(s):
            recent_memory = memory[reach:]
            joined_s = s[reach:] + recent_memory * s[:-reach]
            joined_memory = recent_memory * memory[:-reach]
            s = xp.concatenate([s[:reach], joined_s])
            memory = xp.concatenate([memory[:reach], joined_memory])
            reach *= 2
        return xp.moveaxis(s, 0, -2)


class Reversal(AbstractTransition):
    """Another transition that keeps one direction near standstill.

    At a reversal dry friction jumps, at an instant that no grid of samples contains.
    Between the two sides of this class lies every force on the way, and both change
    smoothly.

    Attributes:
        transition: Transition elsewhere.
        side: Direction that is kept near standstill, 1 or -1.
        width: Speeds up to which it is kept; at twice these it has faded [rad/s or
            m/s].
    """

    transition: AbstractTransition
    side: float
    width: Joints

    def __call__(self, qd):
        """Return the other transition, drawn to the side."""
        one = jnp.ones_like(qd)
        nearness = 2 * one - jnp.abs(qd) / self.width
        nearness = jnp.minimum(one, jnp.maximum(0 * one, nearness))
        share = nearness**2 * (3 - 2 * nearness)
        value = self.transition(qd)
        return value + share * (self.side - value)
