"""Virtual joints: rows of the equations of motion for the forces between two bodies.

A group of six joints, three that slide along x, y, z and three that turn about these
axes, stands between two bodies, or between the ground and a body. Nothing drives them,
and their coordinates are zero. Their forces are the force [N] and the moment [N m] that
the first body exerts on the second one, along the axes of the second one and about its
origin. The first five bodies of a group have no mass.
"""

import dataclasses
from typing import Any

import numpy as np
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]

from jaxid.arrays import AnyArray, Indices, Matrix3, Vector3
from jaxid.errors import InputError

from .limits_and_drives import of_joints

GROUP = 6
"""Number of joints of a group."""
FORCE_NAMES = ("fx", "fy", "fz", "mx", "my", "mz")
"""Endings of the names of a group's joints: forces along, moments about the axes."""


def frames_between(virtual: Indices) -> set[int]:
    """Return the indices of the bodies between two virtual joints of a group."""
    return {*virtual} - {*virtual[GROUP - 1 :: GROUP]}


def solid_bodies(robot: Any) -> Indices:
    """Return the indices of the bodies that have a mass.

    A base on a sensor does not move: its gravity is a part of the sensor's bias.
    """
    massless = frames_between(robot.virtual)
    if robot.has_base_sensor:
        massless.add(GROUP - 1)
    return tuple(i for i in range(robot.bodies) if i not in massless)


def numbers_of_bodies(bodies: int, virtual: Indices) -> Indices:
    """Return for each body the number in names of parameters.

    Driven joints and their bodies have the numbers 1, 2, …; a base before them has the
    number 0, and bodies behind sensors have the numbers after those of all others.
    """
    driven = [body for body in range(bodies) if body not in virtual]
    numbers = {body: number for number, body in enumerate(driven, 1)}
    next_number = len(driven) + 1
    for start in range(0, len(virtual), GROUP):
        group = virtual[start : start + GROUP]
        is_base = group[0] == 0
        numbers.update(dict.fromkeys(group, 0 if is_base else next_number))
        next_number += not is_base
    return tuple(numbers[body] for body in range(bodies))


def virtual_elements(base: str, ground: str) -> list[tuple[Any, Any]]:
    """Return the elements of six virtual joints of a URDF, each with the link below."""
    elements = []
    parent = ground
    for number, ending in enumerate(FORCE_NAMES):
        name = f"{base} {ending}"
        child = base if number == GROUP - 1 else f"{name} frame"
        axis = np.roll(["1", "0", "0"], number)
        joint = E.joint(
            E.parent(link=parent),
            E.child(link=child),
            E.axis(xyz=" ".join(axis)),
            name=name,
            type="prismatic" if number < GROUP // 2 else "continuous",
        )
        elements.append((joint, E.link(name=child)))
        parent = child
    return elements


def on_virtual_joints(robot: Any, name: str, *, floating: bool) -> Any:
    """Return the robot with a base body between the ground and its first bodies.

    Args:
        robot: Robot whose bodies on the ground stand on the base.
        name: Name of the base.
        floating: Whether the base moves freely. Its acceleration is then measured by an
            IMU, which measures gravity too: gravity of the robot is zero.

    Raises:
        InputError: If the robot stands on virtual joints already.
    """
    _refuse_second_base(robot)
    at_origin = with_group(robot, name, 0, -1, np.eye(3), np.zeros(3))
    return at_origin.replace(
        gravity=np.zeros(3) if floating else robot.gravity, floating=floating
    )


def _refuse_second_base(robot: Any) -> None:
    """Refuse a robot that stands on virtual joints already."""
    if robot.virtual[:1] == (0,):
        raise InputError(f"`{robot.name}` has a base that floats or is measured.")


def with_group(
    robot: Any,
    name: str,
    start: int,
    carrier: int,
    rotation: Matrix3,
    position: Vector3,
) -> Any:
    """Return the robot with six virtual joints, and the body behind them.

    Args:
        robot: The robot.
        name: Name of the body.
        start: Index of the first virtual joint: 0 to carry all bodies on the ground, or
            the number of joints.
        carrier: Index of the body that carries the joints; -1 for the ground.
        rotation: Attitude of the joints in the carrier.
        position: Origin of the joints in the carrier [m].
    """

    def moved(body: int) -> int:
        return body + GROUP if body >= start else body

    def inserted(values: Any, group: Any) -> Any:
        return [*values[:start], *group, *values[start:]]

    if robot.loops:
        raise InputError(
            f"`{robot.name}` has closed loops: sensors and bases on them are not "
            "described."
        )
    # What stood on the ground stands on the base.
    parents = [moved(body) for body in robot.parent]
    if carrier < 0:
        parents = [GROUP - 1 if body < 0 else body for body in parents]
    group = range(start, start + GROUP)
    names = [f"{name} {ending}" for ending in FORCE_NAMES]
    followers = [
        dataclasses.replace(x, leader=moved(x.leader)) for x in robot.followers
    ]
    tool = robot.tool
    if tool is not None:
        tool = dataclasses.replace(tool, body=moved(tool.body))
    padding = (GROUP, 0) if start == 0 else (0, GROUP)
    rotations = [rotation, *np.tile(np.eye(3), (GROUP - 1, 1, 1))]
    offsets = [position, *np.zeros((GROUP - 1, 3))]
    return robot.replace(
        joint_names=tuple(inserted(robot.joint_names, names)),
        parent=tuple(inserted(parents, [carrier, *group[:-1]])),
        followers=tuple(followers),
        revolute=tuple(inserted(robot.revolute, np.arange(GROUP) >= 3)),
        axis=np.array(inserted(robot.axis, np.tile(np.eye(3), (2, 1)))),
        rotation=np.array(inserted(robot.rotation, rotations)),
        offset=np.array(inserted(robot.offset, offsets)),
        limits=padded(robot.limits, *padding),
        drives=padded(robot.drives, *padding),
        tool=tool,
        tip_body=moved(robot.tip_body),
        virtual=tuple(sorted([*map(moved, robot.virtual), *group])),
    )


def with_sensor(
    robot: Any, rotation: Matrix3, position: Vector3, *, under_base: bool
) -> Any:
    """Return the robot with a six-axis force sensor, as `Robot.with_sensor` does."""
    if under_base:
        _refuse_second_base(robot)
        # What stands on the ground stands in the frame of the sensor.
        on_sensor = robot.mounted(rotation.T, -rotation.T @ position)
        return with_group(on_sensor, "base", 0, -1, rotation, position)
    if robot.sensor_bodies[-1:] == (robot.tip_body,):
        raise InputError(f"`{robot.name}` has a sensor at its end-effector already.")
    attitude = robot.tip_rotation @ rotation
    origin = robot.tip_offset + robot.tip_rotation @ position
    start = robot.joints
    behind = with_group(robot, "sensor", start, robot.tip_body, attitude, origin)
    return behind.replace(
        tip_body=start + GROUP - 1,
        tip_rotation=rotation.T,
        tip_offset=-rotation.T @ position,
    )


def padded(owner: Any, before: int, after: int) -> Any:
    """Return limits or drives with entries for virtual joints, at either end."""
    fields = {}
    joints = 0
    for field in dataclasses.fields(owner):
        values = getattr(owner, field.name, None)
        if not isinstance(values, np.ndarray):
            continue
        is_matrix = values.ndim == 2
        unknown = UNKNOWN.get(field.name, np.inf)
        joints = len(values) + before + after
        fields[field.name] = np.pad(
            values, (before, after), constant_values=0.0 if is_matrix else unknown
        )
        if is_matrix:
            virtual = [*range(before), *range(joints - after, joints)]
            fields[field.name][virtual, virtual] = 1.0
    return dataclasses.replace(owner, joints=joints, **fields)


def driven_robot(robot: Any) -> Any:
    """Return the driven joints as a robot of their own, for what logs hold of them."""
    if not robot.virtual:
        return robot
    joints = list(robot.driven)
    return robot.replace(
        joint_names=tuple(robot.joint_names[i] for i in joints),
        parent=None,
        followers=(),
        revolute=tuple(robot.revolute[i] for i in joints),
        axis=robot.axis[joints],
        rotation=robot.rotation[joints],
        offset=robot.offset[joints],
        limits=of_joints(robot.limits, joints),
        drives=of_joints(robot.drives, joints),
        tool=None,
        tip_body=None,
        virtual=(),
        floating=False,
        contacts=(),
    )


def on_all_joints(
    robot: Any, values: AnyArray, virtual_value: float = 0.0
) -> np.ndarray:
    """Return values of all joints [*batch joints], from those of the driven ones."""
    shape = (*np.shape(values)[:-1], robot.joints)
    all_values = np.full(shape, virtual_value, float)
    all_values[..., list(robot.driven)] = values
    return all_values


def with_moving_base(robot: Any) -> Any:
    """Return a robot whose floating base moves on joints like any others.

    Coordinates of the base are its position on the ground, then its turns about x, y
    and z in a row.
    """
    return robot.replace(virtual=(), floating=False, contacts=())


def with_driven(robot: Any, joints: Any) -> Any:
    """Return the robot with the limits and drives of its driven joints replaced."""
    if not robot.virtual:
        return joints
    before = len([i for i in robot.virtual if i < robot.driven[0]])
    after = len(robot.virtual) - before
    return robot.replace(
        limits=padded(joints.limits, before, after),
        drives=padded(joints.drives, before, after),
    )


UNKNOWN = {
    "position_min": -np.inf,
    "zero": 0.0,
    "rotor_inertia": np.nan,
    "stated_ratios": 1.0,
}
"""Entries of limits and drives of which nothing is known; all others are infinite."""
