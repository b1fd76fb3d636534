"""Random motions that keep all limits, of which a search starts with the best.

A motion of a random shape about a pose at which the robot may stand still is made as
large as the constraints allow. Many are drawn and checked together: that takes less
time than the first steps of a search, and no design is worse than the best of them.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.motion import Motion
from jaxid.robot.loop_closing import reachable

from .coefficient_limits import FILLED_FRACTION, Grid, ScaledMotions
from .criterion_gradient import criterion_at_samples
from .feasible_candidates import Candidates
from .problem import MARGIN, SEARCH_SAMPLES, WATCHED_INSTANTS, ExcitationProblem
from .watched_constraints import watched_excess

Poses = Float[np.ndarray, "poses joints"]
"""Places of poses within the ranges of the joints, from 0 to 1."""
Sizes = Float[np.ndarray, "motions joints"]
"""Sizes of motions relative to the limits of the joints."""

DRAWS_PER_START = 2
"""Random motions that are drawn for each start; the best of them are taken."""
POSES = 1000
"""Random poses of one round."""
MAX_ROUNDS = 20
"""Rounds in which poses are looked for that keep all constraints."""
POSE_SPREAD = 0.05
"""Standard deviation of poses near good ones, relative to the joints' ranges."""
ROUNDING = 1e-9
"""Change of a pose that is no move [rad or m]."""
MIN_POSE_ROOM = 0.05
"""Relative distance from all constraints that a pose should have, to move about it."""
MIN_SIZE = 1e-3
"""Size of a motion that is almost at rest, relative to the limits of the joints."""
HALVINGS = 7
"""Bisections of the logarithm of a size; then it is found to 6 %."""
INSTANTS_OF_JOINTS = WATCHED_INSTANTS[::6]
"""Instants at which joints are tried alone, which needs not be exact."""


class Draws(NamedTuple):
    """Random shapes of motions, each about a pose."""

    grid: Grid  # limits of the joints
    shapes: ScaledMotions
    places: Poses

    def motions(self, sizes: Sizes) -> ScaledMotions:
        """Return the motions of these sizes."""
        return self.grid.fill(self.shapes, self.places, sizes)


def random_feasible_motions(
    problem: ExcitationProblem, random: np.random.Generator, count: int
) -> Candidates:
    """Return random motions as large as the constraints allow, the best first.

    Values and constraints are those at few samples and instants.

    Args:
        problem: Problem with constraints.
        random: Generator of poses and shapes.
        count: Number of motions.
    """
    number = DRAWS_PER_START * count
    places = _standing_poses(problem, random, number)
    shapes = random.standard_normal((number, problem.size))
    x = _enlarge(problem, Draws(problem.limits.grid(), shapes, places))
    values = criterion_at_samples(problem, x, None, SEARCH_SAMPLES)
    motions = Candidates(x, values, watched_excess(problem, x) + MARGIN)
    return motions.at(motions.order()[:count])


def _standing_poses(
    problem: ExcitationProblem, random: np.random.Generator, count: int
) -> Poses:
    """Return poses that keep the constraints, or come nearest to it, the best first.

    After the first round half of the poses are drawn near the best ones: the poses that
    keep all constraints may be one in many thousands.
    """
    joints, _ = problem.limits.shape
    places = np.zeros((0, joints))
    next_places = random.uniform(0.1, 0.9, (POSES, joints))
    for _ in range(MAX_ROUNDS):
        all_places = np.concatenate([places, next_places])
        excess = _excess_at_rest(problem, all_places)
        order = np.argsort(excess, kind="stable")[:count]
        places = all_places[order]
        if excess[order[-1]] <= -MIN_POSE_ROOM:
            break
        neighbours = places[random.integers(0, len(places), POSES // 2)]
        steps = POSE_SPREAD * random.standard_normal(neighbours.shape)
        near_places = np.clip(neighbours + steps, 0.05, 0.95)
        other_places = random.uniform(0.1, 0.9, (POSES // 2, joints))
        next_places = np.concatenate([near_places, other_places])
    return places


def _excess_at_rest(problem: ExcitationProblem, places: Poses):
    """Return the largest excess over constraints in each pose, at standstill."""
    limits = problem.limits.limits
    middle = 0.5 * (limits.position_min + limits.position_max)
    half_range = 0.5 * (limits.position_max - limits.position_min)
    # The places about which `Grid.fill` lets a motion of no size stand.
    reach = FILLED_FRACTION * problem.limits.grid().bound
    q = middle + reach * (2.0 * places - 1.0) * half_range
    standstill = Motion(q, np.zeros_like(q), np.zeros_like(q))
    excess = np.full(len(q), -np.inf)
    for constraint in problem.constraints:
        values = np.asarray(constraint(problem.robot, standstill))
        excess = np.maximum(excess, values.max(axis=1))
    # Behind a singular pose closed loops are on another branch.
    poses = np.asarray(q)
    moves = np.abs(reachable(problem.robot, poses) - poses)
    is_behind = moves.max(axis=1) > ROUNDING
    return np.where(is_behind, np.maximum(excess, 1.0), excess)


def _enlarge(problem: ExcitationProblem, draws: Draws) -> ScaledMotions:
    """Return the motions of draws, as large as the constraints allow.

    The joints of every other motion become smaller alike, from full size. Those of the
    others do so from the sizes that they reach alone.
    """
    sizes = np.ones(draws.places.shape)
    other_draws = Draws(draws.grid, draws.shapes[1::2], draws.places[1::2])
    sizes[1::2] = _sizes_of_joints_alone(problem, other_draws)
    return draws.motions(_largest_sizes(problem, draws, sizes, WATCHED_INSTANTS))


def _sizes_of_joints_alone(problem: ExcitationProblem, draws: Draws) -> Sizes:
    """Return how large each joint may move while the others almost stand still.

    So a joint that has no room does not stop the others.
    """
    sizes = np.ones(draws.places.shape)
    joints, _ = problem.limits.shape
    for joint in range(joints):
        target_sizes = np.full(draws.places.shape, MIN_SIZE)
        target_sizes[:, joint] = 1.0
        reached_sizes = _largest_sizes(problem, draws, target_sizes, INSTANTS_OF_JOINTS)
        sizes[:, joint] = reached_sizes[:, joint]
    return sizes


def _largest_sizes(
    problem: ExcitationProblem,
    draws: Draws,
    high_sizes: Sizes,
    instants: np.ndarray,
) -> Sizes:
    """Return the largest sizes that keep the constraints, by bisection.

    They lie between almost standing still and the sizes that are given.
    """
    low = np.zeros((len(high_sizes), 1))
    high = np.ones((len(high_sizes), 1))
    growth = high_sizes / MIN_SIZE
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        motions = draws.motions(MIN_SIZE * growth**middle)
        excess = watched_excess(problem, motions, instants) + MARGIN
        is_kept = excess[:, None] <= 0.0
        low = np.where(is_kept, middle, low)
        high = np.where(is_kept, high, middle)
    return MIN_SIZE * growth**low
