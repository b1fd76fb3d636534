"""Fences: keep XLA from computing a shared value again in every result that needs it.

XLA's CPU backend fuses elementwise operations into the loops of their consumers, and copies a
shared operation into each of them. A program of a thousand operations with hundreds of results is
then computed many times over. A fence on a shared value stops that.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.program.operation import FUNCTIONS, Operation
from jaxid.program.program import Program

_FREE = (Operation.INPUT, Operation.NEGATE)
_COST_OF_FUNCTION = 20


class AbstractFence(eqx.Module):
    """A way to make XLA compute a value once."""

    @abc.abstractmethod
    def anchor(self, reference: Array) -> Array:
        """Makes the number that the fences hold on to, once per program.

        Args:
            reference: A number that is known only at run time, of the precision of the program.
        """

    @abc.abstractmethod
    def __call__(self, x: Array, anchor: Array) -> Array:
        """Returns x, which XLA now computes once."""


class NoFence(AbstractFence):
    """Leaves XLA alone."""

    def anchor(self, reference: Array) -> Array:
        """Any number; it is not used."""
        return reference

    def __call__(self, x: Array, anchor: Array) -> Array:
        """The identity."""
        return x


class BarrierFence(AbstractFence):
    """`jax.lax.optimization_barrier`, which newer versions of XLA respect on a CPU."""

    def anchor(self, reference: Array) -> Array:
        """Any number; it is not used."""
        return reference

    def __call__(self, x: Array, anchor: Array) -> Array:
        """An optimization barrier for this value by itself."""
        return jax.lax.optimization_barrier(x)


class DivisionFence(AbstractFence):
    """Divides by a one that XLA cannot see through.

    XLA does not copy a division, since divisions are dear, and x / 1 is exact, for NaN and
    infinities too. The derivative has the same fence.
    """

    def anchor(self, reference: Array) -> Array:
        """The one: (sign bit of an input | 1), which is 1 whatever the input is, NaN included."""
        wide = reference.dtype == jnp.float64
        bits = jax.lax.bitcast_convert_type(
            jax.lax.stop_gradient(reference), jnp.uint64 if wide else jnp.uint32
        )
        sign = jax.lax.shift_right_logical(bits, jnp.full_like(bits, 63 if wide else 31))
        return (sign | jnp.ones_like(bits)).astype(reference.dtype)

    def __call__(self, x: Array, anchor: Array) -> Array:
        """The division by one."""
        return x / anchor


def default_fence(backend: str, version: tuple[int, ...]) -> AbstractFence:
    """Chooses a fence that was measured to hold (`benchmarks/fences.py`, JAX 0.10.2 and 0.12.0).

    In 0.10 only the division holds on a CPU. In 0.12 both do, equally fast; the barrier adds no
    arithmetic. Where between them that changed was not measured.

    On a GPU nothing was measured. A fence there would break the program into many kernels, and
    float64 divisions are slow, so none is placed.

    Args:
        backend: Name of JAX's platform, as `jax.default_backend()` gives it.
        version: Version of JAX, as `jax.__version_info__` gives it.
    """
    if backend != "cpu":
        return NoFence()
    return BarrierFence() if version >= (0, 12) else DivisionFence()


def fenced_nodes(program: Program, threshold: int = 6) -> frozenset[int]:
    """Positions of the nodes worth a fence: (uses - 1) times the cost to compute again > threshold.

    Args:
        program: Where to place fences.
        threshold: In operations; between 0 and 30 the speed hardly depends on it.
    """
    uses = [0] * len(program.nodes)
    for node in program.nodes:
        for k in node.uses:
            uses[k] += 1
    for x in program.outputs:
        if isinstance(x, int):
            uses[x] += 1
    costs, fenced = [], set()
    for k, node in enumerate(program.nodes):
        own = _COST_OF_FUNCTION if node.operation in FUNCTIONS else node.operation not in _FREE
        cost = own + sum(costs[i] for i in node.uses)
        if cost * (uses[k] - 1) > threshold:
            fenced.add(k)
            cost = 0
        costs.append(cost)
    return frozenset(fenced)
