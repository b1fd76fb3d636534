"""Surroundings of a robot and shapes of its links, which must keep a distance."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np

from jaxid.arrays import Texts
from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.excitation.motions_on_feet import MotionsOnFeet
from jaxid.robot.capsule_fit import (
    UnreadShapes,
    fit_capsules,
    stand_in_capsules,
)
from jaxid.robot.collision import GROUND, Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.limits_and_drives import owners
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.virtual_joints import with_moving_base

from .robot_file import RobotFile, joint_number

Vector = tuple[float, float, float]


def capsule(
    *, name: str, body: str, start: Vector, radius: float, end: Vector | None = None
) -> tuple[str, Capsule]:
    """Return a capsule and the name of its body; a sphere without `end`.

    Args:
        name: Name of the capsule.
        body: Name of the joint that moves the capsule's body, or "ground".
        start: One end of the axis, in the frame of the body [m].
        radius: Radius [m].
        end: Other end of the axis [m].
    """
    return body, Capsule(name, GROUND, start=start, end=end, radius=radius)


def box(
    *, name: str, centre: Vector, size: Vector, rotation: Vector | None = None
) -> Box:
    """Return a box in the world.

    Args:
        name: Name of the box.
        centre: Centre [m].
        size: Lengths of the edges [m].
        rotation: Roll, pitch, yaw [deg].
    """
    R = None if rotation is None else rpy_rotation(np.deg2rad(rotation))
    return Box(name, centre=centre, size=size, rotation=R)


@dataclasses.dataclass(frozen=True)
class Collision:
    """Shapes that must keep a distance while a designed motion runs.

    Attributes:
        distance: Distance that must remain [m].
        fit: Whether to fit capsules around the geometry of the robot's links.
        packages: Folder to which `package://` in the URDF file refers, like `"."`.
        floor: Height of the floor [m], "base" for the plane on which the robot stands,
            or false for none.
        capsules: Capsules on bodies or on the ground, like
            `[{ name = "gun", body = "ground", start = [0, 0, 0], end = [0, 0, 1],
            radius = 0.1 }]`.
        boxes: Boxes in the world, with angles in degrees, like
            `[{ name = "table", centre = [0.8, 0, 0.2], size = [1, 1, 1], rotation = [0,
            0, 45] }]`.
        pairs: Pairs of shapes to check, like `[["gun", "table"]]`; by default all pairs
            that the joints can bring together.
    """

    distance: float = 0.03
    fit: bool = True
    packages: str | None = None
    floor: float | Literal["base"] | bool = "base"
    capsules: tuple[Annotated[tuple[str, Capsule], capsule], ...] = ()
    boxes: tuple[Annotated[Box, box], ...] = ()
    pairs: list[tuple[str, str]] | None = None

    def build(
        self,
        robot: Robot,
        robot_file: RobotFile | None = None,
        base_plane: HalfSpace | None = None,
    ) -> "Surroundings":
        """Return the distance that shapes must keep, and what is not known of them.

        Args:
            robot: The robot.
            robot_file: File with the geometry of its links.
            base_plane: Solid below the plane on which it stands; z = 0 by default.

        Raises:
            InputError: If shapes cannot be made, or a name is unknown.
        """
        robot_stands = robot.floating
        user_capsules = []
        for body, shape in self.capsules:
            number = GROUND if body == "ground" else joint_number(robot, body)
            user_capsules.append(dataclasses.replace(shape, body=number))
        capsules = []
        faults = []
        if self.fit and robot_file is not None:
            # The user's shapes replace what the file does not tell of a body.
            known_bodies = {capsule.body for capsule in user_capsules}
            capsules, faults = fit_links(robot_file, self.packages, known_bodies)
        capsules += user_capsules
        obstacles: list[Box | HalfSpace] = list(self.boxes)
        if robot_stands:
            # Its feet touch the floor. Boxes stand beside its standing pose.
            robot = with_moving_base(robot)
            if not capsules:
                faults.append("no shape of the robot is known")
        elif self.floor in ("base", True):
            obstacles.append(base_plane or HalfSpace("floor"))
        elif self.floor is not False:
            obstacles.append(HalfSpace("floor", height=self.floor))
        if self.fit and not robot_stands:
            substitutes = substitute_capsules(robot, capsules)
            capsules += substitutes
            if substitutes:
                names = ", ".join(f"`{capsule.name}`" for capsule in substitutes)
                faults.append(
                    f"the shape of {names} is unknown: thick capsules along the lines "
                    "between the joints are used instead; give `capsules` in "
                    "`[collision]`, or a file with collision geometry"
                )
        clearance = None
        try:
            model = CollisionModel(robot, capsules, obstacles, self.pairs)
            clearance = Clearance(model, self.distance)
        except InputError:
            # Without shapes of the user, there may be none that can meet.
            if self.capsules or self.boxes or self.pairs:
                raise
        notes = () if clearance is None else clearance.model.notes
        return Surroundings(self, clearance, tuple(faults), notes)


def fit_links(
    robot_file: RobotFile, packages: str | None, known_bodies: set[int]
) -> tuple[list[Capsule], list[str]]:
    """Return capsules around the robot file's geometry, and what cannot be read.

    Args:
        robot_file: Robot file.
        packages: Folder of its packages.
        known_bodies: Bodies whose shape is known otherwise.
    """
    faults: dict[str, UnreadShapes] = {}
    capsules = fit_capsules(
        robot_file.path,
        packages=packages,
        faults=faults,
        **robot_file.chain,
        **robot_file.placement,
    )
    # Links with the same fault share a sentence, and so do all without their meshes.
    faults_by_kind: dict[str | bool, dict[str, UnreadShapes]] = {}
    for link, fault in faults.items():
        if fault.body not in known_bodies:
            kind = fault.has_no_file or fault.reason
            faults_by_kind.setdefault(kind, {})[link] = fault
    sentences = []
    for alike_faults in faults_by_kind.values():
        reasons = [fault.reason.rstrip(".") for fault in alike_faults.values()]
        others = len(set(reasons)) - 1
        note = f"; {others} more like it" if others else ""
        sentences.append(
            f"{owners('link', [*alike_faults])}: geometry not read ({reasons[0]}"
            f"{note}); give `capsules` of this body in `[collision]`, or the file"
        )
    return list(capsules), sentences


def substitute_capsules(robot: Robot, capsules: Sequence[Capsule]) -> list[Capsule]:
    """Return capsules for bodies of which no shape is known."""
    # The base may be a frame alone.
    first_body = 0 if capsules else GROUND
    bodies = {*range(first_body, robot.bodies)} - {x.body for x in capsules}
    return list(stand_in_capsules(robot, sorted(bodies)))


def compared_on_feet(
    surroundings: "Surroundings", motions: MotionsOnFeet
) -> "Surroundings":
    """Return the surroundings without pairs that are too near however little it sways.

    Capsules around links are coarse: those of a trunk and of its thighs often overlap.
    """
    clearance = surroundings.clearance
    if clearance is None:
        return surroundings
    robot = with_moving_base(motions.robot)
    model = clearance.model
    least_gaps = np.full(len(model.groups), np.inf)
    for number in range(motions.phases):
        phase = motions.phase(number, np.zeros(motions.shape))
        if phase.spline is not None:
            q = phase.motion(motions.times).q
            gaps = np.asarray(model.clearance(robot, q)).min(axis=0)
            least_gaps = np.minimum(least_gaps, gaps)
    is_near = least_gaps < clearance.distance
    names = [shape.name for shape in (*model.capsules, *model.obstacles)]
    pairs = []
    for number in np.flatnonzero(~is_near).tolist():
        for place in model.groups[number]:
            first, second = model.pairs[place]
            pairs.append((names[first], names[second]))
    near_names = [model.pair_names[k] for k in np.flatnonzero(is_near).tolist()]
    note = (
        f"not checked, since capsules around them are nearer than "
        f"{clearance.distance:g} m where the robot only leans and lifts its feet: "
        f"{', '.join(near_names)}"
    )
    if pairs:
        gaps_by_name = dict(zip(model.pair_names, least_gaps, strict=True))
        model = CollisionModel(robot, model.capsules, model.obstacles, pairs)
        gaps = np.array([gaps_by_name[name] for name in model.pair_names])
        # Others could not move where a pair is hardly farther than asked.
        clearance = Clearance(model, np.minimum(clearance.distance, 0.5 * gaps))
    return surroundings._replace(
        clearance=clearance if pairs else None,
        notes=(*surroundings.notes, note) if near_names else surroundings.notes,
    )


class Surroundings(NamedTuple):
    """Shapes of robot and surroundings."""

    collision: Collision  # what the user says of them
    clearance: Clearance | None  # distance that they must keep; None if there are none
    faults: Texts  # what is not known of them, in sentences
    notes: Texts = ()  # pairs of shapes that are not compared, in sentences

    @property
    def shapes(self) -> CollisionModel | None:
        """All shapes; None if there are none."""
        return None if self.clearance is None else self.clearance.model

    @property
    def obstacles(self) -> tuple[Box | HalfSpace, ...]:
        """Floor, boxes and other solids that do not move."""
        return () if self.shapes is None else self.shapes.obstacles
