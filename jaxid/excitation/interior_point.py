"""A primal-dual interior point method with quasi-Newton curvature, for many starts in lockstep.

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
import scipy.linalg

from jaxid.arrays import Float

from .coefficient_limits import Grid

STIFFNESS = 0.3  # initial curvature: small, so that first steps are large
TO_BOUNDARY = 0.995  # fraction of the way to the next limit that a step may go
DECREASE = 1e-4  # fraction of the promised decrease that a step must give
DAMPING = (
    0.1  # fraction of the expected curvature along a step below which it is damped
)
PATIENCE = 8  # refused steps in a row after which the curvature is forgotten
COOLING = 0.9  # factor of the barrier after a good step
INSIDE = 0.985  # fraction of the bound within which a stage starts


class Evaluation(NamedTuple):
    """Objective, and constraints that are not linear, of one start, with their derivatives."""

    value: float
    gradient: Float[np.ndarray, " scaled"]
    excess: Float[np.ndarray, " constraints"]
    slopes: Float[np.ndarray, "constraints scaled"]


Inequalities = Float[np.ndarray, " inequalities"]
"""One number for each inequality: its distance from the bound, or its multiplier.

Limits of the joints, upwards, then downwards; constraints; sign of the slack if there
are any.
"""


class State(NamedTuple):
    """State of one start.

    `y`, `slack`, `evaluation` and `duals` are the present point, `step`, `dual_step`,
    `length` and `dual_length` the next trial, `slope` is the derivative of the merit
    along the step, `refused` counts refused steps in a row, and `fresh` says that the
    point is yet to be evaluated.
    """

    y: Float[np.ndarray, " scaled"]
    slack: Float[np.ndarray, " slacks"]
    evaluation: Evaluation
    duals: Inequalities
    curvature: Float[np.ndarray, "scaled scaled"]
    barrier: float
    step: Float[np.ndarray, " scaled_and_slack"]
    dual_step: Inequalities
    length: float = 0.0
    dual_length: float = 0.0
    slope: float = 0.0
    refused: int = 0
    fresh: bool = True

    @property
    def trial(self) -> Float[np.ndarray, " scaled"]:
        """Point to be evaluated next."""
        return self.y + self.length * self.step[: len(self.y)]


class Stage(NamedTuple):
    """One run of the method."""

    bound: float  # multiple to which limits are relaxed or tightened
    barrier: float  # weight of the logarithmic barrier at the start
    least: float  # weight below which the barrier does not fall
    iterations: int  # largest number of iterations
    sharpness: float = 4.0  # sharpness of smooth extremes in the objective
    penalty: float = 10.0  # penalty of the slack by which constraints are exceeded


def begin(
    grid: Grid, y: Float[np.ndarray, "starts scaled"], constraints: int = 0
) -> list[State]:
    """Return the state of some starts before the first stage, with a number of constraints."""
    size, slack = np.shape(y)[1], np.zeros(1 if constraints else 0)
    duals = np.zeros(2 * grid.c.size + constraints + len(slack))
    none = Evaluation(
        0.0, np.zeros(size), np.zeros(constraints), np.zeros((constraints, size))
    )
    curvature, step = STIFFNESS * np.eye(size), np.zeros(size + len(slack))
    return [
        State(np.array(x), slack, none, duals, curvature, 0.0, step, duals) for x in y
    ]


def run(
    grid: Grid,
    objective: Callable[[np.ndarray, Sequence[int]], Sequence[Evaluation]],
    states: list[State],
    stage: Stage,
) -> list[State]:
    """Move the starts inside the bound of a stage, then iterate until all have converged.

    The objective evaluates points [points, scaled] of starts with these numbers.
    """
    states = [_begin_stage(grid, stage, one) for one in states]
    for _ in range(stage.iterations):
        active = [k for k, one in enumerate(states) if not _has_converged(stage, one)]
        if not active:
            break
        found = objective(np.array([states[k].trial for k in active]), active)
        for k, evaluation in zip(active, found, strict=True):
            with np.errstate(all="ignore"):
                states[k] = _update(grid, stage, states[k], evaluation)
    return states


def _has_converged(stage: Stage, one: State) -> bool:
    """Return whether the promised decrease is rounding."""
    settled = one.barrier <= stage.least and not one.fresh
    return settled and abs(one.slope) <= 1e-14 * (1.0 + abs(one.evaluation.value))


def _begin_stage(grid: Grid, stage: Stage, one: State) -> State:
    """Move one start inside the bound, with multipliers on the central path."""
    y = np.asarray(grid.scale_into_limits(one.y, INSIDE * (stage.bound * grid.bound)))
    central, duals = stage.barrier / _room(grid, stage, y), np.array(one.duals)
    limits = duals[: len(central)]
    moved = not limits.any() or (y != one.y).any()
    limits[:] = central if moved else np.clip(limits, central / 1e3, central * 1e3)
    return one._replace(
        y=y,
        duals=duals,
        barrier=stage.barrier,
        step=np.zeros_like(one.step),
        length=0.0,
        fresh=True,
    )


def _update(grid: Grid, stage: Stage, old: State, evaluation: Evaluation) -> State:
    """Take the step of one start, or shorten it."""
    trial = old.trial
    slack = _cheapest_slack(old.slack, evaluation.excess, stage.penalty, old.barrier)
    room = _room(grid, stage, trial, slack.sum() - evaluation.excess, slack)
    if old.fresh:
        duals = old.barrier / room
        duals[: 2 * grid.c.size] = old.duals[: 2 * grid.c.size]
        begun = old._replace(y=trial, slack=slack, evaluation=evaluation, duals=duals)
        return _directed(grid, stage, begun._replace(refused=0, fresh=False), room)
    before = _room(
        grid, stage, old.y, old.slack.sum() - old.evaluation.excess, old.slack
    )
    merit = _merit(old.evaluation, old.slack, before, stage.penalty, old.barrier)
    new = _merit(evaluation, slack, room, stage.penalty, old.barrier)
    promised = DECREASE * old.length * old.slope
    finite = math.isfinite(evaluation.value) and np.isfinite(evaluation.gradient).all()
    if finite and new <= merit + promised + 1e-10 * abs(merit):
        return _directed(grid, stage, _taken(stage, old, slack, evaluation, room), room)
    if old.refused >= PATIENCE:
        flat = np.eye(len(trial)) * np.trace(old.curvature) / len(trial)
        return _directed(grid, stage, old._replace(curvature=flat, refused=0), before)
    # A refused step is shortened to the minimum of a parabola through what is known.
    shorter = -old.slope * old.length**2 / (2 * (new - merit - old.slope * old.length))
    least, most = 0.1 * old.length, 0.5 * old.length
    shorter = float(np.clip(shorter, least, most)) if math.isfinite(shorter) else least
    return old._replace(length=shorter, refused=old.refused + 1)


def _taken(
    stage: Stage,
    old: State,
    slack: np.ndarray,
    evaluation: Evaluation,
    room: Inequalities,
) -> State:
    """Return the state of one start after its step was taken."""
    barrier = max(stage.least, old.barrier * (COOLING if old.length > 0.1 else 1.0))
    central = barrier / room
    duals = np.clip(
        old.duals + old.dual_length * old.dual_step, central / 1e3, central * 1e3
    )
    # Curvature is that of the Lagrangian: of the value and of constraints that bend.
    change = evaluation.gradient - old.evaluation.gradient
    _, bending, _ = _parts(duals, evaluation)
    change = change + bending @ (evaluation.slopes - old.evaluation.slopes)
    return old._replace(
        y=old.trial,
        slack=slack,
        evaluation=evaluation,
        duals=duals,
        curvature=_damped_bfgs(old.curvature, old.trial - old.y, change),
        barrier=barrier,
        refused=0,
    )


def _directed(grid: Grid, stage: Stage, state: State, room: Inequalities) -> State:
    """Return one start with the step to the barrier's minimum, and how far it may go."""
    evaluation, size, slacks, R = (
        state.evaluation,
        len(state.y),
        len(state.slack),
        grid.R,
    )
    joints, _, variables = R.shape
    ratio, central = state.duals / room, state.barrier / room
    stiffness, of_constraints, of_slack = _parts(ratio, evaluation)
    push, pull, spare = _parts(central, evaluation)
    stiff = of_constraints[:, None] * evaluation.slopes
    H = np.zeros((size + slacks, size + slacks))
    H[:size, :size] = state.curvature + evaluation.slopes.T @ stiff
    weighted = R * stiffness.reshape(2, *grid.c.shape).sum(axis=0)[:, :, None]
    for j, block in enumerate(np.swapaxes(R, 1, 2) @ weighted):
        place = slice(j * variables, (j + 1) * variables)
        H[place, place] += block
    ridge = 1e-9 * np.trace(H[:size, :size]) / size
    up, down = push.reshape(2, *grid.c.shape)
    away = np.einsum("jrk,jr->jk", R, up - down).reshape(size)
    downhill = -(evaluation.gradient + away + pull @ evaluation.slopes)
    if slacks:
        H[:size, size] = H[size, :size] = -stiff.sum(axis=0)
        H[size, size] = of_constraints.sum() + of_slack[0]
        downhill = np.concatenate([downhill, pull.sum() - stage.penalty + spare])
    H[np.diag_indices(size + slacks)] += ridge
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, check_finite=False)
        step = scipy.linalg.cho_solve(factor, downhill, check_finite=False)
    except np.linalg.LinAlgError:
        step = np.full(size + slacks, np.nan)
    if not np.isfinite(step).all():
        # Where rounding makes the matrix indefinite, its diagonal alone decides.
        step = downhill / np.diagonal(H)
    rows, more = (
        np.einsum("jrk,jk->jr", R, step[:size].reshape(joints, variables)),
        step[size:],
    )
    bent = evaluation.slopes @ step[:size] - more.sum()
    change = np.concatenate([rows.ravel(), -rows.ravel(), bent, -more])
    dual_step = central - state.duals + ratio * change
    return state._replace(
        step=step,
        dual_step=dual_step,
        length=_longest(change, room),
        dual_length=_longest(-dual_step, state.duals),
        slope=-float(downhill @ step),
    )


def _room(grid: Grid, stage: Stage, y: np.ndarray, *more: np.ndarray) -> Inequalities:
    """Return the distances from the limits of the joints, followed by those of what is given."""
    away = (grid.rows(y) - grid.c).ravel()
    bound = stage.bound * grid.bound
    return np.concatenate([bound - away, bound + away, *more])


def _parts(
    x: Inequalities, evaluation: Evaluation
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of limits, constraints and slack."""
    constraints = len(evaluation.excess)
    slack = len(x) - (constraints > 0)
    return x[: slack - constraints], x[slack - constraints : slack], x[slack:]


def _longest(change: Inequalities, room: Inequalities) -> float:
    """Return the longest step, at most 1, that stays inside all bounds."""
    return min(1.0, TO_BOUNDARY / float((change / room).max(initial=1e-12)))


def _damped_bfgs(B: np.ndarray, s: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the damped BFGS update, which stays positive definite [1, procedure 18.2]."""
    Bs = B @ s
    expected, actual = float(s @ Bs), float(s @ change)
    if not expected > 1e-16:
        return B
    damped = DAMPING * expected
    mix = 1.0 if actual >= damped else (expected - damped) / (expected - actual)
    r = mix * change + (1.0 - mix) * Bs
    new = B - np.outer(Bs, Bs / expected) + np.outer(r, r / (s @ r))
    return new if np.isfinite(new).all() else B


def _cheapest_slack(
    like: np.ndarray, excess: np.ndarray, penalty: float, barrier: float
) -> np.ndarray:
    """Return the slack of least cost, with the barrier that keeps all constraints below it.

    So a step may exceed a constraint that bends: the slack follows, and is penalised.
    """
    if not len(like):
        return like
    # From below, where the largest term alone balances the penalty, Newton's method
    # grows to it.
    x = max(0.0, float(excess.max())) + barrier / penalty
    for _ in range(12):
        room = np.append(x - excess, x)
        pull = (barrier / room).sum() - penalty
        x += max(0.0, pull / (barrier / room**2).sum())
    return np.array([x])


def _merit(
    evaluation: Evaluation,
    slack: np.ndarray,
    room: Inequalities,
    penalty: float,
    barrier: float,
) -> float:
    """Return the merit function, which a step must decrease."""
    logs = sum(
        float(np.log(np.maximum(x, 1e-300)).sum()) for x in _parts(room, evaluation)
    )
    return evaluation.value + penalty * float(slack.sum()) - barrier * logs
