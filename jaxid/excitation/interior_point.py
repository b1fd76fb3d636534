"""A primal-dual interior point method with quasi-Newton curvature, for many starts in lockstep.

Minimises f(y) subject to |R y - c| <= b, rows joint by joint. Each iteration evaluates value and
gradient of every start once; the step towards the barrier's minimum needs products with the rows
and one Cholesky factor for each start. Curvature is a damped BFGS matrix [1, procedure 18.2].

[1] J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., 2006, chapters 18 and 19.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.excitation.limits import Grid, held_within
from jaxid.types import AnyArray, Array, Float, Int

TO_BOUNDARY = 0.995
"""Share of the way to the next limit that a step may go."""
DECREASE = 1e-4
"""Share of the promised decrease that a step must give."""
DAMPING = 0.1
"""Curvature along a step is kept above this share of what was expected."""
PATIENCE = 8
"""Refused steps in a row before the curvature is forgotten."""
COOLING = 0.9
"""Factor of the barrier after a good step."""
INSIDE = 0.985
"""Share of the bound within which a stage starts."""


class State(NamedTuple):
    """Where the starts are; a leading axis for them."""

    y: Float[Array, "*starts scaled"]
    value: Float[Array, "*starts"]
    gradient: Float[Array, "*starts scaled"]
    duals: Float[Array, "*starts 2 joints rows"]
    curvature: Float[Array, "*starts scaled scaled"]
    barrier: Float[Array, "*starts"]
    step: Float[Array, "*starts scaled"]
    dual_step: Float[Array, "*starts 2 joints rows"]
    length: Float[Array, "*starts"]
    dual_length: Float[Array, "*starts"]
    slope: Float[Array, "*starts"]
    refused: Int[Array, "*starts"]
    fresh: Array


class Stage(NamedTuple):
    """One leg of a schedule.

    Attributes:
        bound: Limits are relaxed or tightened to this multiple of themselves.
        barrier: Weight of the logarithmic barrier at the start.
        least: Weight below which the barrier does not fall.
        iterations: Number of evaluations.
    """

    bound: float
    barrier: float
    least: float
    iterations: int


class InteriorPoint:
    """The method for one problem.

    Args:
        objective: From scaled numbers of all starts and a context to values and gradients.
        grid: Rows of the limits.
        still: Scaled numbers of half of each joint's range.
        stiffness: Curvature to begin with: small, so that first steps are large.
    """

    def __init__(
        self,
        objective: Callable[[Array, Any], tuple[Array, Array]],
        grid: Grid,
        still: Float[AnyArray, "joints variables"],
        stiffness: float = 0.3,
    ):
        self._objective, self._grid, self._still = objective, grid, still
        self._stiffness = stiffness
        self._run = jax.jit(self._iterate)

    def start(self, y: Float[AnyArray, "starts scaled"]) -> State:
        """The state of some starts before the first stage."""
        starts, size = np.shape(y)
        joints, rows = self._grid.c.shape
        duals = jnp.zeros((starts, 2, joints, rows))
        none, flat = jnp.zeros(starts), jnp.zeros((starts, size))
        return State(
            y=jnp.asarray(y),
            value=none,
            gradient=flat,
            duals=duals,
            curvature=jnp.tile(self._stiffness * jnp.eye(size), (starts, 1, 1)),
            barrier=none,
            step=flat,
            dual_step=duals,
            length=none,
            dual_length=none,
            slope=none,
            refused=jnp.zeros(starts, int),
            fresh=jnp.ones(starts, bool),
        )

    def run(self, state: State, stage: Stage, context: Any) -> State:
        """One stage: moves the starts inside its bound, then iterates."""
        bound = stage.bound * self._grid.bound
        numbers = (jnp.asarray(x, float) for x in (bound, stage.barrier, stage.least))
        state = self._run(state, *numbers, jnp.asarray(stage.iterations), context)
        return jax.block_until_ready(state)

    def _iterate(self, state: State, bound, barrier, least, iterations, context) -> State:
        def begin(one: State) -> State:
            y = held_within(self._grid, self._still, one.y, INSIDE * bound)
            slack = self._slack(y, bound)
            central = barrier / slack
            duals = jnp.clip(one.duals, central / 1e3, central * 1e3)
            fresh = jnp.all(one.duals == 0) | jnp.any(y != one.y)
            return one._replace(
                y=y,
                duals=jnp.where(fresh, central, duals),
                barrier=barrier,
                step=jnp.zeros_like(y),
                dual_step=jnp.zeros_like(one.duals),
                fresh=jnp.ones((), bool),
            )

        def iteration(_, state: State) -> State:
            trial = state.y + state.length[:, None] * state.step
            value, gradient = self._objective(trial, context)
            update = jax.vmap(self._update, in_axes=(0, 0, 0, 0, None, None))
            return update(state, trial, value, gradient, bound, least)

        return jax.lax.fori_loop(0, iterations, iteration, jax.vmap(begin)(state))

    def _update(self, old: State, trial, value, gradient, bound, least) -> State:
        """Takes the step or shortens it."""
        slack, before = self._slack(trial, bound), self._slack(old.y, bound)
        merit = old.value - old.barrier * jnp.sum(jnp.log(before))
        new = value - old.barrier * jnp.sum(jnp.log(jnp.maximum(slack, 1e-300)))
        promised = DECREASE * old.length * old.slope
        good = new <= merit + promised + 1e-10 * jnp.abs(merit)
        good = (good & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))) | old.fresh

        barrier = jnp.where(old.length > 0.1, old.barrier * COOLING, old.barrier)
        barrier = jnp.where(old.fresh, old.barrier, jnp.maximum(least, barrier))
        central = barrier / slack
        duals = jnp.clip(old.duals + old.dual_length * old.dual_step, central / 1e3, central * 1e3)
        curvature = _updated(old.curvature, trial - old.y, gradient - old.gradient)
        curvature = jnp.where(old.fresh, old.curvature, curvature)
        taken = old._replace(
            y=trial,
            value=value,
            gradient=gradient,
            duals=jnp.where(old.fresh, old.duals, duals),
            curvature=curvature,
            barrier=barrier,
            refused=jnp.zeros((), old.refused.dtype),
            fresh=jnp.zeros((), bool),
        )
        # A refused step is shortened to the minimum of a parabola through what is known.
        rise = 2 * (new - merit - old.slope * old.length)
        shorter = -old.slope * old.length**2 / rise
        least_length, most_length = 0.1 * old.length, 0.5 * old.length
        shorter = jnp.where(
            jnp.isfinite(shorter), jnp.clip(shorter, least_length, most_length), least_length
        )
        forget = old.refused >= PATIENCE
        size = old.y.shape[-1]
        flat = jnp.eye(size) * jnp.trace(old.curvature) / size
        kept = old._replace(
            curvature=jnp.where(forget, flat, old.curvature),
            refused=jnp.where(forget, 0, old.refused + 1),
        )
        state = jax.tree.map(lambda a, b: jnp.where(good, a, b), taken, kept)
        turned = self._directed(state, bound)
        again = good | forget
        straight = state._replace(length=shorter)
        return jax.tree.map(lambda a, b: jnp.where(again, a, b), turned, straight)

    def _directed(self, state: State, bound) -> State:
        """The step to the barrier's minimum, and how far it may go."""
        slack = self._slack(state.y, bound)
        ratio, central = state.duals / slack, state.barrier / slack
        blocks = jnp.einsum("jrk,jr,jrl->jkl", self._grid.R, ratio[0] + ratio[1], self._grid.R)
        size = state.y.shape[-1]
        H = state.curvature + _block_diagonal(blocks)
        H = H + 1e-9 * jnp.trace(H) / size * jnp.eye(size)
        push = jnp.einsum("jrk,jr->jk", self._grid.R, central[0] - central[1])
        downhill = -(state.gradient + push.reshape(size))
        step = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(H), True), downhill)
        change = self._along(step)
        dual_step = central - state.duals + ratio * change
        return state._replace(
            step=step,
            dual_step=dual_step,
            length=_to_boundary(change / slack),
            dual_length=_to_boundary(-dual_step / state.duals),
            slope=-jnp.sum(downhill * step),
        )

    def _along(self, y: Float[Array, " scaled"]) -> Float[Array, "2 joints rows"]:
        """Rows times numbers, upwards and downwards."""
        rows = jnp.einsum("jrk,jk->jr", self._grid.R, y.reshape(np.shape(self._still)))
        return jnp.stack([rows, -rows])

    def _slack(self, y: Float[Array, " scaled"], bound) -> Float[Array, "2 joints rows"]:
        c = self._grid.c
        return bound - (self._along(y) - np.stack([c, -c]))


def _to_boundary(approach: Array) -> Array:
    """The longest step, at most 1, that keeps what must be positive so."""
    return jnp.minimum(1.0, TO_BOUNDARY / jnp.maximum(1e-12, jnp.max(approach)))


def _updated(B: Array, s: Array, change: Array) -> Array:
    """The damped BFGS update, which keeps the matrix positive [1, procedure 18.2]."""
    Bs = B @ s
    expected, seen = s @ Bs, s @ change
    damped = DAMPING * expected
    mix = jnp.where(seen >= damped, 1.0, (expected - damped) / (expected - seen))
    r = mix * change + (1.0 - mix) * Bs
    new = B - jnp.outer(Bs, Bs) / expected + jnp.outer(r, r) / (s @ r)
    return jnp.where((expected > 1e-16) & jnp.all(jnp.isfinite(new)), new, B)


def _block_diagonal(blocks: Float[Array, "joints k l"]) -> Float[Array, "size size"]:
    n, k, _ = blocks.shape
    return (jnp.eye(n)[:, None, :, None] * blocks[:, :, None, :]).reshape(n * k, n * k)
