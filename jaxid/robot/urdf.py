"""Robots from URDF and MJCF files, and the parameters that such a file claims."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, is_traced
from jaxid.errors import InputError

from .forward_and_inverse_kinematics import tip_jacobian
from .inertia import Inertia
from .limits_and_drives import FAR, Limits, owners, range_fault
from .robot import Robot
from .urdf_tree import TURNING, UrdfTree

_ZERO = (0.0, 0.0, 0.0)


def load_urdf(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    gravity: Numbers | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
) -> Robot:
    """Load a robot from a URDF, xacro or MJCF file; `urdf_parameters` reads its inertias.

    Joints turn (revolute, continuous) or slide (prismatic) about any axis. The frame of
    a body is the frame of the link that its joint moves. Links on fixed joints become
    part of the body that carries them. Joints come depth first, and in the order of the
    file where a link carries several; so a parent comes before its children. A joint
    that mimics another is held at zero, or where the other joint's range puts it, and
    counts as fixed.

    MuJoCo compiles an MJCF file: a joint that an equality constraint couples to another
    is held like a mimic joint, largest forces are those of the actuators, and gravity
    is that of the file.

    Limits that the file does not state, or states as zero, are infinite. Angles that
    can only be degrees are rejected, and so are lengths that no robot has; held joints,
    and suspicious lengths, speeds, forces and inertias are reported in the robot's
    notes.

    Args:
        path: URDF or MJCF file; a xacro file is expanded by the program `xacro`.
        tip: Link (in MJCF a body or site) of the end-effector: only the chain from
            `base` to it is loaded, with the links fixed to it. If None, the whole tree
            below `base` is, and the end-effector is the last link of the longest chain:
            of the most moving joints, then of the most links, then first in the file.
        base: Link or body that stands on the ground; the root if None.
        gravity: Acceleration of gravity in the frame of the ground [m/s²]; 9.81
            downwards if None, or that of an MJCF file.
        base_rotation: Attitude of the base link on the ground; upright if None.
        base_position: Origin of the base link on the ground [m].

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no URDF, is no open tree, has a floating or planar joint on
            the way, or angles or lengths in other units; if `xacro` or MuJoCo cannot
            read it or is missing.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    limits, limit_notes = _limits(tree)
    tip_body, tip_rotation, tip_offset = tree.carriers[tree.tip]
    try:
        robot = Robot(
            tree.name,
            parent=tuple(tree.parent),
            revolute=tuple(joint.get("type") in TURNING for joint in tree.joints),
            axis=tree.axis,
            rotation=tree.rotation,
            offset=tree.offset,
            joint_names=tuple(joint.get("name") for joint in tree.joints),
            gravity=tree.gravity if gravity is None else gravity,
            limits=limits,
            tip_body=tip_body,
            tip_rotation=tip_rotation,
            tip_offset=tip_offset,
            source=tree.path,
            notes=(*_held_notes(tree), *limit_notes, *_inertial_notes(tree)),
        )
    except InputError as error:
        raise InputError(f"`{path}`: {error}") from error
    robot = robot.mounted(base_rotation, base_position)
    return robot.replace(notes=(*robot.notes, *_weight_notes(robot, tree.bodies())))


load_mjcf = load_urdf
"""The same for an MJCF file."""


def urdf_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    check: bool = True,
) -> Float[AnyArray, " inertial"]:
    """Return the inertial parameters that a URDF or MJCF file claims, often from CAD (Eq. 9).

    Ten for each body of `load_urdf` with the same arguments, in the order of its
    joints: (m, m r_c, A, B, C, D, E, F) about the body's origin. Links on fixed joints
        are added to the
    body that carries them; links without inertia count as massless. Links below a
    moving joint that `tip` leaves out are left out.

    Args:
        path: URDF or MJCF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        check: Whether links that cannot exist are rejected; otherwise their numbers are
            returned as they are.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded, an inertia is not finite, or a link
            cannot exist.
    """
    return UrdfTree(path, base=base, tip=tip).bodies(check=check).ravel()


def joint_parameters(
    path: str | Path, *, tip: str | None = None, base: str | None = None
) -> dict[str, Float[np.ndarray, " joints"]]:
    """Return `armature`, `damping` and dry `friction` that a file claims, zero where it does not.

    Arguments and errors are those of `load_urdf`.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    return {
        key: np.array(
            [tree.numbers(j.find("dynamics"), key, (0.0,))[0] for j in tree.joints]
        )
        for key in ("armature", "damping", "friction")
    }


def _limits(tree: UrdfTree) -> tuple[Limits, list[str]]:
    values = np.full((4, len(tree.joints)), np.inf)
    values[0] = -np.inf
    unknown: dict[str, list[str]] = {}
    for i, joint in enumerate(tree.joints):
        name = joint.get("name")
        turns = joint.get("type") in TURNING
        low, high = tree.range(joint)
        if low == high == 0.0:
            unknown.setdefault("a range from 0 to 0", []).append(name)
        elif not (turns and high - low >= 2e4):  # such a joint turns without end
            if fault := range_fault(low, high, turns):
                unit = "radians, not degrees" if turns else "metres"
                raise tree.error(joint, f"{fault}: its limits must be in {unit}")
            if low >= high:
                raise tree.error(
                    joint, f"ranges from {low:g} to {high:g}: exchange the ends"
                )
            values[:2, i] = low, high
        for k, key in enumerate(("velocity", "effort"), 2):
            value = tree.limit(joint, key, np.inf)
            if value > 0.0:
                values[k, i] = value
            else:
                unknown.setdefault(f"{key} {value:g}", []).append(name)
    low, high, speed, force = values
    limits = Limits(position_min=low, position_max=high, velocity=speed, force=force)
    notes = [
        f"{owners('joint', who)}: {what} is taken as unknown."
        for what, who in unknown.items()
    ]
    return limits, notes


def _held_notes(tree: UrdfTree) -> Iterator[str]:
    """Yield notes on joints that are held, and on objects that are no part of the robot."""
    groups: dict[tuple[str, str], list[str]] = {}
    for joint in tree.held:
        master = joint.find("mimic").get("joint", "")
        groups.setdefault((master, f"{tree.held_at(joint):.4g}"), []).append(
            joint.get("name")
        )
    for (master, value), names in groups.items():
        cause = f"mimic of joint `{master}`" if master else "constraint"
        yield (
            f"{owners('joint', names)}: held at {value} ({cause}); the links belong "
            "to the bodies "
            "that carry them."
        )
    if tree.loose:
        yield f"{owners('link', tree.loose)}: left out, as objects that float freely."


def _inertial_notes(tree: UrdfTree) -> Iterator[str]:
    """Yield notes on bodies without mass, and on links that cannot exist."""
    inertials = {
        n: tree.inertial(n) for n, (body, _, _) in tree.carriers.items() if body >= 0
    }
    massive = {
        tree.carriers[n][0] for n, found in inertials.items() if found and found[0].mass
    }
    if light := [j.get("name") for i, j in enumerate(tree.joints) if i not in massive]:
        yield (
            f"{owners('joint', light)}: the body has no mass; `urdf_parameters` "
            "takes zero."
        )
    for name, inertial in inertials.items():
        if inertial is not None and inertial[1]:
            yield (
                f"link `{name}`: its inertial, which identification does not need, "
                "belongs to no "
                f"body: {inertial[1]}."
            )


def _weight_notes(
    robot: Robot, bodies: Float[np.ndarray, "joints 10"]
) -> Iterator[str]:
    """Yield notes on joints that cannot hold a fraction of what gravity needs with these bodies."""
    if is_traced(robot):
        return
    low, high = (
        np.asarray(x) for x in (robot.limits.position_min, robot.limits.position_max)
    )
    ends = np.where(robot.revolute, np.pi, 0.0)
    low, high = (
        np.where(np.isfinite(low), low, -ends),
        np.where(np.isfinite(high), high, ends),
    )
    q = np.random.default_rng(0).uniform(low, high, (64, robot.joints))
    forces = np.zeros(q.shape)
    for body, inertia in enumerate(map(Inertia.from_parameters, bodies)):
        if inertia.mass > 0.0 and np.abs(inertia.centre).max() < FAR:
            carried = robot.replace(tip_body=body, tip_offset=inertia.centre)
            forces -= inertia.mass * (tip_jacobian(carried, q)[2] @ robot.gravity)
    needed = np.abs(forces).max(axis=0)
    for j, (name, most) in enumerate(
        zip(robot.joint_names, robot.limits.force, strict=True)
    ):
        if most < 0.25 * needed[j]:
            unit = robot.force_unit(j)
            yield (
                f"joint `{name}`: an effort of {most:.3g} {unit} is far below the "
                f"{needed[j]:.3g} "
                f"{unit} that gravity needs with the inertias of the file: are its "
                "units right?"
            )
