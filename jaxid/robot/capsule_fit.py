"""Capsules around the links of a robot, from their geometry or from its joints."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Matrix, Matrix3, Numbers, Vector, Vector3
from jaxid.errors import InputError

from .collision_geometry import Shape, link_shapes, mjcf_shapes
from .limits_and_drives import MAX_LINK_LENGTH
from .robot import Robot
from .shapes import GROUND, Capsule
from .urdf_elements import ORIGIN
from .urdf_tree import UrdfTree

STAND_IN_SHARE = 0.07
"""Radius of a capsule for an unknown shape, relative to the robot's length."""
AXIS_SHARE = 0.6
"""Length of the first axis of a search, relative to the extent of the points."""
FIRST_SHIFT = 0.1
"""First shift of an axis in a search, relative to the size of the points."""


class UnreadShapes(NamedTuple):
    """Body of a link whose geometry cannot be read, and why."""

    body: int  # -1 is the ground
    reason: str
    has_no_file: bool  # whether the file of a mesh was not found


def fit_capsules(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = ORIGIN,
    xacro_arguments: Mapping[str, str] | None = None,
    floating: bool = False,
    packages: str | Path | None = None,
    faults: dict[str, UnreadShapes] | None = None,
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
        xacro_arguments: As in `load_urdf`.
        floating: As in `load_urdf`.
        packages: Folder that holds the packages of `package://` paths. If None, they
            are searched in the folders above the file.
        faults: Dictionary for the links whose geometry cannot be read; if None, that is
            an error.

    Raises:
        FileNotFoundError: If the file or a mesh does not exist.
        InputError: If the file cannot be loaded, or its geometry cannot be read.
    """
    tree = UrdfTree(
        path, base=base, tip=tip, xacro_arguments=xacro_arguments, floating=floating
    )
    mount = np.eye(3) if base_rotation is None else np.array(base_rotation, np.float64)
    place = np.array(base_position, np.float64)

    capsules: list[Capsule] = []
    for link, body, rotation, position, shapes in placed_shapes(
        tree, mount, place, packages, faults
    ):
        for number, shape in enumerate(shapes, 1):
            label = link if number == 1 else f"{link} {number}"
            axis = Segment(shape.points[0], shape.points[-1], shape.radius)
            if shape.radius == 0.0:
                axis = enclose(shape.points)
            capsule = Capsule(
                label,
                body,
                start=position + rotation @ axis.start,
                end=position + rotation @ axis.end,
                radius=axis.radius,
            )
            capsules.append(capsule)
    if not capsules and faults is None:
        raise InputError(f"`{path}` has no collision geometry for these links.")
    return tuple(capsules)


class LinkShapes(NamedTuple):
    """Shapes of a link, and the place of its frame.

    Attributes:
        link: Name of the link.
        body: Body that the link belongs to; -1 is the ground.
        rotation: Orientation of the link's frame in that of the body.
        position: Origin of the link's frame in that of the body [m].
        shapes: Shapes in the link's frame.
    """

    link: str
    body: int
    rotation: Matrix3
    position: Vector3
    shapes: list[Shape]


def placed_shapes(
    tree: UrdfTree,
    mount: Matrix,
    place: Vector,
    packages: str | Path | None = None,
    faults: dict[str, UnreadShapes] | None = None,
) -> Iterator[LinkShapes]:
    """Yield the shapes of each link of a file whose base is mounted on the ground.

    For `packages`, `faults` and errors see `fit_capsules`.
    """
    path = tree.path
    # MuJoCo has read the shapes of an MJCF file; those of a URDF are read here.
    compiled_shapes = mjcf_shapes(path) if tree.compiled else {}

    for link, (body, rotation, position) in tree.placed_links().items():
        if body == GROUND:
            rotation = mount @ rotation
            position = place + mount @ position
        shapes = compiled_shapes.get(link, [])
        try:
            if not tree.compiled:
                # Numbers that overflow make a shape that is too large.
                with np.errstate(over="ignore", invalid="ignore"):
                    shapes = list(link_shapes(tree, packages, link))
            _refuse_huge_shapes(path, link, shapes)
        except (OSError, InputError) as error:
            if faults is None:
                raise
            has_no_file = isinstance(error, FileNotFoundError)
            faults[link] = UnreadShapes(body, str(error), has_no_file)
            shapes = []
        yield LinkShapes(link, body, rotation, position, shapes)


def _refuse_huge_shapes(path: str | Path, link: str, shapes: list[Shape]):
    """Reject shapes that no robot has."""
    for shape in shapes:
        reach = np.abs(shape.points).max(initial=0.0) + shape.radius
        if not reach <= MAX_LINK_LENGTH:
            raise InputError(
                f"`{path}`: the geometry of link `{link}` must be within "
                f"{MAX_LINK_LENGTH:g} m, but reaches {reach:g} m: give it in metres "
                "(`scale` of a mesh)."
            )


def stand_in_capsules(robot: Robot, bodies: list[int]) -> list[Capsule]:
    """Return capsules between the joints of bodies whose shape is unknown."""
    offsets = [np.asarray(offset) for offset in (*robot.offset, robot.tip_offset)]
    carriers = (*robot.parent, robot.tip_body)
    robot_length = sum(float(np.linalg.norm(offset)) for offset in offsets)
    radius = STAND_IN_SHARE * robot_length

    capsules = []
    for body in bodies:
        link = "base" if body == GROUND else f"link of {robot.body_names[body]}"
        number = 0
        for carrier, end in zip(carriers, offsets, strict=True):
            if carrier != body or not end.any():
                continue
            number += 1
            label = link if number == 1 else f"{link} {number}"
            capsules.append(
                Capsule(label, body, start=np.zeros(3), end=end, radius=radius)
            )
    return capsules


class Segment(NamedTuple):
    """Axis and radius of a capsule.

    Attributes:
        start: One end of the axis [m].
        end: The other end [m].
        radius: Radius [m].
    """

    start: Vector3
    end: Vector3
    radius: float

    @property
    def volume(self) -> float:
        """Volume of the capsule [m³]."""
        length = float(np.linalg.norm(self.end - self.start))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


def enclose(points: AnyArray) -> Segment:
    """Return a small capsule around all points [m].

    The ends of the axis are searched from those of the best principal direction. For
    every axis the radius reaches the farthest point, so all points are inside, whatever
    the search finds. (The smallest cylinder is no help: a capsule about its axis is up
    to six times larger.)
    """
    hull = _hull_points(np.asarray(points))
    centre = 0.5 * (hull.min(axis=0) + hull.max(axis=0))
    extent = float(np.ptp(hull, axis=0).max())
    size = max(extent, 1e-9)
    centred_hull = hull - hull.mean(axis=0)
    _, _, directions = np.linalg.svd(centred_hull)

    def volume(ends):
        return _capsule_about(hull, ends).volume

    axes = []
    for direction in directions:
        heights = (hull - centre) @ direction
        # The round ends reach beyond the axis.
        reach = AXIS_SHARE * np.array([heights.min(), heights.max()])
        ends = centre + reach[:, None] * direction
        axes.append(ends.ravel())
    start = min(axes, key=volume)
    simplex = np.vstack([start, start + FIRST_SHIFT * size * np.eye(6)])
    options = {
        "initial_simplex": simplex,
        "maxiter": 500,
        "xatol": 1e-4 * size,
        "fatol": 1e-5 * size**3,
    }
    optimum = scipy.optimize.minimize(
        volume, start, method="Nelder-Mead", options=options
    )
    return _capsule_about(hull, optimum.x)


def _capsule_about(points: np.ndarray, ends: np.ndarray):
    """Return the smallest capsule around points whose axis has these ends."""
    start, end = ends.reshape(2, 3)
    axis = end - start
    vectors = points - start
    square = max(float(axis @ axis), 1e-18)
    heights = vectors @ axis / square
    fractions = np.clip(heights, 0.0, 1.0)
    nearest_points = fractions[:, None] * axis
    distances = np.linalg.norm(vectors - nearest_points, axis=1)
    # Rounding must leave no point outside.
    radius = float(distances.max()) * (1 + 1e-9) + 1e-12
    return Segment(start, end, radius)


def _hull_points(points: np.ndarray):
    """Return the corners of the hull; all points if they are few or in a plane."""
    if len(points) <= 4:
        return points
    try:
        return points[scipy.spatial.ConvexHull(points).vertices]
    except scipy.spatial.QhullError:
        return points
