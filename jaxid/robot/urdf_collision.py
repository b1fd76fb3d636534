"""Capsules around the collision geometry of a URDF file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Numbers
from jaxid.errors import InputError
from jaxid.robot.capsules import GROUND, Capsule
from jaxid.robot.enclose import enclose
from jaxid.robot.snap import SNAP_TOLERANCE, rpy_rotation
from jaxid.robot.urdf import merged_links

MESH_SCHEMES = ("package://", "file://", "model://")
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def fit_capsules(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = (0.0, 0.0, 0.0),
    packages: str | Path | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> tuple[Capsule, ...]:
    """Fits a capsule around every collision geometry of a URDF file.

    Spheres stay what they are, cylinders get round ends, boxes and meshes a small capsule that
    holds all their corners. A capsule is named after its link, with a number from the second on.
    Bodies are those of `load_urdf` with the same arguments; a capsule of a link that stands on the
    ground belongs to the ground.

    Meshes are read by the package trimesh, which is in the extra `meshes`.

    Args:
        path: The file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        base_rotation: As in `load_urdf`.
        base_position: As in `load_urdf` [m].
        packages: Folder that holds the packages of `package://` paths. If None, they are sought in
            the folders above the file.
        snap_tolerance: As in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the file or a mesh does not exist.
        ImportError: If there are meshes and trimesh is not installed.
        InputError: If the file cannot be loaded, or its geometry not be read.
    """
    path = Path(path)
    links = merged_links(path, base=base, tip=tip, snap_tolerance=snap_tolerance)
    mount = np.eye(3) if base_rotation is None else np.array(base_rotation, np.float64)
    place = np.array(base_position, np.float64)
    found: list[Capsule] = []
    for name, elements in _collisions(path):
        if name not in links:
            continue
        body, R, r = links[name]
        if body == GROUND:
            R, r = mount @ R, place + mount @ r
        for number, element in enumerate(elements, 1):
            origin = element.find("origin")
            xyz = _numbers(path, origin, "xyz", 3, (0.0, 0.0, 0.0))
            turned = R @ rpy_rotation(_numbers(path, origin, "rpy", 3, (0.0, 0.0, 0.0)))
            start, end, radius = _fitted(path, packages, element)
            found.append(
                Capsule.of(
                    name if number == 1 else f"{name} {number}",
                    body,
                    start=r + R @ xyz + turned @ start,
                    end=r + R @ xyz + turned @ end,
                    radius=radius,
                )
            )
    if not found:
        raise InputError(f"`{path}` has no collision geometry for the links that were asked for.")
    return tuple(found)


def _collisions(path: Path) -> Iterator[tuple[str, list[Any]]]:
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, remove_comments=True
    )
    for link in etree.parse(str(path), parser).getroot().iterfind("link"):
        yield link.get("name"), link.findall("collision")


def _fitted(
    path: Path, packages: str | Path | None, collision: Any
) -> tuple[np.ndarray, np.ndarray, float]:
    """Ends and radius in the frame of the geometry."""
    geometry = collision.find("geometry")
    shape = geometry[0] if geometry is not None and len(geometry) else None
    kind = None if shape is None else shape.tag
    if kind == "sphere":
        return np.zeros(3), np.zeros(3), float(_numbers(path, shape, "radius", 1)[0])
    if kind in ("cylinder", "capsule"):
        half = 0.5 * _numbers(path, shape, "length", 1)[0]
        radius = float(_numbers(path, shape, "radius", 1)[0])
        return np.array([0.0, 0.0, -half]), np.array([0.0, 0.0, half]), radius
    if kind == "box":
        return enclose(CORNERS * _numbers(path, shape, "size", 3))
    if kind == "mesh":
        vertices = _vertices(path, packages, shape)
        return enclose(vertices * _numbers(path, shape, "scale", 3, (1.0, 1.0, 1.0)))
    line = collision.sourceline if shape is None else shape.sourceline
    raise InputError(
        f"`{path}`, line {line}: a collision geometry must be a box, cylinder, sphere, capsule or "
        f"mesh, but is {'empty' if kind is None else f'`{kind}`'}."
    )


def _vertices(path: Path, packages: str | Path | None, mesh: Any) -> np.ndarray:
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"`{path}` has collision meshes, which need the package trimesh: install the extra "
            '`meshes` (`pip install "jaxid-robotics[meshes]"`).'
        ) from error
    file = _mesh_file(path, packages, mesh)
    try:
        loaded = trimesh.load(str(file), force="mesh")
        vertices = np.asarray(loaded.vertices, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # readers of many formats raise many exceptions
        raise InputError(f"`{file}` is no mesh that can be read: {error}.") from error
    if not len(vertices):
        raise InputError(f"`{file}` has no vertices.")
    return vertices


def _mesh_file(path: Path, packages: str | Path | None, mesh: Any) -> Path:
    name = mesh.get("filename") or ""
    scheme = next((s for s in MESH_SCHEMES if name.startswith(s)), "")
    rest = Path(name[len(scheme) :])
    folders = [path.parent, *path.absolute().parents]
    if packages is not None:
        folders = [Path(packages)]
    if scheme != "package://":
        folders = [path.parent]
    # A package may lie in a folder of its name, or the file in the package itself.
    inner = Path(*rest.parts[1:]) if scheme == "package://" else rest
    for folder in folders:
        for candidate in (folder / rest, folder / inner):
            if candidate.is_file():
                return candidate
    raise FileNotFoundError(
        f"`{path}`, line {mesh.sourceline}: the mesh `{name}` is not there; say with `packages` "
        "which folder holds its package."
    )


def _numbers(
    path: Path,
    element: Any,
    key: str,
    count: int,
    default: tuple[float, ...] | None = None,
) -> np.ndarray:
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return np.array(default)
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        line = 0 if element is None else element.sourceline
        raise InputError(
            f"`{path}`, line {line}: `{key}` must be {count} finite "
            f"{'number' if count == 1 else 'numbers'}, but is {text!r}."
        )
    return numbers
