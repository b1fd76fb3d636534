"""The search from many starts at once: relaxed limits first, then tight ones; then generations.

The children of the motions found are improved in the same way, and of parents and children the best
survive. In the end limits are kept on a finer grid, so that less of them is left unused, and the
best motions are polished one by one.
"""

import functools
import hashlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float, PRNGKeyArray
from jaxid.errors import InputError
from jaxid.excitation.candidates import (
    PENALTY,
    evaluate,
    evaluate_within_limits,
    shrink_to_constraints,
)
from jaxid.excitation.interior_point import InteriorPoint, Stage, State
from jaxid.excitation.polish import polish
from jaxid.excitation.problem import SEARCHED, ExcitationProblem
from jaxid.io import write_bytes

FINE = 256
"""Rows of each order by which limits are kept in the end."""
POLISHING = 4
"""Time of polishing one motion, relative to a step of the schedule."""


class ScheduleStep(NamedTuple):
    """One step of the search schedule: a run of the interior point method.

    Attributes:
        bound: Multiple to which limits are relaxed or tightened; 0.998 leaves room for rounding.
        barrier: Weight of the barrier at the start.
        least: Weight below which it does not fall.
        iterations: Number of iterations.
        sharpness: Sharpness of smooth extremes.
        evaluated: Whether the results are compared with the best so far.
        penalty: Penalty of exceeding constraints.
    """

    bound: float
    barrier: float
    least: float
    iterations: int
    sharpness: float
    evaluated: bool = False
    penalty: float = 10.0


SCHEDULE = (
    ScheduleStep(2.0, 1e-2, 1e-3, 80, 4.0),
    ScheduleStep(1.5, 1e-3, 1e-3, 40, 4.0),
    ScheduleStep(1.25, 1e-3, 1e-3, 40, 4.0),
    ScheduleStep(1.1, 1e-3, 1e-3, 40, 4.0),
    ScheduleStep(0.998, 1e-3, 1e-5, 100, 4.0),
    ScheduleStep(0.998, 1e-3, 1e-6, 100, 4.0, evaluated=True),
    ScheduleStep(0.998, 1e-3, 1e-6, 150, 8.0),
    ScheduleStep(0.998, 1e-3, 1e-6, 150, 8.0, evaluated=True),
    ScheduleStep(1.3, 1e-3, 1e-3, 60, 8.0),
    ScheduleStep(0.998, 1e-3, 1e-6, 125, 8.0),
    ScheduleStep(0.998, 1e-3, 1e-6, 125, 8.0, evaluated=True),
    ScheduleStep(0.998, 1e-3, 1e-6, 150, 20.0, evaluated=True),
)
"""Relaxed limits, then the limits; slightly relaxed once more; sharper in the end."""

SETTLING = tuple(
    ScheduleStep(0.998, 1e-4, 1e-6, n, 20.0, evaluated=True, penalty=100.0) for n in (100, 50, 50)
)
"""Further steps where there are constraints: their peaks move, and exceeding them is expensive."""

GENERATION = ScheduleStep(0.998, 1e-3, 1e-6, 150, 20.0, evaluated=True, penalty=100.0)
"""Improvement of children."""
LAST = ScheduleStep(0.998, 1e-4, 1e-6, 300, 20.0, evaluated=True, penalty=100.0)
"""Last improvement, on the fine grid."""


class Search:
    """A search that can be stopped after each step, saved and resumed.

    Args:
        problem: Problem to be solved.
        key: Key of the random numbers.
        starts: Number of random motions to start from.
        generations: Number of generations.
        polished: Number of the best motions that are polished.

    Attributes:
        done: Number of steps done.
        first: Values of the random motions.
        best: Best motions so far.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        key: PRNGKeyArray,
        starts: int,
        generations: int,
        polished: int,
    ):
        self._problem, self._key = problem, key
        self._schedule = SCHEDULE + SETTLING if problem.constraints else SCHEDULE
        self._generations, self._polished = generations, min(polished, starts)
        x = problem.limits.random(key, starts)
        self.done, self.best = 0, evaluate(problem, x)
        self.first = self.best.value
        self._order = self.best.promising()
        self._state = _begin(problem, SEARCHED, x)

    @property
    def steps(self) -> int:
        """Number of steps: of the starts, of their descendants, the last one, and polishing."""
        return self._searching + self._polished

    @property
    def searching(self) -> bool:
        """Whether the next step is one of the search from many starts, not polishing."""
        return self.done < self._searching

    @property
    def fraction(self) -> float:
        """Completed fraction of the work, from 0 to 1."""
        polished = max(self.done - self._searching, 0)
        total = self._searching + POLISHING * self._polished
        return (self.done - polished + POLISHING * polished) / total

    @property
    def _searching(self) -> int:
        return len(self._schedule) + self._generations + 1

    def advance(self) -> None:
        """Do the next step."""
        number, generation = self.done, self.done - len(self._schedule)
        if generation < 0:
            self._improve_starts(self._schedule[number])
        elif generation < self._generations:
            key = jax.random.fold_in(self._key, generation)
            children = _improve(self._problem, SEARCHED, self._children(key), GENERATION)
            self.best = self.best.survivors(evaluate_within_limits(self._problem, children.y))
        elif generation == self._generations:
            start = _begin(self._problem, FINE, self.best.x)
            found = _improve(self._problem, FINE, start, LAST)
            self.best = self.best.improved(evaluate_within_limits(self._problem, found.y))
        else:
            place = int(self._order[number - self._searching])
            better = polish(self._problem, np.asarray(self.best.x[place]))
            self.best = self.best.improved_at(place, better)
        self.done = number + 1
        if self.done <= self._searching:
            self._order = self.best.promising()

    def finish(self) -> None:
        """Make motions smaller where no other keeps all constraints."""
        if not (np.asarray(self.best.excess) <= 0.0).any():
            for place, x in enumerate(np.asarray(self.best.x)):
                self.best = self.best.improved_at(place, shrink_to_constraints(self._problem, x))

    def save(self, path: str | Path) -> None:
        """Write the state of the search.

        Args:
            path: Path of the file.
        """
        buffer = io.BytesIO()
        eqx.tree_serialise_leaves(buffer, (self._digest(), self._content()))
        write_bytes(path, buffer.getvalue())

    def resume(self, path: str | Path) -> None:
        """Go on from a state that was saved for the same problem and settings.

        Args:
            path: Path of the file.

        Raises:
            InputError: If the file is no state, or belongs to another search.
        """
        digest = self._digest()
        try:
            with Path(path).open("rb") as file:
                if (eqx.tree_deserialise_leaves(file, digest) != digest).any():
                    raise InputError(
                        f"`{path}` was saved by a design with other settings: use those again, or "
                        "remove the file to start anew."
                    )
                content = eqx.tree_deserialise_leaves(file, self._content())
        except (ValueError, EOFError, RuntimeError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"`{path}` is no saved state of a design: remove it.") from error
        self.done = int(content[0])
        self.first, self.best, self._order, self._state = content[1:]

    def _content(self) -> tuple:
        content = np.array(self.done), self.first, self.best, self._order
        return *jax.tree.map(np.asarray, content), self._state

    def _digest(self) -> np.ndarray:
        """Return a digest of everything that the result depends on."""
        p = self._problem
        settings = len(self.first), self._generations, self._polished, p.samples
        parts = p.base, p.limits, p.criterion, p.constraints, p.noise, p.prior, settings
        digest = hashlib.sha256(eqx.tree_pformat(parts, width=10**6).encode())
        for leaf in jax.tree.leaves((parts, jax.random.key_data(self._key))):
            digest.update(np.asarray(leaf).tobytes() if eqx.is_array_like(leaf) else b"")
        return np.frombuffer(digest.digest(), np.uint8)

    def _improve_starts(self, step: ScheduleStep) -> None:
        if self.done == len(SCHEDULE):
            self._restart(np.asarray(self.best.excess) > 0)
        self._state = _improve(self._problem, SEARCHED, self._state, step)
        if step.evaluated:
            found = evaluate_within_limits(self._problem, self._state.y)
            self.best = self.best.improved(found)

    def _restart(self, broken: Bool[np.ndarray, " starts"]) -> None:
        """Start again where constraints are broken, from small motions that keep them best."""
        if not broken.any():
            return
        limits = self._problem.limits
        sizes = (0.8, 0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)
        many = jnp.concatenate(
            [limits.random(jax.random.key(k), 16, size) for k, size in enumerate(sizes)]
        )
        best = jnp.argsort(jnp.maximum(_watched_excess(self._problem, many), 0.0))
        chosen = many[best[np.arange(len(broken)) % len(many)]]
        self._state = jax.tree.map(
            lambda a, b: jnp.where(broken.reshape(-1, *(1,) * (a.ndim - 1)), a, b),
            _begin(self._problem, SEARCHED, chosen),
            self._state,
        )

    def _children(self, key: PRNGKeyArray) -> State:
        children = crossover(self._problem, jnp.asarray(self.best.x), key)
        return _begin(self._problem, SEARCHED, children)


def _begin(problem: ExcitationProblem, points: int, x: AnyArray) -> State:
    return InteriorPoint(problem.limits.grid(points)).init(x, problem.conditions)


def _improve(problem: ExcitationProblem, points: int, state: State, step: ScheduleStep) -> State:
    """Run one step of the schedule; with constraints in parts, whose peaks are found anew."""
    part = 25 if problem.constraints else step.iterations
    for start in range(0, step.iterations, part):
        barrier = max(step.least, step.barrier * 0.9**start)
        stage = Stage(step.bound, barrier, step.least, step.penalty)
        numbers = jax.tree.map(lambda x: jnp.asarray(x, float), (stage, step.sharpness))
        iterations = jnp.asarray(min(part, step.iterations - start))
        instants = _watched_instants(problem, state.y)
        state = _run(problem, points, state, *numbers, iterations, instants)
    return jax.block_until_ready(state)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _run(
    problem: ExcitationProblem, points: int, state: State, stage, sharpness, iterations, instants
) -> State:
    solver = InteriorPoint(problem.limits.grid(points))

    def objective(x: Array) -> Any:
        return problem.evaluate(x, sharpness, instants)

    return solver.run(objective, state, stage, iterations)


@functools.partial(jax.jit, static_argnums=0)
def _watched_instants(problem: ExcitationProblem, x: Array) -> Array:
    return problem.watched_instants(x)


@functools.partial(jax.jit, static_argnums=0)
def _watched_excess(problem: ExcitationProblem, x: Array) -> Array:
    return problem.watched_excess(x)


@functools.partial(jax.jit, static_argnums=(0, 3))
def crossover(
    problem: ExcitationProblem, x: Float[Array, "starts scaled"], key: PRNGKeyArray, tries: int = 16
) -> Float[Array, "starts scaled"]:
    """Return one child of each motion with another one: the most promising of several.

    Some joints of a child move as in one parent, the others as in another, begun at another time.
    Limits hold for each joint alone, so that a child keeps the limits that its parents keep. The
    information of a motion does not depend on when its period begins or which way it runs, so that
    two good motions may fit together at one shift only: many children are tried.

    Args:
        problem: Criterion, limits and constraints.
        x: Scaled coefficients of the parents.
        key: Key of the random numbers.
        tries: Number of children of each motion of which the most promising one is kept.
    """
    retimings = jnp.asarray(problem.basis.retimings())

    def penalised(children: Array) -> Array:
        value = problem.values(children, None, problem.search_samples)
        if problem.constraints:
            value = value + PENALTY * jnp.maximum(problem.watched_excess(children), 0.0)
        return jnp.where(jnp.isnan(value), jnp.inf, value)

    def another(best: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple, None]:
        children = _draw_children(problem, retimings, x, key)
        value = penalised(children)
        better = value < best[1]
        return (jnp.where(better[:, None], children, best[0]), jnp.minimum(value, best[1])), None

    none = x, jnp.full(len(x), jnp.inf)
    return jax.lax.scan(another, none, jax.random.split(key, tries))[0][0]


def _draw_children(
    problem: ExcitationProblem, retimings: Array, x: Array, key: PRNGKeyArray
) -> Array:
    mate_key, kind_key, time_key, share_key, joint_key, other_key = jax.random.split(key, 6)
    starts, (joints, _) = len(x), problem.limits.shape
    ahead = jax.random.randint(mate_key, (starts,), 1, max(starts, 2))
    # Half of the second parents are not retimed: motions of one descent fit together already.
    which = jax.random.randint(time_key, (starts,), 0, len(retimings))
    T = retimings[jnp.where(jax.random.uniform(kind_key, (starts,), float) < 0.5, 0, which)]
    mates = problem.limits.coefficients(x[(jnp.arange(starts) + ahead) % starts])
    mates = problem.limits.scaled(jnp.einsum("bvw,bjw->bjv", T, mates))
    # A child has this expected fraction of joints from its second parent, and at least one.
    share = jax.random.uniform(share_key, (starts, 1), float, 0.1, 0.5)
    taken = jax.random.uniform(other_key, (starts, joints), float) < share
    surely = jax.random.randint(joint_key, (starts, 1), 0, joints)
    taken = (taken | (surely == np.arange(joints)[None]))[:, :, None]
    first, second = (z.reshape(starts, joints, -1) for z in (x, mates))
    return jnp.where(taken, second, first).reshape(x.shape)
