"""The tables `[robot]`, `[limits]`, `[drives]` and `[load]` of an experiment file."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np

from jaxid.errors import InputError
from jaxid.experiment_values import PerJoint, TomlTable, Vector
from jaxid.measurement.columns import Columns
from jaxid.robot import library
from jaxid.robot.contacts import AbstractContactShape, Sole, Sphere
from jaxid.robot.inertia import Tool
from jaxid.robot.limits_and_drives import Limits, per_joint, range_fault
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.shapes import HalfSpace
from jaxid.workflow.robot_file import RobotFile, joint_number

MIN_FORCE = 1e-9
"""Force that is taken for a mistake if a limit is smaller [N m or N]."""
AngleUnit = Literal["rad", "deg"]


def inertia_tensor(
    *,
    xx: float,
    yy: float,
    zz: float,
    xy: float = 0.0,
    xz: float = 0.0,
    yz: float = 0.0,
) -> np.ndarray:
    """Return an inertia tensor about the centre of mass, with the signs of a URDF file.

    Args:
        xx: Moment about x [kg m²].
        yy: Moment about y [kg m²].
        zz: Moment about z [kg m²].
        xy: Product [kg m²].
        xz: Product [kg m²].
        yz: Product [kg m²].
    """
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def known_load(
    *,
    mass: float,
    centre_of_mass: Vector | None = None,
    inertia: Annotated[np.ndarray, inertia_tensor] | None = None,
    body: str | None = None,
) -> Callable[[Robot], Tool | float]:
    """Known load, whose forces are subtracted and not identified.

    Args:
        mass: Mass [kg], like `1.5`.
        centre_of_mass: Centre of mass in the frame of the end-effector, or of `body`
            [m], like `[0.0, 0.0, 0.05]`. `jaxid gains` needs only the mass of a load on
            the end-effector.
        inertia: Inertia tensor about the centre of mass [kg m²], like
            `{ xx = 1e-3, yy = 1e-3, zz = 1e-3, xy = 0.0, xz = 0.0, yz = 0.0 }`; a point
            mass by default.
        body: Name of the joint that moves the body with the load, like `"joint1"`; the
            end-effector by default.

    Returns:
        Function from a robot to the load as a tool of it; to the mass if nothing else
        is known.

    Raises:
        InputError: If the centre of mass is missing beside `inertia` or `body`.
    """
    if centre_of_mass is None and (inertia is not None or body is not None):
        raise InputError("`centre_of_mass` is missing.")

    def on(robot: Robot) -> Tool | float:
        if centre_of_mass is None:
            return mass
        content: Any = {
            "mass": mass,
            "centre_of_mass": centre_of_mass,
            "inertia": inertia,
        }
        if body is None:
            return cast(Tool, robot.with_tool(**content).tool)
        return Tool(joint_number(robot, body), **content)

    return on


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Source and place of the robot; `urdf`, `mjcf` or `builtin` is needed.

    Attributes:
        urdf: Path of a URDF or xacro file, relative to the folder of this file.
        mjcf: Path of an MJCF file, which MuJoCo compiles, like `"arm.xml"`.
        tip: Link (body or site) of the end-effector in the URDF (MJCF) file: only the
            chain from `base` to it is used, like `"flange"`.
        base: Link (body) of that file that is fixed to the ground, like `"base_link"`.
        xacro_arguments: Arguments with which a xacro file is expanded, like
            `{ dof = "6" }`.
        builtin: Name of a robot that jaxid knows, like `"tx40"`: tx90l_on_rail, tx40,
            ur10, ur10e, panda, iiwa14, kr300 or planar_arm.
        floating: Whether the base of that file moves freely, as that of a robot on
            legs, like `true`: then `[recording]` names `gyro`, `accelerometer` and
            `contact`.
        imu: Link (site) of the IMU on a floating base, like `"imu"`; the frame of the
            base by default.
        contacts: Links (bodies) of the feet of a floating base, in the order of
            `recording.contact`, with the radius of a ball [m] or "sole", like
            `{ FL_foot = 0.022, FR_foot = 0.022 }`; those of an MJCF file by default.

        name: Name of the robot, like `"my robot"`.
        gravity: Gravity in the frame of the ground [m/s²], that of the robot's file by
            default, like `[0.0, 0.0, -9.81]`.
        base_rotation: Orientation of the robot on level ground: roll, pitch, yaw [deg];
            by default as the robot's file places `base`, like `[0.0, 0.0, 0.0]`.
        base_position: Position of the robot on the ground [m], like `[0.0, 0.0, 0.0]`.
        snap_tolerance: Largest deviation [rad] at which axes still count as parallel or
            perpendicular, like `1e-3` for a file with 1.571 instead of pi/2.
        tool: Known load at the end-effector, whose forces are subtracted.
    """

    urdf: str | None = None
    mjcf: str | None = None
    tip: str | None = None
    base: str | None = None
    xacro_arguments: dict[str, str | bool | int | float] | None = None
    builtin: str | None = None
    floating: bool | None = None
    imu: str | None = None
    contacts: dict[str, float | str] | None = None

    name: str | None = None
    gravity: Vector | None = None
    base_rotation: Vector | None = None
    base_position: Vector | None = None
    snap_tolerance: float | None = None
    tool: Annotated[Callable[[Robot], Tool | float], known_load] | None = None

    def robot_file(self, folder: Path) -> RobotFile | None:
        """Return the robot's URDF or MJCF file; None for other sources."""
        name = self.urdf or self.mjcf
        if name is None:
            return None
        # xacro reads `true` and numbers as TOML writes them.
        arguments = {
            key: value if isinstance(value, str) else json.dumps(value)
            for key, value in (self.xacro_arguments or {}).items()
        }
        chain = {"tip": self.tip, "base": self.base, "xacro_arguments": arguments}
        base = {"floating": bool(self.floating), "imu": self.imu}
        contacts = None if self.contacts is None else _shapes_of(self.contacts)
        return RobotFile(
            folder / name, **chain, **self.placement, **base, contacts=contacts
        )

    @property
    def placement(self) -> dict[str, Any]:
        """Position and orientation on the ground, for functions that make robots."""
        rotation = None
        if self.base_rotation is not None:
            rotation = rpy_rotation(np.deg2rad(self.base_rotation))
        position = self.base_position or (0.0, 0.0, 0.0)
        return {"base_rotation": rotation, "base_position": position}

    @property
    def base_plane(self) -> HalfSpace:
        """Solid below the plane on which the robot stands."""
        rotation, position = self.placement.values()
        normal = np.array([0.0, 0.0, 1.0]) if rotation is None else rotation[:, 2]
        height = float(normal @ np.array(position))
        return HalfSpace("floor", normal=normal, height=height)

    def build(self, robot_file: RobotFile | None) -> Robot:
        """Return the robot."""
        if robot_file is not None:
            robot = robot_file.load(self.gravity)
        else:
            build = getattr(library, cast(str, self.builtin))
            robot = build().mounted(*self.placement.values())
        if self.snap_tolerance is not None:
            robot = robot.snapped(self.snap_tolerance)
        if self.gravity is not None:
            robot = robot.replace(gravity=np.array(self.gravity))
        if self.name is not None:
            robot = robot.replace(name=self.name)
        tool = None if self.tool is None else self.tool(robot)
        if isinstance(tool, float):
            raise InputError("`robot.tool.centre_of_mass` is missing.")
        return robot if tool is None else robot.replace(tool=tool)


def _shapes_of(contacts: dict[str, float | str]) -> dict[str, AbstractContactShape]:
    """Return the shapes of feet."""
    shapes: dict[str, AbstractContactShape] = {}
    for link, value in contacts.items():
        if isinstance(value, str) and value != "sole":
            raise InputError(
                f'`contacts` must hold a radius [m] or "sole", but `{link}` has '
                f"{value!r}."
            )
        shapes[link] = Sole() if isinstance(value, str) else Sphere(value)
    return shapes


def require_joint_lists(tables: TomlTable, robot: Robot) -> None:
    """Reject lists of another number of joints, as another `tip` leaves them.

    A single list of a wrong length has another cause.
    """
    keys = [
        f"`{name}.{key}`"
        for name in ("limits", "drives", "recording")
        for key, value in tables.get(name, {}).items()
        if isinstance(value, list) and len(value) != robot.joints
    ]
    if len(keys) > 1 and Path(robot.source).is_file():
        options = f" --tip {robot.source_tip}" if robot.source_tip else ""
        if robot.source_base:
            options += f" --base {robot.source_base}"
        raise InputError(
            f"{', '.join(keys)} do not hold {robot.joints} entries, one for each joint "
            f"({', '.join(robot.joint_names)}): where `tip` or `base` has changed, "
            f"take these lists from what `jaxid init {robot.source}{options}` prints."
        )


def require_gears(robot: Robot, columns: Columns) -> None:
    """Reject logs of motors without the gear ratios that the robot's file states."""
    is_of_motors = columns.angles_on_motor_side or columns.forces_on_motor_side
    if is_of_motors and robot.drives.lack_stated_ratios:
        ratios = robot.drives.stated_ratios.tolist()
        raise InputError(
            "`recording.side` or `forces_side` says that the log was recorded on the "
            "motor side, but the gear ratios are 1, while the robot's file states "
            f"others (`<transmission>`): give `gear_ratios = {ratios}` in `[drives]`, "
            "or the side of the joints."
        )


def require_floating_base(robot: Robot, columns: Columns) -> None:
    """Reject signals of a trunk where the robot stands on a fixed base."""
    keys = ("gyro", "accelerometer", "contact")
    given_keys = [key for key in keys if getattr(columns, key) is not None]
    if given_keys and not robot.floating:
        raise InputError(
            f"`recording.{given_keys[0]}` is for a robot on legs: add "
            "`floating = true` to `[robot]`, or leave the key out."
        )


def replace_limits(
    robot: Robot,
    *,
    angle_unit: AngleUnit = "rad",
    position_min: PerJoint | None = None,
    position_max: PerJoint | None = None,
    velocity: PerJoint | None = None,
    acceleration: PerJoint | None = None,
    jerk: PerJoint | None = None,
    force: PerJoint | None = None,
) -> Robot:
    """Limits of the joints, one number each: inf for none, nan for the robot's own.

    Args:
        robot: Robot without these limits.
        angle_unit: Unit of everything but forces and rails: "rad" or "deg".
        position_min: Lower ends of the ranges [rad or m].
        position_max: Upper ends of the ranges [rad or m].
        velocity: Largest speeds [rad/s or m/s].
        acceleration: Largest accelerations [rad/s² or m/s²].
        jerk: Largest jerks [rad/s³ or m/s³].
        force: Largest forces [N m or N].

    Raises:
        InputError: If a list has another length, or a limit is not plausible.
    """
    arguments = {
        "position_min": position_min,
        "position_max": position_max,
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
        "force": force,
    }
    limits = {}
    assumptions = robot.limits.assumed
    for name, numbers in arguments.items():
        values = per_joint(name, numbers, robot.joints, np.nan)
        if name != "force":
            values = values * _angle_scale(robot, angle_unit)
        is_given = ~np.isnan(values)
        limits[name] = np.where(is_given, values, getattr(robot.limits, name))
        # What is given is no assumption of the robot's source any more.
        replaced_names = {
            f"{name} of {robot.joint_names[j]}" for j in np.flatnonzero(is_given)
        }
        if is_given.all():
            replaced_names.add(name)
        assumptions = tuple(text for text in assumptions if text not in replaced_names)
    _require_plausible(robot, limits)
    return robot.replace(limits=Limits(robot.joints, **limits, assumed=assumptions))


def _require_plausible(robot: Robot, limits: dict[str, np.ndarray]) -> None:
    """Reject forces that would make weights infinite, and ranges that no joint has."""
    forces = limits["force"]
    if ((forces > 0) & (forces < MIN_FORCE)).any():
        raise InputError(
            f"`force` must be at least {MIN_FORCE} N m or N, but is {forces}."
        )
    for j, name in enumerate(robot.joint_names):
        low = limits["position_min"][j]
        high = limits["position_max"][j]
        fault = range_fault(low, high, robot.revolute[j])
        if fault:
            cure = "give the limits in metres, inf for none"
            if robot.revolute[j]:
                cure = 'for degrees, add `angle_unit = "deg"`; inf means no limit'
            raise InputError(f"joint `{name}` {fault}: {cure}.")


def _angle_scale(robot: Robot, unit: AngleUnit) -> np.ndarray:
    """Return the size of the unit of each joint [rad or m]."""
    is_in_degrees = np.array(robot.revolute) & (unit == "deg")
    return np.where(is_in_degrees, np.pi / 180, 1.0)


def replace_drives(
    robot: Robot,
    *,
    gear_ratios: list[float] | None = None,
    matrix: list[PerJoint] | None = None,
    zero: list[float] | None = None,
    angle_unit: AngleUnit = "rad",
    max_torques: list[float] | None = None,
) -> Robot:
    """Motors and gears, needed for logs on the motors' side.

    Args:
        robot: Robot without these drives.
        gear_ratios: Ratio of motor to joint speed [1; rad/m for a prismatic joint].
        matrix: Rows with the ratios of each motor to all joints, instead of
            `gear_ratios`, like `[[50.0, 0.0], [50.0, 50.0]]`.
        zero: Joint angles at which the motors' angles are zero [rad or m], like `0.0`.
        angle_unit: Unit of `zero`: "rad" or "deg".
        max_torques: Largest torques of the motors, before the gears [N m].

    Raises:
        InputError: If a list has another length, or the ratios cannot be inverted.
    """
    if gear_ratios is not None and matrix is not None:
        raise InputError("give `gear_ratios` or `matrix`, but not both.")
    joints = robot.joints
    drives: dict[str, Any] = {}
    if max_torques is not None:
        drives["max_torques"] = max_torques
    if gear_ratios is not None:
        drives["reduction"] = per_joint("gear_ratios", gear_ratios, joints, 1.0)
    if matrix is not None:
        if {len(matrix), *map(len, matrix)} != {joints}:
            raise InputError(f"`matrix` must hold {joints} rows of {joints} numbers.")
        drives["reduction"] = matrix
    if zero is not None:
        angles = per_joint("zero", zero, joints, 0.0)
        drives["zero"] = angles * _angle_scale(robot, angle_unit)
    return robot.replace(drives=dataclasses.replace(robot.drives, **drives))
