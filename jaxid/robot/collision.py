"""Collision models: capsules on a robot's bodies, obstacles of its world, and their clearances."""

import functools
import itertools
import re
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Hashable, Int, double_precision
from jaxid.errors import InputError

from .capsule_fit import fit_capsules as fit_capsules
from .forward_and_inverse_kinematics import placements
from .robot import Robot
from .shapes import (
    GROUND as GROUND,
    ROUNDING,
    Box as Box,
    Capsule as Capsule,
    HalfSpace as HalfSpace,
    closest_places,
    segment_distance,
)

_POSES = 400
"""Number of random poses in which pairs are tried."""


class CollisionModel(Hashable):
    """Shapes, and the pairs of them that must stay apart.

    Clearances are those of pairs of bodies: the least of all shapes that one and the
    other carry. Capsules on the ground count by themselves, if their names differ in
    more than a number.

    Args:
        robot: Robot whose bodies carry the capsules.
        capsules: Capsules with different names.
        obstacles: Obstacles with different names.
        pairs: Names of shapes to watch. If None: all pairs but those of one body, of
            neighbouring bodies, of the ground with itself, and those that overlap in
            each of 400 random poses, which the notes list.

    Attributes:
        pairs: Indices of shapes to watch against each other: of a capsule and of
            another one, or of an obstacle, which come after all capsules.
        groups: Places in `pairs` that one clearance is the least of.
        room: Largest clearance of each group in random poses [m]; infinite for given
            pairs.
        notes: Pairs that were left out, in sentences.

    Raises:
        InputError: If a name is missing or comes twice, a body does not exist, two
            obstacles are paired, or there is no pair.
    """

    capsules: tuple[Capsule, ...]
    obstacles: tuple[HalfSpace | Box, ...]
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    room: tuple[float, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        capsules: Sequence[Capsule],
        obstacles: Sequence[HalfSpace | Box] = (),
        pairs: Sequence[Sequence[str]] | None = None,
    ):
        self.capsules = tuple(capsules)
        self.obstacles = tuple(obstacles)
        names = [shape.name for shape in (*capsules, *obstacles)]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"two shapes are named `{name}`: rename one.")
        for c in capsules:
            if not GROUND <= c.body < robot.joints:
                bodies = f"from 0 to {robot.joints - 1}, or -1 for the ground"
                raise InputError(
                    f"`body` of capsule `{c.name}` must be {bodies}, but is {c.body}."
                )
        self.notes = ()
        if pairs is not None:
            self._watch(pairs, names)
            return
        every = CollisionModel(
            robot, capsules, obstacles, _meeting_pairs(robot, capsules, names)
        )
        best = every._largest_gaps(robot).tolist()
        room = dict(zip(every.pairs, best, strict=True))
        left = [pair for pair, gap in room.items() if gap <= 0]
        if left:
            said = ", ".join(f"{names[i]} and {names[k]}" for i, k in left)
            self.notes = (
                f"not watched, for they overlap in every pose that was tried: {said}.",
            )
        self._watch(
            [(names[i], names[k]) for i, k in every.pairs if (i, k) not in left], names
        )
        self.room = tuple(
            min(room[self.pairs[k]] for k in group) for group in self.groups
        )

    def _watch(self, pairs: Sequence[Sequence[str]], names: list[str]) -> None:
        """Enter pairs by their names, and group them."""
        found = [_indices(names, len(self.capsules), pair) for pair in pairs]
        if not found:
            raise InputError(
                "a collision model needs at least one pair of shapes that can meet."
            )
        # Pairs of capsules first, then obstacle by obstacle.
        self.pairs = tuple(
            sorted(found, key=lambda p: max(p[1], len(self.capsules) - 1))
        )
        groups: dict[tuple, list[int]] = {}
        for place, pair in enumerate(self.pairs):
            groups.setdefault(tuple(self._owner(shape) for shape in pair), []).append(
                place
            )
        self.groups = tuple(map(tuple, groups.values()))
        self.room = (np.inf,) * len(self.groups)

    def _owner(self, shape: int) -> int | str:
        """Return what a shape's clearances count for: a body, or a thing on the ground."""
        if shape >= len(self.capsules):
            return self.obstacles[shape - len(self.capsules)].name
        c = self.capsules[shape]
        return _stem(c.name) if c.body == GROUND else c.body

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of each clearance's shapes; of several, those of the bodies' first capsules."""
        shapes, first = (*self.capsules, *self.obstacles), {}
        for shape in range(len(self.capsules)):
            first.setdefault(self._owner(shape), _stem(shapes[shape].name))

        def name(shape: int, alone: bool) -> str:
            own = shapes[shape].name
            return own if alone else first.get(self._owner(shape), own)

        pairs = [(self.pairs[group[0]], len(group) == 1) for group in self.groups]
        return tuple(
            f"{name(i, alone)} and {name(k, alone)}" for (i, k), alone in pairs
        )

    def ends(
        self, robot: Robot, q: Float[AnyArray, " joints"]
    ) -> Float[Array, "capsules 2 3"]:
        """Return the ends of all capsules' axes in the frame of the ground [m], for one pose."""
        rotations, origins = placements(robot, q)
        rows = []
        for c in self.capsules:
            points = jnp.stack([jnp.asarray(c.start), jnp.asarray(c.end)])
            if c.body != GROUND:
                points = points @ rotations[c.body].T + jnp.stack([origins[c.body]] * 2)
            rows.append(points)
        return jnp.stack(rows)

    def clearances(
        self, ends: Float[AnyArray, "*batch capsules 2 3"]
    ) -> Float[AnyArray, "*batch groups"]:
        """Return the clearances [m] for given ends of all axes on the ground [m]."""
        if isinstance(ends, np.ndarray):
            least = self._nearest_gaps(ends.reshape(-1, *ends.shape[-3:]))
            return least.reshape(*ends.shape[:-3], len(self.groups))
        start, end = ends[..., 0, :], ends[..., 1, :]
        radii = jnp.stack([jnp.asarray(c.radius) for c in self.capsules])
        i, k = self._indices.T
        inner = k < len(self.capsules)
        gaps = []
        if inner.any():
            sides = (x[..., j[inner], :] for j in (i, k) for x in (start, end))
            gap, sizes = segment_distance(*sides), radii[i[inner]] + radii[k[inner]]
            gaps.append(gap - jnp.broadcast_to(sizes, gap.shape))
        for number, obstacle in enumerate(self.obstacles, len(self.capsules)):
            if (own := k == number).any():
                gap = obstacle.distance(start[..., i[own], :], end[..., i[own], :])
                gaps.append(gap - jnp.broadcast_to(radii[i[own]], gap.shape))
        gathered = jnp.concatenate(gaps, axis=-1)[..., self._filled]
        # With the derivative of one of the pairs.
        least = jnp.argmin(jax.lax.stop_gradient(gathered), axis=-1, keepdims=True)
        return jnp.take_along_axis(gathered, least, axis=-1)[..., 0]

    def slopes(
        self,
        ends: Float[np.ndarray, "samples capsules 2 3"],
        chosen: Int[np.ndarray, " samples"],
    ) -> tuple[
        Float[np.ndarray, " samples"], Float[np.ndarray, "samples capsules 2 3"]
    ]:
        """Return one clearance of each sample [m], and its derivative by the ends, in NumPy."""
        filled, samples = self._filled[chosen], np.arange(len(ends))
        gaps = self._gaps(ends, np.repeat(samples, filled.shape[1]), filled.ravel())
        gaps = gaps.reshape(filled.shape)
        least = gaps.argmin(axis=1)
        pairs, found = self._indices[filled[samples, least]], np.zeros(ends.shape)
        for k in np.unique(pairs[:, 1]):
            at = samples[pairs[:, 1] == k]
            i = pairs[at, 0]
            if k >= len(self.capsules):
                found[at, i] = self.obstacles[k - len(self.capsules)].slopes(
                    ends[at, i]
                )
                continue
            first, second = ends[at, i], ends[at, k]
            a, b = closest_places(first[:, 0], first[:, 1], second[:, 0], second[:, 1])
            a, b = (np.stack([1.0 - x, x], axis=1) for x in (a, b))
            apart = (a * first).sum(axis=1) - (b * second).sum(axis=1)
            away = apart / np.sqrt((apart**2).sum(axis=1) + ROUNDING**2)[:, None]
            found[at, i], found[at, k] = a * away[:, None], -b * away[:, None]
        return gaps[samples, least], found

    def _nearest_gaps(
        self, ends: Float[np.ndarray, "samples capsules 2 3"]
    ) -> Float[np.ndarray, "samples groups"]:
        """Return the least gap of each group, without computing those that cannot be it."""
        i, k = self._indices.T
        inner = k < len(self.capsules)
        middle, half = ends.mean(axis=2), 0.5 * np.diff(ends, axis=2)[:, :, 0]
        reach = np.sqrt(np.einsum("tci,tci->tc", half, half))
        apart = middle[:, i[inner]] - middle[:, k[inner]]
        most = np.full((len(ends), len(i)), np.inf)
        most[:, inner] = (
            np.sqrt(np.einsum("tpi,tpi->tp", apart, apart)) - self._sizes[inner]
        )
        least = np.full(most.shape, -np.inf)
        least[:, inner] = most[:, inner] - reach[:, i[inner]] - reach[:, k[inner]]
        owner = np.zeros(len(i), int)
        for number, group in enumerate(self.groups):
            owner[list(group)] = number
        needed = least <= most[:, self._filled].min(axis=2)[:, owner]
        gaps = np.full(most.shape, np.inf)
        gaps[needed] = self._gaps(ends, *np.nonzero(needed))
        return gaps[:, self._filled].min(axis=2)

    def _gaps(
        self,
        ends: Float[np.ndarray, "samples capsules 2 3"],
        samples: Int[np.ndarray, " gaps"],
        pairs: Int[np.ndarray, " gaps"],
    ) -> Float[np.ndarray, " gaps"]:
        """Return the gaps of some pairs in some samples [m], in NumPy."""
        i, k = self._indices[pairs].T
        inner, gaps = k < len(self.capsules), np.empty(len(pairs))
        first, second = ends[samples[inner], i[inner]], ends[samples[inner], k[inner]]
        gaps[inner] = segment_distance(
            first[:, 0], first[:, 1], second[:, 0], second[:, 1]
        )
        for number in np.unique(k[~inner]):
            at = k == number
            own = ends[samples[at], i[at]]
            obstacle = self.obstacles[number - len(self.capsules)]
            gaps[at] = np.asarray(obstacle.distance(own[:, 0], own[:, 1]))
        return gaps - self._sizes[pairs]

    @functools.cached_property
    def _indices(self) -> Int[np.ndarray, "pairs 2"]:
        return np.array(self.pairs)

    @functools.cached_property
    def _sizes(self) -> Float[np.ndarray, " pairs"]:
        """Sums of the pairs' radii [m]."""
        radii = np.array([float(c.radius) for c in self.capsules])
        radii = np.concatenate([radii, np.zeros(len(self.obstacles))])
        return radii[self._indices].sum(axis=1)

    @functools.cached_property
    def _filled(self) -> Int[np.ndarray, "groups pairs"]:
        """Places of each group's pairs, the first one repeated."""
        most = max(map(len, self.groups))
        return np.array(
            [[*group, *group[:1] * (most - len(group))] for group in self.groups]
        )

    def _largest_gaps(self, robot: Robot) -> Float[np.ndarray, " pairs"]:
        """Return the largest gap of each pair in random poses."""
        low = np.asarray(robot.limits.position_min)
        high = np.asarray(robot.limits.position_max)
        low = np.where(np.isfinite(low), low, -np.pi)
        high = np.where(np.isfinite(high), high, np.pi)
        random = np.random.default_rng(0)
        q = random.uniform(
            np.minimum(low, high), np.maximum(low, high), (_POSES, robot.joints)
        )
        with double_precision():
            ends = jax.jit(jax.vmap(lambda x: self.ends(robot, x)))(q)
        shape = (_POSES, len(self.pairs))
        every = np.unravel_index(np.arange(np.prod(shape)), shape)
        return self._gaps(np.asarray(ends), *every).reshape(shape).max(axis=0)

    @eqx.filter_jit
    def clearance(
        self, robot: Robot, q: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch groups"]:
        """Return the distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            robot: Robot whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        q = jnp.asarray(q)
        poses = jnp.reshape(q, (-1, robot.joints))
        gaps = self.clearances(jax.vmap(lambda x: self.ends(robot, x))(poses))
        return gaps.reshape(*q.shape[:-1], gaps.shape[-1])


def _stem(name: str) -> str:
    """Return the name of a capsule's link, without the number of the capsule."""
    return re.sub(r" \d+$", "", name)


def _meeting_pairs(
    robot: Robot, capsules: Sequence[Capsule], names: list[str]
) -> list[tuple[str, str]]:
    """Return names of the shapes on bodies that are neither one nor neighbours."""
    bodies = [*(c.body for c in capsules), *[GROUND] * (len(names) - len(capsules))]
    parents = [robot.parent[b] if b != GROUND else None for b in bodies]
    return [
        (names[i], names[k])
        for i, k in itertools.combinations(range(len(names)), 2)
        if i < len(capsules) and bodies[k] != bodies[i]
        if k >= len(capsules) or (bodies[k] != parents[i] and parents[k] != bodies[i])
    ]


def _indices(names: list[str], capsules: int, pair: Sequence[str]) -> tuple[int, int]:
    for name in pair:
        if name not in names:
            raise InputError(
                f"`{name}` is none of the shapes {', '.join(f'`{n}`' for n in names)}."
            )
    i, k = sorted(names.index(name) for name in pair)
    if i >= capsules or i == k:
        raise InputError(
            f"`{pair[0]}` and `{pair[1]}` cannot meet: pair a capsule with another "
            "shape."
        )
    return i, k
