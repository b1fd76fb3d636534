"""Capsules around the collision geometry of URDF files, and around clouds of points."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError
from jaxid.robot.collision.shapes import GROUND, Capsule
from jaxid.robot.kinematics import rpy_rotation
from jaxid.robot.plausibility import SNAP_TOLERANCE
from jaxid.robot.urdf import merged_links
from jaxid.robot.urdf_tree import UrdfTree

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_ZERO = (0.0, 0.0, 0.0)


class Enclosure(NamedTuple):
    """Capsule around points: the ends of its axis [m] and its radius [m]."""

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radius: float

    @property
    def volume(self) -> float:
        """Volume of the capsule [m³]."""
        length = float(np.linalg.norm(self.end - self.start))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


def fit_capsules(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
    packages: str | Path | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
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
        snap_tolerance: As in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the file or a mesh does not exist.
        ImportError: If there are meshes and trimesh is not installed.
        InputError: If the file cannot be loaded, or its geometry cannot be read.
    """
    path, tree = Path(path), UrdfTree(path)
    mount = np.eye(3) if base_rotation is None else np.array(base_rotation, np.float64)
    place = np.array(base_position, np.float64)
    found: list[Capsule] = []
    links = merged_links(path, base=base, tip=tip, snap_tolerance=snap_tolerance)
    for name, link in tree.links.items():
        if name not in links:
            continue
        body, R, r = links[name]
        if body == GROUND:
            R, r = mount @ R, place + mount @ r
        for number, element in enumerate(link.findall("collision"), 1):
            origin = tree.child(element, "origin")
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


def enclose(points: Float[AnyArray, "points 3"]) -> Enclosure:
    """Find a small capsule around all points.

    The direction and the place of the axis are searched from each of the principal directions. For
    every axis the radius reaches the farthest point and the ends are as near as they can be, so all
    points are inside, whatever the search finds.

    Args:
        points: At least one point [m].

    Raises:
        InputError: If there is no point, or one is not finite.
    """
    cloud = np.asarray(points, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud) or not np.isfinite(cloud).all():
        raise InputError(f"`points` must be rows of three finite numbers, but are {cloud.shape}.")
    cloud = _hull(cloud)
    centre = 0.5 * (cloud.max(axis=0) + cloud.min(axis=0))
    _, _, directions = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=True)
    size = max(float(np.ptp(cloud, axis=0).max()), 1e-9)
    found = []
    for k in range(3):
        frame = np.roll(directions, -k, axis=0)
        best = minimize(
            lambda x, frame=frame: _enclose_along(cloud, centre, frame, x, size).volume,
            np.zeros(4),
            method="Nelder-Mead",
            options={"maxiter": 400, "xatol": 1e-5, "fatol": 1e-6 * size**3},
        )
        found.append(_enclose_along(cloud, centre, frame, best.x, size))
    return min(found, key=lambda capsule: capsule.volume)


def _enclose_along(
    cloud: np.ndarray, centre: np.ndarray, frame: np.ndarray, x: np.ndarray, size: float
) -> Enclosure:
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
    return Enclosure(place + low * axis, place + high * axis, radius)


def _hull(cloud: np.ndarray) -> np.ndarray:
    """Return the corners of a cloud; all of it where it is flat."""
    try:
        return cloud[ConvexHull(cloud).vertices] if len(cloud) > 4 else cloud
    except QhullError:
        return cloud


def _enclose_geometry(tree: UrdfTree, packages: str | Path | None, collision: Any) -> Enclosure:
    """Return the capsule around one geometry, in the frame of the geometry."""
    geometry = tree.child(collision, "geometry")
    shape = geometry[0] if geometry is not None and len(geometry) else collision
    if shape.tag == "box":
        return enclose(_CORNERS * tree.numbers(shape, "size", _ZERO))
    if shape.tag == "mesh":
        scale = tree.numbers(shape, "scale", (1.0, 1.0, 1.0))
        return enclose(_vertices(tree, packages, shape) * scale)
    if shape.tag not in ("sphere", "cylinder", "capsule"):
        raise InputError(
            f"{tree.place(shape)}: a collision geometry must be a box, cylinder, sphere, capsule "
            f"or mesh, but is `{shape.tag}`."
        )
    length = 0.0 if shape.tag == "sphere" else tree.numbers(shape, "length", (0.0,))[0]
    half = np.array([0.0, 0.0, 0.5 * length])
    return Enclosure(-half, half, float(tree.numbers(shape, "radius", (0.0,))[0]))


def _vertices(tree: UrdfTree, packages: str | Path | None, mesh: Any) -> np.ndarray:
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"`{tree.path}` has collision meshes, which need the package trimesh: install the "
            'extra `meshes` (`pip install "jaxid-robotics[meshes]"`).'
        ) from error
    file = _mesh_file(tree, packages, mesh)
    try:
        loaded = trimesh.load(str(file), force="mesh")
        vertices = np.asarray(loaded.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # readers of many formats raise many exceptions
        raise InputError(f"`{file}` is no mesh that can be read: {error}.") from error
    if not len(vertices):
        raise InputError(f"`{file}` has no vertices.")
    return vertices


def _mesh_file(tree: UrdfTree, packages: str | Path | None, mesh: Any) -> Path:
    """Return the file of a mesh: beside the URDF file, or in a package in a folder above it."""
    path, name = Path(tree.path), mesh.get("filename") or ""
    scheme, _, rest = name.rpartition("://")
    files, folders = [Path(rest)], [path.parent]
    if scheme == "package":
        # A package may lie in a folder of its name, or the file in the package itself.
        files.append(Path(*files[0].parts[1:]))
        folders = [path.parent, *path.absolute().parents]
    if packages is not None:
        folders = [Path(packages)]
    for folder in folders:
        for file in files:
            if (folder / file).is_file():
                return folder / file
    raise FileNotFoundError(
        f"{tree.place(mesh)}: the mesh `{name}` does not exist; give by `packages` the folder that "
        "holds its package."
    )
