"""The tables `[collision]` and `[excitation]` of an experiment file."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.excitation.criteria import CRITERIA, AbstractCriterion
from jaxid.robot.capsule_fit import fit_capsules, stand_in_capsules
from jaxid.robot.collision import GROUND, Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.library import tx90l_on_rail_collision
from jaxid.robot.limits_and_drives import owners
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.trajectory.controllers import CONTROLLERS
from jaxid.trajectory.fourier import FourierBasis, RestToRestBasis
from jaxid.trajectory.lead_in_and_out import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis
from jaxid.trajectory.trajectory import AbstractBasis, count_cycles

from .decoder import Bounds, Count, Finite, OneOf, Positive, Vector
from .robot_tables import RobotSource, joint_number

Corner = tuple[float, float, float]


def capsule(
    *, name: str, body: str, start: Vector, radius: Positive, end: Vector | None = None
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
        packages: Folder of what the URDF file calls `package://`, like `"."`.
        floor: Height of the floor [m], "base" for the plane on which the robot stands,
            or false for none.
        capsules: Capsules on bodies or on the ground, like
            `[{ name = "gun", body = "ground", start = [0, 0, 0], end = [0, 0, 1],
            radius = 0.1 }]`.
        boxes: Boxes in the world, with angles in degrees, like
            `[{ name = "table", centre = [0.8, 0, 0.2], size = [1, 1, 1], rotation = [0,
            0, 45] }]`.
        pairs: Pairs of shapes to watch, like `[["gun", "table"]]`; by default all that
            the joints can bring together.
    """

    distance: Positive = 0.03
    fit: bool = True
    packages: str | None = None
    floor: Finite | Literal["base"] | bool = "base"
    capsules: tuple[Annotated[tuple[str, Capsule], capsule], ...] = ()
    boxes: tuple[Annotated[Box, box], ...] = ()
    pairs: list[tuple[str, str]] | None = None

    def build(self, robot: Robot, source: RobotSource, folder: Path) -> "Surroundings":
        """Return the distance that shapes must keep; the robot's source may know shapes.

        Raises:
            InputError: If shapes cannot be made, or a name is unknown.
        """
        capsules, obstacles, pairs, faults = [], [], None, []
        moved = source.base_rotation is not None or source.base_position is not None
        if self.fit and source.builtin == "tx90l_on_rail" and not moved:
            capsules, obstacles, pairs = self._rail(tx90l_on_rail_collision())
        elif self.fit:
            capsules, faults = self._fitted(robot, source, folder)
        for body, shape in self.capsules:
            number = GROUND if body == "ground" else joint_number(robot, body)
            capsules.append(dataclasses.replace(shape, body=number))
        obstacles += self.boxes
        if self.floor is not False and not any(
            isinstance(o, HalfSpace) for o in obstacles
        ):
            obstacles.append(self._floor(source))
        if self.fit:
            # The base may be a frame alone.
            first = 0 if capsules else GROUND
            bare = sorted({*range(first, robot.joints)} - {c.body for c in capsules})
            stout = stand_in_capsules(robot, bare)
            capsules += stout
            if names := ", ".join(f"`{c.name}`" for c in stout):
                faults.append(
                    f"the shape of {names} is unknown: stout capsules along the lines "
                    "between the "
                    "joints stand in for it; give `capsules` in `[collision]`, or a "
                    "file with "
                    "collision geometry"
                )
        try:
            model = CollisionModel(robot, capsules, obstacles, self.pairs or pairs)
        except InputError:
            if self.capsules or self.boxes or self.pairs:
                raise
            return Surroundings(None, tuple(faults))
        return Surroundings(Clearance(model, self.distance), tuple(faults))

    def _floor(self, source: RobotSource) -> HalfSpace:
        """Return the floor: horizontal at a height, or the plane on which the robot stands."""
        if self.floor not in ("base", True):
            return HalfSpace("floor", height=self.floor)
        R, r = source.placement.values()
        normal = np.array([0.0, 0.0, 1.0]) if R is None else R[:, 2]
        return HalfSpace("floor", normal=normal, height=float(normal @ np.array(r)))

    def _rail(
        self, model: CollisionModel
    ) -> tuple[list[Capsule], list[HalfSpace | Box], list[tuple[str, str]] | None]:
        """Return shapes that are known of a robot, and their pairs if there are no others."""
        names = [s.name for s in (*model.capsules, *model.obstacles)]
        pairs = [(names[i], names[k]) for i, k in model.pairs]
        alone = not self.capsules and not self.boxes and self.floor in ("base", True)
        obstacles = list(model.obstacles) if self.floor in ("base", True) else []
        return list(model.capsules), obstacles, pairs if alone else None

    def _fitted(
        self, robot: Robot, source: RobotSource, folder: Path
    ) -> tuple[list[Capsule], list[str]]:
        """Return capsules around the geometry of the robot's file, and what cannot be read."""
        if source.file is None:
            return [], []
        packages, faults = None if self.packages is None else folder / self.packages, {}
        place = {**source.chain, **source.placement}
        found = fit_capsules(
            folder / source.file, packages=packages, faults=faults, **place
        )
        why = {
            text: [n for n, t in faults.items() if t == text]
            for text in faults.values()
        }
        said = (
            f"{owners('link', n)}: geometry not read ({x.rstrip('.')})"
            for x, n in why.items()
        )
        return list(found), list(said)


class Surroundings(NamedTuple):
    """Shapes of robot and surroundings."""

    clearance: Clearance | None  # distance that they must keep; None if there are none
    faults: tuple[str, ...]  # what is not known of them, in sentences

    @property
    def shapes(self) -> CollisionModel | None:
        """All shapes; None if there are none."""
        return None if self.clearance is None else self.clearance.model


@dataclasses.dataclass(frozen=True)
class Leads:
    """Ways from standstill into a periodic motion, and out of it.

    Attributes:
        time: Duration of each, if they are designed together with the motion [s].
        periods: Number of periods between them.
    """

    time: Positive | None = None
    periods: Annotated[int, Bounds(least=1, most=1000)] = 1


@dataclasses.dataclass(frozen=True)
class Excitation:
    """Motion that `jaxid excite` designs, within the limits above.

    Attributes:
        criterion: Objective: "d_optimal" for the smallest standard deviations on the
            whole, a_optimal, e_optimal, condition_number (the paper's, Eq. 36),
            weighted_condition_number or scaled_condition_number.
        harmonics: Number of harmonics of the Fourier series.
        omega: Ground frequency of the series [rad/s].
        rest: Whether the motion starts and stops at rest.
        spline: Spline from rest to rest in place of a series, like
            `{ points = 12, duration = 8.0 }`.
        leads: Way from standstill into the periodic motion, and out; or a table, like
            `{ time = 0.5, periods = 2 }`: of so many seconds, designed together with
            the motion, and two periods between them.
        samples: Number of samples that one run will measure.
        noise: Standard deviation of the forces' noise for each joint [N m or N]; by
            default 1 % of the largest forces.
        starts: Number of random motions to start from.
        generations: Number of times that the motions found have children.
        time: Time for the search [s], like `60.0`; by default all of its steps are
            done.
        seed: Seed of the random motions.
        sample_time: Time between two rows of the written table, the controller's cycle
            [s], like `0.004`; by default that of the controller, or of the samples.
        controller: Controller that plays the motion, for its cycle and its file:
            franka, kuka_fri, kuka_rsi or universal_robots, like `"universal_robots"`.
        ros: Kind of the file for ROS 2: "yaml" or "mcap" (a bag).
        nominal: Folder of an earlier result of `jaxid identify`, to compare with, like
            `"report"`.
        earlier: Motions whose logs will be used together with this one's, like
            `["trajectory.json"]`.
        force_margin: Fraction of the largest forces to keep free, by nominal
            parameters, like `0.1`; by default 0.3 if friction or others are unknown,
            else 0.
        tip_speed: Largest speed of the end-effector [m/s], like `1.5`.
        tip_acceleration: Largest acceleration of the end-effector [m/s²], like `10.0`.
        workspace: Box for the end-effector: two corners [m], like
            `[[-1.0, -1.0, 0.1], [1.0, 1.0, 1.5]]`.
    """

    criterion: Annotated[str, OneOf(CRITERIA)] = "d_optimal"
    harmonics: Annotated[int, Bounds(least=1, most=50)] = 5
    omega: Annotated[float, Bounds(above=0.0, most=1000.0)] = 0.8
    rest: bool = False
    spline: RestToRestSplineBasis | None = None
    leads: bool | Leads = True
    samples: Annotated[int, Bounds(least=2, most=10_000_000)] = 800
    noise: list[Annotated[float, Bounds(above=0.0, below=1e9)]] | None = None
    starts: Count = 32
    generations: Annotated[int, Bounds(least=0, most=10_000)] = 12
    time: Positive | None = None
    seed: Annotated[int, Bounds(least=0, most=2**32 - 1)] = 0
    sample_time: Annotated[float, Bounds(least=1e-5)] | None = None
    controller: Annotated[str, OneOf(CONTROLLERS)] | None = None
    ros: Literal["yaml", "mcap"] = "yaml"
    nominal: str | None = None
    earlier: tuple[str, ...] = ()
    force_margin: Annotated[float, Bounds(least=0.0, below=1.0)] | None = None
    tip_speed: Positive = math.inf
    tip_acceleration: Positive = math.inf
    workspace: tuple[Corner, Corner] | None = None

    @property
    def objective(self) -> AbstractCriterion:
        """Criterion of that name."""
        return CRITERIA[self.criterion]

    @property
    def cycle(self) -> float | None:
        """Time between two rows of the table [s]; None for that of the samples."""
        if self.sample_time is None and self.controller is not None:
            return CONTROLLERS[self.controller].sample_time
        return self.sample_time

    @property
    def chosen_leads(self) -> Leads | None:
        """Ways into and out of the motion; None if it starts as it is."""
        if not self.leads or self.rest or self.spline is not None:
            return None
        return self.leads if isinstance(self.leads, Leads) else Leads()

    @property
    def rests(self) -> bool:
        """Whether the motion starts and ends at standstill, if leads are possible."""
        return self.chosen_leads is not None or self.rest or self.spline is not None

    def basis(self, constrained: bool) -> AbstractBasis:
        """Return the basis of the trajectories; with other constraints, leads are designed too.

        Raises:
            InputError: If two kinds are asked for, or one whose end no sample would
                meet.
        """
        if self.spline is not None:
            if self.rest:
                raise InputError(
                    "`rest` is for Fourier series, and a `spline` rests at its ends: "
                    "leave one out."
                )
            return self.spline
        leads, series = self.chosen_leads, (self.harmonics, self.omega)
        if self.rest:
            return RestToRestBasis(*series)
        if leads is None and self.cycle is not None:
            # Samples at full speed must not end before the period or go on after it.
            period, step = 2 * np.pi / self.omega, self.cycle
            count = count_cycles(period, step)
            if abs(count * step - period) > 1e-6 * step:
                raise InputError(
                    f"`sample_time` must divide the period of {period:.9g} s where "
                    "there are no "
                    f"`leads`: choose `omega` = {2 * np.pi / (count * step):.9g}, or "
                    "use `leads`."
                )
        if leads is None or (not constrained and leads.time is None):
            return FourierBasis(*series)
        return LeadsBasis(*series, lead=leads.time or 0.5, periods=leads.periods)
