"""Clearances of capsules on a robot's bodies, and of obstacles of its world."""

import itertools
import re
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Float,
    Hashable,
    Indices,
    Joints,
    Matrix,
    Texts,
    double_precision,
)
from jaxid.errors import InputError

from .forward_kinematics import placements
from .limits_and_drives import complete_limits
from .loop_closing import reachable
from .robot import Robot
from .shapes import GROUND, Box, Capsule, HalfSpace, segment_distance

POSES = 400
"""Number of random poses in which pairs are tried."""


class CollisionModel(Hashable):
    """Shapes, and the pairs of them that must stay apart.

    A clearance is the smallest distance between the shapes of two bodies. Capsules on
    the ground count as bodies of their own, if their names differ in more than a
    number.

    Args:
        robot: Robot whose bodies carry the capsules.
        capsules: Capsules with different names.
        obstacles: Obstacles with different names.
        pairs: Names of shapes to watch. If None: all pairs but those of one body, of
            neighbouring bodies, which a joint or a loop joins, of the ground with
            itself, and those that overlap in each of 400 random poses, which the notes
            list.

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
    groups: tuple[Indices, ...] = eqx.field(static=True)
    room: tuple[float, ...] = eqx.field(static=True)
    notes: Texts = eqx.field(static=True)

    def __init__(
        self,
        robot: Robot,
        capsules: Sequence[Capsule],
        obstacles: Sequence[HalfSpace | Box] = (),
        pairs: Sequence[Sequence[str]] | None = None,
    ):
        self.capsules = tuple(capsules)
        self.obstacles = tuple(obstacles)
        self.notes = ()
        _check_shapes(robot, self.capsules, self._names)
        if pairs is None:
            meeting_pairs = _meeting_pairs(robot, self.capsules, len(obstacles))
            self.pairs = self._ordered(meeting_pairs)
            largest_gaps = self._largest_gaps(robot) if self.pairs else []
            room = dict(zip(self.pairs, largest_gaps, strict=True))
            overlaps = [pair for pair in self.pairs if room[pair] <= 0]
            self.pairs = tuple(pair for pair in self.pairs if room[pair] > 0)
            self.notes = self._overlap_notes(overlaps)
        else:
            self.pairs = self._ordered([self._indices(pair) for pair in pairs])
            room = dict.fromkeys(self.pairs, np.inf)
        if not self.pairs:
            raise InputError(
                "a collision model needs at least one pair of shapes that can touch."
            )
        self.groups = self._groups()
        self.room = tuple(
            min(room[self.pairs[place]] for place in group) for group in self.groups
        )

    @property
    def _names(self):
        """Names of all shapes, in the order of their indices."""
        return [shape.name for shape in (*self.capsules, *self.obstacles)]

    @property
    def pair_names(self) -> Texts:
        """Names of each clearance's two shapes; of the first ones if they are more."""
        shape_names = self._names
        body_names: dict[int | str, str] = {}
        for shape, capsule in enumerate(self.capsules):
            body_names.setdefault(self._owner(shape), _stem(capsule.name))

        names = []
        for group in self.groups:
            pair = self.pairs[group[0]]
            words = [shape_names[shape] for shape in pair]
            if len(group) > 1:
                for side, shape in enumerate(pair):
                    words[side] = body_names.get(self._owner(shape), words[side])
            names.append(" and ".join(words))
        return tuple(names)

    def ends(self, robot: Robot, q: Joints) -> Float[Array, "capsules 2 3"]:
        """Return the ends of all capsules' axes on the ground in one pose [m]."""
        rotations, origins = placements(robot, q)
        # The ground comes last, where its index -1 leads.
        ground_rotation = jnp.eye(3)[None]
        ground_origin = jnp.zeros((1, 3))
        rotations = jnp.concatenate([rotations, ground_rotation])
        origins = jnp.concatenate([origins, ground_origin])
        bodies = np.array([capsule.body for capsule in self.capsules])
        starts = jnp.stack([capsule.start for capsule in self.capsules])
        ends = jnp.stack([capsule.end for capsule in self.capsules])
        axes = jnp.stack([starts, ends], axis=1)
        turned_axes = jnp.einsum("cij,cej->cei", rotations[bodies], axes)
        body_origins = origins[bodies][:, None]
        return turned_axes + jnp.broadcast_to(body_origins, turned_axes.shape)

    @eqx.filter_jit
    def clearance(
        self,
        robot: Robot,
        q: Float[AnyArray, "*batch joints"],
    ) -> Float[AnyArray, "*batch groups"]:
        """Return the clearances of poses, negative where shapes overlap [m].

        Args:
            robot: Robot whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        poses = jnp.reshape(jnp.asarray(q), (-1, robot.joints))
        ends = jax.vmap(lambda pose: self.ends(robot, pose))(poses)
        return self.clearances(ends).reshape(*q.shape[:-1], len(self.groups))

    @eqx.filter_jit
    def clearances(
        self, ends: Float[AnyArray, "*batch capsules 2 3"]
    ) -> Float[Array, "*batch groups"]:
        """Return the clearances [m] for given ends of all axes on the ground [m]."""
        *batch, capsules, _, _ = ends.shape
        gaps = jax.vmap(self._gaps)(jnp.reshape(ends, (-1, capsules, 2, 3)))
        # All groups get the same number of pairs: the first ones are repeated.
        size = max(map(len, self.groups))
        places = [np.resize(group, size) for group in self.groups]
        gaps_of_groups = gaps[:, np.array(places)]
        # The derivative is that of one pair, also where several are equally near.
        nearest_pairs = jnp.argmin(
            jax.lax.stop_gradient(gaps_of_groups),
            axis=-1,
            keepdims=True,
        )
        clearances = jnp.take_along_axis(gaps_of_groups, nearest_pairs, axis=-1)
        return clearances.reshape(*batch, len(self.groups))

    @eqx.filter_jit
    def gaps(self, ends: Array) -> Array:
        """Return the gap of each pair [samples, pairs] for given ends of all axes [m].

        Args:
            ends: Ends of all axes on the ground [samples, capsules, 2, 3] [m].
        """
        return jax.vmap(self._gaps)(ends)

    def least_of_groups(self, gaps: Matrix) -> Matrix:
        """Return the clearances [samples, groups] from the gaps of all pairs."""
        order = np.concatenate(self.groups)
        sizes = [len(group) for group in self.groups]
        first_places = np.cumsum([0, *sizes[:-1]])
        return np.minimum.reduceat(gaps[:, order], first_places, axis=1)

    @eqx.filter_jit
    def linearised_clearances(self, ends: Array, places: Array) -> tuple[Array, Array]:
        """Return one clearance of each sample [m], and its derivatives by the ends.

        Only the pairs of that clearance are computed.

        Args:
            ends: Ends of all axes on the ground [samples, capsules, 2, 3] [m].
            places: Place of each sample's clearance among the groups.
        """
        size = max(map(len, self.groups))
        pair_places = np.array([np.resize(group, size) for group in self.groups])
        pairs_of_groups = jnp.asarray(np.array(self.pairs)[pair_places])

        def clearance(ends, pairs):
            gaps = self._gaps_of_pairs(ends, pairs)
            nearest_pair = jnp.argmin(jax.lax.stop_gradient(gaps))
            return gaps[nearest_pair]

        linearise = jax.vmap(jax.value_and_grad(clearance))
        return linearise(ends, pairs_of_groups[places])

    def _gaps_of_pairs(self, ends: Array, pairs: Array):
        """Return the gaps of some pairs [pairs, 2], which differ between samples."""
        radii = jnp.stack([jnp.asarray(capsule.radius) for capsule in self.capsules])
        last_capsule = len(self.capsules) - 1
        axes = ends[pairs[:, 0]]
        second_shapes = pairs[:, 1]
        second_capsules = jnp.minimum(second_shapes, last_capsule)
        second_axes = ends[second_capsules]
        distances = segment_distance(
            axes[:, 0], axes[:, 1], second_axes[:, 0], second_axes[:, 1]
        )
        distances = distances - radii[second_capsules]
        for number, obstacle in enumerate(self.obstacles, len(self.capsules)):
            distance = obstacle.distance(axes[:, 0], axes[:, 1])
            distances = jnp.where(second_shapes == number, distance, distances)
        return distances - radii[pairs[:, 0]]

    def _gaps(self, ends: Array):
        """Return the distance between the surfaces of each pair for some `ends` [m]."""
        start = ends[:, 0]
        end = ends[:, 1]
        radii_of_capsules = [jnp.asarray(capsule.radius) for capsule in self.capsules]
        radii = jnp.stack(radii_of_capsules)
        first_numbers, second_numbers = np.array(self.pairs).T
        # Distances from the axes of the first shapes, in the order of the pairs.
        distances = []
        is_capsule = second_numbers < len(self.capsules)
        if is_capsule.any():
            i = first_numbers[is_capsule]
            k = second_numbers[is_capsule]
            axis_distances = segment_distance(start[i], end[i], start[k], end[k])
            distances.append(axis_distances - radii[k])
        for number, obstacle in enumerate(self.obstacles, len(self.capsules)):
            i = first_numbers[second_numbers == number]
            if i.size:
                distance = obstacle.distance(start[i], end[i])
                distances.append(distance)
        return jnp.concatenate(distances) - radii[first_numbers]

    def _largest_gaps(self, robot: Robot):
        """Return the largest gap of each pair in random poses [m]."""
        limits = complete_limits(robot)
        random = np.random.default_rng(0)
        q = random.uniform(
            limits.position_min,
            limits.position_max,
            (POSES, robot.joints),
        )

        def gaps(pose):
            return self._gaps(self.ends(robot, pose))

        with double_precision():
            gaps_of_poses = jax.jit(jax.vmap(gaps))(reachable(robot, q))
        return np.asarray(gaps_of_poses).max(axis=0).tolist()

    def _ordered(self, pairs: Sequence[tuple[int, int]]):
        """Return pairs of capsules first, then those of each obstacle."""
        last_capsule = len(self.capsules) - 1
        return tuple(sorted(pairs, key=lambda pair: max(pair[1], last_capsule)))

    def _groups(self):
        """Return the places of the pairs of each two bodies."""
        groups: dict[tuple, list[int]] = {}
        for place, pair in enumerate(self.pairs):
            owners = tuple(self._owner(shape) for shape in pair)
            groups.setdefault(owners, []).append(place)
        return tuple(tuple(group) for group in groups.values())

    def _owner(self, shape: int):
        """Return the body, or the thing on the ground, to which a shape belongs."""
        if shape >= len(self.capsules):
            return self.obstacles[shape - len(self.capsules)].name
        capsule = self.capsules[shape]
        return _stem(capsule.name) if capsule.body == GROUND else capsule.body

    def _overlap_notes(self, pairs: Sequence[tuple[int, int]]):
        """Return a note on pairs that overlap in all random poses, if there are any."""
        if not pairs:
            return ()
        names = self._names
        words = ", ".join(f"{names[i]} and {names[k]}" for i, k in pairs)
        return (
            f"not checked, since they overlap in every pose that was tried: {words}.",
        )

    def _indices(self, pair: Sequence[str]):
        """Return the indices of two shapes by their names, in ascending order."""
        names = self._names
        for name in pair:
            if name not in names:
                words = ", ".join(f"`{shape}`" for shape in names)
                raise InputError(f"`{name}` is none of the shapes {words}.")
        i, k = sorted(names.index(name) for name in pair)
        if i >= len(self.capsules) or i == k:
            raise InputError(
                f"`{pair[0]}` and `{pair[1]}` cannot touch: pair a capsule with "
                "another shape."
            )
        return i, k


def _check_shapes(robot: Robot, capsules: Sequence[Capsule], names: list[str]):
    """Reject names that come twice, and bodies that the robot does not have."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two shapes are named `{name}`: rename one.")
    for capsule in capsules:
        if not GROUND <= capsule.body < robot.bodies:
            raise InputError(
                f"`body` of capsule `{capsule.name}` must be from 0 to "
                f"{robot.bodies - 1}, or -1 for the ground, but is {capsule.body}."
            )


def _meeting_pairs(
    robot: Robot,
    capsules: Sequence[Capsule],
    obstacles: int,
):
    """Return the pairs of shapes on bodies that are neither one nor neighbours.

    Neighbours are joined by a joint, or pinned together by a loop.
    """
    bodies = [capsule.body for capsule in capsules]
    neighbours = {frozenset(link) for link in enumerate(robot.parent)}
    neighbours |= {frozenset(loop.bodies) for loop in robot.loops}
    pairs = []
    for i, k in itertools.combinations(range(len(capsules)), 2):
        pair = frozenset((bodies[i], bodies[k]))
        if len(pair) == 2 and pair not in neighbours:
            pairs.append((i, k))
    # An obstacle is not part of the base that carries the first body.
    for i, body in enumerate(bodies):
        if body != GROUND:
            pairs += [(i, len(bodies) + number) for number in range(obstacles)]
    return pairs


def _stem(name: str):
    """Return the name of a capsule's link, without the number of the capsule."""
    return re.sub(r" \d+$", "", name)
