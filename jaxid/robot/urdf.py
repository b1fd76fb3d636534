"""Robots from URDF files, and the inertial parameters that such a file claims."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError
from jaxid.robot.kinematics import rpy_rotation
from jaxid.robot.limits import Limits
from jaxid.robot.plausibility import (
    FARTHEST,
    LARGEST_ANGLE,
    SNAP_TOLERANCE,
    angle_notes,
    array_notes,
    check_tolerance,
    far_notes,
    fast_notes,
    range_fault,
    snap_angles,
    snap_axis,
    snap_rotation,
)
from jaxid.robot.robot import GRAVITY, Robot
from jaxid.robot.urdf_tree import UrdfJoint, UrdfTree, words

_TURNING = ("revolute", "continuous")
_ZERO = (0.0, 0.0, 0.0)
_ENDLESS = 2e4
"""Range from which a joint turns without end [rad]."""


def load_urdf(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    gravity: Numbers = GRAVITY,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> Robot:
    """Load a robot from a URDF file; its inertias are read by `urdf_parameters`.

    Joints turn (revolute, continuous) or slide (prismatic) about any axis. The frame of a body is
    the frame of the link that its joint moves. Links on fixed joints become part of the body that
    carries them. Joints come depth first, and in the order of the file where a link carries
    several; so a parent comes before its children.

    Limits that the file does not state, or states as zero, are infinite. Angles that can only be
    degrees are rejected, and so are lengths that no robot has; suspicious lengths, speeds and
    inertias are reported in the robot's notes.

    Args:
        path: URDF file, expanded if it was a xacro file.
        tip: Link of the end-effector: only the chain from `base` to it is loaded, with the links
            fixed to it. If None, the whole tree below `base` is, and the end-effector is the last
            link of the longest chain: of the most moving joints, then of the most links, then
            first in the file.
        base: Link that stands on the ground; the root if None.
        gravity: Acceleration of gravity in the frame of the ground [m/s²].
        base_rotation: Attitude of the base link on the ground; upright if None.
        base_position: Origin of the base link on the ground [m].
        snap_tolerance: Angles, attitudes and axes this close to a quarter turn become exact [rad];
            the robot's notes list them. Zero turns it off.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no URDF, is no open tree, has a mimic, floating or planar joint on
            the way, or angles or lengths in other units.
    """
    tree = UrdfTree(path)
    bodies = _merge(tree, base, tip, snap_tolerance)
    limits, limit_notes = _limits(tree, bodies.joints)
    end_body, end_rotation, end_offset = bodies.links[bodies.tip]
    robot = Robot(
        tree.name,
        parent=tuple(bodies.parent),
        revolute=tuple(joint.kind in _TURNING for joint in bodies.joints),
        axis=bodies.axis,
        rotation=bodies.rotation,
        offset=bodies.offset,
        joint_names=tuple(joint.name for joint in bodies.joints),
        gravity=gravity,
        limits=limits,
        tip_body=end_body,
        tip_rotation=end_rotation,
        tip_offset=end_offset,
        source=tree.path,
        notes=(*bodies.notes, *limit_notes, *_inertial_notes(tree, bodies)),
    )
    return robot.mounted(base_rotation, base_position)


def urdf_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
    check: bool = True,
) -> Float[AnyArray, " inertial"]:
    """Return the inertial parameters that a URDF file claims, often from CAD (Eq. 9).

    Ten for each body of `load_urdf` with the same arguments, in the order of its joints:
    (m, m r_c, A, B, C, D, E, F) about the body's origin. Links on fixed joints are added to the
    body that carries them; links without inertia count as massless. Links below a moving joint
    that `tip` leaves out are left out.

    Args:
        path: URDF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        snap_tolerance: As in `load_urdf` [rad].
        check: Whether links that cannot exist are rejected; otherwise their numbers are returned
            as they are.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded, an inertia is not finite, or a link cannot exist.
    """
    tree = UrdfTree(path)
    bodies = _merge(tree, base, tip, snap_tolerance)
    parameters = np.zeros((len(bodies.joints), 10))
    for name, (i, R, r) in bodies.links.items():
        inertial = tree.inertial(name) if i >= 0 else None
        if inertial is None:
            continue
        if check and (reason := inertial.fault()):
            raise InputError(
                f"`{tree.path}`: the inertial of link `{name}` belongs to no body: {reason}; "
                "correct the file, or do without its inertias."
            )
        parameters[i] += inertial.in_link().moved(R, r).parameters
    return parameters.ravel()


def merged_links(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    """Return for each link the body that carries it, and its placement in the body's frame.

    A link on the ground has body -1 and its placement in the frame of the base link.

    Args:
        path: URDF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        snap_tolerance: As in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded.
    """
    return _merge(UrdfTree(path), base, tip, snap_tolerance).links


class _Bodies(NamedTuple):
    """Moving joints and, for each link, its body (-1: ground) and its placement in it."""

    joints: list[UrdfJoint]
    parent: list[int]
    axis: list[np.ndarray]
    rotation: list[np.ndarray]
    offset: list[np.ndarray]
    links: dict[str, tuple[int, np.ndarray, np.ndarray]]
    tip: str
    notes: tuple[str, ...]


def _merge(tree: UrdfTree, base: str | None, tip: str | None, snap_tolerance: float) -> _Bodies:
    """Merge links on fixed joints into the bodies that carry them."""
    tolerance = check_tolerance(snap_tolerance)
    base = tree.root if base is None else tree.require_link("base", base)
    chain = None
    if tip is not None:
        chain = {joint.name for joint in tree.chain(base, tree.require_link("tip", tip))}
    out = _Bodies([], [], [], [], [], {base: (-1, np.eye(3), np.zeros(3))}, "", ())
    notes: list[str] = []
    length = {base: (0, 0)}
    waiting = tree.children[base][::-1]
    while waiting:
        joint = waiting.pop()
        fixed = joint.kind == "fixed"
        if not fixed and chain is not None and joint.name not in chain:
            continue
        rotation, offset, origin_notes = _origin(tree, joint, tolerance)
        carrier, R, r = out.links[joint.parent]
        exact = snap_rotation(R @ rotation, tolerance)
        notes += origin_notes
        notes += array_notes(joint.name, "attitude", R @ rotation, exact)
        placement = (exact, r + R @ offset)
        if fixed:
            out.links[joint.child] = (carrier, *placement)
        else:
            axis, axis_notes = _axis(tree, joint, tolerance)
            notes += axis_notes
            out.links[joint.child] = (len(out.joints), np.eye(3), np.zeros(3))
            out.joints.append(joint)
            out.parent.append(carrier)
            out.axis.append(axis)
            out.rotation.append(placement[0])
            out.offset.append(placement[1])
        moving, links = length[joint.parent]
        length[joint.child] = (moving + (not fixed), links + 1)
        waiting += tree.children[joint.child][::-1]
    end = max(length, key=lambda link: length[link]) if tip is None else tip
    if out.links[end][0] < 0:
        below = f"below link `{base}`" if tip is None else f"between links `{base}` and `{tip}`"
        raise InputError(
            f"`{tree.path}` has no moving joint {below}: choose another `base` or `tip`."
        )
    return out._replace(tip=end, notes=tuple(notes))


def _origin(
    tree: UrdfTree, joint: UrdfJoint, tolerance: float
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    element = tree.child(joint.element, "origin")
    offset, rpy = (tree.numbers(element, key, _ZERO) for key in ("xyz", "rpy"))
    if np.abs(offset).max() > FARTHEST:
        raise tree.error(
            joint,
            f'has `xyz="{words(offset)}"`, which is {np.abs(offset).max():g} m: lengths in a '
            "URDF are in metres",
        )
    if np.abs(rpy).max() > LARGEST_ANGLE:
        raise tree.error(
            joint,
            f'has `rpy="{words(rpy)}"`, which is more than a turn: angles in a URDF are in '
            "radians, not degrees",
        )
    snapped = snap_angles(rpy, tolerance)
    notes = angle_notes(joint.name, ("roll", "pitch", "yaw"), rpy, snapped)
    return rpy_rotation(snapped), offset, notes


def _axis(tree: UrdfTree, joint: UrdfJoint, tolerance: float) -> tuple[np.ndarray, tuple[str, ...]]:
    mimic = tree.child(joint.element, "mimic")
    fault = None
    if joint.kind not in (*_TURNING, "prismatic"):
        fault = f"is {joint.kind}, but only revolute, continuous and prismatic joints can be used"
    elif mimic is not None:
        fault = f"mimics joint `{mimic.get('joint')}`, but every joint must move freely"
    if fault:
        cure = "choose `tip` (or `base`) so that the chain avoids it, or make it fixed"
        raise tree.error(joint, f"{fault}: {cure}")
    axis = tree.numbers(tree.child(joint.element, "axis"), "xyz", (1.0, 0.0, 0.0))
    length = np.linalg.norm(axis)
    if length < 1e-9:
        raise tree.error(joint, "has the zero vector as its axis: give it a direction")
    snapped = snap_axis(axis, tolerance)
    return snapped, array_notes(joint.name, "axis", axis / length, snapped)


def _limits(tree: UrdfTree, joints: list[UrdfJoint]) -> tuple[Limits, tuple[str, ...]]:
    n = len(joints)
    values = np.full((4, n), np.inf)
    values[0] = -np.inf
    notes: list[str] = []
    for i, joint in enumerate(joints):
        element = tree.child(joint.element, "limit")
        if element is None:
            continue
        turns = joint.kind in _TURNING
        if joint.kind != "continuous":
            (low, high), range_notes = _range(tree, joint, element)
            values[:2, i] = low, high
            notes += range_notes
        for k, key in enumerate(("velocity", "effort"), 2):
            value = tree.numbers(element, key, (np.inf,), infinite=True)[0]
            if value > 0.0:
                values[k, i] = value
            else:
                notes.append(f"joint `{joint.name}`: {key} {value:g} is taken as unknown.")
        notes += fast_notes(joint.name, values[2, i], turns)
        if not turns:
            notes += far_notes(f"joint `{joint.name}`: an end of its range", values[:2, i])
    low, high, speed, force = values
    limits = Limits(n, position_min=low, position_max=high, velocity=speed, force=force)
    return limits, tuple(notes)


def _range(
    tree: UrdfTree, joint: UrdfJoint, element: Any
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Return the range of a joint, infinite where unknown, and notes."""
    given = {}
    for key, unlimited in (("lower", -np.inf), ("upper", np.inf)):
        other = tree.numbers(
            element, "upper" if key == "lower" else "lower", (np.inf,), infinite=True
        )
        # A missing bound is zero if the other one is given, as the URDF standard says.
        default = 0.0 if np.isfinite(other[0]) else unlimited
        given[key] = float(tree.numbers(element, key, (default,), infinite=True)[0])
    low, high = given["lower"], given["upper"]
    if low == high == 0.0:
        note = f"joint `{joint.name}`: a range from 0 to 0 is taken as unknown."
        return (-np.inf, np.inf), (note,)
    turns = joint.kind in _TURNING
    if turns and high - low >= _ENDLESS:
        return (-np.inf, np.inf), ()
    if fault := range_fault(low, high, turns):
        unit = "radians, not degrees" if turns else "metres"
        raise tree.error(joint, f"{fault}: limits in a URDF are in {unit}")
    if low >= high:
        raise tree.error(
            joint,
            f"ranges from {low:g} to {high:g}, but the lower end must be below the upper one",
        )
    return (low, high), ()


def _inertial_notes(tree: UrdfTree, bodies: _Bodies) -> Iterator[str]:
    """Yield notes on bodies without mass, and on links that cannot exist."""
    inertials = {n: tree.inertial(n) for n, (i, _, _) in bodies.links.items() if i >= 0}
    for i, joint in enumerate(bodies.joints):
        carried = [inertials[name] for name in inertials if bodies.links[name][0] == i]
        if all(inertial is None for inertial in carried):
            yield (
                f"joint `{joint.name}`: the file gives its body no mass; `urdf_parameters` takes "
                "zero."
            )
    for name, inertial in inertials.items():
        if inertial is not None and (reason := inertial.fault()):
            yield (
                f"link `{name}`: its inertial, which identification does not need, belongs to no "
                f"body: {reason}."
            )
