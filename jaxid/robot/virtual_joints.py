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

from jaxid.errors import InputError

GROUP = 6
"""Number of joints of a group."""
FORCE_NAMES = ("fx", "fy", "fz", "mx", "my", "mz")
"""Endings of the names of a group's joints: forces along, moments about the axes."""


def numbers_of_bodies(bodies: int, virtual: tuple[int, ...]) -> tuple[int, ...]:
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
    if robot.virtual[:1] == (0,):
        raise InputError(f"`{robot.name}` has a base that floats or is measured.")
    followers = tuple(
        dataclasses.replace(x, leader=x.leader + GROUP) for x in robot.followers
    )
    tool = robot.tool
    if tool is not None:
        tool = dataclasses.replace(tool, body=tool.body + GROUP)
    names = tuple(f"{name} {ending}" for ending in FORCE_NAMES)
    eyes = np.broadcast_to(np.eye(3), (GROUP, 3, 3))
    return robot.replace(
        joint_names=(*names, *robot.joint_names),
        parent=(*range(-1, GROUP - 1), *(parent + GROUP for parent in robot.parent)),
        followers=followers,
        revolute=(False, False, False, True, True, True, *robot.revolute),
        axis=np.concatenate([np.tile(np.eye(3), (2, 1)), robot.axis]),
        rotation=np.concatenate([eyes, robot.rotation]),
        offset=np.concatenate([np.zeros((GROUP, 3)), robot.offset]),
        gravity=np.zeros(3) if floating else robot.gravity,
        limits=padded(robot.limits, GROUP, 0),
        drives=padded(robot.drives, GROUP, 0),
        tool=tool,
        tip_body=robot.tip_body + GROUP,
        virtual=(*range(GROUP), *(joint + GROUP for joint in robot.virtual)),
        floating=floating,
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


UNKNOWN = {
    "position_min": -np.inf,
    "zero": 0.0,
    "rotor_inertia": np.nan,
    "stated_ratios": 1.0,
}
"""Entries of limits and drives of which nothing is known; all others are infinite."""
