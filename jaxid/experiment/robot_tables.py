"""The tables `[robot]`, `[limits]`, `[drives]` and `[load]` of an experiment file."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.robot import library
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.library import from_dh
from jaxid.robot.limits_and_drives import Limits, per_joint, range_fault
from jaxid.robot.robot import Robot, Tool
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.urdf import joint_parameters, load_urdf, urdf_parameters

from .decoder import Finite, Magnitude, PerJoint, Positive, Vector

AngleUnit = Literal["rad", "deg"]
DhRow = tuple[str | None, bool, tuple[float, float, float, float]]


def dh_row(
    *,
    alpha: float = 0.0,
    a: float = 0.0,
    d: float = 0.0,
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


def known_load(
    *,
    mass: Positive,
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


def joint_number(robot: Robot, name: str, key: str = "body") -> int:
    """Return the index of the joint that a key or an option names."""
    if name not in robot.joint_names:
        raise InputError(
            f"`{key}` must be the name of the joint that moves it "
            f'({", ".join(robot.joint_names)}), but is "{name}".'
        )
    return robot.joint_names.index(name)


@dataclasses.dataclass(frozen=True)
class RobotSource:
    """Place of a robot, and its source: one of `urdf`, `mjcf`, `builtin` and `dh` is needed.

    Attributes:
        urdf: Path of a URDF or xacro file, as seen from the folder of this file.
        mjcf: Path of an MJCF file, which MuJoCo compiles, like `"arm.xml"`.
        tip: Link (body or site) of the end-effector in the URDF (MJCF) file: only the
            chain from `base` to it is used, like `"flange"`.
        base: Link (body) of that file that stands on the ground, like `"base_link"`.
        builtin: Name of a robot that jaxid knows, like `"tx40"`: tx90l_on_rail, tx40,
            ur10, ur10e, panda, iiwa14, kr300 or planar_arm.
        dh: Denavit-Hartenberg table with one row for each joint, alpha and theta in
            degrees, a and d in metres, like `[{ alpha = -90.0, a = 0.0, d = 0.3, theta
            = 90.0, name = "turn" }]`; `slides = true` marks a prismatic joint.
        convention: Convention of `dh`: "modified" lists alpha and a of the link before
            each joint, "standard" those of the link after it.
        name: Name of the robot, like `"my robot"`.
        gravity: Gravity in the frame of the ground [m/s²], like `[0.0, 0.0, -9.81]`.
        base_rotation: Orientation of the robot on the ground: roll, pitch, yaw [deg],
            like `[0.0, 0.0, 0.0]`.
        base_position: Position of the robot on the ground [m], like `[0.0, 0.0, 0.0]`.
        snap_tolerance: Angle [rad] up to which the robot's axes are taken for parallel
            or perpendicular, like `1e-3` for a file with 1.571 instead of pi/2.
        tool: Known load at the end-effector, whose forces are subtracted.
    """

    urdf: str | None = None
    mjcf: str | None = None
    tip: str | None = None
    base: str | None = None
    builtin: (
        Literal[
            "tx90l_on_rail",
            "tx40",
            "ur10",
            "ur10e",
            "panda",
            "iiwa14",
            "kr300",
            "planar_arm",
        ]
        | None
    ) = None
    dh: list[Annotated[DhRow, dh_row]] | None = None
    convention: Literal["modified", "standard"] | None = None
    name: str | None = None
    gravity: Vector | None = None
    base_rotation: Vector | None = None
    base_position: Vector | None = None
    snap_tolerance: Magnitude | None = None
    tool: Annotated[Callable[[Robot], Tool | float], known_load] | None = None

    def __post_init__(self) -> None:
        given = [
            k for k in ("urdf", "mjcf", "builtin", "dh") if getattr(self, k) is not None
        ]
        if len(given) != 1:
            came = " and ".join(f"`{k}`" for k in given) or "none of them"
            raise InputError(
                "one of `urdf`, `mjcf`, `builtin` and `dh` is needed, but there is "
                f"{came}."
            )
        owners = {
            "tip": ("urdf", "mjcf"),
            "base": ("urdf", "mjcf"),
            "convention": ("dh",),
        }
        for key, owner in owners.items():
            if getattr(self, key) is not None and given[0] not in owner:
                raise InputError(
                    f"`{key}` belongs to `{owner[0]}`, not to `{given[0]}`: remove it."
                )

    @property
    def placement(self) -> dict[str, Any]:
        """Position and orientation on the ground, as functions take them that make robots."""
        R = (
            None
            if self.base_rotation is None
            else rpy_rotation(np.deg2rad(self.base_rotation))
        )
        return {
            "base_rotation": R,
            "base_position": self.base_position or (0.0, 0.0, 0.0),
        }

    @property
    def chain(self) -> dict[str, Any]:
        """Chain in the URDF or MJCF file."""
        return {"tip": self.tip, "base": self.base}

    @property
    def file(self) -> str | None:
        """Path of the URDF or MJCF file."""
        return self.mjcf if self.urdf is None else self.urdf

    def build(self, folder: Path) -> Robot:
        """Return the robot; paths are relative to the folder of the experiment file."""
        if self.file is not None:
            path, key = folder / self.file, "mjcf" if self.urdf is None else "urdf"
            if not path.is_file():
                raise InputError(
                    f"`{key}`: `{path}` is no file: paths are relative to this file."
                )
            robot = load_urdf(path, **self.chain, **self.placement)
        elif self.dh is not None:
            robot = from_dh(
                [numbers for _, _, numbers in self.dh],
                convention=self.convention or "",
                revolute=tuple(not slides for _, slides, _ in self.dh),
                joint_names=tuple(
                    name or f"joint{i}" for i, (name, *_) in enumerate(self.dh, 1)
                ),
                source="Denavit-Hartenberg table of the experiment file",
                **self.placement,
            )
        else:
            robot = getattr(library, cast(str, self.builtin))().mounted(
                *self.placement.values()
            )
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

    def parameters(self, folder: Path) -> Float[np.ndarray, "bodies 10"] | None:
        """Return the bodies' parameters that the robot's file claims; None if there is none.

        Raises:
            InputError: If the file describes a body that cannot exist.
        """
        if self.file is None:
            return None
        return np.asarray(urdf_parameters(folder / self.file, **self.chain)).reshape(
            -1, 10
        )

    def claims(self, folder: Path) -> dict[str, float]:
        """Return all that the robot's file claims, by names in a model; nothing without bodies.

        Raises:
            InputError: If the file describes a body that cannot exist.
        """
        bodies = self.parameters(folder)
        if bodies is None or not np.any(bodies):
            return {}
        return named(bodies) | self.joint_parameters(folder)

    def joint_parameters(self, folder: Path) -> dict[str, float]:
        """Return rotor inertias and friction that the file claims, by their names in a model."""
        if self.file is None:
            return {}
        claimed = joint_parameters(folder / self.file, **self.chain)
        rows = zip(("Ia", "fv", "fc"), claimed.values(), strict=True)
        return {
            f"{k}{j}": float(x)
            for k, row in rows
            for j, x in enumerate(row, 1)
            if x > 0.0
        }


def named(bodies: Float[np.ndarray, "bodies 10"]) -> dict[str, float]:
    """Return the parameters of bodies by their names in a model."""
    names = (f"{name}{k + 1}" for k in range(len(bodies)) for name in INERTIAL_NAMES)
    return dict(zip(names, bodies.ravel().tolist(), strict=True))


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
    }
    given |= {"acceleration": acceleration, "jerk": jerk, "force": force}
    fields, told = {}, []
    for name, values in given.items():
        new = per_joint(name, values, robot.joints, np.nan)
        new = new if name == "force" else new * _angle_scale(robot, angle_unit)
        known = np.isnan(new)
        fields[name] = np.where(known, getattr(robot.limits, name), new)
        told += [
            f"{name} of {j}"
            for j, k in zip(robot.joint_names, known, strict=True)
            if not k
        ]
        told += [] if known.any() else [name]
    # Forces that no joint has would make weights infinite.
    most = np.asarray(fields["force"])
    if ((most > 0) & (most < 1e-9)).any() or (np.isfinite(most) & (most >= 1e9)).any():
        raise InputError(
            f"`force` must lie between 1e-9 and 1e9 N m or N, but is {most}."
        )
    for j, name in enumerate(robot.joint_names):
        low, high = fields["position_min"][j], fields["position_max"][j]
        if why := range_fault(low, high, robot.revolute[j]):
            cure = "give the limits in metres, inf for none"
            if robot.revolute[j]:
                cure = 'for degrees add `angle_unit = "deg"`, and inf means no limit'
            raise InputError(f"joint `{name}` {why}: {cure}.")
    assumed = tuple(name for name in robot.limits.assumed if name not in told)
    limits = Limits(robot.joints, **fields, assumed=assumed)
    return robot.replace(limits=limits)


def _angle_scale(robot: Robot, unit: AngleUnit) -> np.ndarray:
    return np.where(np.array(robot.revolute) & (unit == "deg"), np.pi / 180, 1.0)


def replace_drives(
    robot: Robot,
    *,
    gear_ratios: list[Finite] | None = None,
    matrix: list[PerJoint] | None = None,
    zero: list[Finite] | None = None,
    angle_unit: AngleUnit = "rad",
    max_torques: list[Positive] | None = None,
    rotor_inertia: list[Magnitude] | None = None,
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
        rotor_inertia: Inertias of the rotors, before the gears [kg m²], like `1e-4`;
            shown, not used.

    Raises:
        InputError: If a list has another length, or the ratios cannot be inverted.
    """
    if gear_ratios is not None and matrix is not None:
        raise InputError("give `gear_ratios` or `matrix`, but not both.")
    n = robot.joints
    if matrix is not None and {len(matrix), *map(len, matrix)} != {n}:
        raise InputError(f"`matrix` must hold {n} rows of {n} numbers.")
    new: dict[str, Any] = {"max_torques": max_torques, "rotor_inertia": rotor_inertia}
    new["reduction"] = matrix
    if gear_ratios is not None:
        new["reduction"] = per_joint("gear_ratios", gear_ratios, n, 1.0)
    if zero is not None:
        new["zero"] = per_joint("zero", zero, n, 0.0) * _angle_scale(robot, angle_unit)
    given = {name: value for name, value in new.items() if value is not None}
    return robot.replace(drives=dataclasses.replace(robot.drives, **given))
