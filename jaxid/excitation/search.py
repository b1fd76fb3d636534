"""The search from many starts at once: relaxed limits first, then tight ones; then generations.

The children of the motions found are improved in the same way, and of parents and children the best
survive. In the end limits are kept on a finer grid, so that less of them is left unused, and the
best motions are polished one by one.
"""

import functools
import hashlib
import io
from contextlib import suppress
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, PRNGKeyArray
from jaxid.errors import InputError
from jaxid.io import write_bytes

from . import interior_point
from .coefficient_limits import scale_samples
from .interior_point import Stage, State
from .polish import polish
from .problem import (
    PENALTY,
    SEARCHED,
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
SETTLING = tuple(Stage(0.998, 1e-4, 1e-6, n, 20.0, 100.0) for n in (100, 50, 50))
"""Further stages where there are constraints: their peaks move, and exceeding them is expensive."""
EVALUATED = frozenset({5, 7, 10, 11, 12, 13, 14})
"""Stages of both whose results are compared with the best so far."""
GENERATION = Stage(0.998, 1e-3, 1e-6, 150, 20.0, 100.0)
"""Improvement of children."""
LAST = Stage(0.998, 1e-4, 1e-6, 300, 20.0, 100.0)
"""Last improvement, on the fine grid."""


class Search:
    """A search that can be stopped after each step, saved and resumed.

    Attributes:
        done: Number of steps done.
        steps: Number of steps: of the starts, of their descendants, the last one, and polishing.
        first: Values of the random motions.
        best: Best motions so far.
        history: Value of the criterion for the best motion, before the first step and after each.
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
        self._searching = len(self._schedule) + generations + 1
        self.steps = self._searching + self._polished
        x = problem.limits.random(key, starts)
        self.done, self.best = 0, evaluate(problem, x)
        self.first = self.best.value
        self.history = np.full(self.steps + 1, self.best.best_value)
        self._order = self.best.promising()
        self._state = _begin(problem, SEARCHED, x)

    @property
    def feasible(self) -> bool:
        """Whether the best motion so far keeps all constraints."""
        return bool((self.best.broken == 0).any())

    @property
    def searching(self) -> bool:
        """Whether the next step is one of the search from many starts, not polishing."""
        return self.done < self._searching

    def advance(self) -> None:
        """Do the next step."""
        problem, number, generation = self._problem, self.done, self.done - len(self._schedule)
        if generation < 0:
            if number == len(SCHEDULE) and self.best.broken.any():
                self._restart_broken()
            self._state = _improve(problem, SEARCHED, self._state, self._schedule[number])
            if number in EVALUATED:
                self.best = self.best.improved(evaluate_within_limits(problem, self._state.y))
        elif generation < self._generations:
            key = jax.random.fold_in(self._key, generation)
            children = crossover(problem, jnp.asarray(self.best.x), key)
            found = _improve(problem, SEARCHED, _begin(problem, SEARCHED, children), GENERATION)
            self.best = self.best.survivors(evaluate_within_limits(problem, found.y))
        elif generation == self._generations:
            found = _improve(problem, FINE, _begin(problem, FINE, self.best.x), LAST)
            self.best = self.best.improved(evaluate_within_limits(problem, found.y))
        else:
            place = int(self._order[number - self._searching])
            better = polish(problem, np.asarray(self.best.x[place]))
            self.best = self.best.improved(better, np.arange(len(self.first)) == place)
        self.done = number + 1
        self.history[self.done :] = self.best.best_value
        if self.done <= self._searching:
            self._order = self.best.promising()

    def finish(self) -> None:
        """Make motions smaller where no other keeps all constraints."""
        if self.best.broken.all():
            for place, x in enumerate(np.asarray(self.best.x)):
                small = shrink_to_constraints(self._problem, x)
                self.best = self.best.improved(small, np.arange(len(self.first)) == place)

    def save(self, path: str | Path) -> None:
        """Write the state of the search."""
        buffer = io.BytesIO()
        eqx.tree_serialise_leaves(buffer, (self._digest(), self._content()))
        write_bytes(path, buffer.getvalue())

    def resume(self, path: str | Path) -> None:
        """Go on from a state that was saved for the same problem and settings."""
        digest, content = self._digest(), self._content()
        saved = np.zeros_like(digest)
        with Path(path).open("rb") as file, suppress(ValueError, EOFError, RuntimeError, TypeError):
            saved, content = eqx.tree_deserialise_leaves(file, (digest, content))
        if (saved != digest).any():
            raise InputError(
                f"`{path}` is damaged, or of a design with other settings: remove it to begin anew."
            )
        self.done = int(content[0])
        self.first, self.best, self.history, self._order, self._state = content[1:]

    def _content(self) -> tuple:
        done, known = np.array(self.done), (self.first, self.best, self.history)
        return done, *known, self._order, self._state

    def _digest(self) -> np.ndarray:
        """Return a digest of everything that the result depends on."""
        p = self._problem
        settings = len(self.first), self._generations, self._polished, p.samples
        parts = p.base, p.limits, p.criterion, p.constraints, p.noise, p.prior, settings
        digest = hashlib.sha256(eqx.tree_pformat(parts, width=10**6).encode())
        for leaf in jax.tree.leaves((parts, jax.random.key_data(self._key))):
            digest.update(np.asarray(leaf).tobytes() if eqx.is_array_like(leaf) else b"")
        return np.frombuffer(digest.digest(), np.uint8)

    def _restart_broken(self) -> None:
        """Start again where constraints are broken, from small motions that keep them best."""
        broken = self.best.broken > 0
        sizes = (0.8, 0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)
        random = self._problem.limits.random
        many = jnp.concatenate([random(jax.random.key(k), 16, s) for k, s in enumerate(sizes)])
        best = jnp.argsort(jnp.maximum(_watched_excess(self._problem, many), 0.0))
        chosen = many[best[np.arange(len(broken)) % len(many)]]
        self._state = jax.tree.map(
            lambda a, b: jnp.where(broken.reshape(-1, *(1,) * (a.ndim - 1)), a, b),
            _begin(self._problem, SEARCHED, chosen),
            self._state,
        )


def _begin(problem: ExcitationProblem, points: int, x: AnyArray) -> State:
    return interior_point.begin(problem.limits.grid(points), x, problem.conditions)


def _improve(problem: ExcitationProblem, points: int, state: State, stage: Stage) -> State:
    """Run one stage; with constraints in parts, whose peaks are found anew."""
    whole = int(stage.iterations)
    part = 25 if problem.constraints else whole
    for start in range(0, whole, part):
        barrier = max(stage.least, stage.barrier * interior_point.COOLING**start)
        now = stage._replace(barrier=barrier, iterations=min(part, whole - start))
        numbers = Stage(*(jnp.asarray(x, float) for x in now))
        state = _run(problem, points, state, numbers, _watched_instants(problem, state.y))
    return jax.block_until_ready(state)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _run(
    problem: ExcitationProblem, points: int, state: State, stage: Stage, instants: Array
) -> State:
    def objective(x: Array) -> Any:
        return problem.evaluate(x, stage.sharpness, instants)

    return interior_point.run(problem.limits.grid(points), objective, state, stage)


_watched_instants = jax.jit(ExcitationProblem.watched_instants, static_argnums=0)
_watched_excess = jax.jit(ExcitationProblem.watched_excess, static_argnums=0)


@functools.partial(jax.jit, static_argnums=(0, 3))
def crossover(
    problem: ExcitationProblem,
    x: Float[Array, "starts scaled"],
    key: PRNGKeyArray,
    tries: int = 16,
) -> Float[Array, "starts scaled"]:
    """Return one child of each motion with another one: the most promising of several.

    Some joints of a child move as in one parent, the others as in another, begun at another time.
    Limits hold for each joint alone, so that a child keeps the limits that its parents keep. The
    information of a motion does not depend on when its period begins or which way it runs, so that
    two good motions may fit together at one shift only: many children are tried.
    """
    retimings = jnp.asarray(problem.basis.retimings())

    def another(best: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple, None]:
        children = _draw_children(problem, retimings, x, key)
        value = problem.values(children, None, scale_samples(SEARCHED, problem.basis))
        if problem.constraints:
            value = value + PENALTY * jnp.maximum(problem.watched_excess(children), 0.0)
        value = jnp.where(jnp.isnan(value), jnp.inf, value)
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
    second = jnp.einsum("bvw,bjw->bjv", T, mates) / np.asarray(problem.limits.scale)[None]
    # A child has this expected fraction of joints from its second parent, and at least one.
    share = jax.random.uniform(share_key, (starts, 1), float, 0.1, 0.5)
    taken = jax.random.uniform(other_key, (starts, joints), float) < share
    surely = jax.random.randint(joint_key, (starts, 1), 0, joints)
    taken = (taken | (surely == np.arange(joints)[None]))[:, :, None]
    return jnp.where(taken, second, x.reshape(second.shape)).reshape(x.shape)
