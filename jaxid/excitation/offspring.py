"""Children of motions: some joints move as in one, the others as in another, begun at another time.

Limits of joints are kept by each joint alone, so that the child of two motions that keep them keeps
them too. What a motion tells does not depend on when its period begins or which way it runs, so
that two good motions may fit together at one shift only: many children are tried.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray
from jaxid.excitation.judge import PRICE
from jaxid.excitation.problem import Context, Problem

TRIED = 16
"""Children of each motion, of which the most promising one is kept."""
AS_IT_IS = 0.5
"""Share of second parents that are not retimed: those of one descent fit together already."""
TAKEN = (0.1, 0.5)
"""Least and largest expected share of joints that a child has from its second parent."""


class Offspring:
    """Draws the next generation of motions of one problem.

    Args:
        problem: Limits, criterion and constraints.
    """

    def __init__(self, problem: Problem):
        self._problem = problem
        self._objective = problem.objective()
        self._draw = jax.jit(self._drawn)

    def __call__(
        self, y: Float[AnyArray, "starts scaled"], key: PRNGKeyArray
    ) -> Float[Array, "starts scaled"]:
        """One child of each motion with another one.

        Args:
            y: The motions.
            key: Of the random numbers.
        """
        return self._draw(jnp.asarray(y), key)

    def _drawn(self, y: Array, key: PRNGKeyArray) -> Array:
        def another(best: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple, None]:
            children = self._children(y, key)
            price = self._price(children)
            better = price < best[1]
            kept = jnp.where(better[:, None], children, best[0]), jnp.where(better, price, best[1])
            return kept, None

        none = y, jnp.full(len(y), jnp.inf)
        return jax.lax.scan(another, none, jax.random.split(key, TRIED))[0][0]

    def _children(self, y: Array, key: PRNGKeyArray) -> Array:
        of_mate, of_kind, of_time, of_share, of_joint, of_others = jax.random.split(key, 6)
        starts, (joints, _) = len(y), self._problem.limits.shape
        ahead = jax.random.randint(of_mate, (starts,), 1, max(starts, 2))
        retimings = jnp.asarray(self._problem.basis.retimings())
        which = jax.random.randint(of_time, (starts,), 0, len(retimings))
        as_it_is = jax.random.uniform(of_kind, (starts,), float) < AS_IT_IS
        T = retimings[jnp.where(as_it_is, 0, which)]
        mates = self._problem.limits.numbers(y[(jnp.arange(starts) + ahead) % starts])
        mates = self._problem.limits.scaled(jnp.einsum("bvw,bjw->bjv", T, mates))
        share = jax.random.uniform(of_share, (starts, 1), float, *TAKEN)
        taken = jax.random.uniform(of_others, (starts, joints), float) < share
        surely = jax.random.randint(of_joint, (starts, 1), 0, joints)
        taken = (taken | (surely == np.arange(joints)[None]))[:, :, None]
        own, foreign = (z.reshape(starts, joints, -1) for z in (y, mates))
        return jnp.where(taken, foreign, own).reshape(y.shape)

    def _price(self, y: Array) -> Array:
        """The criterion, with what constraints are exceeded."""
        none = np.zeros((len(y), 0), int)
        price = self._objective(y, Context(None, none))[0]
        if self._problem.constraints:
            price = price + PRICE * jnp.maximum(self._problem.worst(y), 0.0)
        return jnp.where(jnp.isnan(price), jnp.inf, price)
