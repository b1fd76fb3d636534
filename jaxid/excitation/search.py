"""The search from many starts at once: relaxed limits first, then tight ones; the best is kept.

Everything a search knows between two legs is in its state, so it can be stopped, saved and resumed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.excitation.interior_point import COOLING, InteriorPoint, Stage, State
from jaxid.excitation.judge import Best, Judge
from jaxid.excitation.limits import CERTIFIED, JointLimits, random_motion
from jaxid.excitation.problem import Context, Problem
from jaxid.types import AnyArray, Array, Bool, Float, PRNGKeyArray

GRID = 64
"""Rows of each order by which limits are kept during the search."""
CALM = (0.8, 0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)
"""Sizes of further random motions, for starts that find no way to keep the constraints."""
KICK = 0.15
"""Size of a disturbance of all joints, by the mean size of a motion's numbers."""
STRETCH = 25
"""Iterations after which the peaks of constraints are looked for anew."""
TIGHT = 0.998
"""Share of the limits within which legs end: what is left is for rounding."""


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

SETTLING = tuple(Leg(Stage(TIGHT, 1e-4, 1e-6, n, 100.0), 20.0, True) for n in (100, 50, 50))
"""What follows where there are constraints: their peaks move, and what cannot be kept is dear."""


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

    Attributes:
        problem: The same.
        judge: Of its motions.
    """

    def __init__(self, problem: Problem, starts: int):
        self.problem, self._starts = problem, starts
        self._legs = LEGS + SETTLING if problem.constraints else LEGS
        limits = problem.limits
        self._solver = InteriorPoint(problem.evaluation(), limits.grid(GRID), limits.still)
        self.judge = Judge(problem)
        self._worst = jax.jit(problem.worst)

    def begin(self, key: PRNGKeyArray) -> Searched:
        """Random motions that fill their limits."""
        y = random_starts(self.problem.limits, key, self._starts)
        best = self.judge(y)
        state = self._solver.start(y, self.problem.conditions)
        return Searched(state, 0, best.value, best)

    def advance(self, searched: Searched) -> Searched:
        """The next leg."""
        leg = self._legs[searched.leg]
        state = searched.state
        broken = np.asarray(searched.best.excess) > 0
        if searched.leg == len(LEGS) and broken.any():
            state = self._calmed(state, broken)
        for stage in self._stretches(leg.stage):
            context = Context(jnp.asarray(leg.sharpness), self.problem.peaks(state.y))
            state = self._solver.run(state, stage, context)
        best = searched.best
        if leg.judged:
            best = best.improved(self.judge.within(state.y))
        return Searched(state, searched.leg + 1, searched.first, best)

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
        """Number of legs."""
        return len(self._legs)


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


def kicked(
    limits: JointLimits, y: Float[AnyArray, " scaled"], key: PRNGKeyArray, number: int
) -> Float[np.ndarray, " scaled"]:
    """A motion near a good one, from which another optimum may be found.

    By turns all joints are disturbed a little, and one joint much.

    Args:
        limits: Of the joints.
        y: The good motion.
        key: Of the design.
        number: Of the disturbance.
    """
    of_shape, of_joint = jax.random.split(jax.random.fold_in(key, number))
    motion = np.reshape(np.array(y), limits.shape)
    noise = np.asarray(jax.random.normal(of_shape, limits.shape, float))
    if number % 2:
        joint = int(jax.random.randint(of_joint, (), 0, limits.shape[0]))
        motion[joint] += np.abs(motion[joint]).mean() * noise[joint]
    else:
        motion += KICK * np.abs(motion).mean() * noise
    return motion.ravel()


def crossed(
    limits: JointLimits,
    y: Float[AnyArray, " scaled"],
    other: Float[AnyArray, " scaled"],
    key: PRNGKeyArray,
    number: int,
) -> Float[np.ndarray, " scaled"]:
    """A good motion with some joints, fewer than half on average, that move as in another one.

    Limits of joints are kept by each joint alone, so that the child of two motions that keep them
    keeps them too.

    Args:
        limits: Of the joints.
        y: The good motion.
        other: The other one.
        key: Of the design.
        number: Of the crossing.
    """
    of_joint, of_share, of_others = jax.random.split(jax.random.fold_in(key, number), 3)
    joints = limits.shape[0]
    share = jax.random.uniform(of_share, (), float, 0.1, 0.5)
    taken = np.array(jax.random.uniform(of_others, (joints,), float) < share)
    taken[int(jax.random.randint(of_joint, (), 0, joints))] = True
    own, foreign = (np.reshape(np.asarray(z), limits.shape) for z in (y, other))
    return np.where(taken[:, None], foreign, own).ravel()
