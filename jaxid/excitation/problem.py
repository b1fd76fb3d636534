"""A design problem: what is to be made small, over which trajectories, within which limits."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Int
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.constraint import AbstractConstraint, Finding
from jaxid.excitation.criteria import AbstractCriterion
from jaxid.excitation.information import Information, InformationMap, information
from jaxid.excitation.interior_point import Evaluation, each_start
from jaxid.excitation.limits import JointLimits, enough
from jaxid.excitation.spectral import Sharpness

SEEN = 64
"""Samples on which a motion is judged while it is searched."""
CHECKED = 8160
"""Samples on which constraints are checked."""
WATCHED = 48
"""Samples at which constraints are always watched during the search."""
PEAKS = 10
"""Further instants for each value of the constraints: its highest peaks between those samples."""
MARGIN = 1e-3
"""Relative distance that is kept from constraints, for what happens between instants."""


class Context(NamedTuple):
    """What changes between the stages of a search.

    Attributes:
        sharpness: Of smooth extremes of eigenvalues.
        instants: At which constraints are watched, of those that are checked.
    """

    sharpness: Sharpness
    instants: Int[AnyArray, "starts instants"]


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
        seen: Samples on which motions of few numbers are judged during the search.
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
        # Constraints ask the robot for its limits of force.
        self.robot, self.basis = base.model.robot.replace(limits=limits.limits), limits.basis
        self.constraints = constraints
        self.weights, self.prior, self.sizes = weights, prior, sizes
        self.measured, self.seen = measured, enough(seen, limits.basis)
        self._all_rows = self.basis.rows(self.basis.instants(CHECKED))[:3]
        self._check = jax.jit(self._constrained)
        self._peaks = jax.jit(lambda y: jax.lax.map(self._highest, y))

    def information(self, x: Float[AnyArray, "joints variables"]) -> Information:
        """The information of one run, exact."""
        motion = self.basis.trajectory(np.asarray(x)).motion(self.basis.times(self.measured))
        return information(self.base, motion, self.weights, self.prior, self.sizes)

    def value(self, x: Float[AnyArray, "joints variables"]) -> float:
        """The criterion of one run, exact: its logarithm."""
        return float(self.criterion(jax.tree.map(jnp.asarray, self.information(x))))

    def excess(self, x: Float[AnyArray, "joints variables"]) -> float:
        """By how much the worst constraint is not kept, relative; minus infinity without any."""
        return float(self._tops(x).max()) if self.constraints else -np.inf

    def findings(self, x: Float[AnyArray, "joints variables"]) -> list[Finding]:
        """The constraints in words."""
        if not self.constraints:
            return []
        values, start, found = self._tops(x), 0, []
        for constraint in self.constraints:
            width = len(constraint.entries(self.robot))
            found += constraint.describe(self.robot, values[start : start + width])
            start += width
        return found

    @property
    def entries(self) -> int:
        """Values that all constraints have together, at one sample."""
        return sum(len(c.entries(self.robot)) for c in self.constraints)

    @property
    def conditions(self) -> int:
        """How many values of constraints a search keeps from being positive."""
        return (WATCHED + PEAKS) * self.entries

    def peaks(self, y: Float[AnyArray, "starts scaled"]) -> Int[Array, "starts instants"]:
        """The instants at which constraints of these motions must be watched."""
        if not self.constraints:
            return jnp.zeros((len(y), 0), int)
        return self._peaks(jnp.asarray(y))

    def objective(self, samples: int | None = None) -> Callable:
        """Values and gradients of some starts at once: the criterion.

        Args:
            samples: On which motions are judged.

        Returns:
            From scaled numbers [starts, scaled] and a `Context` to values and gradients.
        """
        informed = InformationMap.of(
            self.base,
            self.basis,
            evaluated=self.seen if samples is None else samples,
            measured=self.measured,
            weights=self.weights,
            prior=self.prior,
            sizes=self.sizes,
        )

        def total(y: Array, context: Context) -> Array:
            seen = informed(self.limits.numbers(y))

            def judged(plain: Array, weighted: Array) -> Array:
                return self.criterion(Information(plain, weighted, self.sizes), context.sharpness)

            return jax.vmap(judged)(jnp.asarray(seen.plain), jnp.asarray(seen.weighted))

        def value_and_gradient(y: Array, context: Context) -> tuple[Array, Array]:
            values, pull = jax.vjp(lambda z: total(z, context), y)
            return values, pull(jnp.ones_like(values))[0]

        return value_and_gradient

    def evaluation(self) -> Callable[[Array, Context], Evaluation]:
        """The criterion and the constraints of some starts at once, with their derivatives."""
        objective, count = self.objective(), self.entries
        steady = np.arange(WATCHED * count)
        # At its peaks a value alone counts: the others have their own.
        peaks = (
            WATCHED * count + np.arange(PEAKS * count) * count + np.repeat(np.arange(count), PEAKS)
        )
        chosen = np.concatenate([steady, peaks])

        def evaluated(y: Array, context: Context) -> Evaluation:
            free = Evaluation.free(*objective(y, context))
            if not self.constraints:
                return free
            excess, slopes = each_start(self.constrained, y, context.instants)
            starts, size = y.shape
            return free._replace(
                excess=excess.reshape(starts, -1)[:, chosen] + MARGIN,
                slopes=slopes.reshape(starts, -1, size)[:, chosen],
            )

        return evaluated

    def constrained(
        self, y: Float[Array, " scaled"], instants: Int[AnyArray, " instants"]
    ) -> tuple[Float[Array, "instants values"], Float[Array, "instants values scaled"]]:
        """All constraints of one motion at some of the checked instants, and their derivatives."""
        rows = jnp.asarray(self._all_rows)[:, instants]
        x = self.limits.numbers(y)
        q, qd, qdd = (part @ x.T for part in rows)

        # Samples do not see each other: one pull gives a value's derivatives at all of them.
        values, pull = jax.vjp(lambda *motion: self._values(Motion(*motion)), q, qd, qdd)
        each = jnp.eye(values.shape[1])[:, None, :]
        by_motion = jax.vmap(lambda one: pull(jnp.broadcast_to(one, values.shape)))(each)
        scale = np.asarray(self.limits.scale)
        slopes = sum(
            jnp.einsum("vtj,tk,jk->tvjk", J, part, scale)
            for J, part in zip(by_motion, rows, strict=True)
        )
        return values, jnp.reshape(slopes, (*values.shape, y.shape[-1]))

    def checked(self, y: Float[AnyArray, " scaled"]) -> Float[np.ndarray, "checked values"]:
        """All constraints of one motion at all checked instants."""
        return np.asarray(self._check(self.limits.numbers(np.asarray(y))))

    def worst(self, y: Float[Array, "starts scaled"]) -> Float[Array, " starts"]:
        """The worst excess of some motions at the instants that are always watched."""
        steady = np.arange(0, CHECKED, CHECKED // WATCHED)
        rows = np.asarray(self._all_rows)[:, steady]

        def one(y: Array) -> Array:
            x = self.limits.numbers(y)
            return jnp.max(self._values(Motion(*(part @ x.T for part in rows))))

        return jax.lax.map(one, y)

    def _tops(self, x: Float[AnyArray, "joints variables"]) -> Float[np.ndarray, " values"]:
        """The highest of each value, between the checked instants as well.

        There it is that of the parabola through a peak and its two neighbours.
        """
        values = np.asarray(self._check(x))
        before, peak, after = values[:-2], values[1:-1], values[2:]
        bend = 2 * peak - before - after
        top = (peak >= before) & (peak >= after) & (bend > 0)
        rise = np.where(top, (after - before) ** 2 / (8 * np.where(top, bend, 1.0)), 0.0)
        return np.maximum((peak + rise).max(axis=0), values[[0, -1]].max(axis=0))

    def _highest(self, y: Float[Array, " scaled"]) -> Int[Array, " instants"]:
        """Equidistant instants, and the highest peaks of each value."""
        values = self._constrained(self.limits.numbers(y)).T
        peak = (values >= jnp.roll(values, 1, 1)) & (values >= jnp.roll(values, -1, 1))
        found = jax.lax.top_k(jnp.where(peak, values, -jnp.inf), PEAKS)[1]
        steady = np.arange(0, CHECKED, CHECKED // WATCHED)
        return jnp.concatenate([jnp.asarray(steady, found.dtype), found.reshape(-1)])

    def _constrained(self, x: AnyArray) -> Float[Array, "checked values"]:
        """All constraints of one motion at all checked instants."""
        x = jnp.asarray(x)
        return self._values(Motion(*(part @ x.T for part in self._all_rows)))

    def _values(self, motion: Motion) -> Float[Array, "*batch values"]:
        return jnp.concatenate([c(self.robot, motion) for c in self.constraints], axis=-1)
