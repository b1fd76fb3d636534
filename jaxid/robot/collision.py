"""Collision models: capsules on a robot's bodies, obstacles of its world, and their clearances."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from jaxid.arrays import AnyArray, Array, Float, Hashable, Numbers, double_precision
from jaxid.errors import InputError

from .forward_and_inverse_kinematics import placements
from .robot import Robot
from .rotations import rpy_rotation
from .shapes import (
    GROUND as GROUND,
    Box as Box,
    Capsule as Capsule,
    HalfSpace as HalfSpace,
    segment_distance,
)
from .urdf_tree import UrdfTree

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_ZERO = (0.0, 0.0, 0.0)


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
        pairs: Indices of shapes to watch against each other: of a capsule and of another one, or
            of an obstacle, which come after all capsules.
        notes: Pairs that were left out, in sentences.

    Raises:
        InputError: If a name is missing or comes twice, a body does not exist, two obstacles are
            paired, or there is no pair.
    """

    capsules: tuple[Capsule, ...]
    obstacles: tuple[HalfSpace | Box, ...]
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
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
                raise InputError(f"`body` of capsule `{c.name}` must be {bodies}, but is {c.body}.")
        overlap: list[str] = []
        if pairs is None:
            pairs = _meeting_pairs(robot, capsules, names)
            if pairs:
                overlap = _always_overlapping(
                    robot, CollisionModel(robot, capsules, obstacles, pairs)
                )
            pairs = [p for p in pairs if " and ".join(p) not in overlap]
        found = [_indices(names, len(capsules), pair) for pair in pairs]
        if not found:
            raise InputError("a collision model needs at least one pair of shapes that can meet.")
        self.pairs = tuple(sorted(found, key=lambda pair: pair[1] >= len(capsules)))
        self.notes = tuple(
            f"{pair} overlap in every pose that was tried, so they are not watched."
            for pair in overlap
        )

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the shapes of each clearance: pairs of capsules first, then obstacles."""
        shapes = (*self.capsules, *self.obstacles)
        return tuple(f"{shapes[i].name} and {shapes[k].name}" for i, k in self.pairs)

    def ends(self, robot: Robot, q: Float[AnyArray, " joints"]) -> Float[Array, "capsules 2 3"]:
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
    ) -> Float[Array, "*batch pairs"]:
        """Return the clearances [m] for given ends of all axes on the ground [m]."""
        ends, count = jnp.asarray(ends), len(self.capsules)
        start, end = ends[..., 0, :], ends[..., 1, :]
        radii = jnp.stack([jnp.asarray(c.radius) for c in self.capsules])
        gaps = []
        if inner := [pair for pair in self.pairs if pair[1] < count]:
            i, k = np.transpose(inner)
            gap = segment_distance(
                start[..., i, :], end[..., i, :], start[..., k, :], end[..., k, :]
            )
            gaps.append(gap - jnp.broadcast_to(radii[i] + radii[k], gap.shape))
        for i, k in self.pairs[len(inner) :]:
            gap = self.obstacles[k - count].distance(start[..., i, :], end[..., i, :])
            gaps.append((gap - radii[i])[..., None])
        return jnp.concatenate(gaps, axis=-1)

    @eqx.filter_jit
    def clearance(
        self, robot: Robot, q: Float[AnyArray, "*batch joints"]
    ) -> Float[Array, "*batch pairs"]:
        """Return the distance between the surfaces of every pair, negative where they overlap [m].

        Args:
            robot: Robot whose bodies carry the capsules.
            q: Joint coordinates [rad or m].
        """
        q = jnp.asarray(q)
        poses = jnp.reshape(q, (-1, robot.joints))
        gaps = self.clearances(jax.vmap(lambda x: self.ends(robot, x))(poses))
        return gaps.reshape(*q.shape[:-1], gaps.shape[-1])


def _always_overlapping(robot: Robot, model: CollisionModel) -> list[str]:
    """Return the names of the pairs that overlap in each of 200 random poses."""
    low = np.asarray(robot.limits.position_min)
    high = np.asarray(robot.limits.position_max)
    low = np.where(np.isfinite(low), low, -np.pi)
    high = np.where(np.isfinite(high), high, np.pi)
    random = np.random.default_rng(0)
    q = random.uniform(np.minimum(low, high), np.maximum(low, high), (200, robot.joints))
    with double_precision():
        gaps = np.asarray(model.clearance(robot, jnp.asarray(q)))
    return [model.pair_names[k] for k in np.flatnonzero(gaps.max(axis=0) <= 0)]


def _meeting_pairs(
    robot: Robot, capsules: Sequence[Capsule], names: list[str]
) -> list[tuple[str, str]]:
    """Return names of the shapes on bodies that are neither one nor neighbours."""
    bodies = [*(c.body for c in capsules), *[GROUND] * (len(names) - len(capsules))]
    parents = [robot.parent[b] if b != GROUND else None for b in bodies]
    return [
        (names[i], names[k])
        for i, k in itertools.combinations(range(len(names)), 2)
        if i < len(capsules) and bodies[k] not in (bodies[i], parents[i])
        if parents[k] != bodies[i]
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
            f"`{pair[0]}` and `{pair[1]}` cannot meet: pair a capsule with another shape."
        )
    return i, k


def fit_capsules(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
    packages: str | Path | None = None,
) -> tuple[Capsule, ...]:
    """Fit a capsule around every collision geometry of a URDF file.

    Spheres remain spheres, cylinders get round ends, boxes and meshes a small capsule that holds
    all their corners. A capsule is named after its link, with a number from the second on. Bodies
    are those of `load_urdf` with the same arguments; a capsule of a link that stands on the ground
    belongs to the ground. Meshes are read by the package trimesh (extra `meshes`).

    Args:
        path: URDF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        base_rotation: As in `load_urdf`.
        base_position: As in `load_urdf` [m].
        packages: Folder that holds the packages of `package://` paths. If None, they are searched
            in the folders above the file.

    Raises:
        FileNotFoundError: If the file or a mesh does not exist.
        ImportError: If there are meshes and trimesh is not installed.
        InputError: If the file cannot be loaded, or its geometry cannot be read.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    mount = np.eye(3) if base_rotation is None else np.array(base_rotation, np.float64)
    place = np.array(base_position, np.float64)
    found: list[Capsule] = []
    for name, link in tree.links.items():
        if name not in tree.carriers:
            continue
        body, R, r = tree.carriers[name]
        if body == GROUND:
            R, r = mount @ R, place + mount @ r
        for number, element in enumerate(link.findall("collision"), 1):
            origin = element.find("origin")
            centre = r + R @ tree.numbers(origin, "xyz", _ZERO)
            attitude = R @ rpy_rotation(tree.numbers(origin, "rpy", _ZERO))
            start, end, radius = _enclose_geometry(tree, packages, element)
            found.append(
                Capsule(
                    name if number == 1 else f"{name} {number}",
                    body,
                    start=centre + attitude @ start,
                    end=centre + attitude @ end,
                    radius=radius,
                )
            )
    if not found:
        raise InputError(f"`{path}` has no collision geometry for the links that were asked for.")
    return tuple(found)


def enclose(points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return both ends [m] and the radius [m] of a small capsule around all points.

    The direction and the place of the axis are searched from each of the principal directions. For
    every axis the radius reaches the farthest point and the ends are as near as they can be, so all
    points are inside, whatever the search finds.
    """
    try:
        cloud = points[ConvexHull(points).vertices] if len(points) > 4 else points
    except QhullError:  # a flat cloud
        cloud = points
    centre = 0.5 * (cloud.max(axis=0) + cloud.min(axis=0))
    _, _, directions = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=True)
    size = max(float(np.ptp(cloud, axis=0).max()), 1e-9)
    found = []
    for k in range(3):
        frame = np.roll(directions, -k, axis=0)
        best = minimize(
            lambda x, frame=frame: _volume(*_enclose_along(cloud, centre, frame, x, size)),
            np.zeros(4),
            method="Nelder-Mead",
            options={"maxiter": 400, "xatol": 1e-5, "fatol": 1e-6 * size**3},
        )
        found.append(_enclose_along(cloud, centre, frame, best.x, size))
    return min(found, key=lambda capsule: _volume(*capsule))


def _volume(start: np.ndarray, end: np.ndarray, radius: float) -> float:
    return np.pi * radius**2 * (float(np.linalg.norm(end - start)) + 4 / 3 * radius)


def _enclose_along(
    cloud: np.ndarray, centre: np.ndarray, frame: np.ndarray, x: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the capsule about an axis near the first of three directions, turned and shifted."""
    axis = frame[0] + x[0] * frame[1] + x[1] * frame[2]
    axis = axis / np.linalg.norm(axis)
    place = centre + size * (x[2] * frame[1] + x[3] * frame[2])
    along = (cloud - place) @ axis
    away = np.linalg.norm(cloud - place - along[:, None] * axis, axis=1)
    # Rounding must leave no point outside.
    radius = float(away.max()) * (1 + 1e-9) + 1e-12
    reach = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = (along + reach).min(), (along - reach).max()
    if low > high:
        low = high = 0.5 * (low + high)
    return place + low * axis, place + high * axis, radius


def _enclose_geometry(
    tree: UrdfTree, packages: str | Path | None, collision: Any
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the capsule around one geometry, in the frame of the geometry."""
    geometry = collision.find("geometry")
    inner = None if geometry is None else geometry.find("*")
    shape = collision if inner is None else inner
    if shape.tag == "box":
        return enclose(_CORNERS * tree.numbers(shape, "size", _ZERO))
    if shape.tag == "mesh":
        scale = tree.numbers(shape, "scale", (1.0, 1.0, 1.0))
        return enclose(_vertices(tree, packages, shape) * scale)
    if shape.tag not in ("sphere", "cylinder", "capsule"):
        raise InputError(
            f"{tree.place(shape)}: `{shape.tag}` is no box, cylinder, sphere, capsule or mesh."
        )
    length = 0.0 if shape.tag == "sphere" else tree.numbers(shape, "length", (0.0,))[0]
    half = np.array([0.0, 0.0, 0.5 * length])
    return -half, half, float(tree.numbers(shape, "radius", (0.0,))[0])


def _vertices(tree: UrdfTree, packages: str | Path | None, mesh: Any) -> np.ndarray:
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"`{tree.path}` has collision meshes, which trimesh reads: "
            'install it (`pip install "jaxid-robotics[meshes]"`).'
        ) from error
    path, name = Path(tree.path), mesh.get("filename") or ""
    scheme, _, rest = name.rpartition("://")
    files, folders = [Path(rest)], [path.parent]
    if scheme == "package":
        # A package may lie in a folder of its name, or the file in the package itself.
        files.append(Path(*files[0].parts[1:]))
        folders = [path.parent, *path.absolute().parents]
    if packages is not None:
        folders = [Path(packages)]
    places = (folder / file for folder, file in itertools.product(folders, files))
    file = next(filter(Path.is_file, places), None)
    if file is None:
        raise FileNotFoundError(
            f"{tree.place(mesh)}: the mesh `{name}` is not there: give its folder by `packages`."
        )
    try:
        loaded = trimesh.load(str(file), force="mesh")
        vertices = np.asarray(loaded.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # readers of many formats raise many exceptions
        raise InputError(f"`{file}` is no mesh that can be read: {error}.") from error
    return vertices
