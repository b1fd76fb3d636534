"""A primal-dual interior point method with quasi-Newton curvature, for many starts.

Minimises f(y) subject to |R y - c| <= b, rows joint by joint, and to constraints that
are not linear, which a common slack may exceed at a penalty. Each iteration evaluates
value and gradient of every start once; the step towards the barrier's minimum needs
products with the rows and one Cholesky factor for each start. Curvature is a damped
BFGS matrix [1, procedure 18.2].

In NumPy: its matrices are small, and nothing is compiled.

[1] J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., 2006, chapters 18 and 19.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Float

from .coefficient_limits import Grid, ScaledMotions

INITIAL_CURVATURE = 0.3  # small, so that first steps are large
MAX_SHARE_OF_WAY = 0.995  # fraction of the way to the next limit that a step may go
DECREASE = 1e-4  # fraction of the promised decrease that a step must give
DAMPING = 0.1  # fraction of the expected curvature below which a step is damped
PATIENCE = 8  # refused steps in a row after which the curvature is forgotten
BARRIER_FACTOR = 0.9  # factor of the barrier after a good step
MIN_GOOD_LENGTH = 0.1  # length from which a step is a good one
START_FRACTION = 0.985  # fraction of the bound within which a stage starts
CENTRALITY = 1e3  # factor by which multipliers may differ from the central path
RIDGE = 1e-9  # added to the matrix, relative to its mean diagonal entry


ScaledVector = Float[np.ndarray, " scaled"]
ConstraintVector = Float[np.ndarray, " constraints"]
SlackVector = Float[np.ndarray, " slacks"]  # one slack if there are constraints
StepVector = Float[np.ndarray, " scaled_and_slack"]


class Evaluation(NamedTuple):
    """Objective and nonlinear constraints of one start, with their derivatives."""

    value: float
    gradient: ScaledVector
    excess: ConstraintVector
    slopes: np.ndarray  # of the constraints, by the scaled coefficients


Inequalities = Float[np.ndarray, " inequalities"]
"""One number for each inequality: its distance from the bound, or its multiplier.

Limits of the joints, upwards, then downwards; constraints; sign of the slack if there
are any.
"""


class Parts(NamedTuple):
    """The numbers of inequalities by their kinds."""

    limits: np.ndarray
    constraints: ConstraintVector
    slack: SlackVector


class Iterate(NamedTuple):
    """Present point of one start, its multipliers, and the step that is next."""

    y: ScaledVector
    slack: SlackVector
    evaluation: Evaluation
    duals: Inequalities  # multipliers
    curvature: np.ndarray  # of the Lagrangian
    barrier: float  # weight of the logarithmic barrier
    step: StepVector
    dual_step: Inequalities
    length: float = 0.0  # fraction of the step that is tried
    dual_length: float = 0.0
    slope: float = 0.0  # derivative of the merit along the step
    refusals: int = 0  # refused steps in a row
    needs_evaluation: bool = True  # whether the point itself is to be evaluated next

    @property
    def trial(self) -> ScaledVector:
        """Point to be evaluated next."""
        return self.y + self.length * self.step[: len(self.y)]


class Stage(NamedTuple):
    """One run of the method."""

    bound: float  # multiple to which limits are relaxed or tightened
    barrier: float  # weight of the logarithmic barrier at the start
    min_barrier: float  # weight below which the barrier does not fall
    iterations: int  # largest number of iterations
    sharpness: float = 4.0  # sharpness of smooth extremes in the objective
    penalty: float = 10.0  # penalty of the slack by which constraints are exceeded


def begin(grid: Grid, y: ScaledMotions, constraints: int = 0) -> list[Iterate]:
    """Return the iterates of some starts before the first stage."""
    size = np.shape(y)[1]
    slack = np.zeros(1 if constraints else 0)
    duals = np.zeros(2 * grid.c.size + constraints + len(slack))
    zero_slopes = np.zeros((constraints, size))
    evaluation = Evaluation(0.0, np.zeros(size), np.zeros(constraints), zero_slopes)
    curvature = INITIAL_CURVATURE * np.eye(size)
    step = np.zeros(size + len(slack))
    return [
        Iterate(np.array(point), slack, evaluation, duals, curvature, 0.0, step, duals)
        for point in y
    ]


def run(
    grid: Grid,
    objective: Callable[[np.ndarray, Sequence[int]], Sequence[Evaluation]],
    iterates: list[Iterate],
    stage: Stage,
) -> list[Iterate]:
    """Move the starts inside the bound of a stage, and iterate to convergence.

    The objective evaluates points [points, scaled] of starts with these numbers.
    """
    iterates = [_begin_stage(grid, stage, iterate) for iterate in iterates]
    for _ in range(stage.iterations):
        active_starts = [
            k for k, each in enumerate(iterates) if not _has_converged(stage, each)
        ]
        if not active_starts:
            break
        points = np.array([iterates[k].trial for k in active_starts])
        evaluations = objective(points, active_starts)
        for k, evaluation in zip(active_starts, evaluations, strict=True):
            with np.errstate(all="ignore"):
                iterates[k] = _update(grid, stage, iterates[k], evaluation)
    return iterates


def _has_converged(stage: Stage, iterate: Iterate):
    """Return whether the promised decrease is rounding."""
    if iterate.barrier > stage.min_barrier or iterate.needs_evaluation:
        return False
    return abs(iterate.slope) <= 1e-14 * (1.0 + abs(iterate.evaluation.value))


def _begin_stage(grid: Grid, stage: Stage, iterate: Iterate):
    """Move one start inside the bound, with multipliers on the central path."""
    bound = START_FRACTION * (stage.bound * grid.bound)
    y = grid.scale_into_limits(iterate.y, bound)
    central_duals = stage.barrier / _limit_room(grid, stage, y)
    duals = np.array(iterate.duals)
    limit_duals = duals[: len(central_duals)]
    if not limit_duals.any() or (y != iterate.y).any():
        limit_duals[:] = central_duals
    else:
        limit_duals[:] = _clip_to_central_path(limit_duals, central_duals)
    return iterate._replace(
        y=y,
        duals=duals,
        barrier=stage.barrier,
        step=np.zeros_like(iterate.step),
        length=0.0,
        needs_evaluation=True,
    )


def _update(
    grid: Grid,
    stage: Stage,
    iterate: Iterate,
    evaluation: Evaluation,
):
    """Take the step of one start, or shorten it."""
    slack = _cheapest_slack(stage, iterate, evaluation.excess)
    room = _room(grid, stage, iterate.trial, evaluation, slack)
    if iterate.needs_evaluation:
        duals = iterate.barrier / room
        limits = slice(2 * grid.c.size)
        duals[limits] = iterate.duals[limits]
        iterate = iterate._replace(
            y=iterate.trial,
            slack=slack,
            evaluation=evaluation,
            duals=duals,
            refusals=0,
            needs_evaluation=False,
        )
        return _with_step(grid, stage, iterate, room)

    present_room = _room(grid, stage, iterate.y, iterate.evaluation, iterate.slack)
    merit = _merit(stage, iterate, iterate.evaluation, iterate.slack, present_room)
    trial_merit = _merit(stage, iterate, evaluation, slack, room)
    promised_decrease = DECREASE * iterate.length * iterate.slope
    rounding = 1e-10 * abs(merit)
    is_finite = math.isfinite(evaluation.value) and bool(
        np.isfinite(evaluation.gradient).all()
    )
    if is_finite and trial_merit <= merit + promised_decrease + rounding:
        iterate = _take_step(stage, iterate, slack, evaluation, room)
        return _with_step(grid, stage, iterate, room)
    if iterate.refusals >= PATIENCE:
        size = len(iterate.y)
        mean_curvature = np.trace(iterate.curvature) / size
        iterate = iterate._replace(curvature=np.eye(size) * mean_curvature, refusals=0)
        return _with_step(grid, stage, iterate, present_room)
    length = _shorter_length(iterate, trial_merit - merit)
    return iterate._replace(length=length, refusals=iterate.refusals + 1)


def _shorter_length(iterate: Iterate, increase: float):
    """Return the length to the minimum of a parabola through the known merits."""
    length = iterate.length
    slope = iterate.slope
    best_length = -slope * length**2 / (2 * (increase - slope * length))
    if not math.isfinite(best_length):
        return 0.1 * length
    return float(np.clip(best_length, 0.1 * length, 0.5 * length))


def _take_step(
    stage: Stage,
    iterate: Iterate,
    slack: np.ndarray,
    evaluation: Evaluation,
    room: Inequalities,
):
    """Return the iterate at the end of its step, with new multipliers and curvature.

    Args:
        stage: Run of the method.
        iterate: Iterate before the step; `trial` is its point at the end of the step.
        slack: Slack at that point.
        evaluation: Objective and constraints at that point.
        room: Distance of each inequality from its bound at that point.
    """
    # After a short step the point is still far from the best one for this barrier.
    barrier_factor = BARRIER_FACTOR if iterate.length > MIN_GOOD_LENGTH else 1.0
    barrier = max(stage.min_barrier, iterate.barrier * barrier_factor)
    duals = iterate.duals + iterate.dual_length * iterate.dual_step
    duals = _clip_to_central_path(duals, barrier / room)

    # Curvature is that of the Lagrangian: of the value and of constraints that bend.
    constraint_duals = _split(duals, evaluation).constraints
    objective_change = evaluation.gradient - iterate.evaluation.gradient
    slope_changes = evaluation.slopes - iterate.evaluation.slopes
    gradient_change = objective_change + constraint_duals @ slope_changes
    step = iterate.trial - iterate.y
    curvature = _damped_bfgs(iterate.curvature, step, gradient_change)
    return iterate._replace(
        y=iterate.trial,
        slack=slack,
        evaluation=evaluation,
        duals=duals,
        curvature=curvature,
        barrier=barrier,
        refusals=0,
    )


def _with_step(
    grid: Grid,
    stage: Stage,
    iterate: Iterate,
    room: Inequalities,
):
    """Return one start with the step to the barrier's minimum and its length."""
    stiffness = iterate.duals / room
    central_duals = iterate.barrier / room
    descent = _descent(grid, stage, iterate, central_duals)
    step = _solve(_barrier_hessian(grid, iterate, stiffness), descent)
    change = _change_of_inequalities(grid, iterate, step)
    dual_step = central_duals - iterate.duals + stiffness * change
    return iterate._replace(
        step=step,
        dual_step=dual_step,
        length=_longest_step(change, room),
        dual_length=_longest_step(-dual_step, iterate.duals),
        slope=-float(descent @ step),
    )


def _barrier_hessian(
    grid: Grid,
    iterate: Iterate,
    stiffness: Inequalities,
):
    """Return the curvature of the objective with its barrier."""
    slopes = iterate.evaluation.slopes
    size = len(iterate.y)
    parts = _split(stiffness, iterate.evaluation)
    stiff_slopes = parts.constraints[:, None] * slopes
    H = np.zeros((len(iterate.step), len(iterate.step)))
    H[:size, :size] = iterate.curvature + slopes.T @ stiff_slopes

    _add_limits(H, grid, parts.limits)
    ridge = RIDGE * np.trace(H[:size, :size]) / size
    if len(parts.slack):
        coupling = -stiff_slopes.sum(axis=0)
        H[:size, size] = coupling
        H[size, :size] = coupling
        H[size, size] = parts.constraints.sum() + parts.slack[0]
    H[np.diag_indices(len(H))] += ridge
    return H


def _add_limits(H: np.ndarray, grid: Grid, stiffness: np.ndarray):
    """Add the curvature of the limits, which couple the variables of one joint only."""
    upper_stiffness, lower_stiffness = stiffness.reshape(2, *grid.c.shape)
    stiff_rows = grid.R * (upper_stiffness + lower_stiffness)[:, :, None]
    blocks = np.swapaxes(grid.R, 1, 2) @ stiff_rows
    variables = grid.R.shape[2]
    for joint, block in enumerate(blocks):
        start = joint * variables
        place = slice(start, start + variables)
        H[place, place] += block


def _descent(
    grid: Grid,
    stage: Stage,
    iterate: Iterate,
    central_duals: Inequalities,
):
    """Return the negative gradient of the objective with its barrier."""
    evaluation = iterate.evaluation
    parts = _split(central_duals, evaluation)
    upper_parts, lower_parts = parts.limits.reshape(2, *grid.c.shape)
    differences = upper_parts - lower_parts
    limit_gradient = np.einsum("jrk,jr->jk", grid.R, differences).reshape(-1)
    constraint_gradient = parts.constraints @ evaluation.slopes
    descent = -(evaluation.gradient + limit_gradient + constraint_gradient)
    if not len(parts.slack):
        return descent
    slack_descent = parts.constraints.sum() - stage.penalty + parts.slack
    return np.concatenate([descent, slack_descent])


def _solve(H: np.ndarray, downhill: np.ndarray):
    """Return the Newton step; by the diagonal if rounding makes H indefinite."""
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, check_finite=False)
        step = scipy.linalg.cho_solve(factor, downhill, check_finite=False)
    except np.linalg.LinAlgError:
        step = np.full(len(H), np.nan)
    return step if np.isfinite(step).all() else downhill / np.diagonal(H)


def _change_of_inequalities(
    grid: Grid,
    iterate: Iterate,
    step: np.ndarray,
):
    """Return by how much a step reduces the distance from each bound."""
    size = len(iterate.y)
    slack_step = step[size:]
    rows = grid.rows(step[:size]).ravel()
    constraint_changes = iterate.evaluation.slopes @ step[:size] - slack_step.sum()
    return np.concatenate([rows, -rows, constraint_changes, -slack_step])


def _limit_room(grid: Grid, stage: Stage, y: np.ndarray):
    """Return the distances from the limits of the joints."""
    rows = (grid.rows(y) - grid.c).ravel()
    bound = stage.bound * grid.bound
    return np.concatenate([bound - rows, bound + rows])


def _room(
    grid: Grid,
    stage: Stage,
    y: np.ndarray,
    evaluation: Evaluation,
    slack: np.ndarray,
):
    """Return the distances from all bounds."""
    limit_room = _limit_room(grid, stage, y)
    return np.concatenate([limit_room, slack.sum() - evaluation.excess, slack])


def _split(numbers: Inequalities, evaluation: Evaluation):
    """Return the numbers of limits, constraints and slack."""
    constraints = len(evaluation.excess)
    slack = len(numbers) - (constraints > 0)
    limits = slack - constraints
    return Parts(numbers[:limits], numbers[limits:slack], numbers[slack:])


def _clip_to_central_path(duals: np.ndarray, central_duals: np.ndarray):
    """Return multipliers that are not too far from the central path."""
    return np.clip(duals, central_duals / CENTRALITY, central_duals * CENTRALITY)


def _longest_step(change: Inequalities, room: Inequalities):
    """Return the longest step, at most 1, that stays inside all bounds."""
    return min(1.0, MAX_SHARE_OF_WAY / float((change / room).max(initial=1e-12)))


def _damped_bfgs(B: np.ndarray, s: np.ndarray, change: np.ndarray):
    """Return the damped BFGS update, positive definite [1, procedure 18.2]."""
    Bs = B @ s
    expected_change = float(s @ Bs)
    actual_change = float(s @ change)
    if not expected_change > 1e-16:
        return B
    min_change = DAMPING * expected_change
    damping = 1.0
    if actual_change < min_change:
        damping = (expected_change - min_change) / (expected_change - actual_change)
    r = damping * change + (1.0 - damping) * Bs
    update = B - np.outer(Bs, Bs / expected_change) + np.outer(r, r / (s @ r))
    return update if np.isfinite(update).all() else B


def _cheapest_slack(
    stage: Stage,
    iterate: Iterate,
    excess: ConstraintVector,
):
    """Return the slack of least cost, the barrier included.

    So a step may exceed a constraint that bends: the slack follows, and is penalised.
    """
    if not len(iterate.slack):
        return iterate.slack
    barrier = iterate.barrier
    # From below, where the largest term alone balances the penalty, Newton's method
    # grows to it.
    slack = max(0.0, float(excess.max())) + barrier / stage.penalty
    for _ in range(12):
        room = np.append(slack - excess, slack)
        slope = (barrier / room).sum() - stage.penalty
        slack += max(0.0, slope / (barrier / room**2).sum())
    return np.array([slack])


def _merit(
    stage: Stage,
    iterate: Iterate,
    evaluation: Evaluation,
    slack: np.ndarray,
    room: Inequalities,
):
    """Return the objective with penalty and barrier, which a step must decrease.

    `room` holds the distance of each inequality from its bound.
    """
    # A lower bound keeps the logarithms finite where a step meets a limit.
    logarithms = [
        float(np.log(np.maximum(part, 1e-300)).sum())
        for part in _split(room, evaluation)
    ]
    penalty = stage.penalty * float(slack.sum())
    return evaluation.value + penalty - iterate.barrier * sum(logarithms)
