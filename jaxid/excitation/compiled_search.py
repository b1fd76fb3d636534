"""The search of `search.py` as one program of JAX, which runs where its arrays are.

All starts are improved together, and nothing returns to the host before the end of a
part. On a GPU that is what a search costs; on a CPU compiling takes longer than the
whole search in NumPy.
"""

import time
from collections.abc import Callable, Generator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array

from . import interior_point, search
from .coefficient_limits import ScaledMotions
from .feasible_candidates import Candidates, evaluate_within_limits
from .interior_point_iterates import Iterates, Stage
from .problem import MARGIN, ExcitationProblem
from .search import Mating, Step
from .watched_constraints import count_watched

KEEP, RESUME, BREED = range(3)
"""Motions with which a part begins: those before it, the best so far, or children."""
NOT, BY_PLACE, BY_VALUE = range(3)
"""How motions are compared with the best so far: not yet, each with one, or all."""


class Plan(NamedTuple):
    """One part of a search; or all parts, as arrays with one entry for each."""

    stage: Stage
    origin: Any  # motions with which it begins
    comparison: Any  # how its motions are compared with the best so far
    generation: Any  # number of the matings of its children


class State(NamedTuple):
    """State of a search between two parts."""

    iterates: Iterates
    # best motions so far, with values at few samples and instants
    candidates: Candidates


class CompiledSearch(eqx.Module):
    """Solver of excitation problems that is one program of JAX.

    `minimise(problem, CompiledSearch())` uses it on any device; `minimise(problem)`
    does on a GPU.

    Attributes:
        generations: Number of generations.
        seed: Seed of the children.
    """

    generations: int = 12
    seed: int = 0

    def __call__(self, problem: ExcitationProblem, x: ScaledMotions) -> Array:
        """Return better motions [starts, scaled], after all parts of the search."""
        random = np.random.default_rng(self.seed)
        return jax.jit(self.program(problem, len(x), random))(jnp.asarray(x))

    def program(
        self, problem: ExcitationProblem, starts: int, random: np.random.Generator
    ) -> Callable[[Array], Array]:
        """Return the whole search as a function of JAX, from motions to better ones."""
        plan = plan_parts(problem, self.generations)
        matings = draw_generations(problem, starts, self.generations, random)

        def improve(x):
            advance = partial(run_part, problem, plan, matings)
            state = begin(problem, x)
            return jax.lax.fori_loop(0, len(plan.origin), advance, state).candidates.x

        return improve


def compiled_search(
    problem: ExcitationProblem,
    x: ScaledMotions,
    candidates: Candidates,
    generations: int,
    random: np.random.Generator,
    deadline: float,
) -> Generator[Step, None, None]:
    """Improve motions as `search` does; between parts the host sees the best motion."""
    plan = plan_parts(problem, generations)
    matings = draw_generations(problem, len(x), generations, random)
    advance = jax.jit(partial(run_part, problem, plan, matings))
    final_part = len(plan.origin) - len(search.split_stage(search.FINE_STAGE))
    state = begin(problem, jnp.asarray(x))
    for number in range(len(plan.origin)):
        yield Step("improving all motions together", candidates)
        if time.monotonic() >= deadline and number < final_part:
            continue
        state = advance(number, state)
        if plan.comparison[number] != NOT:
            best_motion = state.candidates.best_motion
            others = evaluate_within_limits(problem, best_motion[None])
            candidates = candidates.survivors(others)
    final_motions = np.asarray(state.candidates.x)
    candidates = candidates.survivors(evaluate_within_limits(problem, final_motions))
    yield Step("improving all motions together", candidates)


def plan_parts(problem: ExcitationProblem, generations: int) -> Plan:
    """Return all parts: the schedule, generations of children, and a last stage."""
    parts = []
    for stage in search.schedule_of(problem):
        # With relaxed limits a motion is not yet a result.
        comparison = BY_PLACE if stage.bound < 1.0 else NOT
        parts += _parts_of_stage(stage, KEEP, comparison)
    for generation in range(generations):
        parts += _parts_of_stage(search.GENERATION_STAGE, BREED, BY_VALUE, generation)
    parts += _parts_of_stage(search.FINE_STAGE, RESUME, BY_PLACE)
    return jax.tree.map(lambda *numbers: np.array(numbers), *parts)


def _parts_of_stage(
    stage: Stage, origin: int, comparison: int, generation: int = 0
) -> list[Plan]:
    """Return the parts of a stage: its motions are compared after the last one."""
    parts = [Plan(part, KEEP, NOT, generation) for part in search.split_stage(stage)]
    parts[0] = parts[0]._replace(origin=origin)
    parts[-1] = parts[-1]._replace(comparison=comparison)
    return parts


def draw_generations(
    problem: ExcitationProblem,
    starts: int,
    generations: int,
    random: np.random.Generator,
) -> Mating:
    """Draw the choices of all children, generations first."""
    draws = [
        search.draw_matings(problem, starts, random) for _ in range(max(generations, 1))
    ]
    return jax.tree.map(lambda *choices: np.stack(choices), *draws)


def begin(problem: ExcitationProblem, x: Array) -> State:
    """Return the state before the first part."""
    grid = problem.limits.grid(search.FINE_SAMPLES)
    iterates = interior_point.begin(grid, x, count_watched(problem))
    infinity = jnp.full(len(x), np.inf)
    return State(iterates, Candidates(x, infinity, infinity))


def run_part(
    problem: ExcitationProblem, plan: Plan, matings: Mating, number: Array, state: State
) -> State:
    """Run one part of a search."""
    grid = problem.limits.grid(search.FINE_SAMPLES)
    part = jax.tree.map(lambda column: jnp.asarray(column)[number], plan)
    candidates = state.candidates

    def keep():
        return state.iterates

    def resume():
        return interior_point.begin(grid, candidates.x, count_watched(problem))

    def breed():
        mating = jax.tree.map(lambda x: jnp.asarray(x)[part.generation], matings)
        children = search.crossover(problem, candidates.x, mating)
        return interior_point.begin(grid, children, count_watched(problem))

    iterates = jax.lax.switch(part.origin, [keep, resume, breed])
    objective = search.watched_objective(problem, iterates.y, part.stage.sharpness)
    iterates = interior_point.run(grid, objective, iterates, part.stage)

    evaluation = iterates.evaluation
    excess = evaluation.excess.max(axis=1, initial=-np.inf) - MARGIN
    is_finite = jnp.isfinite(evaluation.value)
    values = jnp.where(is_finite, evaluation.value, np.inf)
    others = Candidates(iterates.y, values, excess)
    candidates = jax.lax.switch(
        part.comparison,
        [
            lambda: candidates,
            lambda: candidates.better_of(others),
            lambda: candidates.survivors(others),
        ],
    )
    return State(iterates, candidates)
