"""A primal-dual interior point method with quasi-Newton curvature, for many starts in lockstep.

Minimises f(y) subject to |R y - c| <= b, rows joint by joint, and to constraints that are not
linear, which a common slack may exceed at a penalty. Each iteration evaluates value and gradient of
every start once; the step towards the barrier's minimum needs products with the rows and one
Cholesky factor for each start. Curvature is a damped BFGS matrix [1, procedure 18.2].

[1] J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., 2006, chapters 18 and 19.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float, Int

from .coefficient_limits import Grid

STIFFNESS = 0.3  # initial curvature: small, so that first steps are large
TO_BOUNDARY = 0.995  # fraction of the way to the next limit that a step may go
DECREASE = 1e-4  # fraction of the promised decrease that a step must give
DAMPING = 0.1  # fraction of the expected curvature along a step below which it is damped
PATIENCE = 8  # refused steps in a row after which the curvature is forgotten
COOLING = 0.9  # factor of the barrier after a good step
INSIDE = 0.985  # fraction of the bound within which a stage starts


class Evaluation(NamedTuple):
    """Objective, and constraints that are not linear, of some starts, with their derivatives."""

    value: Float[Array, "*starts"]
    gradient: Float[Array, "*starts scaled"]
    excess: Float[Array, "*starts constraints"]
    slopes: Float[Array, "*starts constraints scaled"]

    @classmethod
    def unconstrained(cls, value: Array, gradient: Array) -> "Evaluation":
        """Return the evaluation of an objective without constraints."""
        none = gradient[..., None, :][..., :0, :]
        return cls(value, gradient, none[..., 0], none)


class Inequalities(NamedTuple):
    """One number for each inequality: its distance from the bound, or its multiplier.

    Limits of the joints, upwards and downwards; constraints; sign of the slack if there are any.
    """

    limits: Float[Array, "*starts 2 joints rows"]
    constraints: Float[Array, "*starts constraints"]
    slack: Float[Array, "*starts slacks"]


class State(NamedTuple):
    """State of the method; a leading axis for the starts.

    `y`, `slack`, `evaluation` and `duals` are the present point, `step`, `dual_step`, `length` and
    `dual_length` the next trial, `slope` is the derivative of the merit along the step, `refused`
    counts refused steps in a row, and `fresh` says that the point is yet to be evaluated.
    """

    y: Float[Array, "*starts scaled"]
    slack: Float[Array, "*starts slacks"]
    evaluation: Evaluation
    duals: Inequalities
    curvature: Float[Array, "*starts scaled scaled"]
    barrier: Float[Array, "*starts"]
    step: Float[Array, "*starts scaled_and_slack"]
    dual_step: Inequalities
    length: Float[Array, "*starts"]
    dual_length: Float[Array, "*starts"]
    slope: Float[Array, "*starts"]
    refused: Int[Array, "*starts"]
    fresh: Bool[Array, "*starts"]


class Stage(NamedTuple):
    """One run of the method.

    Attributes:
        bound: Multiple to which limits are relaxed or tightened.
        barrier: Weight of the logarithmic barrier at the start.
        least: Weight below which the barrier does not fall.
        iterations: Largest number of iterations.
        sharpness: Sharpness of smooth extremes in the objective.
        penalty: Penalty of the slack by which constraints are exceeded.
    """

    bound: Float[Array, ""] | float
    barrier: Float[Array, ""] | float
    least: Float[Array, ""] | float
    iterations: Int[Array, ""] | int
    sharpness: Float[Array, ""] | float = 4.0
    penalty: Float[Array, ""] | float = 10.0


def begin(grid: Grid, y: Float[AnyArray, "starts scaled"], constraints: int = 0) -> State:
    """Return the state of some starts before the first stage, with a number of constraints."""
    starts, size = np.shape(y)
    slack = jnp.zeros((starts, 1 if constraints else 0))
    none, excess = jnp.zeros(starts), jnp.zeros((starts, constraints))
    duals = Inequalities(jnp.zeros((starts, 2, *grid.c.shape)), excess, slack)
    slopes = jnp.zeros((starts, constraints, size))
    return State(
        y=jnp.asarray(y),
        slack=slack,
        evaluation=Evaluation(none, jnp.zeros((starts, size)), excess, slopes),
        duals=duals,
        curvature=jnp.tile(STIFFNESS * jnp.eye(size), (starts, 1, 1)),
        barrier=none,
        step=jnp.zeros((starts, size + slack.shape[1])),
        dual_step=duals,
        length=none,
        dual_length=none,
        slope=none,
        refused=jnp.zeros(starts, int),
        fresh=jnp.ones(starts, bool),
    )


def run(
    grid: Grid,
    objective: Callable[[Array], Evaluation],
    state: State,
    stage: Stage,
) -> State:
    """Move the starts inside the bound of a stage, then iterate until all have converged."""

    def proceed(carry: tuple[Array, State]) -> Array:
        number, state = carry
        # The promised decrease is rounding.
        settled = (state.barrier <= stage.least) & ~state.fresh
        scale = 1.0 + jnp.abs(state.evaluation.value)
        converged = settled & (jnp.abs(state.slope) <= 1e-14 * scale)
        return (number < stage.iterations) & ~jnp.all(converged)

    def iterate(carry: tuple[Array, State]) -> tuple[Array, State]:
        number, state = carry
        trial = state.y + state.length[:, None] * state.step[:, : state.y.shape[-1]]
        update = functools.partial(_update, grid, stage)
        return number + 1, map_starts(update, state, trial, objective(trial))

    begun = jax.vmap(functools.partial(_begin_stage, grid, stage))(state)
    return jax.lax.while_loop(proceed, iterate, (jnp.asarray(0), begun))[1]


def map_starts(function: Callable, *arguments: Any) -> Any:
    """Apply a function of one start to many: at once, or on a CPU one by one.

    There the matrices of one start stay in the cache, and its products are not loops of XLA.
    """

    def one_by_one(*arguments: Any) -> Any:
        return jax.lax.map(lambda one: function(*one), arguments)

    return jax.lax.platform_dependent(*arguments, cpu=one_by_one, default=jax.vmap(function))


def _begin_stage(grid: Grid, stage: Stage, one: State) -> State:
    """Move one start inside the bound, with multipliers on the central path."""
    y = grid.scale_into_limits(one.y, INSIDE * (stage.bound * grid.bound))
    central = stage.barrier / _room(grid, stage, y)
    duals = jnp.clip(one.duals.limits, central / 1e3, central * 1e3)
    moved = jnp.all(one.duals.limits == 0) | jnp.any(y != one.y)
    return one._replace(
        y=y,
        duals=one.duals._replace(limits=jnp.where(moved, central, duals)),
        barrier=jnp.asarray(stage.barrier, float),
        step=jnp.zeros_like(one.step),
        length=jnp.zeros_like(one.length),
        fresh=jnp.ones((), bool),
    )


def _update(grid: Grid, stage: Stage, old: State, trial: Array, evaluation: Evaluation) -> State:
    """Take the step of one start, or shorten it."""
    size = old.y.shape[-1]
    slack = _cheapest_slack(old.slack, evaluation.excess, stage.penalty, old.barrier)
    room = _rooms(grid, stage, trial, slack, evaluation.excess)
    before = _rooms(grid, stage, old.y, old.slack, old.evaluation.excess)
    merit = _merit(old.evaluation.value, old.slack, before, stage.penalty, old.barrier)
    new = _merit(evaluation.value, slack, room, stage.penalty, old.barrier)
    promised = DECREASE * old.length * old.slope
    good = new <= merit + promised + 1e-10 * jnp.abs(merit)
    finite = jnp.isfinite(evaluation.value) & jnp.all(jnp.isfinite(evaluation.gradient))
    good = (good & finite) | old.fresh
    taken = _taken(stage, old, trial, slack, evaluation, room)
    # A refused step is shortened to the minimum of a parabola through what is known.
    rise = 2 * (new - merit - old.slope * old.length)
    shorter = -old.slope * old.length**2 / rise
    least, most = 0.1 * old.length, 0.5 * old.length
    shorter = jnp.where(jnp.isfinite(shorter), jnp.clip(shorter, least, most), least)
    forget = old.refused >= PATIENCE
    flat = jnp.eye(size) * jnp.trace(old.curvature) / size
    kept = old._replace(
        curvature=jnp.where(forget, flat, old.curvature),
        refused=jnp.where(forget, 0, old.refused + 1),
    )
    state = jax.tree.map(lambda a, b: jnp.where(good, a, b), taken, kept)
    turned = _directed(grid, stage, state)
    straight = state._replace(length=shorter)
    return jax.tree.map(lambda a, b: jnp.where(good | forget, a, b), turned, straight)


def _taken(
    stage: Stage,
    old: State,
    trial: Array,
    slack: Array,
    evaluation: Evaluation,
    room: Inequalities,
) -> State:
    """Return the state of one start after its step was taken."""
    barrier = jnp.where(old.length > 0.1, old.barrier * COOLING, old.barrier)
    barrier = jnp.where(old.fresh, old.barrier, jnp.maximum(stage.least, barrier))
    central = jax.tree.map(lambda x: barrier / x, room)
    moved = jax.tree.map(
        lambda dual, step, c: jnp.clip(dual + old.dual_length * step, c / 1e3, c * 1e3),
        old.duals,
        old.dual_step,
        central,
    )
    begun = central._replace(limits=old.duals.limits)
    duals = jax.tree.map(lambda a, b: jnp.where(old.fresh, a, b), begun, moved)
    # Curvature is that of the Lagrangian: of the value and of constraints that bend.
    change = evaluation.gradient - old.evaluation.gradient
    change = change + duals.constraints @ (evaluation.slopes - old.evaluation.slopes)
    curvature = _damped_bfgs(old.curvature, trial - old.y, change)
    return old._replace(
        y=trial,
        slack=slack,
        evaluation=evaluation,
        duals=duals,
        curvature=jnp.where(old.fresh, old.curvature, curvature),
        barrier=barrier,
        refused=jnp.zeros((), old.refused.dtype),
        fresh=jnp.zeros((), bool),
    )


def _directed(grid: Grid, stage: Stage, state: State) -> State:
    """Return one start with the step to the barrier's minimum, and how far it may go."""
    evaluation, size, R = state.evaluation, state.y.shape[-1], grid.R
    room = _rooms(grid, stage, state.y, state.slack, evaluation.excess)
    ratio = jax.tree.map(lambda dual, x: dual / x, state.duals, room)
    central = jax.tree.map(lambda x: state.barrier / x, room)
    blocks = jnp.einsum("jrk,jr,jrl->jkl", R, ratio.limits[0] + ratio.limits[1], R)
    joints = jnp.eye(len(blocks))[:, None, :, None]
    stiff = ratio.constraints[:, None] * evaluation.slopes
    H = state.curvature + (joints * blocks[:, :, None, :]).reshape(size, size)
    H = H + evaluation.slopes.T @ stiff
    ridge = 1e-9 * jnp.trace(H) / size
    push = jnp.einsum("jrk,jr->jk", R, central.limits[0] - central.limits[1]).reshape(size)
    downhill = -(evaluation.gradient + push + central.constraints @ evaluation.slopes)
    one = jnp.ones_like(state.slack)
    across = -jnp.outer(jnp.sum(stiff, axis=0), one)
    corner = jnp.diag(jnp.sum(ratio.constraints) + ratio.slack)
    H = jnp.block([[H, across], [across.T, corner]]) + ridge * jnp.eye(size + len(one))
    spare = one * (jnp.sum(central.constraints) - stage.penalty) + central.slack
    downhill = jnp.concatenate([downhill, spare])
    step = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(H), True), downhill)
    # Where rounding makes the matrix indefinite, its diagonal alone decides.
    step = jnp.where(jnp.all(jnp.isfinite(step)), step, downhill / jnp.diagonal(H))
    rows, more = grid.rows(step[:size]), step[size:]
    bent = evaluation.slopes @ step[:size] - jnp.sum(more)
    change = Inequalities(jnp.stack([rows, -rows]), bent, -more)
    dual_step = jax.tree.map(
        lambda c, dual, r, x: c - dual + r * x, central, state.duals, ratio, change
    )
    approach = jax.tree.map(lambda x, y: x / y, change, room)
    dual_approach = jax.tree.map(lambda x, y: -x / y, dual_step, state.duals)
    return state._replace(
        step=step,
        dual_step=dual_step,
        length=_longest(approach),
        dual_length=_longest(dual_approach),
        slope=-jnp.sum(downhill * step),
    )


def _room(grid: Grid, stage: Stage, y: Float[Array, " scaled"]) -> Float[Array, "2 joints rows"]:
    """Return the distances from the limits of the joints, upwards and downwards."""
    rows = grid.rows(y)
    return stage.bound * grid.bound - (jnp.stack([rows, -rows]) - np.stack([grid.c, -grid.c]))


def _rooms(grid: Grid, stage: Stage, y: Array, slack: Array, excess: Array) -> Inequalities:
    return Inequalities(_room(grid, stage, y), jnp.sum(slack) - excess, slack)


def _longest(approach: Inequalities) -> Array:
    """Return the longest step, at most 1, that stays inside all bounds."""
    nearest = jnp.max(jnp.stack([jnp.max(x, initial=1e-12) for x in approach]))
    return jnp.minimum(1.0, TO_BOUNDARY / nearest)


def _damped_bfgs(B: Array, s: Array, change: Array) -> Array:
    """Return the damped BFGS update, which stays positive definite [1, procedure 18.2]."""
    Bs = B @ s
    expected, actual = s @ Bs, s @ change
    damped = DAMPING * expected
    mix = jnp.where(actual >= damped, 1.0, (expected - damped) / (expected - actual))
    r = mix * change + (1.0 - mix) * Bs
    new = B - jnp.outer(Bs, Bs) / expected + jnp.outer(r, r) / (s @ r)
    return jnp.where((expected > 1e-16) & jnp.all(jnp.isfinite(new)), new, B)


def _cheapest_slack(like: Array, excess: Array, penalty: Any, barrier: Any) -> Array:
    """Return the slack of least cost, with the barrier that keeps all constraints below it.

    So a step may exceed a constraint that bends: the slack follows, and is penalised.
    """
    # From below, where the largest term alone balances the penalty, Newton's method grows to it.
    start = jnp.maximum(0.0, jnp.max(excess, initial=0.0)) + barrier / penalty

    def grow(_: Any, x: Array) -> Array:
        room = jnp.concatenate([x - excess, x[None]])
        pull = jnp.sum(barrier / room) - penalty
        return x + jnp.maximum(0.0, pull / jnp.sum(barrier / room**2))

    return jnp.full_like(like, jax.lax.fori_loop(0, 12, grow, start))


def _merit(value: Array, slack: Array, room: Inequalities, penalty: Any, barrier: Any) -> Array:
    """Return the merit function, which a step must decrease."""
    logs = sum(jnp.sum(jnp.log(jnp.maximum(x, 1e-300))) for x in room)
    return value + penalty * jnp.sum(slack) - barrier * logs
