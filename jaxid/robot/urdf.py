"""Robots from URDF and MJCF files, and the parameters that such a file claims."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Joints, Numbers, Vector
from jaxid.errors import InputError

from .contacts import AbstractContactShape, Imu, contact_at, imu_at
from .follower_joints import Followers
from .inertia import IMPOSSIBLE, MAX_DENSITY, ball_densities
from .joint_coordinates import linear_coordinates, linear_ratios, with_leader
from .limits_and_drives import (
    MAX_STATED_ANGLE,
    MAX_STATED_LENGTH,
    Drives,
    Limits,
    owners,
    range_fault,
)
from .loop_assembly import assembled
from .robot import Robot
from .urdf_elements import ORIGIN
from .urdf_tree import TURNING_TYPES, UrdfTree
from .virtual_joints import GROUP

MIN_RANGE = 1e-6
"""Length of a range below which it is empty, up to rounding [rad or m]."""
MAX_MAGNITUDE = 1e7
"""Largest speed or force that a file can state; larger ones are no limits."""
REDUCTION_TAGS = ("mechanicalReduction", "mechanical_reduction")
"""Elements of a transmission that state its ratio, in ROS 1 and ROS 2."""


def load_urdf(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    gravity: Numbers | None = None,
    base_rotation: Numbers | None = None,
    base_position: Numbers = ORIGIN,
    xacro_arguments: Mapping[str, str] | None = None,
    floating: bool = False,
    imu: str | Imu | None = None,
    contacts: Mapping[str, AbstractContactShape] | None = None,
) -> Robot:
    """Load a robot from a URDF, xacro or MJCF file, without its inertias.

    Joints turn (revolute, continuous) or slide (prismatic) about any axis. The frame of
    a body is the frame of the link that its joint moves. Links on fixed joints become
    part of the body that carries them. Joints come depth first, and in the order of the
    file where a link carries several; so a parent comes before its children. A joint
    that mimics another is held at zero, or where the other joint's range puts it, and
    counts as fixed; one that carries more than a finger is rejected.

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
            downwards in the frame of the root if None, or that of an MJCF file.
        base_rotation: Attitude of the base link on the ground. If None, their frames
            are parallel, and gravity has the direction that the joints between the root
            and the base give it.
        base_position: Origin of the base link on the ground [m].
        xacro_arguments: Texts of the arguments of a xacro file, by name.
        floating: Whether the base moves freely: it is a body on six virtual joints,
            whose acceleration, gravity included, an IMU measures. `base` is then the
            link of the base: the root if None, or the link that the file lets float.
        imu: Link (body or site) of the IMU, or its place on the base; the frame of the
            base if None.
        contacts: Links of the feet of a floating base, and their shapes, in the order
            of the logs' flags; if None, those of an MJCF file: bodies at the ends of
            the tree that collide, a ball as `Sphere`, any other as `Sole`.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no URDF, is no open tree, has a floating or planar joint,
            or a link of the arm on a joint that mimics another, or angles or lengths in
            other units; if `xacro` or MuJoCo cannot read it or is missing.
    """
    tree = UrdfTree(
        path, base=base, tip=tip, xacro_arguments=xacro_arguments, floating=floating
    )
    limits, limit_notes = _limits(tree)
    notes = (
        *_held_notes(tree),
        *_follower_notes(tree),
        *_effect_notes(tree),
        *limit_notes,
        *_negative_notes(tree),
        *_inertial_notes(tree),
    )
    if floating:
        gravity = np.zeros(3)
    if gravity is None:
        # An attitude of the base that the user gives is that on level ground.
        gravity = tree.gravity
        if base_rotation is None:
            gravity = tree.base_gravity
            notes = (*_mount_notes(tree, base), *notes)
    joints = _leading_joints(tree)
    tip_body, tip_rotation, tip_offset = tree.carriers[tree.tip]
    if contacts is None:
        contacts = tree.contact_shapes if floating else {}
    if contacts and not floating:
        raise InputError(
            "`contacts` are those of a robot on legs: add `floating = true`, or leave "
            "them out."
        )
    try:
        robot = Robot(
            tree.name,
            parent=tuple(placement.body for placement in tree.placements),
            revolute=tuple(joint.get("type") in TURNING_TYPES for joint in joints),
            followers=tree.followers,
            loops=tree.loops,
            axis=tree.axes,
            rotation=[placement.rotation for placement in tree.placements],
            offset=[placement.position for placement in tree.placements],
            joint_names=tuple(joint.get("name") for joint in joints),
            gravity=gravity,
            limits=limits,
            drives=Drives(len(joints), stated_ratios=_gear_ratios(tree)),
            tip_body=tip_body,
            tip_rotation=tip_rotation,
            tip_offset=tip_offset,
            source=tree.path,
            source_tip=tip,
            source_base=base,
            source_arguments=tuple((xacro_arguments or {}).items()),
            notes=notes,
            virtual=tuple(range(GROUP)) if floating else (),
            floating=floating,
            imu=imu_at(tree, imu),
            contacts=tuple(
                contact_at(tree, link, shape) for link, shape in contacts.items()
            ),
        )
        robot = robot.mounted(base_rotation, base_position)
        if not tree.loops:
            return robot
        names = robot.body_names
        poses = [np.array([pose.get(x, 0.0) for x in names]) for pose in tree.poses]
        return assembled(robot, poses)
    except InputError as error:
        raise InputError(f"`{path}`: {error}") from error


load_mjcf = load_urdf
"""The same for an MJCF file."""


def urdf_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    xacro_arguments: Mapping[str, str] | None = None,
    floating: bool = False,
    check: bool = True,
) -> AnyArray:
    """Return the inertial parameters that a URDF or MJCF file claims (Eq. 9).

    Ten for each body of `load_urdf` with the same arguments, in the order of its
    joints: (m, m r_c, A, B, C, D, E, F) about the body's origin. Links on fixed joints
    are added to the body that carries them; links without inertia count as massless.
    Links below a moving joint that `tip` leaves out are left out.

    Args:
        path: URDF or MJCF file.
        tip: As in `load_urdf`.
        base: As in `load_urdf`.
        xacro_arguments: As in `load_urdf`.
        floating: As in `load_urdf`; the first ten are then those of the base.
        check: Whether links that cannot exist are rejected; otherwise their numbers are
            returned as they are.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded, an inertia is not finite, or a link
            cannot exist.
    """
    tree = UrdfTree(
        path, base=base, tip=tip, xacro_arguments=xacro_arguments, floating=floating
    )
    return tree.bodies(check=check).ravel()


def joint_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    xacro_arguments: Mapping[str, str] | None = None,
    floating: bool = False,
) -> dict[str, Joints]:
    """Return `armature`, `damping`, dry `friction` and springs that a file claims.

    Springs have a `stiffness` [N m/rad or N/m] and a position of rest, `springref` [rad
    or m]. All are zero where the file claims none. Those of joints that follow others
    count at the joints that they follow. Arguments and errors are those of `load_urdf`.
    """
    tree = UrdfTree(
        path, base=base, tip=tip, xacro_arguments=xacro_arguments, floating=floating
    )
    parameters = {}
    joints = tree.joints[GROUP if floating else 0 :]
    for key in ("armature", "damping", "friction", "stiffness", "springref"):
        elements = [joint.find("dynamics") for joint in joints]
        values = [tree.numbers(element, key, (0.0,))[0] for element in elements]
        parameters[key] = np.array(values)
    if tree.followers:
        return _of_leaders(tree.followers, parameters)
    return parameters


def _leading_joints(tree: UrdfTree) -> list[Any]:
    """Return the elements of the moving joints that follow no others."""
    return tree.joints[: len(tree.joints) - len(tree.followers)]


def _of_leaders(followers: Followers, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return parameters of all joints as those of the joints that move alone."""
    joints = len(parameters["armature"]) - len(followers)
    # No parameter describes those of joints that loops move.
    described = joints + len(with_leader(followers))
    parameters = {key: values[:described] for key, values in parameters.items()}
    # What is negative is not used.
    for key in ("armature", "damping", "friction", "stiffness"):
        parameters[key] = np.maximum(parameters[key], 0.0)
    ratios = linear_ratios(followers, joints).T
    sums = {key: ratios**2 @ values for key, values in parameters.items()}
    sums["friction"] = np.abs(ratios) @ parameters["friction"]
    # The springs of all joints are one spring, which rests where their forces cancel.
    positions = linear_coordinates(followers, np.zeros(joints))
    deflections = positions - parameters["springref"]
    spring_forces = parameters["stiffness"] * deflections
    has_spring = sums["stiffness"] > 0.0
    stiffness = np.where(has_spring, sums["stiffness"], np.inf)
    sums["springref"] = -(ratios @ spring_forces) / stiffness
    return sums


def _limits(tree: UrdfTree):
    """Return the limits of all joints, and notes on those that are taken as unknown."""
    joints = len(_leading_joints(tree))
    low = np.empty(joints)
    high = np.empty(joints)
    magnitudes = {key: np.full(joints, np.inf) for key in ("velocity", "effort")}
    unknown_limits: dict[str, list[str]] = {}
    for i, joint in enumerate(_leading_joints(tree)):
        name = joint.get("name")
        low[i], high[i] = _checked_range(tree, joint)
        stated_low, stated_high = tree.range(joint)
        if (low[i], high[i]) != (stated_low, stated_high):
            stated_range = f"a range from {stated_low:g} to {stated_high:g}"
            unknown_limits.setdefault(stated_range, []).append(name)
        # Files often state zero, or 1e9, for what nobody has looked up.
        for key, values in magnitudes.items():
            value = tree.limit(joint, key, np.inf)
            if 0.0 < value <= MAX_MAGNITUDE or value == np.inf:
                values[i] = value
            else:
                unknown_limits.setdefault(f"{key} {value:g}", []).append(name)
    _limit_by_followers(tree, low, high, magnitudes["velocity"])
    limits = Limits(
        position_min=low,
        position_max=high,
        velocity=magnitudes["velocity"],
        force=magnitudes["effort"],
    )
    notes = [
        f"{owners('joint', joints)}: {limit} is taken as unknown."
        for limit, joints in unknown_limits.items()
    ]
    soft_joints = [
        joint.get("name")
        for joint in tree.joints
        if tree.range(joint) != tree.hard_range(joint)
    ]
    if soft_joints:
        names = owners("joint", soft_joints)
        notes.append(f"{names}: soft limits (`<safety_controller>`) narrow the range.")
    return limits, notes


def _limit_by_followers(tree: UrdfTree, low: Vector, high: Vector, velocity: Vector):
    """Narrow the limits of joints, in place, by those of their followers."""
    joints = tree.joints[len(low) :]
    for joint, follower in zip(joints, tree.followers, strict=True):
        leader = follower.leader
        if leader is None:
            continue
        follower_ends = np.array(_checked_range(tree, joint))
        ends = np.sort((follower_ends - follower.offset) / follower.factor)
        low[leader] = max(low[leader], ends[0])
        high[leader] = min(high[leader], ends[1])
        speed = tree.limit(joint, "velocity", np.inf)
        if speed > 0.0:
            velocity[leader] = min(velocity[leader], speed / abs(follower.factor))
        if low[leader] >= high[leader]:
            raise tree.error(
                joint,
                "is outside its range at all positions of the joint that it follows: "
                "correct the `<limit>` of both, or `multiplier` and `offset`",
            )


def _checked_range(tree: UrdfTree, joint: Any):
    """Return a joint's range; infinite if it is empty, or where no joint can end."""
    turns = joint.get("type") in TURNING_TYPES
    low, high = tree.range(joint)
    fault = range_fault(low, high, turns)
    if fault:
        unit = "radians, not degrees" if turns else "metres"
        raise tree.error(joint, f"{fault}: its limits must be in {unit}")
    if low > high:
        cure = "exchange the two ends, or state both"
        raise tree.error(joint, f"ranges from {low:g} to {high:g}: {cure}")
    if high - low < MIN_RANGE:
        return -np.inf, np.inf
    max_end = MAX_STATED_ANGLE if turns else MAX_STATED_LENGTH
    return (
        low if abs(low) <= max_end else -np.inf,
        high if abs(high) <= max_end else np.inf,
    )


def _gear_ratios(tree: UrdfTree):
    """Return the ratios of motor to joint speed of transmissions of a single joint."""
    ratios = {joint.get("name"): 1.0 for joint in _leading_joints(tree)}
    for transmission in tree.root.iter("transmission"):
        names = [joint.get("name") for joint in transmission.iterfind("joint")]
        if len(names) != 1 or names[0] not in ratios:
            continue
        try:
            elements = transmission.iter(*REDUCTION_TAGS)
            ratio = np.prod([float(element.text or "") for element in elements])
        except ValueError:
            continue  # no simulator, and no fit, needs it
        if ratio and np.isfinite(ratio):
            ratios[names[0]] = float(ratio)
    return list(ratios.values())


def _mount_notes(tree: UrdfTree, base: str | None):
    """Return a note if joints above the base decide where gravity points in it."""
    if not tree.tilting_joints:
        return []
    joints = owners("joint", [joint.get("name") for joint in tree.tilting_joints])
    g = tree.base_gravity
    cosine = g @ np.asarray(tree.gravity) / (g @ g)
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    vector = ", ".join(f"{x:.4g}" for x in g)
    return [
        f"link `{base}` is carried by {joints} at a tilt of {angle:.3g} degrees "
        f"(moving joints are held near zero): gravity in its frame is [{vector}] m/s²; "
        "if the link is mounted differently, give `gravity` or `base_rotation`."
    ]


def _held_notes(tree: UrdfTree):
    """Return notes on joints that are held, and on objects beside the robot."""
    groups: dict[tuple[str, str], list[str]] = {}
    for joint in tree.mimics:
        master = joint.find("mimic").get("joint", "")
        position = f"{tree.held_at(joint):.4g}"
        groups.setdefault((master, position), []).append(joint.get("name"))
    notes = []
    for (master, position), names in groups.items():
        cause = f"mimic of joint `{master}`" if master else "constraint"
        notes.append(
            f"{owners('joint', names)}: held at {position} ({cause}); "
            "the links belong to the bodies that carry them."
        )
    if tree.objects:
        links = owners("link", tree.objects)
        notes.append(f"{links}: left out, because they float freely.")
    return notes


def _follower_notes(tree: UrdfTree):
    """Return notes on joints that follow others and move bodies of the robot."""
    first_number = len(_leading_joints(tree)) + 1
    led_followers = with_leader(tree.followers)
    for number, follower in enumerate(led_followers, first_number):
        leader_name = tree.joints[follower.leader].get("name")
        yield (
            f"joint `{follower.name}`: follows another one, at {follower.factor:.4g} * "
            f"`{leader_name}` + {follower.offset:.4g}; its body has the number "
            f"{number} (`m{number}`); its friction is included in that of "
            f"`{leader_name}`."
        )
    names = [x.name for x in tree.followers[len(led_followers) :]]
    if names:
        yield (
            f"{owners('joint', names)}: closed loops move these; bodies "
            f"{first_number + len(led_followers)} to {len(tree.joints)} are theirs; "
            f"the end-effector is `{tree.tip}`: if it is another link, name it (`tip`)."
        )


def _effect_notes(tree: UrdfTree):
    """Return notes on effects that the default model leaves out."""
    groups: dict[tuple[str, str], list[str]] = {}
    for effect in tree.effects:
        groups.setdefault((effect.kind, effect.words), []).append(effect.name)
    return [
        f"{owners(kind, names)}: the file states {words}, which changes the forces; "
        "the default model does not include it."
        for (kind, words), names in groups.items()
    ]


def _negative_notes(tree: UrdfTree):
    """Return notes on friction, rotors and springs that are negative."""
    notes = []
    for key in ("armature", "damping", "friction", "stiffness"):
        joints = [
            joint.get("name")
            for joint in tree.joints
            if tree.numbers(joint.find("dynamics"), key, (0.0,))[0] < 0.0
        ]
        if joints:
            notes.append(
                f"{owners('joint', joints)}: `{key}` is negative and is not used: "
                "correct it."
            )
    return notes


def _inertial_notes(tree: UrdfTree):
    """Return notes on bodies without mass, and on links that cannot exist."""
    masses = np.zeros(len(tree.joints))
    links_by_fault = {}
    rounded_links = []
    for link, placement in tree.carriers.items():
        inertia_and_fault = tree.inertial(link) if placement.body >= 0 else None
        if inertia_and_fault is None:
            continue
        inertia, fault = inertia_and_fault
        masses[placement.body] += abs(inertia.mass)
        if fault:
            links_by_fault.setdefault(fault, []).append(link)
        elif inertia.nearest_possible() is not inertia:
            rounded_links.append(link)
    notes = []
    if rounded_links:
        notes.append(
            f"{owners('link', rounded_links)}: because of rounding, a moment of "
            "inertia is slightly larger than the sum of the other two: the prior uses "
            "the nearest moments that a real body can have."
        )
    light_bodies = [tree.joints[i].get("name") for i in np.flatnonzero(masses == 0.0)]
    # Those of virtual joints have none.
    light_bodies = light_bodies[GROUP - 1 if tree.floating else 0 :]
    if light_bodies:
        notes.append(
            f"{owners('joint', light_bodies)}: "
            "the body has no mass; `urdf_parameters` takes zero."
        )
    for fault, links in links_by_fault.items():
        # Only moments have a nearest value that can exist.
        use = "the nearest possible values are used as the prior and to check forces"
        if IMPOSSIBLE not in fault:
            use = f"it {IMPOSSIBLE}, so the inertias of the file are not used"
        names = owners("link", links)
        notes.append(f"{names}: {fault}; {use}: correct the inertial.")
    bodies = tree.bodies()
    densities = ball_densities(bodies)
    joints = tree.joints[-len(bodies) :]
    dense_bodies = np.flatnonzero(densities > MAX_DENSITY)
    if dense_bodies.size and not links_by_fault:
        names = owners("joint", [joints[i].get("name") for i in dense_bodies])
        notes.append(
            f"{names}: mass and moments of the body {IMPOSSIBLE}: "
            f"{densities[dense_bodies[0]]:.2g} kg/m³ are more than the density of any "
            "material (is a mass in grams, or are the moments placeholders?); correct "
            "or remove the values."
        )
    return notes
