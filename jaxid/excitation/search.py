"""The search from many starts: relaxed limits first, then tight ones; then generations.

The children of the motions found are improved in the same way, and of parents and
children the best survive. In the end limits are kept on a finer grid, so that less of
them is left unused. Where there are constraints, all starts are small motions that keep
them, so that there is a result after seconds.
"""

import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxid.arrays import Float, PRNGKeyArray
from jaxid.dynamics.motion import Motion

from . import interior_point
from .coefficient_limits import scale_samples
from .interior_point import Evaluation, Stage, State
from .problem import (
    PENALTY,
    SEARCHED,
    Candidates,
    ExcitationProblem,
    evaluate,
    evaluate_within_limits,
    shrink_to_constraints,
)

FINE = 256
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
"""Relaxed limits, then the limits (0.998 leaves room for rounding); slightly relaxed once more;
sharper in the end."""
CONSTRAINED = (
    Stage(1.25, 1e-2, 1e-3, 50),
    Stage(0.998, 1e-3, 1e-4, 75, 4.0, 30.0),
    Stage(0.998, 1e-4, 1e-6, 75, 20.0, 100.0),
    Stage(0.998, 1e-4, 1e-6, 50, 20.0, 100.0),
    Stage(1.1, 1e-3, 1e-3, 25, 8.0, 30.0),
    Stage(0.998, 1e-4, 1e-6, 100, 20.0, 100.0),
    Stage(0.998, 1e-4, 1e-6, 50, 20.0, 100.0),
)
"""The same where there are constraints: exceeding them becomes more and more expensive."""
EVALUATED = frozenset({5, 7, 10, 11})
"""Stages without constraints whose results are compared with the best so far."""
GENERATION = Stage(0.998, 1e-3, 1e-6, 150, 20.0, 100.0)
"""Improvement of children."""
LAST = Stage(0.998, 1e-4, 1e-6, 300, 20.0, 100.0)
"""Last improvement, on the fine grid."""
BATCH = 8
"""Starts that are improved together."""
PART = 25
"""Iterations after which the peaks of constraints are found anew."""


class Search:
    """A search that may be stopped after each step.

    Attributes:
        first: Values of the random motions.
        best: Best motions so far.
        history: Value of the criterion for the best motion, before the first step and
            after each.
        steps: Number of steps without a limit of time.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        key: PRNGKeyArray,
        starts: int,
        generations: int,
        begin: Float[np.ndarray, " scaled"] | None = None,
        seconds: float | None = None,
    ):
        self._problem, self._generations = problem, generations
        self._random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        self._began, self._seconds = time.monotonic(), seconds
        x = problem.limits.random(key, starts)
        if problem.constraints:
            self.first = problem.value_and_gradient(x, None, problem.samples)[0]
            x = first_motions(problem, self._random, x)
        else:
            self.first = evaluate(problem, x).value
        if begin is not None:
            x[0] = begin
        self.best = evaluate_within_limits(problem, x[:1] if problem.constraints else x)
        self._x, self.history = x, [self.best.best_value]
        self._schedule = CONSTRAINED if problem.constraints else SCHEDULE
        batches = -(-starts // BATCH)
        self.steps = batches * (len(self._schedule) + 1) + generations

    @property
    def feasible(self) -> bool:
        """Whether the best motion so far keeps all constraints."""
        return bool((self.best.broken == 0).any())

    @property
    def spent(self) -> float:
        """Fraction of the time that is spent; that of the steps where time is not limited."""
        if self._seconds is None:
            return min((len(self.history) - 1) / self.steps, 1.0)
        return min((time.monotonic() - self._began) / self._seconds, 1.0)

    def run(self) -> Iterator[str]:
        """Search, and yield what it does next at the beginning and after each step."""
        problem = self._problem
        if problem.constraints:
            yield from self._start_batches()
        else:
            yield "searching from many starts"
        for places in self._batches():
            yield from self._improve_batch(places)
        for _ in range(self._generations):
            if self._is_late:
                break
            children = crossover(problem, np.asarray(self.best.x), self._random)
            found = [*self.best.x]
            for start in range(0, len(found), BATCH):
                states = _begin(problem, SEARCHED, children[start : start + BATCH])
                for _ in _improve(problem, SEARCHED, states, GENERATION):
                    if self._is_late:
                        break
                    yield "improving descendants"
                found[start : start + BATCH] = [one.y for one in states]
            self.best = self.best.survivors(
                evaluate_within_limits(problem, np.array(found))
            )
            yield self._done("improving descendants")
        yield from self._finish()

    def _batches(self) -> Iterator[np.ndarray]:
        """Yield the places of starts; with constraints the first batch is one start alone."""
        every = np.arange(len(self._x))
        first = 1 if self._problem.constraints else 0
        for batch in (
            every[:first],
            *np.split(every[first:], range(BATCH, len(every), BATCH)),
        ):
            if len(batch) and not self._is_late:
                yield batch

    def _start_batches(self) -> Iterator[str]:
        """Look for a first motion that keeps all constraints, then for more."""
        yield "looking for a first motion that keeps all limits"
        for x in self._x[1:]:
            if self.feasible:
                break
            self.best = self.best.survivors(shrink_to_constraints(self._problem, x))
            yield self._done("looking for a first motion that keeps all limits")
        first, unknown = self.best.order()[:1], np.full(len(self._x), np.inf)
        found = Candidates(*(part[first] for part in self.best))
        self.best = Candidates(self._x, unknown, unknown).placed([0], found)
        self._x = self.best.x

    def _improve_batch(self, places: np.ndarray) -> Iterator[str]:
        task = "searching from many starts"
        states = _begin(self._problem, SEARCHED, self._x[places])
        for number, stage in enumerate(self._schedule):
            for _ in _improve(self._problem, SEARCHED, states, stage):
                if self._is_late:
                    return
                yield task
            if number in EVALUATED or (self._problem.constraints and stage.bound < 1.0):
                self._take(states, places)
            yield self._done(task)

    def _finish(self) -> Iterator[str]:
        """Keep limits on a finer grid."""
        problem, task = self._problem, "keeping the limits closely"
        promising = self.best.promising()
        for start in range(
            0, len(promising) if self._seconds is None else BATCH, BATCH
        ):
            places = promising[start : start + BATCH]
            states = _begin(problem, FINE, self.best.x[places])
            for _ in _improve(problem, FINE, states, LAST):
                yield task
            self._take(states, places)
            yield self._done(task)

    @property
    def _is_late(self) -> bool:
        """Whether only the time for the fine grid is left."""
        return self._seconds is not None and self.spent > 0.65

    def _take(self, states: list[State], places: np.ndarray) -> None:
        """Replace the motions at some places by those of states that are better."""
        x = np.array([one.y for one in states])
        self._replace(places, evaluate_within_limits(self._problem, x))

    def _replace(self, places: Any, found: Candidates) -> None:
        """Replace the motions at some places by better ones."""
        self.best = self.best.improved(self.best.placed(places, found))

    def _done(self, task: str) -> str:
        self.history.append(self.best.best_value)
        return task

    def finish(self) -> None:
        """Make motions smaller where no other keeps all constraints."""
        if self.best.broken.all():
            for place in self.best.order()[:4]:
                small = shrink_to_constraints(self._problem, self.best.x[place])
                self._replace([place], small)


def first_motions(
    problem: ExcitationProblem,
    random: np.random.Generator,
    x: Float[np.ndarray, "starts scaled"],
) -> Float[np.ndarray, "starts scaled"]:
    """Return as many small motions that keep the constraints best, the largest of them first.

    They have the shapes of given motions, about poses at which the robot may stand
    still.
    """
    limits, robot = problem.limits.limits, problem.base.model.robot
    low, high = np.asarray(limits.position_min), np.asarray(limits.position_max)
    places = random.uniform(0.1, 0.9, (1000, robot.joints))
    q = low + places * (high - low)
    still = Motion(q, np.zeros_like(q), np.zeros_like(q))
    values = [
        np.asarray(c(problem.robot, still)).max(axis=1) for c in problem.constraints
    ]
    good = np.argsort(np.max(values, axis=0))[: len(x)]
    fill = problem.limits.grid().fill
    many = [
        np.asarray(fill(y, place, size))
        for size in (0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)
        for y, place in zip(x, places[good], strict=True)
    ]
    excess = np.array([problem.watched_excess(y) for y in many])
    best = np.argsort(np.maximum(excess, 0.0), kind="stable")[: len(x)]
    return np.array(many)[best]


def _begin(problem: ExcitationProblem, points: int, x: Any) -> list[State]:
    return interior_point.begin(
        problem.limits.grid(points), np.asarray(x), problem.conditions
    )


def _improve(
    problem: ExcitationProblem, points: int, states: list[State], stage: Stage
) -> Iterator[None]:
    """Run one stage in parts, on the list of states; peaks of constraints are found anew."""
    grid = problem.limits.grid(points)
    for start in range(0, stage.iterations, PART):
        barrier = max(stage.least, stage.barrier * interior_point.COOLING**start)
        count = min(PART, stage.iterations - start)
        watched = [problem.watched(one.y) for one in states]

        def objective(
            y: np.ndarray, active: Any, watched: Any = watched
        ) -> list[Evaluation]:
            return problem.evaluate(y, stage.sharpness, [watched[k] for k in active])

        now = stage._replace(barrier=barrier, iterations=count)
        states[:] = interior_point.run(grid, objective, states, now)
        yield


def crossover(
    problem: ExcitationProblem,
    x: Float[np.ndarray, "starts scaled"],
    random: np.random.Generator,
    tries: int = 16,
) -> Float[np.ndarray, "starts scaled"]:
    """Return one child of each motion with another one: the most promising of several.

    Some joints of a child move as in one parent, the others as in another, begun at
    another time. Limits hold for each joint alone, so that a child keeps the limits
    that its parents keep. The information of a motion does not depend on when its
    period begins or which way it runs, so that two good motions may fit together at one
    shift only: many children are tried.
    """
    retimings, count = problem.basis.retimings(), scale_samples(SEARCHED, problem.basis)
    best, least = np.array(x), np.full(len(x), np.inf)
    for _ in range(tries):
        children = _draw_children(problem, retimings, x, random)
        value = problem.value_and_gradient(children, None, count)[0]
        if problem.constraints:
            excess = np.array([problem.watched_excess(y) for y in children])
            value = value + PENALTY * np.maximum(excess, 0.0)
        better = value < least
        best[better], least[better] = children[better], value[better]
    return best


def _draw_children(
    problem: ExcitationProblem,
    retimings: np.ndarray,
    x: np.ndarray,
    random: np.random.Generator,
) -> np.ndarray:
    """Draw one child of each motion with another one."""
    starts = len(x)
    joints, variables = problem.limits.shape
    numbers = np.arange(starts)
    offsets = random.integers(1, max(starts, 2), starts)

    # Half of the second parents are not retimed: motions of one descent fit together
    # already.
    retiming_numbers = random.integers(0, len(retimings), starts)
    is_unchanged = random.random(starts) < 0.5
    maps = retimings[np.where(is_unchanged, 0, retiming_numbers)]
    coefficients = problem.limits.coefficients(x[(numbers + offsets) % starts])
    retimed = np.einsum("bvw,bjw->bjv", maps, coefficients)
    second_parents = retimed / np.asarray(problem.limits.scale)

    # A child has this expected fraction of joints from its second parent, and at least
    # one.
    fractions = random.uniform(0.1, 0.5, (starts, 1))
    is_from_second = random.random((starts, joints)) < fractions
    is_from_second[numbers, random.integers(0, joints, starts)] = True

    first_parents = x.reshape(starts, joints, variables)
    children = np.where(is_from_second[:, :, None], second_parents, first_parents)
    return children.reshape(x.shape)
