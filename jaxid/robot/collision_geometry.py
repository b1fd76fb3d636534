"""Boxes, cylinders, spheres, capsules and meshes of URDF and MJCF files."""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, Matrix3, Vector3
from jaxid.errors import InputError

from .mjcf import body_name, import_mujoco, rotation_of_quaternion
from .urdf_elements import ORIGIN
from .urdf_tree import UrdfTree

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""Corners of a box with edges of length 2."""
MESH_ERROR_PARTS = re.compile(r"^\w+Error: | \(<string>.*\)")
"""Parts of errors of mesh readers that say nothing to a user."""


class Shape(NamedTuple):
    """All that is within a radius of the convex hull of points, in the frame of a link.

    Attributes:
        points: Points [m].
        radius: Radius [m].
    """

    points: Float[AnyArray, "points 3"]
    radius: float

    @classmethod
    def about_axis(cls, length: float, radius: float) -> "Shape":
        """Return a capsule along z, whose axis has a length [m]."""
        half_axis = np.array([0.0, 0.0, 0.5 * length])
        return cls(np.array([-half_axis, half_axis]), radius)

    def placed(self, rotation: Matrix3, position: Vector3) -> "Shape":
        """Return the shape in the frame in which its present frame is placed."""
        return Shape(position + self.points @ rotation.T, self.radius)


BodyShape = tuple[int, Shape]
"""Body, and a shape in its frame; body -1 is the ground."""


def link_shapes(
    tree: UrdfTree,
    packages: str | Path | None,
    link: str,
) -> Iterator[Shape]:
    """Yield the collision shapes of a link of a URDF file, or else its visual ones.

    Args:
        tree: Tree of the file.
        packages: Folder that holds the packages of `package://` paths. If None, they
            are searched in the folders above the file.
        link: Name of the link.

    Raises:
        FileNotFoundError: If a mesh does not exist.
        InputError: If a shape cannot be read.
    """
    element = tree.links[link]
    for part in element.findall("collision") or element.findall("visual"):
        origin = part.find("origin")
        rotation = tree.attitude(origin)
        position = tree.numbers(origin, "xyz", ORIGIN)
        description = part.find("geometry/*")
        # An element without geometry is named in the error.
        shape = _read_shape(
            tree,
            packages,
            part if description is None else description,
        )
        yield shape.placed(rotation, position)


def _read_shape(tree: UrdfTree, packages: str | Path | None, element: Any):
    """Return one shape in its own frame."""

    def number(key):
        return float(tree.numbers(element, key, (0.0,))[0])

    match element.tag:
        case "box":
            return Shape(CORNERS * tree.numbers(element, "size", ORIGIN) / 2, 0.0)
        case "mesh":
            scale = tree.numbers(element, "scale", (1.0, 1.0, 1.0))
            return Shape(_mesh_vertices(tree, packages, element) * scale, 0.0)
        case "sphere":
            return Shape.about_axis(0.0, number("radius"))
        case "cylinder" | "capsule":
            return Shape.about_axis(number("length"), number("radius"))
    raise InputError(
        f"{tree.place(element)}: `{element.tag}` is not a box, "
        "cylinder, sphere, capsule or mesh."
    )


def _mesh_vertices(
    tree: UrdfTree,
    packages: str | Path | None,
    element: Any,
):
    """Return the vertices of a mesh in the unit of its file."""
    import trimesh  # loaded where there are meshes

    name = element.get("filename") or ""
    files = _mesh_files(Path(tree.path), packages, name)
    file = next(filter(Path.is_file, files), None)
    if file is None:
        raise FileNotFoundError(
            f"{tree.place(element)}: the mesh `{name}` was not found: give its folder "
            "as `packages`."
        )
    try:
        mesh: Any = trimesh.load(str(file), force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, np.float64)
    except Exception as error:  # readers of many formats raise many exceptions
        reason = MESH_ERROR_PARTS.sub("", " ".join(str(error).split())).rstrip(".")
        raise InputError(f"`{file}` is not a readable mesh: {reason}.") from error
    if len(vertices) == 0:
        raise InputError(f"`{file}` is not a readable mesh: it has no vertices.")
    return vertices


def _mesh_files(
    description: Path,
    packages: str | Path | None,
    name: str,
) -> Iterator[Path]:
    """Yield the places where the mesh of a description may be."""
    scheme, _, location = name.rpartition("://")
    paths = [Path(location)]
    folders = [description.parent]
    if scheme == "package":
        # A package may lie in a folder of its name, or the file in the package itself.
        paths.append(Path(*paths[0].parts[1:]))
        folders += description.absolute().parents
    if packages is not None:
        folders = [Path(packages)]
    for folder, path in itertools.product(folders, paths):
        yield folder / path


def mjcf_shapes(path: str | Path) -> dict[str, list[Shape]]:
    """Return the shapes of all bodies of an MJCF file, as `mjcf_as_urdf` names them.

    Shapes that cannot collide count only where a body has no others.
    """
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_path(str(path))
    kinds = mujoco.mjtGeom
    unbounded_kinds = (kinds.mjGEOM_PLANE, kinds.mjGEOM_HFIELD, kinds.mjGEOM_SDF)
    is_solid = (model.geom_contype | model.geom_conaffinity) != 0

    shapes: dict[str, list[Shape]] = {}
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        body_is_solid = is_solid[model.geom_bodyid == body].any()
        is_unbounded = int(model.geom_type[geom]) in unbounded_kinds
        if is_unbounded or (body_is_solid and not is_solid[geom]):
            continue
        rotation = rotation_of_quaternion(model.geom_quat[geom])
        shape = _geom_shape(mujoco, model, geom)
        name = "world" if body == 0 else body_name(model, body)
        shapes.setdefault(name, []).append(shape.placed(rotation, model.geom_pos[geom]))
    return shapes


def _geom_shape(mujoco: Any, model: Any, geom: int):
    """Return a shape of a compiled model in its own frame."""
    kinds = mujoco.mjtGeom
    kind = int(model.geom_type[geom])
    size = model.geom_size[geom]
    if kind == kinds.mjGEOM_SPHERE:
        return Shape.about_axis(0.0, float(size[0]))
    if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        return Shape.about_axis(2.0 * size[1], float(size[0]))
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        end = start + model.mesh_vertnum[mesh]
        return Shape(model.mesh_vert[start:end].astype(float), 0.0)
    # An ellipsoid counts as the box around it.
    return Shape(CORNERS * size, 0.0)
