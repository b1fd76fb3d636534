"""The tables `[robot]`, `[limits]`, `[drives]` and `[load]` of an experiment file."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.experiment.decoder import Magnitude, PerJoint, Positive, Vector, quoted
from jaxid.robot import library
from jaxid.robot.collision import Capsule, fit_capsules
from jaxid.robot.joints import Limits, far_notes, fast_notes, range_fault
from jaxid.robot.library import from_dh
from jaxid.robot.robot import GRAVITY, Robot, Tool
from jaxid.robot.rotations import SNAP_TOLERANCE, rpy_rotation
from jaxid.robot.urdf import load_urdf, urdf_parameters

BUILTIN = {
    name: getattr(library, name)
    for name in (
        *("tx90l_on_rail", "tx40", "ur10", "ur10e"),
        *("panda", "iiwa14", "kr300", "planar_arm"),
    )
}
"""Functions that make the robots of the library."""

AngleUnit = Literal["rad", "deg"]
DhRow = tuple[str | None, bool, tuple[float, float, float, float]]


def dh_row(
    *,
    alpha: float,
    a: float,
    d: float,
    theta: float = 0.0,
    slides: bool = False,
    name: str | None = None,
) -> DhRow:
    """Return one joint of a Denavit-Hartenberg table.

    Args:
        alpha: Twist about x [deg].
        a: Length along x [m].
        d: Offset along z [m].
        theta: Angle about z at which the joint is at zero [deg].
        slides: Whether the joint slides along z.
        name: Name of the joint.
    """
    return name, slides, (float(np.deg2rad(alpha)), a, d, float(np.deg2rad(theta)))


def inertia_tensor(
    *,
    xx: Magnitude,
    yy: Magnitude,
    zz: Magnitude,
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


@dataclasses.dataclass(frozen=True)
class Load:
    """Known load, whose forces are subtracted and not identified.

    Attributes:
        mass: Mass [kg], like `1.5`.
        centre_of_mass: Centre of mass in the frame of the end-effector, or of `body` [m], like
            `[0.0, 0.0, 0.05]`.
        inertia: Inertia tensor about the centre of mass [kg m²], like
            `{ xx = 1e-3, yy = 1e-3, zz = 1e-3, xy = 0.0, xz = 0.0, yz = 0.0 }`; a point mass by
            default.
        body: Name of the joint that moves the body with the load, like `"joint1"`; the end-effector
            by default.
    """

    mass: Positive
    centre_of_mass: Vector
    inertia: Annotated[np.ndarray, inertia_tensor] | None = None
    body: str | None = None

    def on(self, robot: Robot) -> Tool:
        """Return the load as a tool of a robot.

        Args:
            robot: Robot that carries it.

        Raises:
            InputError: If no joint has the name of `body`, or no such load could exist.
        """
        if self.body is None:
            loaded = robot.with_tool(
                mass=self.mass, centre_of_mass=self.centre_of_mass, inertia=self.inertia
            )
            return cast(Tool, loaded.tool)
        body = joint_number(robot, self.body)
        return Tool(body, mass=self.mass, centre_of_mass=self.centre_of_mass, inertia=self.inertia)


def joint_number(robot: Robot, name: str, key: str = "body") -> int:
    """Return the index of a joint.

    Args:
        robot: Robot with the joint.
        name: Name of the joint.
        key: Key or option that gives the name, for the message.

    Raises:
        InputError: If the robot has no such joint.
    """
    if name not in robot.joint_names:
        raise InputError(
            f"`{key}` must be the name of the joint that moves it ({joint_list(robot)}), but is "
            f'"{name}".'
        )
    return robot.joint_names.index(name)


def one_per_joint(robot: Robot, name: str, values: list | tuple) -> None:
    """Check that a list holds one value for each joint.

    Args:
        robot: Robot with the joints.
        name: Key of the list.
        values: The list.

    Raises:
        InputError: If it holds more or fewer.
    """
    if len(values) != robot.joints:
        raise InputError(
            f"`{name}` must hold one value for each of the {robot.joints} joints "
            f"({joint_list(robot)}), but holds {len(values)}."
        )


def joint_list(robot: Robot) -> str:
    """Return the names of the joints for a message; of many, the first and the last ones."""
    names = robot.joint_names
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:6])}, … {names[-1]}"


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Source of a robot, and its place on the ground; one of `urdf`, `builtin` and `dh` is needed.

    Attributes:
        urdf: Path of a URDF file, as seen from the folder of this file.
        tip: Link of the end-effector in the URDF file: only the chain from `base` to it is used,
            like `"flange"`.
        base: Link of the URDF file that stands on the ground, like `"base_link"`.
        builtin: Name of a robot that jaxid knows, like `"tx40"`: tx90l_on_rail, tx40, ur10, ur10e,
            panda, iiwa14, kr300 or planar_arm.
        dh: Denavit-Hartenberg table with one row for each joint, alpha and theta in degrees, a and
            d in metres, like `[{ alpha = -90.0, a = 0.0, d = 0.3, theta = 90.0, name = "turn" }]`;
            `slides = true` marks a prismatic joint.
        convention: Convention of `dh`: "modified" lists alpha and a of the link before each joint,
            "standard" those of the link after it.
        name: Name of the robot, like `"my robot"`.
        gravity: Gravity in the frame of the ground [m/s²], like `[0.0, 0.0, -9.81]`.
        base_rotation: Orientation of the robot on the ground: roll, pitch, yaw [deg], like
            `[0.0, 0.0, 0.0]`.
        base_position: Position of the robot on the ground [m], like `[0.0, 0.0, 0.0]`.
        snap_tolerance: Angle [rad] up to which orientations count as quarter turns, like `1e-4`.
        tool: Known load at the end-effector, whose forces are subtracted.
    """

    urdf: str | None = None
    tip: str | None = None
    base: str | None = None
    builtin: str | None = None
    dh: list[Annotated[DhRow, dh_row]] | None = None
    convention: Literal["modified", "standard"] | None = None
    name: str | None = None
    gravity: Vector | None = None
    base_rotation: Vector | None = None
    base_position: Vector | None = None
    snap_tolerance: Magnitude | None = None
    tool: Load | None = None

    def __post_init__(self) -> None:
        given = [f"`{k}`" for k in ("urdf", "builtin", "dh") if getattr(self, k) is not None]
        if len(given) != 1:
            came = " and ".join(given) or "none of them"
            raise InputError(f"one of `urdf`, `builtin` and `dh` is needed, but there is {came}.")
        for key, owner in (("tip", "urdf"), ("base", "urdf"), ("convention", "dh")):
            if getattr(self, key) is not None and getattr(self, owner) is None:
                raise InputError(f"`{key}` belongs to `{owner}`, not to {given[0]}: leave it out.")
        for key in ("gravity", "base_rotation", "base_position"):
            vector = getattr(self, key)
            if vector is not None and not np.isfinite(vector).all():
                raise InputError(f"`{key}` must hold three finite numbers, but is {vector}.")

    @property
    def placement(self) -> dict[str, Any]:
        """Position and orientation on the ground, as functions take them that make robots."""
        R = None if self.base_rotation is None else rpy_rotation(np.deg2rad(self.base_rotation))
        return {"base_rotation": R, "base_position": self.base_position or (0.0, 0.0, 0.0)}

    def build(self, folder: Path) -> Robot:
        """Return the robot.

        Args:
            folder: Folder of the experiment file, to which paths are relative.

        Raises:
            InputError: If the robot cannot be made.
        """
        robot = self._build(folder)
        if self.name is not None:
            robot = robot.replace(name=self.name)
        return robot if self.tool is None else robot.replace(tool=self.tool.on(robot))

    def _build(self, folder: Path) -> Robot:
        gravity = self.gravity or GRAVITY
        if self.urdf is not None:
            path = folder / self.urdf
            if not path.is_file():
                raise InputError(
                    f"`urdf`: `{path}` is no file: paths in an experiment file are relative to its "
                    "folder; mend the path, or put the file there."
                )
            return load_urdf(path, gravity=gravity, **self._chain, **self.placement)
        if self.dh is not None:
            return self._from_dh(self.dh, gravity)
        if self.builtin not in BUILTIN:
            raise InputError(f'`builtin` must be {quoted(BUILTIN)}, but is "{self.builtin}".')
        if self.snap_tolerance is not None:
            raise InputError("`snap_tolerance`: the robot's angles are exact: leave it out.")
        robot = BUILTIN[self.builtin]()
        if self.gravity is not None:
            robot = robot.replace(gravity=np.array(self.gravity))
        return robot.mounted(*self.placement.values())

    @property
    def _chain(self) -> dict[str, Any]:
        tolerance = SNAP_TOLERANCE if self.snap_tolerance is None else self.snap_tolerance
        return {"tip": self.tip, "base": self.base, "snap_tolerance": tolerance}

    def _from_dh(self, rows: list[DhRow], gravity: Vector) -> Robot:
        if self.convention is None:
            raise InputError(
                '`convention` is needed with `dh`: "modified" lists alpha and a of the link before '
                'each joint, "standard" those of the link after it.'
            )
        return from_dh(
            [numbers for _, _, numbers in rows],
            convention=self.convention,
            name=self.name or "robot",
            revolute=tuple(not slides for _, slides, _ in rows),
            joint_names=tuple(name or f"joint{i + 1}" for i, (name, _, _) in enumerate(rows)),
            gravity=gravity,
            snap_tolerance=self._chain["snap_tolerance"],
            source="Denavit-Hartenberg table of the experiment file",
            **self.placement,
        )

    def parameters(self, folder: Path) -> Float[np.ndarray, "bodies 10"] | None:
        """Return the bodies' parameters that the URDF file claims; None if there is no such file.

        Args:
            folder: Folder of the experiment file.

        Raises:
            InputError: If the file describes a body that cannot exist.
        """
        if self.urdf is None:
            return None
        return np.asarray(urdf_parameters(folder / self.urdf, **self._chain)).reshape(-1, 10)

    def capsules(self, folder: Path, packages: str | None) -> tuple[Capsule, ...]:
        """Return capsules around the geometry of the URDF file's links.

        Args:
            folder: Folder of the experiment file.
            packages: Folder of what the URDF file calls `package://`, as seen from there.
        """
        where = None if packages is None else folder / packages
        path = folder / cast(str, self.urdf)
        return tuple(fit_capsules(path, packages=where, **self._chain, **self.placement))


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
    """Limits of the joints, one number for each: inf for none, nan for what the robot says.

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
    given = {
        "position_min": position_min,
        "position_max": position_max,
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
        "force": force,
    }
    degrees = np.where(np.array(robot.revolute) & (angle_unit == "deg"), np.pi / 180, 1.0)
    fields, told = {}, []
    for name, values in given.items():
        known = fields[name] = np.asarray(getattr(robot.limits, name))
        if values is None:
            continue
        one_per_joint(robot, name, values)
        new = np.array(values) * (1.0 if name == "force" else degrees)
        told += [f"{name} of {j}" for j, x in zip(robot.joint_names, new, strict=True) if x == x]
        fields[name] = np.where(np.isnan(new), known, new)
        if not np.isnan(new).any():
            told.append(name)
    _check_forces(fields["force"])
    _check_ranges(robot, fields)
    assumed = tuple(name for name in robot.limits.assumed if name not in told)
    limits = Limits(robot.joints, **fields, assumed=assumed)
    notes = _doubts(robot, limits, position_min or position_max, velocity and angle_unit == "rad")
    return robot.replace(limits=limits, notes=(*robot.notes, *notes))


def _check_forces(forces: np.ndarray) -> None:
    """Reject forces that no joint of a robot has, so that weights stay finite."""
    if ((forces > 0) & (forces < 1e-9)).any() or (np.isfinite(forces) & (forces >= 1e9)).any():
        raise InputError(f"`force` must lie between 1e-9 and 1e9 N m or N, but is {forces}.")


def _check_ranges(robot: Robot, fields: dict[str, np.ndarray]) -> None:
    for j, name in enumerate(robot.joint_names):
        low, high = fields["position_min"][j], fields["position_max"][j]
        if why := range_fault(low, high, robot.revolute[j]):
            cure = "give the limits in metres, inf for none"
            if robot.revolute[j]:
                cure = 'for degrees add `angle_unit = "deg"`, and inf means no limit'
            raise InputError(f"joint `{name}` {why}: {cure}.")


def _doubts(robot: Robot, limits: Limits, ranges: Any, speeds: Any) -> Iterator[str]:
    """Name limits of the file that look as if they were in other units."""
    for j, name in enumerate(robot.joint_names):
        ends = (float(limits.position_min[j]), float(limits.position_max[j]))
        if ranges and not robot.revolute[j]:
            yield from far_notes(f"joint `{name}`: an end of its range", ends)
        if speeds:
            yield from fast_notes(name, float(limits.velocity[j]), robot.revolute[j])


def replace_drives(
    robot: Robot,
    *,
    gear_ratios: PerJoint | None = None,
    matrix: list[PerJoint] | None = None,
    zero: PerJoint | None = None,
    angle_unit: AngleUnit = "rad",
    max_torques: list[Positive] | None = None,
    rotor_inertia: list[Magnitude] | None = None,
) -> Robot:
    """Motors and gears, needed for logs on the motors' side.

    Args:
        robot: Robot without these drives.
        gear_ratios: Ratio of motor to joint speed [1; rad/m for a prismatic joint].
        matrix: Rows with the ratios of each motor to all joints, instead of `gear_ratios`, like
            `[[50.0, 0.0], [50.0, 50.0]]`.
        zero: Joint angles at which the motors' angles are zero [rad or m], like `0.0`.
        angle_unit: Unit of `zero`: "rad" or "deg".
        max_torques: Largest torques of the motors, before the gears [N m].
        rotor_inertia: Inertias of the rotors, before the gears [kg m²], like `1e-4`; shown, not
            used.

    Raises:
        InputError: If a list has another length, or the ratios cannot be inverted.
    """
    if gear_ratios is not None and matrix is not None:
        raise InputError("give `gear_ratios` or `matrix`, but not both.")
    lists = {
        "gear_ratios": gear_ratios,
        "matrix": matrix,
        "zero": zero,
        "max_torques": max_torques,
        "rotor_inertia": rotor_inertia,
    }
    for name, values in lists.items():
        if values is None:
            continue
        one_per_joint(robot, name, values)
        if name in ("gear_ratios", "zero") and not np.isfinite(values).all():
            raise InputError(f"`{name}` must hold finite numbers, but is {values}.")
    if matrix is not None and {len(row) for row in matrix} != {robot.joints}:
        raise InputError(f"`matrix` must hold {robot.joints} numbers in each row.")
    turns = np.array(robot.revolute) & (angle_unit == "deg")
    new = {
        "reduction": gear_ratios or matrix,
        "zero": None if zero is None else np.array(zero) * np.where(turns, np.pi / 180, 1.0),
        "max_torques": max_torques,
        "rotor_inertia": rotor_inertia,
    }
    given = {name: value for name, value in new.items() if value is not None}
    return robot.replace(drives=dataclasses.replace(robot.drives, **given))
