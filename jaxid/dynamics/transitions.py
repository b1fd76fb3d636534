"""How friction passes from one direction of motion to the other, and numbers that shape it."""

import functools
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, matching, one_or_each
from jaxid.errors import InputError


class Shape(NamedTuple):
    """A positive number of a friction law in which forces are not linear: one for each joint.

    Attributes:
        name: Before the joint's number.
        units: For a revolute and a prismatic joint.
        path: Attributes that lead to it, from the term (or transition) that names it.
        wanted: Whether it is identified unless a user says otherwise.
    """

    name: str
    units: tuple[str, str]
    path: tuple[str, ...]
    wanted: bool = True

    def leaf(self, owner: Any) -> Any:
        """The number, or the numbers of the joints, in the term that names it."""
        return functools.reduce(getattr, self.path, owner)

    def below(self, attribute: str) -> "Shape":
        """The same for a term that holds the owner as an attribute."""
        return self._replace(path=(attribute, *self.path))


class AbstractTransition(Hashable):
    """How a friction force passes from one direction of motion to the other."""

    @abstractmethod
    def __call__(self, qd: Float[AnyArray, " joints"]) -> Float[AnyArray, " joints"]:
        """A number between -1 and 1 for each speed [rad/s or m/s]."""

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """What `identify_nonlinear` can find of it."""
        return ()


class Tanh(AbstractTransition):
    r"""The smooth transition $\tanh(\dot q / \epsilon_c)$ (Eq. 14).

    Attributes:
        epsilon: Speed of the transition, one for all joints or one for each, in the joint's own
            unit [rad/s or m/s].
        dead_zone: Speed below which there is no force, likewise [rad/s or m/s].
    """

    epsilon: float | Float[AnyArray, "..."] = eqx.field(converter=one_or_each, default=0.01)
    dead_zone: float | Float[AnyArray, "..."] = eqx.field(converter=one_or_each, default=0.0)

    def __check_init__(self):
        if not isinstance(self.epsilon, jax.Array) and not np.all(np.asarray(self.epsilon) > 0):
            raise InputError(
                f"`epsilon` must be a positive speed, but is {self.epsilon}: "
                "use `HardSign` for a transition without width."
            )

    def __call__(self, qd):
        """The smooth sign of the speed."""
        return _outside(self.dead_zone, qd, jnp.tanh(qd / matching("epsilon", self.epsilon, qd)))

    @property
    def shapes(self):
        """`eps1`, … [rad/s or m/s]."""
        return (Shape("eps", ("rad/s", "m/s"), ("epsilon",)),)


class HardSign(AbstractTransition):
    """The sign of the speed: it says nothing at standstill, where a dead zone belongs.

    Attributes:
        dead_zone: Speed below which there is no force [rad/s or m/s].
    """

    dead_zone: float | Float[AnyArray, "..."] = eqx.field(converter=one_or_each, default=0.0)

    def __call__(self, qd):
        """The sign of the speed."""
        return _outside(self.dead_zone, qd, jnp.sign(qd))


class Reversal(AbstractTransition):
    """Another transition that near standstill holds to one direction, for bounds of forces.

    Where a joint turns round, its dry friction jumps, at an instant that no grid of samples meets.
    Between the two sides of this class lies every force on the way, and both change smoothly.

    Attributes:
        own: The transition elsewhere.
        side: 1 or -1: the direction that holds near standstill.
        width: Speeds up to which it holds; at twice these it has faded [rad/s or m/s].
    """

    own: AbstractTransition
    side: float
    width: Float[AnyArray, " joints"]

    def __call__(self, qd):
        """The other transition, drawn to the side."""
        one = jnp.ones_like(qd)
        near = jnp.minimum(one, jnp.maximum(0 * one, 2 * one - jnp.abs(qd) / self.width))
        near = near**2 * (3 - 2 * near)
        value = self.own(qd)
        return value + near * (self.side - value)


def _outside(dead_zone, qd, value):
    if not isinstance(dead_zone, jax.Array) and not np.any(dead_zone):
        return value
    moves = jnp.abs(qd) > matching("dead_zone", dead_zone, qd)
    return jnp.where(moves, value, jnp.zeros_like(value))


def has_dead_zone(transition: AbstractTransition) -> bool:
    """Whether there are speeds at which a transition says nothing."""
    dead_zone = getattr(transition, "dead_zone", 0.0)
    return isinstance(dead_zone, jax.Array) or bool(np.any(dead_zone))
