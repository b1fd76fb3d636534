"""The tables `[robot]`, `[limits]` and `[drives]` become a robot."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import equinox as eqx
import numpy as np

from jaxid.errors import InputError
from jaxid.experiment.tables import (
    DhRow,
    DrivesTable,
    LimitsTable,
    RobotTable,
    Tables,
    ToolTable,
)
from jaxid.robot import library
from jaxid.robot.dh import from_dh
from jaxid.robot.drives import Drives
from jaxid.robot.kinematics import rpy_rotation
from jaxid.robot.limits import Limits
from jaxid.robot.plausibility import SNAP_TOLERANCE, far_notes, fast_notes, range_fault
from jaxid.robot.robot import GRAVITY, Robot, Tool
from jaxid.robot.urdf import load_urdf

BUILTIN = {
    "tx90l_on_rail": library.tx90l_on_rail,
    "tx40": library.tx40,
    "ur10": library.ur10,
    "ur10e": library.ur10e,
    "panda": library.panda,
    "iiwa14": library.iiwa14,
    "kr300": library.kr300,
    "planar_arm": library.planar_arm,
}
SMALLEST, LARGEST = 1e-9, 1e9
"""Forces that no joint of a robot is below or above [N m or N]: weights stay numbers."""
LIMIT_FIELDS = ("position_min", "position_max", "velocity", "acceleration", "jerk", "force")


@contextmanager
def within(file: str, table: str) -> Iterator[None]:
    """Says of an error from a deeper layer which table of which file it comes from."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        raise InputError(f"{file}: `{table}`: {error}") from error


def build_robot(tables: Tables, path: Path) -> Robot:
    """Makes the robot of an experiment file.

    Args:
        tables: The file's.
        path: Of the file: other paths are relative to its folder.

    Raises:
        InputError: If the robot cannot be made; the message names file and table.
    """
    file, table = path.name, tables.robot
    robot = _source(table, path)
    if table.name is not None and table.dh is None:
        robot = robot.replace(name=table.name)
    if table.tool is not None:
        with within(file, "robot.tool"):
            robot = robot.replace(tool=build_load(robot, table.tool))
    if tables.limits is not None:
        with within(file, "limits"):
            limits = _limits(robot, tables.limits)
        said = _limit_notes(robot, tables.limits, limits)
        robot = robot.replace(limits=limits, notes=(*robot.notes, *said))
    if tables.drives is not None:
        with within(file, "drives"):
            robot = robot.replace(drives=_drives(robot, tables.drives))
    return robot


def each(robot: Robot, name: str, values: list | None) -> list | None:
    """The values themselves, if there is one for each joint.

    Raises:
        InputError: If there are more or fewer.
    """
    if values is not None and len(values) != robot.joints:
        raise InputError(
            f"`{name}` must hold one value for each of the {robot.joints} joints "
            f"({_shown(robot.joint_names)}), but holds {len(values)}."
        )
    return values


def _shown(names: tuple[str, ...]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:6])}, … {names[-1]}"


def _source(table: RobotTable, path: Path) -> Robot:
    given = [k for k in ("urdf", "builtin", "dh") if getattr(table, k) is not None]
    if len(given) != 1:
        came = " and ".join(f"`{k}`" for k in given) if given else "none of them"
        raise InputError(
            f"{path.name}: `robot` needs one of `urdf`, `builtin` and `dh`, but has {came}."
        )
    for key, owner in (("tip", "urdf"), ("base", "urdf"), ("convention", "dh")):
        if getattr(table, key) is not None and given[0] != owner:
            raise InputError(
                f"{path.name}: `robot.{key}` belongs to `{owner}` and means nothing for "
                f"`{given[0]}`: leave it out."
            )
    for key in ("gravity", "base_rotation", "base_position"):
        if getattr(table, key) is not None and not np.isfinite(getattr(table, key)).all():
            raise InputError(f"{path.name}: `robot.{key}` must hold three finite numbers.")
    gravity = GRAVITY if table.gravity is None else table.gravity
    R = None if table.base_rotation is None else rpy_rotation(np.deg2rad(table.base_rotation))
    position = (0.0, 0.0, 0.0) if table.base_position is None else table.base_position
    tolerance = SNAP_TOLERANCE if table.snap_tolerance is None else table.snap_tolerance
    with within(path.name, f"robot.{given[0]}"):
        if table.urdf is not None:
            if not (path.parent / table.urdf).is_file():
                raise InputError(
                    f"`{path.parent / table.urdf}` is no file: paths in an experiment file are "
                    "relative to its folder; mend the path, or put the file there."
                )
            return load_urdf(
                path.parent / table.urdf,
                tip=table.tip,
                base=table.base,
                gravity=gravity,
                base_rotation=R,
                base_position=position,
                snap_tolerance=tolerance,
            )
        if table.dh is not None:
            return _from_rows(table, table.dh, R, position, tolerance)
        if table.builtin not in BUILTIN:
            raise InputError(f'"{table.builtin}" is none of the robots {", ".join(BUILTIN)}.')
        if table.snap_tolerance is not None:
            raise InputError("its angles are exact: leave out `robot.snap_tolerance`.")
        robot = BUILTIN[table.builtin]()
        if table.gravity is not None:
            robot = robot.replace(gravity=np.array(table.gravity))
        return robot.mounted(R, position)


def _from_rows(table: RobotTable, rows: list[DhRow], R, position, tolerance: float) -> Robot:
    if table.convention is None:
        raise InputError(
            'a table needs `robot.convention`: "modified" lists alpha and a of the link before '
            'each joint, "standard" those of the link after it.'
        )
    names = tuple(row.name or f"joint{i + 1}" for i, row in enumerate(rows))
    return from_dh(
        [(np.deg2rad(r.alpha), r.a, r.d, np.deg2rad(r.theta)) for r in rows],
        convention=table.convention,
        name=table.name or "robot",
        revolute=tuple(not row.slides for row in rows),
        joint_names=names,
        base_rotation=R,
        base_position=position,
        gravity=GRAVITY if table.gravity is None else table.gravity,
        snap_tolerance=tolerance,
        source="Denavit-Hartenberg table of the experiment file",
    )


def build_load(robot: Robot, table: ToolTable) -> Tool:
    """A known load, in the frame of the body that carries it.

    Raises:
        InputError: If no joint has the name that is given, or no such load could exist.
    """
    J = None
    if table.inertia is not None:
        i = table.inertia
        J = [[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]]
    if table.body is None:
        loaded = robot.with_tool(mass=table.mass, centre_of_mass=table.centre_of_mass, inertia=J)
        return cast(Tool, loaded.tool)
    if table.body not in robot.joint_names:
        raise InputError(
            f"`body` must be the name of the joint that moves it ({_shown(robot.joint_names)}), "
            f'but is "{table.body}".'
        )
    body = robot.joint_names.index(table.body)
    return Tool(body, mass=table.mass, centre_of_mass=table.centre_of_mass, inertia=J)


def _limits(robot: Robot, table: LimitsTable) -> Limits:
    degrees = np.where(np.array(robot.revolute) & (table.angle_unit == "deg"), np.pi / 180, 1.0)
    fields, said = {}, []
    for name in LIMIT_FIELDS:
        known = np.asarray(getattr(robot.limits, name))
        values = each(robot, name, getattr(table, name))
        if values is not None:
            given = np.array(values) * (1.0 if name == "force" else degrees)
            if name == "force" and (np.isfinite(given) & ~(np.abs(given) < LARGEST)).any():
                raise InputError(f"`force` must be below {LARGEST:g} N m or N, but is {values}.")
            if name == "force" and ((given > 0) & (given < SMALLEST)).any():
                raise InputError(f"`force` must be above {SMALLEST:g} N m or N, but is {values}.")
            # In the file, nan stands for a number that the robot's source knows better.
            said += [
                f"{name} of {j}" for j, x in zip(robot.joint_names, given, strict=True) if x == x
            ]
            known = np.where(np.isnan(given), known, given)
            if not np.isnan(given).any():
                said.append(name)
        fields[name] = known
    for j, name in enumerate(robot.joint_names):
        low, high = fields["position_min"][j], fields["position_max"][j]
        if why := range_fault(low, high, robot.revolute[j]):
            cure = "give the limits in metres, inf for none"
            if robot.revolute[j]:
                cure = 'for degrees add `angle_unit = "deg"`, and inf means no limit'
            raise InputError(f"joint `{name}` {why}: {cure}.")
    assumed = tuple(what for what in robot.limits.assumed if what not in said)
    return Limits(robot.joints, **fields, assumed=assumed)


def _limit_notes(robot: Robot, table: LimitsTable, limits: Limits) -> Iterator[str]:
    """Sentences about limits of the file that exist, but look as if they were in other units."""
    for j, name in enumerate(robot.joint_names):
        ends = (float(limits.position_min[j]), float(limits.position_max[j]))
        given = table.position_min is not None or table.position_max is not None
        if given and not robot.revolute[j]:
            yield from far_notes(f"joint `{name}`: an end of its range", ends)
        if table.velocity is not None and table.angle_unit == "rad":
            yield from fast_notes(name, float(limits.velocity[j]), robot.revolute[j])


def _drives(robot: Robot, table: DrivesTable) -> Drives:
    n, drives = robot.joints, robot.drives
    if table.gear_ratios is not None and table.matrix is not None:
        raise InputError("give `gear_ratios` or `matrix`, but not both.")
    reduction = drives.reduction
    if table.gear_ratios is not None:
        reduction = each(robot, "gear_ratios", table.gear_ratios)
        if not np.isfinite(np.array(table.gear_ratios)).all():
            raise InputError(f"`gear_ratios` must be finite numbers, but are {table.gear_ratios}.")
    if table.matrix is not None:
        widths = {len(row) for row in table.matrix}
        if len(table.matrix) != n or widths != {n}:
            raise InputError(f"`matrix` must hold {n} rows of {n} numbers, one for each joint.")
        reduction = table.matrix
    zero = drives.zero
    if each(robot, "zero", table.zero) is not None:
        turns = np.array(robot.revolute) & (table.angle_unit == "deg")
        if not np.isfinite(np.array(table.zero)).all():
            raise InputError(f"`zero` must hold finite numbers, but is {table.zero}.")
        zero = np.array(table.zero) * np.where(turns, np.pi / 180, 1.0)
    torques = each(robot, "max_torques", table.max_torques)
    inertia = each(robot, "rotor_inertia", table.rotor_inertia)
    fresh = Drives(n, reduction=reduction, zero=zero, max_torques=torques, rotor_inertia=inertia)
    if torques is None:
        fresh = eqx.tree_at(lambda d: d.max_torques, fresh, drives.max_torques)
    if inertia is None:
        fresh = eqx.tree_at(lambda d: d.rotor_inertia, fresh, drives.rotor_inertia)
    return fresh
