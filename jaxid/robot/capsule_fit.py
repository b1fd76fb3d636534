"""Capsules around the links of a robot: of their geometry, or along the lines between joints."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from jaxid.arrays import Float, Numbers
from jaxid.errors import InputError

from .mjcf import mjcf_shapes
from .robot import Robot
from .rotations import rpy_rotation
from .shapes import GROUND, Capsule
from .urdf_tree import UrdfTree

_SIGNS = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
)
_ZERO = (0.0, 0.0, 0.0)


Shape = tuple[Float[np.ndarray, "points 3"], float]
"""Points and a radius: all that is within it of their convex hull, in the frame of a link [m]."""


def fit_capsules(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
    packages: str | Path | None = None,
    faults: dict[str, str] | None = None,
) -> tuple[Capsule, ...]:
    """Fit capsules around the collision geometry of a URDF or MJCF file.

    A link without collision geometry counts with its visual one. Spheres remain
    spheres, cylinders get round ends, boxes and meshes a small capsule that holds all
    their corners. A capsule is named after its link, with a number from the second on.
    Bodies are those of `load_urdf` with the same arguments; a capsule of a link that
    stands on the ground belongs to the ground. Grippers count even where `tip` leaves
    their joints out: held, like joints that mimic others, as near to zero as they can
    be.

    Args:
        path: URDF or MJCF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        base_rotation: As in `load_urdf`.
        base_position: As in `load_urdf` [m].
        packages: Folder that holds the packages of `package://` paths. If None, they
            are searched in the folders above the file.
        faults: Dictionary for why a link's geometry cannot be read, by link; if None,
            that is an error.

    Raises:
        FileNotFoundError: If the file or a mesh does not exist.
        InputError: If the file cannot be loaded, or its geometry cannot be read.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    mount = np.eye(3) if base_rotation is None else np.array(base_rotation, np.float64)
    place = np.array(base_position, np.float64)
    compiled = mjcf_shapes(path) if tree.compiled else None
    found: list[Capsule] = []
    for name, (body, R, r) in tree.placed_links().items():
        if body == GROUND:
            R, r = mount @ R, place + mount @ r
        try:
            if compiled is None:
                shapes = list(_read_shapes(tree, packages, name))
            else:
                shapes = compiled.get(name, [])
        except (OSError, InputError) as error:
            if faults is None:
                raise
            faults[name] = str(error)
            continue
        for number, (points, radius) in enumerate(shapes, 1):
            start, end = points[[0, -1]]
            if radius == 0.0:
                start, end, radius = enclose(points)
            label = name if number == 1 else f"{name} {number}"
            ends = {"start": r + R @ start, "end": r + R @ end}
            found.append(Capsule(label, body, **ends, radius=radius))
    if not found and faults is None:
        raise InputError(
            f"`{path}` has no collision geometry for the links that were asked for."
        )
    return tuple(found)


def stand_in_capsules(robot: Robot, bodies: list[int]) -> list[Capsule]:
    """Return stout capsules for bodies of unknown shape, about the lines between their joints."""
    offsets = [np.asarray(x) for x in (*robot.offset, robot.tip_offset)]
    carriers = (*robot.parent, robot.tip_body)
    stout = 0.07 * sum(float(np.linalg.norm(x)) for x in offsets)
    found = []
    for body in bodies:
        name = "base" if body == GROUND else f"link of {robot.joint_names[body]}"
        ends = [
            x for x, on in zip(offsets, carriers, strict=True) if on == body and x.any()
        ]
        for number, end in enumerate(ends, 1):
            label = name if number == 1 else f"{name} {number}"
            found.append(Capsule(label, body, start=np.zeros(3), end=end, radius=stout))
    return found


def enclose(
    points: Float[np.ndarray, "points 3"],
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return both ends [m] and the radius [m] of a small capsule around all points.

    The direction and the place of the axis are searched from each of the principal
    directions. For every axis the radius reaches the farthest point and the ends are as
    near as they can be, so all points are inside, whatever the search finds.
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
            lambda x, frame=frame: _volume(
                *_enclose_along(cloud, centre, frame, x, size)
            ),
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


def _read_shapes(
    tree: UrdfTree, packages: str | Path | None, name: str
) -> Iterator[Shape]:
    """Yield the shapes of a link of a URDF file, in the frame of the link."""
    link = tree.links[name]
    for element in link.findall("collision") or link.findall("visual"):
        origin, geometry = element.find("origin"), element.find("geometry")
        inner = None if geometry is None else geometry.find("*")
        points, radius = _read_shape(
            tree, packages, element if inner is None else inner
        )
        R = rpy_rotation(tree.numbers(origin, "rpy", _ZERO))
        yield tree.numbers(origin, "xyz", _ZERO) + points @ R.T, radius


def _read_shape(tree: UrdfTree, packages: str | Path | None, shape: Any) -> Shape:
    """Return one shape in its own frame."""
    if shape.tag == "box":
        return _SIGNS * tree.numbers(shape, "size", _ZERO), 0.0
    if shape.tag == "mesh":
        scale = tree.numbers(shape, "scale", (1.0, 1.0, 1.0))
        return _vertices(tree, packages, shape) * scale, 0.0
    if shape.tag not in ("sphere", "cylinder", "capsule"):
        raise InputError(
            f"{tree.place(shape)}: `{shape.tag}` is no box, cylinder, sphere, capsule "
            "or mesh."
        )
    length = 0.0 if shape.tag == "sphere" else tree.numbers(shape, "length", (0.0,))[0]
    half = np.array([0.0, 0.0, 0.5 * length])
    return np.array([-half, half]), float(tree.numbers(shape, "radius", (0.0,))[0])


def _vertices(tree: UrdfTree, packages: str | Path | None, mesh: Any) -> np.ndarray:
    import trimesh  # loaded where there are meshes

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
            f"{tree.place(mesh)}: the mesh `{name}` is not there: give its folder by "
            "`packages`."
        )
    try:
        loaded = trimesh.load(str(file), force="mesh", process=False)
        vertices = np.asarray(loaded.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # readers of many formats raise many exceptions
        raise InputError(f"`{file}` is no mesh that can be read: {error}.") from error
    return vertices
