"""Robots from URDF files, and the inertial parameters that such a file claims."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError
from jaxid.robot.limits import Limits
from jaxid.robot.plausible import (
    ENDLESS,
    FARTHEST,
    LARGEST_ANGLE,
    beyond_range,
    far_notes,
    fast_notes,
    impossible,
)
from jaxid.robot.robot import GRAVITY, Robot, Tool
from jaxid.robot.snap import (
    SNAP_TOLERANCE,
    angle_notes,
    array_notes,
    check_tolerance,
    rpy_rotation,
    snap_angles,
    snap_axis,
    snap_rotation,
)
from jaxid.robot.urdf_file import UrdfTree

_TURNING = ("revolute", "continuous")
_ZERO = (0.0, 0.0, 0.0)


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
    """Loads a robot from a URDF file; its inertias are left to `urdf_parameters`.

    Joints turn (revolute, continuous) or slide (prismatic) about any axis. The frame of a body is
    the frame of the link that its joint moves. Links on fixed joints become part of the body that
    carries them. Joints come depth first, and in the order of the file where a link carries
    several; so a parent comes before its children.

    Limits that the file does not state, or states as zero, are infinite. Angles that can only be
    degrees are refused, and so are lengths that no robot has; what looks like millimetres, and
    inertias that no body has, are named in the robot's notes.

    Args:
        path: The file, expanded if it was a xacro file.
        tip: Link of the end-effector: only the chain from `base` to it is loaded, with the links
            fixed to it. If None, the whole tree below `base` is, and the end-effector is the last
            link of the longest chain: of the most moving joints, then of the most links, then
            first in the file.
        base: Link that stands on the ground; the root if None.
        gravity: In the frame of the ground [m/s²].
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
    body = _merge(tree, base, tip, snap_tolerance)
    limits, limit_notes = _limits(tree, body.joints)
    end_body, end_rotation, end_offset = body.links[body.tip]
    massless = tuple(
        f"joint `{joint.name}`: the file gives what it moves no mass; `urdf_parameters` takes zero."
        for i, joint in enumerate(body.joints)
        if not any(
            tree.urdf.link_map[link].inertial is not None
            for link, (carrier, _, _) in body.links.items()
            if carrier == i
        )
    )
    robot = Robot.of(
        tree.urdf.name,
        parent=tuple(body.parent),
        revolute=tuple(joint.type in _TURNING for joint in body.joints),
        axis=body.axis,
        rotation=body.rotation,
        offset=body.offset,
        joint_names=tuple(joint.name for joint in body.joints),
        gravity=gravity,
        limits=limits,
        tip_body=end_body,
        tip_rotation=end_rotation,
        tip_offset=end_offset,
        source=tree.path,
        notes=(*body.notes, *limit_notes, *massless, *_impossible_links(tree, body)),
    )
    return robot.mounted(base_rotation, base_position)


def urdf_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
    possible: bool = True,
) -> Float[AnyArray, " inertial"]:
    """Reads the inertial parameters of a URDF file: what its authors think, often from CAD (Eq. 9).

    Ten for each body of `load_urdf` with the same arguments, in the order of its joints:
    (m, m r_c, A, B, C, D, E, F) about the body's origin. Links on fixed joints are added to the
    body that carries them; links without inertia count as massless. What hangs on a moving joint
    that `tip` leaves out is left out.

    Args:
        path: The file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        snap_tolerance: As in `load_urdf` [rad].
        possible: Whether links that no body could be are refused; otherwise what the file claims of
            them is taken as it is.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded, an inertia is not finite, or one belongs to no
            body.
    """
    tree = UrdfTree(path)
    body = _merge(tree, base, tip, snap_tolerance)
    parameters = np.zeros((len(body.joints), 10))
    for name, (i, R, r) in body.links.items():
        found = _inertial(tree, name)
        if i < 0 or found is None:
            continue
        mass, J, xyz, rpy = found
        if not all(np.isfinite(v).all() for v in found):
            raise InputError(f"`{tree.path}`: link `{name}` has an inertial that is not finite.")
        if possible and (why := _impossible(found)):
            raise InputError(
                f"`{tree.path}`: the inertial of link `{name}` belongs to no body: {why}; correct "
                "the file, or do without its inertias."
            )
        attitude = R @ rpy_rotation(rpy)
        link = Tool(
            i, mass, r + R @ xyz, attitude @ J @ attitude.T
        )  # not `Tool.of`: files round, and what they claim may be wanted as it is
        parameters[i] += link.parameters
    return parameters.ravel()


class _Inertial(NamedTuple):
    """Mass, moments about the centre of mass, and its place and attitude in the link's frame."""

    mass: np.ndarray
    inertia: np.ndarray
    xyz: np.ndarray
    rpy: np.ndarray


def _inertial(tree: UrdfTree, link: str) -> _Inertial | None:
    inertial = tree.urdf.link_map[link].inertial
    if inertial is None:
        return None
    J = np.zeros((3, 3)) if inertial.inertia is None else inertial.inertia.to_matrix()
    xyz, rpy = inertial.origin and inertial.origin.xyz, inertial.origin and inertial.origin.rpy
    values = inertial.mass, J, _ZERO if xyz is None else xyz, _ZERO if rpy is None else rpy
    return _Inertial(*(np.array(value, np.float64) for value in values))


def _impossible(inertial: _Inertial) -> str:
    if np.abs(inertial.rpy).max() > LARGEST_ANGLE:
        return f"its `rpy` is {_numbers(inertial.rpy)}, which are degrees, not radians"
    return impossible(float(inertial.mass), inertial.inertia, inertial.xyz)


def _impossible_links(tree: UrdfTree, body: "_Bodies") -> tuple[str, ...]:
    """A sentence about each link whose inertial no body could have."""
    notes = []
    for name, (i, _, _) in body.links.items():
        found = _inertial(tree, name)
        if i >= 0 and found is not None and (why := _impossible(found)):
            notes.append(
                f"link `{name}`: its inertial, which identification does not need, belongs to no "
                f"body: {why}."
            )
    return tuple(notes)


def _numbers(values: Any) -> str:
    return " ".join(f"{x:g}" for x in values)


def merged_links(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    snap_tolerance: float = SNAP_TOLERANCE,
) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    """For each link of a file the body that carries it, and its placement in the body's frame.

    A link on the ground has body -1 and its placement in the frame of the base link.

    Args:
        path: The file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        snap_tolerance: As in `load_urdf` [rad].

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded.
    """
    return _merge(UrdfTree(path), base, tip, snap_tolerance).links


class _Bodies(NamedTuple):
    """The moving joints and, for each link, its body (-1: ground) and its placement in it."""

    joints: list[Any]
    parent: list[int]
    axis: list[np.ndarray]
    rotation: list[np.ndarray]
    offset: list[np.ndarray]
    links: dict[str, tuple[int, np.ndarray, np.ndarray]]
    tip: str
    notes: tuple[str, ...]


def _merge(tree: UrdfTree, base: str | None, tip: str | None, snap_tolerance: float) -> _Bodies:
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
        fixed = joint.type == "fixed"
        if not fixed and chain is not None and joint.name not in chain:
            continue
        rotation, offset, said = _origin(tree, joint, tolerance)
        notes += said
        carrier, R, r = out.links[joint.parent]
        exact = snap_rotation(R @ rotation, tolerance)
        notes += array_notes(joint.name, "attitude", R @ rotation, exact)
        placement = (exact, r + R @ offset)
        if fixed:
            out.links[joint.child] = (carrier, *placement)
        else:
            axis, said = _axis(tree, joint, tolerance)
            notes += said
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
    tree: UrdfTree, joint: Any, tolerance: float
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    offset = tree.numbers(joint, "xyz", joint.origin and joint.origin.xyz, _ZERO)
    rpy = tree.numbers(joint, "rpy", joint.origin and joint.origin.rpy, _ZERO)
    if np.abs(offset).max() > FARTHEST:
        raise tree.error(
            joint,
            f'has `xyz="{_numbers(offset)}"`, which is {np.abs(offset).max():g} m: lengths in a '
            "URDF are in metres",
        )
    if np.abs(rpy).max() > LARGEST_ANGLE:
        raise tree.error(
            joint,
            f'has `rpy="{_numbers(rpy)}"`, which is more than a turn: angles in a URDF are in '
            "radians, not degrees",
        )
    snapped = snap_angles(rpy, tolerance)
    notes = angle_notes(joint.name, ("roll", "pitch", "yaw"), rpy, snapped)
    return rpy_rotation(snapped), offset, notes


def _axis(tree: UrdfTree, joint: Any, tolerance: float) -> tuple[np.ndarray, tuple[str, ...]]:
    if joint.type not in (*_TURNING, "prismatic"):
        raise tree.error(
            joint,
            f"is {joint.type}, but only revolute, continuous and prismatic joints can be "
            "identified: choose `tip` (or `base`) so that the chain avoids it, or make it fixed",
        )
    if joint.mimic is not None:
        raise tree.error(
            joint,
            f"mimics joint `{joint.mimic.joint}`, but every joint must move freely: choose `tip` "
            "(or `base`) so that the chain avoids it, or make it fixed",
        )
    axis = tree.numbers(joint, "axis", joint.axis, (1.0, 0.0, 0.0))
    length = np.linalg.norm(axis)
    if length < 1e-9:
        raise tree.error(joint, "has the zero vector as its axis: give it a direction")
    snapped = snap_axis(axis, tolerance)
    return snapped, array_notes(joint.name, "axis", axis / length, snapped)


def _limits(tree: UrdfTree, joints: list[Any]) -> tuple[Limits, tuple[str, ...]]:
    n = len(joints)
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    speed, force = np.full(n, np.inf), np.full(n, np.inf)
    notes: list[str] = []
    for i, joint in enumerate(joints):
        limit = joint.limit
        if limit is None:
            continue
        given = (limit.lower, limit.upper, limit.velocity, limit.effort)
        if np.isnan(given).any():
            raise tree.error(joint, "has a limit that is not a number")
        if joint.type != "continuous" and limit.lower == limit.upper == 0.0:
            notes.append(f"joint `{joint.name}`: a range from 0 to 0 is taken as unknown.")
        elif joint.type != "continuous":
            low[i], high[i] = limit.lower, limit.upper
            if joint.type in _TURNING and high[i] - low[i] >= 2 * ENDLESS:
                low[i], high[i] = -np.inf, np.inf
            if why := beyond_range(low[i], high[i], joint.type in _TURNING):
                unit = "radians, not degrees" if joint.type in _TURNING else "metres"
                raise tree.error(joint, f"{why}: limits in a URDF are in {unit}")
            if low[i] >= high[i]:
                raise tree.error(
                    joint,
                    f"ranges from {low[i]:g} to {high[i]:g}, but the lower end must be below "
                    "the upper one",
                )
        for name, value, array in (
            ("velocity", limit.velocity, speed),
            ("effort", limit.effort, force),
        ):
            if value > 0.0:
                array[i] = value
            else:
                notes.append(f"joint `{joint.name}`: {name} {value:g} is taken as unknown.")
        turns = joint.type in _TURNING
        notes += fast_notes(joint.name, speed[i], turns)
        notes += (
            ()
            if turns
            else far_notes(f"joint `{joint.name}`: an end of its range", (low[i], high[i]))
        )
    return (
        Limits.of(n, position_min=low, position_max=high, velocity=speed, force=force),
        tuple(notes),
    )
