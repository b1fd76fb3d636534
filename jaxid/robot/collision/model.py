"""Collision model: capsules of a robot, obstacles of its world, and the pairs to watch."""

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Hashable, double_precision
from jaxid.errors import InputError
from jaxid.robot.collision.shapes import GROUND, AbstractObstacle, Capsule, segment_distance
from jaxid.robot.kinematics import placements
from jaxid.robot.robot import Robot

Pairs = tuple[tuple[int, int], ...]


class CollisionModel(Hashable):
    """Shapes, and the pairs of them that must stay apart.

    Args:
        robot: Robot whose bodies carry the capsules.
        capsules: Capsules with different names.
        obstacles: Obstacles with different names.
        pairs: Names of shapes to watch. If None: all pairs but those of one body, of neighbouring
            bodies, of the ground with itself, and those that overlap in each of 200 random poses,
            which the notes list.

    Attributes:
        pairs: Indices of capsules to watch against each other.
        contacts: Indices of a capsule and of the obstacle to watch it against.
        notes: Pairs that were left out, in sentences.

    Raises:
        InputError: If a name is missing or comes twice, a body does not exist, two obstacles are
            paired, or there is no pair.
    """

    capsules: tuple[Capsule, ...]
    obstacles: tuple[AbstractObstacle, ...]
    pairs: Pairs = eqx.field(static=True)
    contacts: Pairs = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        capsules: Sequence[Capsule],
        obstacles: Sequence[AbstractObstacle] = (),
        pairs: Sequence[tuple[str, str]] | None = None,
    ):
        self.capsules, self.obstacles = tuple(capsules), tuple(obstacles)
        names = [shape.name for shape in (*capsules, *obstacles)]
        _check_shapes(robot, names, capsules)
        count = len(capsules)
        if pairs is None:
            every = itertools.combinations(range(len(names)), 2)
            found = [(i, k) for i, k in every if i < count and _can_meet(robot, capsules, i, k)]
        else:
            found = [_indices(names, count, pair) for pair in pairs]
        overlapping = set()
        if pairs is None and found:
            overlapping = _always_overlapping(robot, self.capsules, self.obstacles, found)
        self.pairs = tuple(x for x in found if x[1] < count and x not in overlapping)
        self.contacts = tuple(
            (i, k - count) for i, k in found if k >= count and (i, k) not in overlapping
        )
        self.notes = tuple(
            f"{names[i]} and {names[k]} overlap in every pose that was tried, so they are not "
            "watched."
            for i, k in found
            if (i, k) in overlapping
        )
        if not self.pairs and not self.contacts:
            raise InputError("a collision model needs at least one pair of shapes that can meet.")

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the shapes of each clearance: pairs of capsules first, then obstacles."""
        c, o = self.capsules, self.obstacles
        return (
            *(f"{c[i].name} and {c[k].name}" for i, k in self.pairs),
            *(f"{c[i].name} and {o[k].name}" for i, k in self.contacts),
        )

    def ends(self, robot: Robot, q: Float[AnyArray, " joints"]) -> Float[Array, "capsules 2 3"]:
        """Return the ends of all capsules' axes in the frame of the ground [m], for one pose.

        Args:
            robot: Robot whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        return _ends(self.capsules, robot, q)

    def clearances(
        self, ends: Float[AnyArray, "*batch capsules 2 3"]
    ) -> Float[Array, "*batch pairs"]:
        """Return the distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            ends: Ends of all axes in the frame of the ground [m].
        """
        return _clearances(self.capsules, self.obstacles, self.pairs, self.contacts, ends)

    def clearance(
        self, robot: Robot, q: Float[AnyArray, "*batch joints"]
    ) -> Float[Array, "*batch pairs"]:
        """Return the distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            robot: Robot whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        q = jnp.asarray(q)
        shapes = self.capsules, self.obstacles, self.pairs, self.contacts
        gaps = _clearances_of_poses(*shapes, robot, jnp.reshape(q, (-1, robot.joints)))
        return gaps.reshape(*q.shape[:-1], gaps.shape[-1])


def _ends(capsules: tuple[Capsule, ...], robot: Robot, q: AnyArray) -> Array:
    rotations, origins = placements(robot, q)
    rows = []
    for c in capsules:
        points = jnp.stack([jnp.asarray(c.start), jnp.asarray(c.end)])
        if c.body != GROUND:
            points = points @ rotations[c.body].T + jnp.stack([origins[c.body]] * 2)
        rows.append(points)
    return jnp.stack(rows)


def _clearances(
    capsules: tuple[Capsule, ...],
    obstacles: tuple[AbstractObstacle, ...],
    pairs: Pairs,
    contacts: Pairs,
    ends: AnyArray,
) -> Array:
    ends = jnp.asarray(ends)
    start, end = ends[..., 0, :], ends[..., 1, :]
    radii = jnp.stack([jnp.asarray(c.radius) for c in capsules])
    found = []
    if pairs:
        i, k = (np.array(x) for x in zip(*pairs, strict=True))
        gap = segment_distance(start[..., i, :], end[..., i, :], start[..., k, :], end[..., k, :])
        found.append(gap - jnp.broadcast_to(radii[i] + radii[k], gap.shape))
    for i, k in contacts:
        gap = obstacles[k].distance(start[..., i, :], end[..., i, :])
        found.append((gap - radii[i])[..., None])
    return jnp.concatenate(found, axis=-1)


@eqx.filter_jit
def _clearances_of_poses(capsules, obstacles, pairs: Pairs, contacts: Pairs, robot, q) -> Array:
    ends = jax.vmap(lambda x: _ends(capsules, robot, x))(q)
    return _clearances(capsules, obstacles, pairs, contacts, ends)


def _always_overlapping(
    robot: Robot,
    capsules: tuple[Capsule, ...],
    obstacles: tuple[AbstractObstacle, ...],
    found: list[tuple[int, int]],
) -> set[tuple[int, int]]:
    """Return the pairs that overlap in each of 200 random poses."""
    count = len(capsules)
    pairs = tuple(x for x in found if x[1] < count)
    contacts = tuple((i, k - count) for i, k in found if k >= count)
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    low = np.where(np.isfinite(low), low, -np.pi)
    high = np.where(np.isfinite(high), high, np.pi)
    random = np.random.default_rng(0)
    q = random.uniform(np.minimum(low, high), np.maximum(low, high), (200, robot.joints))
    with double_precision():
        gaps = _clearances_of_poses(capsules, obstacles, pairs, contacts, robot, jnp.asarray(q))
    ordered = [*pairs, *((i, count + k) for i, k in contacts)]
    return {
        pair for pair, gap in zip(ordered, np.asarray(gaps).max(axis=0), strict=True) if gap <= 0
    }


def _can_meet(robot: Robot, capsules: Sequence[Capsule], i: int, k: int) -> bool:
    """Return whether two shapes belong to bodies that are neither one nor neighbours."""
    first = capsules[i].body
    second = capsules[k].body if k < len(capsules) else GROUND
    parents = [robot.parent[b] if b != GROUND else None for b in (first, second)]
    return first != second and parents[0] != second and parents[1] != first


def _check_shapes(robot: Robot, names: list[str], capsules: Sequence[Capsule]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two shapes are named `{name}`: rename one.")
    for c in capsules:
        if not GROUND <= c.body < robot.joints:
            raise InputError(
                f"`body` of capsule `{c.name}` must be from 0 to {robot.joints - 1}, or -1 for the "
                f"ground, but is {c.body}."
            )


def _indices(names: list[str], capsules: int, pair: tuple[str, str]) -> tuple[int, int]:
    for name in pair:
        if name not in names:
            raise InputError(
                f"`{name}` is none of the shapes {', '.join(f'`{n}`' for n in names)}."
            )
    i, k = sorted(names.index(name) for name in pair)
    if i >= capsules:
        raise InputError(f"`{pair[0]}` and `{pair[1]}` are both obstacles: neither can move.")
    if i == k:
        raise InputError(f"`{pair[0]}` cannot be paired with itself.")
    return i, k
