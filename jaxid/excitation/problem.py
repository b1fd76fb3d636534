"""A design problem: what is to be made small, over which trajectories, within which limits."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.constraint import AbstractConstraint, Finding
from jaxid.excitation.criteria import AbstractCriterion
from jaxid.excitation.information import Information, InformationMap, information
from jaxid.excitation.limits import JointLimits
from jaxid.excitation.spectral import Sharpness
from jaxid.types import AnyArray, Array, Float

SEEN = 64
"""Samples on which a motion is judged while it is searched."""
CHECKED = 4000
"""Samples on which constraints are checked."""


class Context(NamedTuple):
    """What changes between the stages of a search.

    Attributes:
        sharpness: Of smooth extremes of eigenvalues.
        multipliers: Of the constraints' values at the samples, for each start.
        weight: Of constraints that are not kept.
    """

    sharpness: Sharpness
    multipliers: Float[AnyArray, "starts samples values"]
    weight: Float[AnyArray, ""] | float


class Problem:
    """A design problem in scaled numbers.

    Args:
        base: Whose parameters a motion shall determine.
        limits: Of the joints, on the trajectories to choose from.
        criterion: What is made small.
        constraints: What else must be kept.
        weights: One over the standard deviation of each joint's noise [1/(N m) or 1/N].
        prior: Information of earlier experiments.
        sizes: A size of each parameter.
        measured: Samples that the experiment will take of one run of the trajectory.
        seen: Samples on which motions are judged during the search.
    """

    def __init__(
        self,
        base: BaseParameters,
        limits: JointLimits,
        criterion: AbstractCriterion,
        constraints: tuple[AbstractConstraint, ...],
        *,
        weights: Float[AnyArray, " joints"],
        prior: Float[AnyArray, "base base"],
        sizes: Float[AnyArray, " base"],
        measured: int,
        seen: int = SEEN,
    ):
        self.base, self.limits, self.criterion = base, limits, criterion
        self.robot, self.basis = base.model.robot, limits.basis
        self.constraints = constraints
        self.weights, self.prior, self.sizes = weights, prior, sizes
        self.measured, self.seen = measured, seen
        self._check = jax.jit(lambda x: self._constrained(x, CHECKED))

    def information(self, x: Float[AnyArray, "joints variables"]) -> Information:
        """The information of one run, exact."""
        motion = self.basis.trajectory(np.asarray(x)).motion(self.basis.times(self.measured))
        return information(self.base, motion, self.weights, self.prior, self.sizes)

    def value(self, x: Float[AnyArray, "joints variables"]) -> float:
        """The criterion of one run, exact: its logarithm."""
        return float(self.criterion(jax.tree.map(jnp.asarray, self.information(x))))

    def excess(self, x: Float[AnyArray, "joints variables"]) -> float:
        """By how much the worst constraint is not kept, relative; minus infinity without any."""
        return float(np.max(self._check(x))) if self.constraints else -np.inf

    def findings(self, x: Float[AnyArray, "joints variables"]) -> list[Finding]:
        """The constraints in words."""
        if not self.constraints:
            return []
        values, start, found = np.asarray(self._check(x)), 0, []
        for constraint in self.constraints:
            width = len(constraint.entries(self.robot))
            found += constraint.describe(self.robot, values[:, start : start + width])
            start += width
        return found

    @property
    def entries(self) -> int:
        """Values that all constraints have together, at one sample."""
        return sum(len(c.entries(self.robot)) for c in self.constraints)

    def objective(self, samples: int | None = None) -> Callable:
        """Values and gradients of some starts at once: criterion and unkept constraints.

        Args:
            samples: On which motions are judged.

        Returns:
            From scaled numbers [starts, scaled] and a `Context` to values and gradients.
        """
        samples = self.seen if samples is None else samples
        informed = InformationMap.of(
            self.base,
            self.basis,
            evaluated=samples,
            measured=self.measured,
            weights=self.weights,
            prior=self.prior,
            sizes=self.sizes,
        )

        def total(y: Array, context: Context) -> Array:
            x = self.limits.numbers(y)
            seen = informed(x)

            def judged(plain: Array, weighted: Array) -> Array:
                return self.criterion(Information(plain, weighted, self.sizes), context.sharpness)

            values = jax.vmap(judged)(jnp.asarray(seen.plain), jnp.asarray(seen.weighted))
            if self.constraints:
                excess = jax.vmap(lambda one: self._constrained(one, samples))(x)
                values = values + _augmented(excess, context)
            return values

        def value_and_gradient(y: Array, context: Context) -> tuple[Array, Array]:
            values, pull = jax.vjp(lambda z: total(z, context), y)
            return values, pull(jnp.ones_like(values))[0]

        return value_and_gradient

    def constrained(self, y: Float[Array, "starts scaled"], samples: int) -> Array:
        """All constraints' values of some starts [starts, samples, values]."""
        return jax.vmap(lambda one: self._constrained(self.limits.numbers(one), samples))(y)

    def _constrained(self, x: AnyArray, samples: int) -> Array:
        q, qd, qdd = self.basis.rows(self.basis.times(samples))[:3]
        x = jnp.asarray(x)
        motion = Motion(q @ x.T, qd @ x.T, qdd @ x.T)
        return self.constrained_motion(motion)

    def constrained_motion(self, motion: Motion) -> Float[Array, "*batch values"]:
        """All constraints' values of a motion, sample by sample."""
        return jnp.concatenate([c(self.robot, motion) for c in self.constraints], axis=-1)


def _augmented(excess: Float[Array, "starts samples values"], context: Context) -> Array:
    """The augmented Lagrangian's share of constraints: their mean over the samples."""
    m, rho = context.multipliers, context.weight
    pushed = jnp.maximum(0.0, m + rho * excess)
    return jnp.sum(pushed**2 - m**2, axis=(1, 2)) / (2 * rho * excess.shape[1])
