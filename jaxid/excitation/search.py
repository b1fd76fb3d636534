"""The search from many starts at once: relaxed limits first, then tight ones; then generations.

The children of what was found are improved in the same way, and of parents and children the best
live on. In the end limits are kept on a finer grid, so that less of them is left unused. Everything
a search knows between two legs is in its state, so it can be stopped, saved and resumed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float, PRNGKeyArray
from jaxid.excitation.interior_point import COOLING, InteriorPoint, Stage, State
from jaxid.excitation.judge import Best, Judge
from jaxid.excitation.limits import CERTIFIED, JointLimits, random_motion
from jaxid.excitation.offspring import Offspring
from jaxid.excitation.problem import Context, Problem

GRID = 64
"""Rows of each order by which limits are kept during the search."""
FINE = 256
"""Rows of each order by which they are kept in the end."""
CALM = (0.8, 0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)
"""Sizes of further random motions, for starts that find no way to keep the constraints."""
STRETCH = 25
"""Iterations after which the peaks of constraints are looked for anew."""
TIGHT = 0.998
"""Share of the limits within which legs end: what is left is for rounding."""
DEAR = 100.0
"""What exceeding constraints costs from where it must come to an end."""


class Leg(NamedTuple):
    """A stage of the interior point method, and what goes with it.

    Attributes:
        stage: Of the method.
        sharpness: Of smooth extremes.
        judged: Whether its results are compared with the best so far.
    """

    stage: Stage
    sharpness: float
    judged: bool


LEGS = (
    Leg(Stage(2.0, 1e-2, 1e-3, 80), 4.0, False),
    Leg(Stage(1.5, 1e-3, 1e-3, 40), 4.0, False),
    Leg(Stage(1.25, 1e-3, 1e-3, 40), 4.0, False),
    Leg(Stage(1.1, 1e-3, 1e-3, 40), 4.0, False),
    Leg(Stage(TIGHT, 1e-3, 1e-5, 100), 4.0, False),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 100), 4.0, True),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 150), 8.0, False),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 150), 8.0, True),
    Leg(Stage(1.3, 1e-3, 1e-3, 60), 8.0, False),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 125), 8.0, False),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 125), 8.0, True),
    Leg(Stage(TIGHT, 1e-3, 1e-6, 150), 20.0, True),
)
"""Relaxed limits, then the limits; once more a little relaxed; sharper in the end."""

SETTLING = tuple(Leg(Stage(TIGHT, 1e-4, 1e-6, n, DEAR), 20.0, True) for n in (100, 50, 50))
"""What follows where there are constraints: their peaks move, and what cannot be kept is dear."""

GENERATION = Leg(Stage(TIGHT, 1e-3, 1e-6, 150, DEAR), 20.0, True)
"""How children are improved."""
LAST = Leg(Stage(TIGHT, 1e-4, 1e-6, 300, DEAR), 20.0, True)
"""On the fine grid."""


class Searched(NamedTuple):
    """What a search knows between two legs."""

    state: State
    leg: int
    first: Float[AnyArray, " starts"]
    best: Best


class Search:
    """The search for one problem.

    Args:
        problem: What is to be found.
        starts: Number of starts.
        generations: How often the motions have children.

    Attributes:
        problem: The same.
        judge: Of its motions.
    """

    def __init__(self, problem: Problem, starts: int, generations: int):
        self.problem, self._starts = problem, starts
        self._legs = LEGS + SETTLING if problem.constraints else LEGS
        self._generations = generations
        evaluation, limits = problem.evaluation(), problem.limits
        self._solver = InteriorPoint(evaluation, limits.grid(GRID), limits.still)
        self._fine = InteriorPoint(evaluation, limits.grid(FINE), limits.still)
        self._offspring = Offspring(problem)
        self.judge = Judge(problem)
        self._worst = jax.jit(problem.worst)

    def begin(self, key: PRNGKeyArray) -> Searched:
        """Random motions that fill their limits."""
        y = random_starts(self.problem.limits, key, self._starts)
        best = self.judge(y)
        state = self._solver.start(y, self.problem.conditions)
        return Searched(state, 0, best.value, best)

    def advance(self, searched: Searched, key: PRNGKeyArray) -> Searched:
        """The next leg.

        Args:
            searched: What is known so far.
            key: Of the random numbers, that with which the search began.
        """
        number, best = int(searched.leg), searched.best
        bred = number - len(self._legs)
        if bred < 0:
            searched = self._continued(searched, self._legs[number])
        elif bred < self._generations:
            children = self._offspring(best.y, jax.random.fold_in(key, bred))
            best = best.survivors(self._anew(self._solver, children, GENERATION))
            searched = searched._replace(best=best)
        else:
            best = best.improved(self._anew(self._fine, best.y, LAST))
            searched = searched._replace(best=best)
        return searched._replace(leg=number + 1)

    def _continued(self, searched: Searched, leg: Leg) -> Searched:
        """A leg of the starts themselves."""
        state, best = searched.state, searched.best
        broken = np.asarray(best.excess) > 0
        if searched.leg == len(LEGS) and broken.any():
            state = self._calmed(state, broken)
        state = self._improved(self._solver, state, leg)
        if leg.judged:
            best = best.improved(self.judge.within(state.y))
        return searched._replace(state=state, best=best)

    def _anew(self, solver: InteriorPoint, y: Float[AnyArray, "starts scaled"], leg: Leg) -> Best:
        """What a leg makes of motions that it begins with."""
        state = self._improved(solver, solver.start(y, self.problem.conditions), leg)
        return self.judge.within(state.y)

    def _improved(self, solver: InteriorPoint, state: State, leg: Leg) -> State:
        for stage in self._stretches(leg.stage):
            context = Context(jnp.asarray(leg.sharpness), self.problem.peaks(state.y))
            state = solver.run(state, stage, context)
        return state

    def _stretches(self, stage: Stage) -> list[Stage]:
        """A stage in parts, between which the instants of constraints follow their peaks."""
        if not self.problem.constraints:
            return [stage]
        parts = range(-(-stage.iterations // STRETCH))
        return [
            stage._replace(
                iterations=min(STRETCH, stage.iterations - k * STRETCH),
                barrier=max(stage.least, stage.barrier * COOLING ** (k * STRETCH)),
            )
            for k in parts
        ]

    def _calmed(self, state: State, broken: Bool[np.ndarray, " starts"]) -> State:
        """Starts anew where constraints are broken, from small motions that keep them best."""
        many = jnp.concatenate(
            [
                random_starts(self.problem.limits, jax.random.key(k), 16, s)
                for k, s in enumerate(CALM)
            ]
        )
        best = jnp.argsort(jnp.maximum(self._worst(many), 0.0))
        chosen = many[best[np.arange(self._starts) % len(many)]]
        anew = self._solver.start(chosen, self.problem.conditions)
        return jax.tree.map(
            lambda a, b: jnp.where(broken.reshape(-1, *(1,) * (a.ndim - 1)), a, b), anew, state
        )

    @property
    def legs(self) -> int:
        """Number of legs: of the starts, of their descendants, and the last one."""
        return len(self._legs) + self._generations + 1


def random_starts(
    limits: JointLimits, key: PRNGKeyArray, starts: int, size: float = 1.0
) -> Float[Array, "starts scaled"]:
    """Motions with random shapes and places that fill their limits, in scaled numbers.

    Args:
        limits: Of the joints.
        key: Of the random numbers.
        starts: How many.
        size: Of the motions, relative to those that fill the limits.
    """
    joints, variables = limits.shape
    fine = limits.grid(CERTIFIED)
    shape, place = jax.random.split(key)
    draws = jax.random.normal(shape, (starts, joints * variables), float)
    places = jax.random.uniform(place, (starts, joints), float)
    return jax.vmap(lambda a, b: random_motion(fine, limits.still, a, b, size=size))(draws, places)
