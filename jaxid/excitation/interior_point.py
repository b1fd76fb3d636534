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

from jaxid.arrays import AnyArray, Array, Float, Int
from jaxid.excitation.limits import Grid, held_within

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
REFINED = 12
"""Steps of Newton's method that find the allowance of a motion."""


class Evaluation(NamedTuple):
    """What an objective gives for some starts; a leading axis for them.

    Attributes:
        value: To be made small.
        gradient: By the scaled numbers.
        excess: Of each constraint that is not linear; not positive where it is kept.
        slopes: Of these, by the scaled numbers.
    """

    value: Float[Array, "*starts"]
    gradient: Float[Array, "*starts scaled"]
    excess: Float[Array, "*starts constraints"]
    slopes: Float[Array, "*starts constraints scaled"]

    @classmethod
    def free(cls, value: Array, gradient: Array) -> "Evaluation":
        """That of an objective without constraints."""
        none = gradient[..., None, :][..., :0, :]
        return cls(value, gradient, none[..., 0], none)


class Bounds(NamedTuple):
    """Something for each inequality: how much room it has left, or its multiplier.

    Attributes:
        limits: Of the joints, upwards and downwards.
        constraints: What is not linear; it may be exceeded by the allowance.
        allowance: Which must not be negative; one number, or none without constraints.
    """

    limits: Float[Array, "*starts 2 joints rows"]
    constraints: Float[Array, "*starts constraints"]
    allowance: Float[Array, "*starts allowances"]


class State(NamedTuple):
    """Where the starts are; a leading axis for them."""

    y: Float[Array, "*starts scaled"]
    allowance: Float[Array, "*starts allowances"]
    seen: Evaluation
    duals: Bounds
    curvature: Float[Array, "*starts scaled scaled"]
    barrier: Float[Array, "*starts"]
    step: Float[Array, "*starts scaled_and_allowance"]
    dual_step: Bounds
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
        price: Of the allowance by which constraints are exceeded.
    """

    bound: float
    barrier: float
    least: float
    iterations: int
    price: float = 10.0


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
        objective: Callable[[Array, Any], Evaluation],
        grid: Grid,
        still: Float[AnyArray, "joints variables"],
        stiffness: float = 0.3,
    ):
        self._objective, self._grid, self._still = objective, grid, still
        self._stiffness = stiffness
        self._run = jax.jit(self._iterate)

    def start(self, y: Float[AnyArray, "starts scaled"], constraints: int = 0) -> State:
        """The state of some starts before the first stage.

        Args:
            y: The starts.
            constraints: How many the objective has that are not linear.
        """
        starts, size = np.shape(y)
        joints, rows = self._grid.c.shape
        allowances = 1 if constraints else 0
        none, flat = jnp.zeros(starts), jnp.zeros((starts, size))
        duals = Bounds(
            jnp.zeros((starts, 2, joints, rows)),
            jnp.zeros((starts, constraints)),
            jnp.zeros((starts, allowances)),
        )
        return State(
            y=jnp.asarray(y),
            allowance=duals.allowance,
            seen=Evaluation(none, flat, duals.constraints, jnp.zeros((starts, constraints, size))),
            duals=duals,
            curvature=jnp.tile(self._stiffness * jnp.eye(size), (starts, 1, 1)),
            barrier=none,
            step=jnp.zeros((starts, size + allowances)),
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
        numbers = (jnp.asarray(x, float) for x in (bound, stage.barrier, stage.least, stage.price))
        state = self._run(state, *numbers, jnp.asarray(stage.iterations), context)
        return jax.block_until_ready(state)

    def _iterate(self, state: State, bound, barrier, least, price, iterations, context) -> State:
        def begin(one: State) -> State:
            y = held_within(self._grid, self._still, one.y, INSIDE * bound)
            limits = self._limits_slack(y, bound)
            central = barrier / limits
            duals = jnp.clip(one.duals.limits, central / 1e3, central * 1e3)
            fresh = jnp.all(one.duals.limits == 0) | jnp.any(y != one.y)
            return one._replace(
                y=y,
                duals=one.duals._replace(limits=jnp.where(fresh, central, duals)),
                barrier=barrier,
                step=jnp.zeros_like(one.step),
                dual_step=jax.tree.map(jnp.zeros_like, one.dual_step),
                length=jnp.zeros_like(one.length),
                dual_length=jnp.zeros_like(one.dual_length),
                fresh=jnp.ones((), bool),
            )

        def iteration(_, state: State) -> State:
            size = state.y.shape[-1]
            trial = state.y + state.length[:, None] * state.step[:, :size]
            seen = self._objective(trial, context)

            def update(old: State, trial: Array, seen: Evaluation) -> State:
                return self._update(old, trial, seen, bound, least, price)

            return each_start(update, state, trial, seen)

        return jax.lax.fori_loop(0, iterations, iteration, jax.vmap(begin)(state))

    def _update(self, old: State, trial, seen: Evaluation, bound, least, price) -> State:
        """Takes the step or shortens it."""
        size = old.y.shape[-1]
        allowance = _cheapest(old.allowance, seen.excess, price, old.barrier)
        slack = self._slack(trial, allowance, seen.excess, bound)
        before = self._slack(old.y, old.allowance, old.seen.excess, bound)
        merit = _merit(old.seen.value, old.allowance, before, price, old.barrier)
        new = _merit(seen.value, allowance, slack, price, old.barrier)
        promised = DECREASE * old.length * old.slope
        good = new <= merit + promised + 1e-10 * jnp.abs(merit)
        finite = jnp.isfinite(seen.value) & jnp.all(jnp.isfinite(seen.gradient))
        good = (good & finite) | old.fresh

        barrier = jnp.where(old.length > 0.1, old.barrier * COOLING, old.barrier)
        barrier = jnp.where(old.fresh, old.barrier, jnp.maximum(least, barrier))
        central = jax.tree.map(lambda x: barrier / x, slack)
        moved = jax.tree.map(
            lambda dual, step, c: jnp.clip(dual + old.dual_length * step, c / 1e3, c * 1e3),
            old.duals,
            old.dual_step,
            central,
        )
        begun = central._replace(limits=old.duals.limits)
        duals = jax.tree.map(lambda a, b: jnp.where(old.fresh, a, b), begun, moved)
        # Curvature is that of the Lagrangian: of the value and of what bends the constraints.
        change = seen.gradient - old.seen.gradient
        change = change + duals.constraints @ (seen.slopes - old.seen.slopes)
        curvature = _updated(old.curvature, trial - old.y, change)
        taken = old._replace(
            y=trial,
            allowance=allowance,
            seen=seen,
            duals=duals,
            curvature=jnp.where(old.fresh, old.curvature, curvature),
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
        flat = jnp.eye(size) * jnp.trace(old.curvature) / size
        kept = old._replace(
            curvature=jnp.where(forget, flat, old.curvature),
            refused=jnp.where(forget, 0, old.refused + 1),
        )
        state = jax.tree.map(lambda a, b: jnp.where(good, a, b), taken, kept)
        turned = self._directed(state, bound, price)
        again = good | forget
        straight = state._replace(length=shorter)
        return jax.tree.map(lambda a, b: jnp.where(again, a, b), turned, straight)

    def _directed(self, state: State, bound, price) -> State:
        """The step to the barrier's minimum, and how far it may go."""
        seen, size = state.seen, state.y.shape[-1]
        slack = self._slack(state.y, state.allowance, seen.excess, bound)
        ratio = jax.tree.map(lambda dual, room: dual / room, state.duals, slack)
        central = jax.tree.map(lambda room: state.barrier / room, slack)
        R = self._grid.R
        blocks = jnp.einsum("jrk,jr,jrl->jkl", R, ratio.limits[0] + ratio.limits[1], R)
        stiff = ratio.constraints[:, None] * seen.slopes
        H = state.curvature + _block_diagonal(blocks) + seen.slopes.T @ stiff
        ridge = 1e-9 * jnp.trace(H) / size
        push = jnp.einsum("jrk,jr->jk", R, central.limits[0] - central.limits[1]).reshape(size)
        downhill = -(seen.gradient + push + central.constraints @ seen.slopes)
        one = jnp.ones_like(state.allowance)
        across = -jnp.outer(jnp.sum(stiff, axis=0), one)
        corner = jnp.diag(jnp.sum(ratio.constraints) + ratio.allowance)
        H = jnp.block([[H, across], [across.T, corner]]) + ridge * jnp.eye(size + len(one))
        spare = one * (jnp.sum(central.constraints) - price) + central.allowance
        downhill = jnp.concatenate([downhill, spare])
        step = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(H), True), downhill)
        # Where rounding makes the matrix indefinite, its diagonal alone decides.
        step = jnp.where(jnp.all(jnp.isfinite(step)), step, downhill / jnp.diagonal(H))
        more = step[size:]
        change = Bounds(self._along(step[:size]), seen.slopes @ step[:size] - jnp.sum(more), -more)
        dual_step = jax.tree.map(
            lambda c, dual, r, x: c - dual + r * x, central, state.duals, ratio, change
        )
        return state._replace(
            step=step,
            dual_step=dual_step,
            length=_to_boundary(jax.tree.map(lambda x, room: x / room, change, slack)),
            dual_length=_to_boundary(
                jax.tree.map(lambda x, dual: -x / dual, dual_step, state.duals)
            ),
            slope=-jnp.sum(downhill * step),
        )

    def _along(self, y: Float[Array, " scaled"]) -> Float[Array, "2 joints rows"]:
        """Rows times numbers, upwards and downwards."""
        rows = jnp.einsum("jrk,jk->jr", self._grid.R, y.reshape(np.shape(self._still)))
        return jnp.stack([rows, -rows])

    def _limits_slack(self, y: Float[Array, " scaled"], bound) -> Float[Array, "2 joints rows"]:
        c = self._grid.c
        return bound - (self._along(y) - np.stack([c, -c]))

    def _slack(self, y: Array, allowance: Array, excess: Array, bound) -> Bounds:
        return Bounds(self._limits_slack(y, bound), jnp.sum(allowance) - excess, allowance)


def each_start(function: Callable, *arguments: Any) -> Any:
    """Applies a function of one start to many: at once, or on a CPU one by one.

    There the matrices of one start stay in the cache, and its products are not loops of XLA.

    Args:
        function: Of one start.
        *arguments: With a leading axis for the starts.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda one: function(*one), arguments)
    return jax.vmap(function)(*arguments)


def _cheapest(like: Array, excess: Array, price, barrier) -> Array:
    """The allowance that costs least, with the barrier that keeps all constraints below it.

    So a step may pass a constraint that bends: the allowance follows, and has its price.
    """
    # From below, where the largest term alone is the price, the method grows to the root.
    least = jnp.maximum(0.0, jnp.max(excess, initial=0.0))
    allowance = least + barrier / price

    def grown(_, x: Array) -> Array:
        room = jnp.concatenate([x - excess, x[None]])
        pull = jnp.sum(barrier / room) - price
        return x + jnp.maximum(0.0, pull / jnp.sum(barrier / room**2))

    return jnp.full_like(like, jax.lax.fori_loop(0, REFINED, grown, allowance))


def _merit(value: Array, allowance: Array, slack: Bounds, price, barrier) -> Array:
    """What a step must make smaller."""
    logs = sum(jnp.sum(jnp.log(jnp.maximum(x, 1e-300))) for x in slack)
    return value + price * jnp.sum(allowance) - barrier * logs


def _to_boundary(approach: Bounds) -> Array:
    """The longest step, at most 1, that keeps what must be positive so."""
    nearest = jnp.max(jnp.stack([jnp.max(x, initial=1e-12) for x in approach]))
    return jnp.minimum(1.0, TO_BOUNDARY / nearest)


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
