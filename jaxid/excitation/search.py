"""The search from many starts: relaxed limits first, then tight ones; then generations.

The children of the motions found are improved in the same way, and of parents and
children the best survive. In the end limits are kept on a finer grid, so that less of
them is left unused. Where there are constraints, all starts are random motions that
keep them, so that there is a result after seconds.
"""

import math
import time
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, namespace

from . import interior_point
from .coefficient_limits import ScaledMotions, scale_samples
from .criterion_gradient import criterion_at_samples, value_and_gradient
from .feasible_candidates import (
    EXCESS_PENALTY,
    Candidates,
    evaluate_within_limits,
    shrink_to_constraints,
)
from .interior_point_iterates import Evaluation, Iterates, Stage
from .problem import MARGIN, SEARCH_SAMPLES, ExcitationProblem
from .watched_constraints import (
    count_watched,
    linearise,
    watch,
    watched_excess,
)

FINE_SAMPLES = 256
"""Rows of each order by which limits are kept in the end."""

SCHEDULE = (
    Stage(2.0, 1e-2, 1e-3, 80),
    Stage(1.5, 1e-3, 1e-3, 40),
    Stage(1.25, 1e-3, 1e-3, 40),
    Stage(1.1, 1e-3, 1e-3, 40),
    Stage(0.998, 1e-3, 1e-5, 100),
    Stage(0.998, 1e-3, 1e-6, 100),
    Stage(0.998, 1e-3, 1e-6, 150, 8.0),
    Stage(0.998, 1e-3, 1e-6, 150, 8.0),
    Stage(1.3, 1e-3, 1e-3, 60, 8.0),
    Stage(0.998, 1e-3, 1e-6, 125, 8.0),
    Stage(0.998, 1e-3, 1e-6, 125, 8.0),
    Stage(0.998, 1e-3, 1e-6, 150, 20.0),
)
"""Relaxed limits, then the limits; slightly relaxed once more; sharper in the end.

The bound 0.998 leaves room for rounding.
"""
CONSTRAINED_SCHEDULE = (
    Stage(1.25, 1e-2, 1e-3, 50),
    Stage(0.998, 1e-3, 1e-4, 75, 4.0, 30.0),
    Stage(0.998, 1e-4, 1e-6, 75, 20.0, 100.0),
    Stage(0.998, 1e-4, 1e-6, 50, 20.0, 100.0),
    Stage(1.1, 1e-3, 1e-3, 25, 8.0, 30.0),
    Stage(0.998, 1e-4, 1e-6, 100, 20.0, 100.0),
    Stage(0.998, 1e-4, 1e-6, 50, 20.0, 100.0),
)
"""The same with constraints: exceeding them becomes more and more expensive."""
GENERATION_STAGE = Stage(0.998, 1e-3, 1e-6, 150, 20.0, 100.0)
"""Improvement of children."""
FINE_STAGE = Stage(0.998, 1e-4, 1e-6, 300, 20.0, 100.0)
"""Improvement in the end, on the fine grid."""
BATCH = 8
"""Starts that are improved together."""
PART = 25
"""Iterations of one step, after which the peaks of constraints are found anew."""
CHILD_TRIES = 16
"""Children of each motion of which the most promising is improved."""


class Step(NamedTuple):
    """State of a search before a step, and after the last one."""

    task: str  # task of the step, in words
    candidates: Candidates  # best motions so far


Search = Generator[Step, None, Candidates]
"""A part of a search: it yields steps, and returns the best motions."""


def schedule_of(problem: ExcitationProblem) -> tuple[Stage, ...]:
    """Return the stages that improve the starts."""
    return CONSTRAINED_SCHEDULE if problem.constraints else SCHEDULE


def count_steps(problem: ExcitationProblem, starts: int, generations: int) -> int:
    """Return the number of steps of a search without a deadline."""
    stages_of_start = (*schedule_of(problem), FINE_STAGE)
    stages = (*stages_of_start, *(GENERATION_STAGE,) * generations)
    steps_of_batch = sum(math.ceil(stage.iterations / PART) for stage in stages)
    return steps_of_batch * math.ceil(starts / BATCH)


def search(
    problem: ExcitationProblem,
    x: ScaledMotions,
    candidates: Candidates,
    generations: int,
    random: np.random.Generator,
    deadline: float = math.inf,
) -> Generator[Step, None, None]:
    """Improve motions; yield the best so far before each step and after the last one.

    Args:
        problem: Problem to be solved.
        x: Motions to start from.
        candidates: The same motions within limits; with constraints only the first.
        generations: Number of generations.
        random: Generator of the children.
        deadline: Time of `time.monotonic` after which only the fine grid follows [s].
    """
    starts = np.arange(len(x))
    batches = np.split(starts, range(BATCH, len(x), BATCH))
    if problem.constraints:
        candidates = yield from _find_feasible_motion(problem, x, candidates)
        x = np.asarray(candidates.x)
        # One motion is improved alone, so that there is a good result soon.
        batches = [starts[:1], *np.split(starts[1:], range(BATCH, len(x) - 1, BATCH))]

    for places in batches:
        if len(places) and time.monotonic() < deadline:
            candidates = yield from _improve_batch(
                problem,
                x,
                candidates,
                places,
                deadline,
            )
    for _ in range(generations):
        if time.monotonic() < deadline:
            candidates = yield from _improve_children(
                problem,
                candidates,
                random,
                deadline,
            )

    candidates = yield from _improve_finely(problem, candidates, deadline)
    yield Step("final stage on a finer grid", candidates)


def _improve_finely(
    problem: ExcitationProblem, candidates: Candidates, deadline: float
) -> Search:
    """Improve all motions on the fine grid, after the deadline only the best batch."""
    order = candidates.promising()
    if time.monotonic() >= deadline:
        order = order[:BATCH]
    for places in np.split(order, range(BATCH, len(order), BATCH)):
        step = Step("final stage on a finer grid", candidates)
        iterates = _begin(problem, FINE_SAMPLES, candidates.x[places])
        iterates = yield from _improve(
            problem,
            FINE_SAMPLES,
            iterates,
            FINE_STAGE,
            step,
        )
        candidates = _take(problem, candidates, places, iterates)
    return candidates


def _find_feasible_motion(
    problem: ExcitationProblem,
    x: ScaledMotions,
    candidates: Candidates,
) -> Search:
    """Look for a motion that keeps all constraints; return it as the first start."""
    for motion in x[1:]:
        if candidates.is_feasible:
            break
        yield Step("looking for a first motion that keeps all limits", candidates)
        candidates = candidates.survivors(shrink_to_constraints(problem, motion))
    infinity = np.full(len(x), np.inf)
    starts = Candidates(x, infinity, infinity)
    return starts.improved(np.array([0]), candidates.at(candidates.order()[:1]))


def _improve_batch(
    problem: ExcitationProblem,
    x: ScaledMotions,
    candidates: Candidates,
    places: np.ndarray,
    deadline: float,
) -> Search:
    """Run all stages for the starts at some places; return the best motions."""
    iterates = _begin(problem, SEARCH_SAMPLES, x[places])
    for stage in schedule_of(problem):
        step = Step("searching from many starts", candidates)
        iterates = yield from _improve(
            problem,
            SEARCH_SAMPLES,
            iterates,
            stage,
            step,
            deadline,
        )
        if stage.bound < 1.0:
            candidates = _take(problem, candidates, places, iterates)
        if time.monotonic() >= deadline:
            break
    return candidates


def _improve_children(
    problem: ExcitationProblem,
    candidates: Candidates,
    random: np.random.Generator,
    deadline: float,
) -> Search:
    """Improve one child of each motion; return the best of parents and children."""
    step = Step("combining and improving motions", candidates)
    x = np.asarray(candidates.x)
    children = crossover(problem, x, draw_matings(problem, len(x), random))
    motions = []
    for start in range(0, len(children), BATCH):
        iterates = _begin(problem, SEARCH_SAMPLES, children[start : start + BATCH])
        iterates = yield from _improve(
            problem,
            SEARCH_SAMPLES,
            iterates,
            GENERATION_STAGE,
            step,
            deadline,
        )
        motions.append(iterates.y)
    return candidates.survivors(
        evaluate_within_limits(problem, np.concatenate(motions))
    )


def _begin(problem: ExcitationProblem, samples: int, x: ScaledMotions):
    """Return the iterates at some motions."""
    grid = problem.limits.grid(samples)
    return interior_point.begin(grid, np.asarray(x), count_watched(problem))


def _improve(
    problem: ExcitationProblem,
    samples: int,
    iterates: Iterates,
    stage: Stage,
    step: Step,
    deadline: float = math.inf,
) -> Generator[Step, None, Iterates]:
    """Run one stage in parts; yield before each; return the iterates.

    The peaks of constraints are found anew for each part.
    """
    grid = problem.limits.grid(samples)
    for part in split_stage(stage):
        yield step
        if time.monotonic() >= deadline:
            break
        objective = watched_objective(problem, iterates.y, part.sharpness)
        iterates = interior_point.run(grid, objective, iterates, part)
    return iterates


def split_stage(stage: Stage) -> list[Stage]:
    """Return the parts of a stage."""
    parts = []
    for start in range(0, stage.iterations, PART):
        barrier = stage.barrier * interior_point.BARRIER_FACTOR**start
        part = stage._replace(
            barrier=max(stage.min_barrier, barrier),
            iterations=min(PART, stage.iterations - start),
        )
        parts.append(part)
    return parts


def watched_objective(
    problem: ExcitationProblem, x: ScaledMotions, sharpness: Any
) -> Callable[[ScaledMotions], Evaluation]:
    """Return the function that evaluates criterion and constraints near motions."""
    watched_values = watch(problem, x) if problem.constraints else []
    samples = scale_samples(SEARCH_SAMPLES, problem.basis)

    def evaluate(y):
        values, gradients = value_and_gradient(problem, y, sharpness, samples)
        constraints = linearise(problem, y, watched_values)
        excess = constraints.values + MARGIN
        return Evaluation(values, gradients, excess, constraints.slopes)

    return evaluate


def _take(
    problem: ExcitationProblem,
    candidates: Candidates,
    places: np.ndarray,
    iterates: Iterates,
):
    """Return the best motions, with those of iterates at some places if better."""
    found_motions = evaluate_within_limits(problem, iterates.y)
    return candidates.improved(places, found_motions)


class Mating(NamedTuple):
    """Random choices by which each motion has one child."""

    mates: AnyArray  # place of the second parent
    retimings: AnyArray  # number of the second parent's change of time
    is_from_second: AnyArray  # [starts, joints]


def draw_matings(
    problem: ExcitationProblem, starts: int, random: np.random.Generator
) -> Mating:
    """Draw the choices of several children of each motion, tries first."""
    joints, _ = problem.limits.shape
    shape = (CHILD_TRIES, starts)
    mates = np.arange(starts) + random.integers(1, max(starts, 2), shape)
    numbers = random.integers(0, len(problem.basis.retimings()), shape)
    # Half of the second parents are not retimed: motions of one descent fit together
    # already.
    numbers[random.random(shape) < 0.5] = 0

    # A child has this expected fraction of joints from its second parent, and at least
    # one.
    fractions = random.uniform(0.1, 0.5, (*shape, 1))
    is_from_second = random.random((*shape, joints)) < fractions
    certain_joints = random.integers(0, joints, shape)
    joint_numbers = np.arange(joints)
    is_from_second |= certain_joints[..., None] == joint_numbers
    return Mating(mates % starts, numbers, is_from_second)


def crossover(
    problem: ExcitationProblem, x: ScaledMotions, matings: Mating
) -> ScaledMotions:
    """Return one child of each motion with another one: the most promising of several.

    Some joints of a child move as in one parent, the others as in another, begun at
    another time. Limits hold for each joint alone, so that a child keeps the limits
    that its parents keep. The information of a motion does not depend on when its
    period begins or which way it runs, so that two good motions may fit together at one
    shift only: many children are tried.
    """
    xp = namespace(x)
    retimings = np.asarray(problem.basis.retimings())
    samples = scale_samples(SEARCH_SAMPLES, problem.basis)

    def try_children(mating):
        children = _children(problem, retimings, x, mating)
        values = criterion_at_samples(problem, children, None, samples)
        if problem.constraints:
            excess = watched_excess(problem, children)
            values = values + EXCESS_PENALTY * xp.maximum(excess, 0.0)
        return children, xp.where(xp.isnan(values), np.inf, values)

    if xp is jnp:
        children, values = jax.lax.map(try_children, matings)
    else:
        tries = [try_children(Mating(*parts)) for parts in zip(*matings, strict=True)]
        children, values = (np.stack(parts) for parts in zip(*tries, strict=True))
    return children[values.argmin(axis=0), np.arange(len(x))]


def _children(
    problem: ExcitationProblem, retimings: np.ndarray, x: ScaledMotions, mating: Mating
):
    """Return one child of each motion with another one."""
    xp = namespace(x)
    starts = len(x)
    joints, variables = problem.limits.shape
    maps = xp.asarray(retimings)[mating.retimings]
    coefficients = problem.limits.coefficients(x[mating.mates])
    # [starts, joints, coefficients] @ [starts, coefficients, coefficients]
    retimed_mates = coefficients @ maps.swapaxes(1, 2)
    second_parents = retimed_mates / np.asarray(problem.limits.scale)[None]
    first_parents = x.reshape(starts, joints, variables)
    is_from_second = mating.is_from_second[:, :, None]
    children = xp.where(is_from_second, second_parents, first_parents)
    return children.reshape(x.shape)
