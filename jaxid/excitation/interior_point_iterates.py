"""Points of an interior point method for many starts, and their distances from bounds.

All numbers are in arrays whose first axis counts the starts, in NumPy or JAX.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, Int, namespace

from .coefficient_limits import Grid, ScaledMotions

INITIAL_CURVATURE = 0.3  # small, so that first steps are large

PerStart = Float[AnyArray, " starts"]
"""One number for each start."""
Slacks = Float[AnyArray, "starts slacks"]
"""One slack of each start if there are constraints, or none."""
Steps = Float[AnyArray, "starts scaled_and_slack"]


class Evaluation(NamedTuple):
    """Objective and nonlinear constraints of all starts, with their derivatives."""

    value: PerStart
    gradient: ScaledMotions
    excess: Float[AnyArray, "starts constraints"]
    slopes: Float[AnyArray, "starts constraints scaled"]


Inequalities = Float[AnyArray, "starts inequalities"]
"""One number for each inequality: its distance from the bound, or its multiplier.

Limits of the joints, upwards, then downwards; constraints; sign of the slack if there
are any.
"""


class Parts(NamedTuple):
    """The numbers of inequalities by their kinds."""

    limits: AnyArray
    constraints: AnyArray
    slack: AnyArray


class Iterates(NamedTuple):
    """Present points of all starts, their multipliers, and the steps that are next."""

    y: ScaledMotions
    slack: Slacks
    evaluation: Evaluation
    duals: Inequalities  # multipliers
    curvature: Float[AnyArray, "starts scaled scaled"]  # of the Lagrangian
    barrier: PerStart  # weight of the logarithmic barrier
    step: Steps
    dual_step: Inequalities
    length: PerStart  # fraction of the step that is tried
    dual_length: PerStart
    slope: PerStart  # derivative of the merit along the step
    refusals: Int[AnyArray, " starts"]  # refused steps in a row
    # whether the point itself is to be evaluated next
    needs_evaluation: Bool[AnyArray, " starts"]

    @property
    def trial(self) -> ScaledMotions:
        """Points to be evaluated next."""
        return self.y + self.length[:, None] * self.step[:, : self.y.shape[1]]


class Stage(NamedTuple):
    """One run of the method."""

    bound: Any  # multiple to which limits are relaxed or tightened
    barrier: Any  # weight of the logarithmic barrier at the start
    min_barrier: Any  # weight below which the barrier does not fall
    iterations: Any  # largest number of iterations
    sharpness: Any = 4.0  # sharpness of smooth extremes in the objective
    penalty: Any = 10.0  # penalty of the slack by which constraints are exceeded


def begin(grid: Grid, y: ScaledMotions, constraints: int = 0) -> Iterates:
    """Return the iterates of some starts before the first stage."""
    xp = namespace(y)
    starts, size = y.shape
    slacks = 1 if constraints else 0
    zeros = xp.zeros(starts)
    duals = xp.zeros((starts, 2 * grid.c.size + constraints + slacks))
    return Iterates(
        y=y,
        slack=xp.zeros((starts, slacks)),
        evaluation=Evaluation(
            zeros,
            xp.zeros_like(y),
            xp.zeros((starts, constraints)),
            xp.zeros((starts, constraints, size)),
        ),
        duals=duals,
        curvature=xp.broadcast_to(
            INITIAL_CURVATURE * np.eye(size)[None], (starts, size, size)
        ),
        barrier=zeros,
        step=xp.zeros((starts, size + slacks)),
        dual_step=duals,
        length=zeros,
        dual_length=zeros,
        slope=zeros,
        refusals=xp.zeros(starts, int),
        needs_evaluation=xp.ones(starts, bool),
    )


def select(is_first: AnyArray, first: Any, second: Any) -> Any:
    """Return for each start the numbers of the first tree, or of the second one."""
    xp = namespace(is_first)

    def choose(x, y):
        axes = (1,) * (x.ndim - 1)
        return xp.where(is_first.reshape(-1, *axes), x, y)

    return jax.tree.map(choose, first, second)


def dot(x: AnyArray, y: AnyArray):
    """Return the product of two vectors of each start."""
    return (x * y).sum(axis=1)


def times(A: AnyArray, x: AnyArray):
    """Return the product of a matrix and a vector of each start."""
    return (A @ x[..., None])[..., 0]


def outer(x: AnyArray):
    """Return the product of a vector of each start with itself, a matrix."""
    return x[:, :, None] * x[:, None]


def limit_room(grid: Grid, stage: Stage, y: ScaledMotions):
    """Return the distances from the limits of the joints."""
    rows = (grid.rows(y) - grid.c[None]).reshape(len(y), -1)
    bound = stage.bound * grid.bound
    return namespace(y).concatenate([bound - rows, bound + rows], axis=1)


def room_of(
    grid: Grid,
    stage: Stage,
    y: ScaledMotions,
    evaluation: Evaluation,
    slack: Slacks,
):
    """Return the distances from all bounds."""
    joint_room = limit_room(grid, stage, y)
    constraint_room = slack.sum(axis=1, keepdims=True) - evaluation.excess
    return namespace(y).concatenate([joint_room, constraint_room, slack], axis=1)


def split(numbers: Inequalities, evaluation: Evaluation):
    """Return the numbers of limits, constraints and slack."""
    constraints = evaluation.excess.shape[1]
    slack = numbers.shape[1] - (constraints > 0)
    limits = slack - constraints
    return Parts(numbers[:, :limits], numbers[:, limits:slack], numbers[:, slack:])
