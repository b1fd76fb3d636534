"""A primal-dual interior point method with quasi-Newton curvature, for many starts.

Minimises f(y) subject to |R y - c| <= b, rows joint by joint, and to constraints that
are not linear, which a common slack may exceed at a penalty. Each iteration evaluates
value and gradient of all starts once; the step towards the barrier's minimum needs
products with the rows and the solution of one linear system for each start. Curvature
is a damped BFGS matrix [1, procedure 18.2].

All starts are in arrays, in NumPy, where nothing is compiled, or in JAX, where a run is
one loop on the device. Starts that have converged stay as they are.

[1] J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., 2006, chapters 18 and 19.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, namespace

from .coefficient_limits import Grid, ScaledMotions
from .interior_point_iterates import (
    Evaluation,
    Inequalities,
    Iterates,
    PerStart,
    Slacks,
    Stage,
    Steps,
    begin as begin,
    dot,
    limit_room,
    outer,
    room_of,
    select,
    split,
    times,
)

MAX_SHARE_OF_WAY = 0.995  # fraction of the way to the next limit that a step may go
DECREASE = 1e-4  # fraction of the promised decrease that a step must give
DAMPING = 0.1  # fraction of the expected curvature below which a step is damped
PATIENCE = 8  # refused steps in a row after which the curvature is forgotten
BARRIER_FACTOR = 0.9  # factor of the barrier after a good step
MIN_GOOD_LENGTH = 0.1  # length from which a step is a good one
START_FRACTION = 0.985  # fraction of the bound within which a stage starts
CENTRALITY = 1e3  # factor by which multipliers may differ from the central path
RIDGE = 1e-9  # added to the matrix, relative to its mean diagonal entry


def run(
    grid: Grid,
    objective: Callable[[ScaledMotions], Evaluation],
    iterates: Iterates,
    stage: Stage,
) -> Iterates:
    """Move the starts inside the bound of a stage, and iterate to convergence."""

    def goes_on(state):
        count, iterates = state
        is_active = ~_have_converged(stage, iterates)
        return (count < stage.iterations) & is_active.any()

    def iterate(state):
        count, iterates = state
        evaluation = objective(iterates.trial)
        updated_iterates = _update(grid, stage, iterates, evaluation)
        is_fixed = _have_converged(stage, iterates)
        return count + 1, select(is_fixed, iterates, updated_iterates)

    state = (0, _begin_stage(grid, stage, iterates))
    if namespace(iterates.y) is jnp:
        return jax.lax.while_loop(goes_on, iterate, state)[1]
    with np.errstate(all="ignore"):
        while goes_on(state):
            state = iterate(state)
    return state[1]


def _have_converged(stage: Stage, iterates: Iterates):
    """Return whether the promised decrease of each start is rounding."""
    xp = namespace(iterates.y)
    value = iterates.evaluation.value
    is_small = xp.abs(iterates.slope) <= 1e-14 * (1.0 + xp.abs(value))
    has_final_barrier = iterates.barrier <= stage.min_barrier
    return is_small & has_final_barrier & ~iterates.needs_evaluation


def _begin_stage(grid: Grid, stage: Stage, iterates: Iterates):
    """Move all starts inside the bound, with multipliers on the central path."""
    xp = namespace(iterates.y)
    bound = START_FRACTION * (stage.bound * grid.bound)
    y = grid.scale_into_limits(iterates.y, bound)
    central_duals = stage.barrier / limit_room(grid, stage, y)
    limits = central_duals.shape[1]
    limit_duals = iterates.duals[:, :limits]
    is_new = ~limit_duals.any(axis=1) | (y != iterates.y).any(axis=1)
    clipped_duals = _clip_to_central_path(limit_duals, central_duals)
    limit_duals = xp.where(is_new[:, None], central_duals, clipped_duals)
    return iterates._replace(
        y=y,
        duals=xp.concatenate([limit_duals, iterates.duals[:, limits:]], axis=1),
        barrier=xp.full_like(iterates.barrier, stage.barrier),
        step=xp.zeros_like(iterates.step),
        length=xp.zeros_like(iterates.length),
        needs_evaluation=xp.ones_like(iterates.needs_evaluation),
    )


def _update(
    grid: Grid,
    stage: Stage,
    iterates: Iterates,
    evaluation: Evaluation,
):
    """Take the step of each start, or shorten it."""
    xp = namespace(iterates.y)
    slack = _cheapest_slack(stage, iterates, evaluation.excess)
    room = room_of(grid, stage, iterates.trial, evaluation, slack)
    present_room = room_of(grid, stage, iterates.y, iterates.evaluation, iterates.slack)
    merit = _merit(stage, iterates, iterates.evaluation, iterates.slack, present_room)
    trial_merit = _merit(stage, iterates, evaluation, slack, room)
    promised_decrease = DECREASE * iterates.length * iterates.slope
    rounding = 1e-10 * xp.abs(merit)
    is_finite = xp.isfinite(evaluation.value)
    is_finite &= xp.isfinite(evaluation.gradient).all(axis=1)
    is_decrease = trial_merit <= merit + promised_decrease + rounding

    is_first = iterates.needs_evaluation
    is_step = ~is_first & is_finite & is_decrease
    has_moved = is_first | is_step
    is_forgotten = ~has_moved & (iterates.refusals >= PATIENCE)
    first = _take_first(grid, iterates, slack, evaluation, room)
    moved = _take_step(stage, iterates, slack, evaluation, room)
    refused = _refuse_step(iterates, trial_merit - merit, is_forgotten)
    points = select(is_step, moved, select(is_first, first, refused))

    point_room = xp.where(has_moved[:, None], room, present_room)
    points_with_steps = _with_steps(grid, stage, points, point_room)
    return select(has_moved | is_forgotten, points_with_steps, points)


def _take_first(
    grid: Grid,
    iterates: Iterates,
    slack: Slacks,
    evaluation: Evaluation,
    room: Inequalities,
):
    """Return the iterates with the evaluation of the points where a stage begins."""
    xp = namespace(iterates.y)
    limits = 2 * grid.c.size
    central_duals = iterates.barrier[:, None] / room[:, limits:]
    return iterates._replace(
        y=iterates.trial,
        slack=slack,
        evaluation=evaluation,
        duals=xp.concatenate([iterates.duals[:, :limits], central_duals], axis=1),
        refusals=xp.zeros_like(iterates.refusals),
        needs_evaluation=xp.zeros_like(iterates.needs_evaluation),
    )


def _refuse_step(iterates: Iterates, increase: PerStart, is_forgotten: AnyArray):
    """Return the iterates with a shorter step, or without what curvature they have.

    The length is that to the minimum of a parabola through the known merits.
    """
    xp = namespace(iterates.y)
    length = iterates.length
    slope = iterates.slope
    best_length = -slope * length**2 / (2 * (increase - slope * length))
    shorter_length = xp.clip(best_length, 0.1 * length, 0.5 * length)
    size = iterates.y.shape[1]
    trace = xp.trace(iterates.curvature, axis1=1, axis2=2)
    plain_curvature = (trace / size)[:, None, None] * np.eye(size)[None]
    return iterates._replace(
        curvature=select(is_forgotten, plain_curvature, iterates.curvature),
        refusals=xp.where(is_forgotten, 0, iterates.refusals + 1),
        length=xp.where(xp.isfinite(best_length), shorter_length, 0.1 * length),
    )


def _take_step(
    stage: Stage,
    iterates: Iterates,
    slack: Slacks,
    evaluation: Evaluation,
    room: Inequalities,
):
    """Return the iterates at the end of their steps: new multipliers and curvature.

    Args:
        stage: Run of the method.
        iterates: Iterates before the step; `trial` are their points at its end.
        slack: Slack at those points.
        evaluation: Objective and constraints at those points.
        room: Distance of each inequality from its bound at those points.
    """
    xp = namespace(iterates.y)
    # After a short step the point is still far from the best one for this barrier.
    is_good = iterates.length > MIN_GOOD_LENGTH
    lower_barrier = iterates.barrier * xp.where(is_good, BARRIER_FACTOR, 1.0)
    barrier = xp.maximum(stage.min_barrier, lower_barrier)
    duals = iterates.duals + iterates.dual_length[:, None] * iterates.dual_step
    duals = _clip_to_central_path(duals, barrier[:, None] / room)

    # Curvature is that of the Lagrangian: of the value and of constraints that bend.
    constraint_duals = split(duals, evaluation).constraints
    objective_change = evaluation.gradient - iterates.evaluation.gradient
    slope_changes = evaluation.slopes - iterates.evaluation.slopes
    constraint_change = times(slope_changes.swapaxes(1, 2), constraint_duals)
    step = iterates.trial - iterates.y
    curvature = _damped_bfgs(
        iterates.curvature, step, objective_change + constraint_change
    )
    return iterates._replace(
        y=iterates.trial,
        slack=slack,
        evaluation=evaluation,
        duals=duals,
        curvature=curvature,
        barrier=barrier,
        refusals=xp.zeros_like(iterates.refusals),
    )


def _with_steps(
    grid: Grid,
    stage: Stage,
    iterates: Iterates,
    room: Inequalities,
):
    """Return the iterates with steps to the barrier's minimum and their lengths."""
    stiffness = iterates.duals / room
    central_duals = iterates.barrier[:, None] / room
    descent = _descent(grid, stage, iterates, central_duals)
    step = _solve(_barrier_hessian(grid, iterates, stiffness), descent)
    change = _change_of_inequalities(grid, iterates, step)
    dual_step = central_duals - iterates.duals + stiffness * change
    return iterates._replace(
        step=step,
        dual_step=dual_step,
        length=_longest_step(change, room),
        dual_length=_longest_step(-dual_step, iterates.duals),
        slope=-dot(descent, step),
    )


def _barrier_hessian(
    grid: Grid,
    iterates: Iterates,
    stiffness: Inequalities,
):
    """Return the curvature of the objective with its barrier."""
    xp = namespace(iterates.y)
    slopes = iterates.evaluation.slopes
    size = iterates.y.shape[1]
    parts = split(stiffness, iterates.evaluation)
    stiff_slopes = parts.constraints[..., None] * slopes
    H = iterates.curvature + slopes.swapaxes(1, 2) @ stiff_slopes
    H = H + _limit_curvature(grid, parts.limits)
    trace = xp.trace(H, axis1=1, axis2=2)
    if parts.slack.shape[1]:
        coupling = -stiff_slopes.sum(axis=1)
        corner = parts.constraints.sum(axis=1) + parts.slack[:, 0]
        upper_rows = xp.concatenate([H, coupling[:, :, None]], axis=2)
        last_row = xp.concatenate([coupling, corner[:, None]], axis=1)
        H = xp.concatenate([upper_rows, last_row[:, None]], axis=1)
    ridge = RIDGE * trace / size
    return H + ridge[:, None, None] * np.eye(H.shape[1])[None]


def _limit_curvature(grid: Grid, stiffness: AnyArray):
    """Return the curvature of the limits, which couple variables of one joint only."""
    xp = namespace(stiffness)
    sides = stiffness.reshape(-1, 2, *grid.c.shape)
    stiffness_of_rows = sides.sum(axis=1)[..., None]
    columns = np.swapaxes(grid.R, 1, 2)[None]
    blocks = columns @ (grid.R[None] * stiffness_of_rows)
    starts, joints, variables, _ = blocks.shape
    is_own_joint = np.eye(joints)[None, :, None, :, None]
    matrices = is_own_joint * blocks[:, :, :, None, :]
    size = joints * variables
    return xp.reshape(matrices, (starts, size, size))


def _descent(
    grid: Grid,
    stage: Stage,
    iterates: Iterates,
    central_duals: Inequalities,
):
    """Return the negative gradient of the objective with its barrier."""
    xp = namespace(iterates.y)
    evaluation = iterates.evaluation
    parts = split(central_duals, evaluation)
    sides = parts.limits.reshape(-1, 2, *grid.c.shape)
    differences = sides[:, 0] - sides[:, 1]
    joint_gradients = np.swapaxes(grid.R, 1, 2)[None] @ differences[..., None]
    limit_gradient = joint_gradients.reshape(iterates.y.shape)
    constraint_gradient = times(evaluation.slopes.swapaxes(1, 2), parts.constraints)
    descent = -(evaluation.gradient + limit_gradient + constraint_gradient)
    if not parts.slack.shape[1]:
        return descent
    constraint_sum = parts.constraints.sum(axis=1, keepdims=True)
    slack_descent = constraint_sum - stage.penalty + parts.slack
    return xp.concatenate([descent, slack_descent], axis=1)


def _solve(H: AnyArray, descent: Steps):
    """Return the Newton steps; by the diagonal where rounding makes H indefinite."""
    xp = namespace(H)
    try:
        step = xp.linalg.solve(H, descent[..., None])[..., 0]
    except np.linalg.LinAlgError:
        step = np.full(descent.shape, np.nan)
    is_descent = xp.isfinite(step).all(axis=1) & (dot(descent, step) >= 0.0)
    diagonal_step = descent / xp.diagonal(H, axis1=1, axis2=2)
    return xp.where(is_descent[:, None], step, diagonal_step)


def _change_of_inequalities(
    grid: Grid,
    iterates: Iterates,
    step: Steps,
):
    """Return by how much a step reduces the distance from each bound."""
    xp = namespace(step)
    starts, size = iterates.y.shape
    slack_step = step[:, size:]
    rows = grid.rows(step[:, :size]).reshape(starts, -1)
    constraint_changes = times(iterates.evaluation.slopes, step[:, :size])
    constraint_changes = constraint_changes - slack_step.sum(axis=1, keepdims=True)
    return xp.concatenate([rows, -rows, constraint_changes, -slack_step], axis=1)


def _clip_to_central_path(duals: AnyArray, central_duals: AnyArray):
    """Return multipliers that are not too far from the central path."""
    xp = namespace(duals)
    return xp.clip(duals, central_duals / CENTRALITY, central_duals * CENTRALITY)


def _longest_step(change: Inequalities, room: Inequalities):
    """Return the longest step, at most 1, that stays inside all bounds."""
    xp = namespace(change)
    shares = (change / room).max(axis=1, initial=1e-12)
    return xp.minimum(1.0, MAX_SHARE_OF_WAY / shares)


def _damped_bfgs(B: AnyArray, s: ScaledMotions, change: ScaledMotions):
    """Return the damped BFGS update, positive definite [1, procedure 18.2]."""
    xp = namespace(B)
    Bs = times(B, s)
    expected_change = dot(s, Bs)
    actual_change = dot(s, change)
    min_change = DAMPING * expected_change
    share = (expected_change - min_change) / (expected_change - actual_change)
    damping = xp.where(actual_change < min_change, share, 1.0)[:, None]
    r = damping * change + (1.0 - damping) * Bs
    update = B - outer(Bs) / expected_change[:, None, None]
    update = update + outer(r) / dot(s, r)[:, None, None]
    is_valid = (expected_change > 1e-16) & xp.isfinite(update).all(axis=(1, 2))
    return select(is_valid, update, B)


def _cheapest_slack(
    stage: Stage,
    iterates: Iterates,
    excess: AnyArray,
):
    """Return the slack of least cost, the barrier included.

    So a step may exceed a constraint that bends: the slack follows, and is penalised.
    """
    if not iterates.slack.shape[1]:
        return iterates.slack
    xp = namespace(excess)
    barrier = iterates.barrier[:, None]
    # From below, where the largest term alone balances the penalty, Newton's method
    # grows to it.
    largest_excess = excess.max(axis=1, keepdims=True)
    slack = xp.maximum(0.0, largest_excess) + barrier / stage.penalty
    for _ in range(12):
        room = xp.concatenate([slack - excess, slack], axis=1)
        slope = (barrier / room).sum(axis=1, keepdims=True) - stage.penalty
        curvature = (barrier / room**2).sum(axis=1, keepdims=True)
        slack = slack + xp.maximum(0.0, slope / curvature)
    return slack


def _merit(
    stage: Stage,
    iterates: Iterates,
    evaluation: Evaluation,
    slack: Slacks,
    room: Inequalities,
):
    """Return the objective with penalty and barrier, which a step must decrease.

    `room` holds the distance of each inequality from its bound.
    """
    xp = namespace(room)
    # A lower bound keeps the logarithms finite where a step meets a limit.
    logarithms = xp.log(xp.maximum(room, 1e-300)).sum(axis=1)
    penalty = stage.penalty * slack.sum(axis=1)
    return evaluation.value + penalty - iterates.barrier * logarithms
