"""What may not touch what: capsules of a robot, obstacles of its world, and the pairs to watch."""

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Hashable, double_precision
from jaxid.errors import InputError
from jaxid.robot.capsules import GROUND, AbstractObstacle, Capsule, segment_distance
from jaxid.robot.kinematics import placements
from jaxid.robot.robot import Robot

POSES = 200
"""Random poses on which pairs that always overlap are found."""
FREE_RANGE = np.pi
"""Half of the range in which a joint without limits is tried [rad or m]."""


class CollisionModel(Hashable):
    """Shapes and the pairs of them that must stay apart.

    Attributes:
        capsules: On bodies or on the ground.
        obstacles: In the world.
        pairs: Indices of capsules to watch against each other.
        contacts: Indices of a capsule and of the obstacle to watch it against.
        notes: What was left out, in sentences.
    """

    capsules: tuple[Capsule, ...]
    obstacles: tuple[AbstractObstacle, ...]
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    contacts: tuple[tuple[int, int], ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        robot: Robot,
        capsules: Sequence[Capsule],
        obstacles: Sequence[AbstractObstacle] = (),
        pairs: Sequence[tuple[str, str]] | None = None,
    ) -> "CollisionModel":
        """Builds a collision model and checks it.

        Args:
            robot: Whose bodies carry the capsules.
            capsules: With names of their own.
            obstacles: With names of their own.
            pairs: Names of shapes to watch. If None: all but those of one body, of neighbouring
                bodies, of the ground with itself, and those that overlap in every one of many
                random poses, which the notes list.

        Raises:
            InputError: If a name is missing or comes twice, a body does not exist, two obstacles
                are paired, or there is no pair.
        """
        names = [shape.name for shape in (*capsules, *obstacles)]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"two shapes are named `{name}`: rename one.")
        for c in capsules:
            if not GROUND <= c.body < robot.joints:
                raise InputError(
                    f"capsule `{c.name}` must be on a body from 0 to {robot.joints - 1} or on the "
                    f"ground (-1), but is on {c.body}."
                )
        count = len(capsules)
        if pairs is None:
            found = [
                (i, k)
                for i, k in itertools.combinations(range(len(names)), 2)
                if i < count and _can_meet(robot, capsules, i, k)
            ]
        else:
            found = [_numbered(names, count, one) for one in pairs]
        everything = cls._sorted(capsules, obstacles, found)
        if pairs is None:
            always = everything._always(robot)
            notes = tuple(
                f"{name} overlap in every pose that was tried, so they are not watched."
                for name, overlaps in zip(everything.pair_names, always, strict=True)
                if overlaps
            )
            ordered = [*everything.pairs, *((i, count + k) for i, k in everything.contacts)]
            kept = [pair for pair, overlaps in zip(ordered, always, strict=True) if not overlaps]
            everything = cls._sorted(capsules, obstacles, kept, notes)
        if not everything.pairs and not everything.contacts:
            raise InputError("a collision model needs at least one pair of shapes that can meet.")
        return everything

    @classmethod
    def _sorted(
        cls,
        capsules: Sequence[Capsule],
        obstacles: Sequence[AbstractObstacle],
        pairs: Sequence[tuple[int, int]],
        notes: tuple[str, ...] = (),
    ) -> "CollisionModel":
        count = len(capsules)
        return cls(
            tuple(capsules),
            tuple(obstacles),
            tuple((i, k) for i, k in pairs if k < count),
            tuple((i, k - count) for i, k in pairs if k >= count),
            notes,
        )

    @property
    def pair_names(self) -> tuple[str, ...]:
        """What each clearance is between: pairs of capsules first, then obstacles."""
        c, o = self.capsules, self.obstacles
        return (
            *(f"{c[i].name} and {c[k].name}" for i, k in self.pairs),
            *(f"{c[i].name} and {o[k].name}" for i, k in self.contacts),
        )

    def ends(self, robot: Robot, q: Float[AnyArray, " joints"]) -> Float[Array, "capsules 2 3"]:
        """Ends of all axes in the frame of the ground [m], for one pose.

        Args:
            robot: Whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
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
    ) -> Float[Array, "*batch pairs"]:
        """Distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            ends: Ends of all axes in the frame of the ground [m].
        """
        ends = jnp.asarray(ends)
        start, end = ends[..., 0, :], ends[..., 1, :]
        radii = jnp.stack([jnp.asarray(c.radius) for c in self.capsules])
        found = []
        if self.pairs:
            i, k = (np.array(x) for x in zip(*self.pairs, strict=True))
            gap = segment_distance(
                start[..., i, :], end[..., i, :], start[..., k, :], end[..., k, :]
            )
            found.append(gap - jnp.broadcast_to(radii[i] + radii[k], gap.shape))
        for i, k in self.contacts:
            gap = self.obstacles[k].distance(start[..., i, :], end[..., i, :])
            found.append((gap - radii[i])[..., None])
        return jnp.concatenate(found, axis=-1)

    def clearance(
        self, robot: Robot, q: Float[AnyArray, "*batch joints"]
    ) -> Float[Array, "*batch pairs"]:
        """Distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            robot: Whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        gaps = _clearances(self, robot, jnp.reshape(jnp.asarray(q), (-1, robot.joints)))
        return gaps.reshape(*q.shape[:-1], gaps.shape[-1])

    def _always(self, robot: Robot) -> np.ndarray:
        """Which pairs overlap in every pose."""
        low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
        low = np.where(np.isfinite(low), low, -FREE_RANGE)
        high = np.where(np.isfinite(high), high, FREE_RANGE)
        random = np.random.default_rng(0)
        q = random.uniform(np.minimum(low, high), np.maximum(low, high), (POSES, robot.joints))
        if not self.pairs and not self.contacts:
            return np.zeros(0, bool)
        with double_precision():
            return np.asarray(self.clearance(robot, q)).max(axis=0) <= 0


@eqx.filter_jit
def _clearances(model: CollisionModel, robot: Robot, q: Float[Array, "samples joints"]) -> Array:
    return model.clearances(jax.vmap(lambda x: model.ends(robot, x))(q))


def _can_meet(robot: Robot, capsules: Sequence[Capsule], i: int, k: int) -> bool:
    """Whether two shapes belong to bodies that are not one or neighbours."""
    first = capsules[i].body
    second = capsules[k].body if k < len(capsules) else GROUND
    parents = [robot.parent[b] if b != GROUND else None for b in (first, second)]
    return first != second and parents[0] != second and parents[1] != first


def _numbered(names: list[str], capsules: int, pair: tuple[str, str]) -> tuple[int, int]:
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
