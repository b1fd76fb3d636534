"""Links and joints of URDF, xacro and MJCF files, merged into the bodies of a robot."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Matrix3, Vector3
from jaxid.errors import InputError

from .description_files import is_mjcf, read_description
from .follower_joints import (
    Followers,
    joints_of_loops,
    loaded_followers,
    loops_of_bodies,
    relation,
    resolved_followers,
)
from .inertia import BodyParameters, Inertia
from .limits_and_drives import MAX_LINK_LENGTH, are_degrees, listed
from .rotations import Placement, axis_rotation, without_rounding
from .urdf_elements import ORIGIN, UrdfElements
from .virtual_joints import GROUP, virtual_elements

TURNING_TYPES = ("revolute", "continuous")
"""Types of joints that turn."""
HOLDABLE_TYPES = (*TURNING_TYPES, "prismatic", "fixed")
"""Types of joints that can be held at one coordinate."""
MAX_ROUNDING = 1e-6
"""Change of gravity's direction that is rounding [rad]."""


class UrdfTree(UrdfElements):
    """Links and joints of a URDF or MJCF file, merged into bodies.

    Links on fixed or held joints become part of the body that carries them. Only what
    kinematics and inertias need is read: an error in a mesh, a transmission or the
    element of a simulator does no harm. Arguments and errors are those of `load_urdf`.

    Attributes:
        gravity: Acceleration of gravity in the frame of the file's root [m/s²].
        base_gravity: The same in the frame of the base, as the joints above it turn it.
        tilting_joints: Elements of these joints, as far as they tilt the base, or can.
        links: Elements of the links, by name.
        carriers: For each link its placement on the body that carries it.
        named_joints: Elements of all joints, by name.
        joints: Elements of the moving joints; those that follow others come last.
        followers: How these follow others, or that loops move them.
        loops: Points of bodies that coincide.
        poses: Coordinates of joints by their names, in the poses that the file states.
        axes: Axes of the moving joints.
        placements: Placements of the bodies that they move, on the bodies that carry
            them.
        mimics: Elements of joints that mimic others and are held.
        side_joints: Elements of joints on moving bodies that lead to no link of the
            chain.
        effects: Effects on forces of bodies that the default model leaves out.
        objects: Names of links that float and move no joint, which are left out.
        tip: Name of the end-effector's link.
        contact_shapes: Shapes of the feet of an MJCF file, by the names of their links.
        floating: Whether the base is on virtual joints.
        compiled: Whether the file is MJCF, whose shapes are no elements of the links.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        base: str | None = None,
        tip: str | None = None,
        xacro_arguments: Mapping[str, str] | None = None,
        floating: bool = False,
    ) -> None:
        self.path = str(path)
        self.floating = floating
        description = read_description(path, xacro_arguments)
        self.root, self.gravity, loops, effects, motors, self.poses = description[:6]
        self.contact_shapes = description.contacts
        self.compiled = is_mjcf(path)
        name = self.root.get("name") or Path(path).stem
        self.name = "".join(c if c.isprintable() else " " for c in name)
        self.links = self.named("link")
        self.named_joints = self.named("joint")
        if self.root.find("joint/parent[@link='world']") is not None:
            # Simulators know this link, so that many files do not define it.
            self.links.setdefault("world", etree.Element("link", name="world"))
        if floating:
            base = self._float(base)
        self._below: dict[str, list[Any]] = {link: [] for link in self.links}
        self._above: dict[str, Any] = {}
        for joint in self.named_joints.values():
            self._add(joint)

        root = self._find_root()
        self.require_link("base", base)
        self.require_link("tip", tip)
        self.followers: Followers = ()
        self.base_gravity = np.array(self.gravity, np.float64)
        self.tilting_joints = []
        for joint in reversed(self._chain(root, base or root)):
            self._turn_gravity(joint)
        self._merge(base or root, tip)
        # The bodies tell which followers move more than a finger.
        tip_chain = self._chain(base or root, tip or base or root)
        loop_joints = joints_of_loops(self, loops, tip_chain)
        followers = loaded_followers(self, tip_chain, loop_joints)
        joints = [*followers, *loop_joints]
        if joints:
            self._merge(base or root, tip, joints)
            alone = (*followers, *(self.named_joints[name] for name in motors))
            self._put_last(followers, [x for x in loop_joints if x not in alone])
        self.loops = tuple(loops_of_bodies(self, loops))
        links = ("", *self.moving_links)
        self.effects = [x for x in effects if x.link in links]

    def _float(self, base: str | None):
        """Put the base on virtual joints; return the link that carries them."""
        self.require_link("base", base)
        above = {link_names(joint)[1]: joint for joint in self.named_joints.values()}
        for joint in self.named_joints.values():
            if joint.get("type") == "floating":
                base = base or link_names(joint)[1]
        roots = [link for link in self.links if link not in above]
        base = base or roots[0]
        ground = f"{base} ground"
        if base in above:
            # What carries the base in the file is part of the ground.
            joint = copy.deepcopy(above[base])
            joint.set("type", "fixed")
            joint.find("child").set("link", ground)
            self.named_joints[joint.get("name")] = joint
        self.links[ground] = etree.Element("link", name=ground)
        for joint, link in virtual_elements(base, ground):
            self.named_joints[joint.get("name")] = joint
            self.links.setdefault(link.get("name"), link)
        return ground

    def require_link(self, argument: str, link: str | None):
        """Reject an argument that names no link."""
        if link is not None and link not in self.links:
            raise InputError(
                f"`{argument}` must be a link of `{self.path}`, but is `{link}`; "
                f"its links are {listed(list(self.links))}."
            )

    def _add(self, joint: Any):
        """Enter a joint between the links that it connects."""
        self.attribute(joint, "type")
        for tag in ("parent", "child"):
            end = joint.find(tag)
            if end is None:
                raise InputError(f"{self.place(joint)}: the joint has no `<{tag}>`.")
            link = self.attribute(end, "link")
            if link not in self.links:
                raise self.error(
                    joint,
                    f"connects link `{link}`, which the file does not define: "
                    "remove the joint, or define the link",
                )
        parent, child = link_names(joint)
        if child in self._above:
            other_joint = self._above[child].get("name")
            raise self.error(
                joint, f"moves link `{child}`, as `{other_joint}` does: remove one"
            )
        self._above[child] = joint
        self._below[parent].append(joint)

    def _find_root(self):
        """Return the only link that no joint moves."""
        if not self.links:
            raise InputError(
                f"`{self.path}` has no links: give the file that describes the robot."
            )
        roots = [link for link in self.links if link not in self._above]
        tree_links = list(roots)
        for link in tree_links:
            tree_links += [link_names(joint)[1] for joint in self._below[link]]
        reached_links = set(tree_links)
        for link in self.links:
            if link not in reached_links:
                raise self.error(
                    self._above[link],
                    "is part of a closed loop: remove one joint of the loop",
                )
        if len(roots) != 1:
            raise InputError(
                f"`{self.path}` must have one root link, but has "
                f"{listed(roots)}: connect them by fixed joints."
            )
        return roots[0]

    def _turn_gravity(self, joint: Any):
        """Turn gravity from the frame of a joint's parent into that of its child."""
        kind = joint.get("type")
        # How a robot floats is unknown: the file's attitude is that at rest.
        pose = self.held_pose if kind in HOLDABLE_TYPES else self._origin
        attitude, _ = pose(joint)
        gravity = attitude.T @ self.base_gravity
        change = gravity - self.base_gravity
        if kind in TURNING_TYPES:
            change = np.append(change, np.cross(self._axis(joint), gravity))
        if np.linalg.norm(change) > MAX_ROUNDING * np.linalg.norm(gravity):
            self.tilting_joints.append(joint)
        self.base_gravity = gravity + 0.0  # makes -0.0 positive

    def _merge(self, base: str, tip: str | None, followers: Sequence[Any] = ()):
        """Merge links on fixed joints into the bodies that carry them, depth first.

        Joints that mimic others are held, unless they are among the followers.
        """
        self.joints = []
        self.axes = []
        self.placements: list[Placement] = []
        self.mimics = []
        self.side_joints = []
        self.objects = []
        chain = None if tip is None else [*self._chain(base, tip), *followers]
        self.carriers = {base: Placement(-1, np.eye(3), np.zeros(3))}
        # Numbers of moving joints and of links on the way from the base.
        lengths = {base: (0, 0)}
        # A stack in reverse order gives the joints of a link in the order of the file.
        stack = self._below[base][::-1]
        while stack:
            joint = stack.pop()
            parent, child = link_names(joint)
            is_fixed = joint.get("type") == "fixed"
            if not is_fixed and chain is not None and joint not in chain:
                # What the base carries beside the chain is no part of any body.
                if self.carriers[parent].body >= 0:
                    self.side_joints.append(joint)
                continue
            if joint.get("type") == "floating" and not self._moves_below(joint):
                self.objects.append(child)
                continue
            is_mimic = joint.find("mimic") is not None and joint not in followers
            if not is_fixed and is_mimic:
                is_fixed = True
                self.mimics.append(joint)
            if is_fixed:
                carrier = self.carriers[parent]
                self.carriers[child] = carrier.of(*self.held_pose(joint))
            else:
                self._add_body(joint)
            joints, links = lengths[parent]
            lengths[child] = (joints + (not is_fixed), links + 1)
            stack += self._below[child][::-1]

        self.tip = tip or max(lengths, key=lambda link: lengths[link])
        if self.carriers[self.tip].body < 0:
            raise self._no_joint_error(base, tip)

    def _no_joint_error(self, base: str, tip: str | None):
        """Return the error of a file without a moving joint between two links."""
        way = f"below link `{base}`"
        if tip is not None:
            way = f"between links `{base}` and `{tip}`"
        return InputError(
            f"`{self.path}` has no moving joint {way}: choose another `base` or `tip`."
        )

    def _add_body(self, joint: Any):
        """Enter the body that a joint moves."""
        parent, child = link_names(joint)
        placement = self.carriers[parent].of(*self._origin(joint))
        self.carriers[child] = Placement(len(self.joints), np.eye(3), np.zeros(3))
        self.joints.append(joint)
        self.axes.append(self._axis(joint))
        self.placements.append(placement)

    def _put_last(self, followers: Sequence[Any], moved_joints: Sequence[Any]):
        """Put the bodies of followers last, behind them those that loops move."""
        places = [
            (joint in followers) + 2 * (joint in moved_joints) for joint in self.joints
        ]
        order = np.argsort(places, kind="stable").tolist()
        numbers = {body: place for place, body in enumerate(order)}
        numbers[-1] = -1
        self.joints = [self.joints[body] for body in order]
        self.axes = [self.axes[body] for body in order]
        placements = [self.placements[body] for body in order]
        self.placements = [placement.renumbered(numbers) for placement in placements]
        for link, carrier in self.carriers.items():
            self.carriers[link] = carrier.renumbered(numbers)
        self.followers = resolved_followers(self, followers, moved_joints)

    def placed_links(self) -> dict[str, Placement]:
        """Return `carriers`, and links on joints that the chain leaves out."""
        placements = dict(self.carriers)
        links = list(placements)
        for link in links:
            for joint in self._below[link]:
                _, child = link_names(joint)
                if joint.get("type") in HOLDABLE_TYPES and child not in placements:
                    placements[child] = placements[link].of(*self.held_pose(joint))
                    links.append(child)
        return placements

    def joints_above(self, link: str):
        """Return the joints between a link and the root."""
        joints = []
        while link in self._above:
            joints.append(self._above[link])
            link, _ = link_names(self._above[link])
        return joints

    @property
    def moving_links(self) -> list[str]:
        """Names of the links that are part of bodies."""
        return [link for link, carrier in self.carriers.items() if carrier.body >= 0]

    def mass(self, link: str) -> float:
        """Return the mass that the file states for a link [kg]."""
        element = self.links[link].find("inertial/mass")
        return float(self.numbers(element, "value", (0.0,))[0])

    def branch(self, joint: Any) -> Iterator[Any]:
        """Yield a joint and all joints below it."""
        yield joint
        for lower_joint in self._below[link_names(joint)[1]]:
            yield from self.branch(lower_joint)

    def _moves_below(self, joint: Any):
        """Return whether the link that a joint carries carries moving joints itself."""
        _, *lower_joints = self.branch(joint)
        return any(joint_below.get("type") != "fixed" for joint_below in lower_joints)

    def held_at(self, joint: Any) -> float:
        """Return the coordinate at which a joint is held [rad or m].

        It is as near to zero as the range of the joint allows, or that of the joint
        that it mimics.
        """
        leader, factor, offset, _ = relation(self, joint)
        if leader is None:
            return offset
        low, high = self.range(leader)
        return offset + factor * min(max(0.0, low), high)

    def held_pose(self, joint: Any) -> tuple[Matrix3, Vector3]:
        """Return attitude and origin [m] of a held joint's link in its parent."""
        R, r = self._origin(joint)
        value = 0.0 if joint.get("type") == "fixed" else self.held_at(joint)
        if value == 0.0:
            return R, r
        axis = self._axis(joint)
        if joint.get("type") in TURNING_TYPES:
            return R @ axis_rotation(axis, value), r
        return R, r + R @ axis * value

    def range(self, joint: Any) -> tuple[float, float]:
        """Return the ends of a joint's range, infinite where unknown [rad or m].

        Soft limits narrow it: beyond them a controller slows the joint down.
        """
        hard_low, hard_high = self.hard_range(joint)
        element = joint.find("safety_controller")
        soft_low = float(self.numbers(element, "soft_lower_limit", (0.0,))[0])
        soft_high = float(self.numbers(element, "soft_upper_limit", (0.0,))[0])
        low = max(hard_low, soft_low)
        high = min(hard_high, soft_high)
        # Both soft limits are zero where a file states none.
        return (low, high) if low < high else (hard_low, hard_high)

    def hard_range(self, joint: Any) -> tuple[float, float]:
        """Return the ends of the range at which a joint stops."""
        low = self.limit(joint, "lower", np.nan)
        high = self.limit(joint, "upper", np.nan)
        has_limit = np.isfinite(low) or np.isfinite(high)
        if joint.get("type") == "continuous" or not has_limit:
            return -np.inf, np.inf
        # A missing bound is zero if the other one is given, as the URDF standard says.
        return 0.0 if np.isnan(low) else low, 0.0 if np.isnan(high) else high

    def _chain(self, base: str, tip: str):
        """Return the joints between two links."""
        joints = []
        link = tip
        while link != base:
            if link not in self._above:
                raise InputError(
                    f"`{self.path}`: no chain leads "
                    f"from `base` `{base}` to `tip` `{tip}`."
                )
            joints.append(self._above[link])
            link, _ = link_names(self._above[link])
        return joints

    def _origin(self, joint: Any):
        """Return attitude and origin of a joint in its parent link."""
        element = joint.find("origin")
        offset = self.numbers(element, "xyz", ORIGIN)
        rpy = self.numbers(element, "rpy", ORIGIN)
        if are_degrees(rpy):
            raise self.error(
                joint, f"has an `rpy` of {_words(rpy)}: give radians, not degrees"
            )
        length = np.abs(offset).max()
        if length > MAX_LINK_LENGTH:
            raise self.error(
                joint, f"stands {length:g} m from its link: give its place in metres"
            )
        return self.attitude(element), offset

    def _axis(self, joint: Any):
        """Return the unit vector of a moving joint's axis."""
        kind = joint.get("type")
        if kind not in (*TURNING_TYPES, "prismatic"):
            raise self._type_error(joint)
        axis = self.numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
        size = np.abs(axis).max()
        if size < 1e-9:
            raise self.error(
                joint, "has the zero vector as its axis: give it a direction"
            )
        direction = axis / size  # huge numbers have no finite length
        return without_rounding(direction / np.linalg.norm(direction))

    def _type_error(self, joint: Any):
        """Return the error of a joint that neither turns nor slides."""
        kind = joint.get("type")
        if kind not in ("floating", "planar", "ball"):
            types = ", ".join(f"`{name}`" for name in HOLDABLE_TYPES)
            return self.error(joint, f"has the type `{kind}`: write one of {types}")
        cure = "make it fixed"
        if kind == "ball":
            cure = "remove it, which fixes its body"
        elif self._moves_below(joint):
            _, child = link_names(joint)
            cure = f"hold the robot at its base (`base`, `--base {child}`)"
        return self.error(
            joint,
            f"is {kind}, but must turn or slide: avoid it (`tip`, `--tip`), or {cure}",
        )

    def bodies(self, *, check: bool = False, nearest: bool = False) -> BodyParameters:
        """Return the parameters of all bodies; reject impossible links if asked to.

        With `nearest`, moments of links are the nearest that can exist. Virtual joints
        have one body together.
        """
        parameters = np.zeros((len(self.joints), 10))
        for link, (body, rotation, position) in self.carriers.items():
            inertia_and_fault = self.inertial(link, nearest=nearest)
            if body < 0 or inertia_and_fault is None:
                continue
            inertia, fault = inertia_and_fault
            if check and fault:
                raise InputError(
                    f"`{self.path}`: link `{link}` cannot exist: {fault}; "
                    "correct its inertial."
                )
            parameters[body] += inertia.moved(rotation, position).parameters
        return parameters[GROUP - 1 :] if self.floating else parameters

    def inertial(
        self, link: str, *, nearest: bool = False
    ) -> tuple[Inertia, str] | None:
        """Return a link's inertia in its own frame and why no body has it; or None."""
        element = self.links[link].find("inertial")
        if element is None:
            return None
        mass = self.mass(link)
        moments = element.find("inertia")
        keys = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
        entries = [self.numbers(moments, key, (0.0,))[0] for key in keys]
        tensor = np.reshape(entries, (3, 3))
        origin = element.find("origin")
        centre = self.numbers(origin, "xyz", ORIGIN)
        rpy = self.numbers(origin, "rpy", ORIGIN)

        inertia = Inertia(mass, centre, tensor)
        if nearest:
            inertia = inertia.nearest_possible()
        fault = inertia.fault(rounding=0.01)
        if are_degrees(rpy):
            fault = f"`rpy` is {_words(rpy)}, which are degrees, not radians"
        R = self.attitude(origin)
        return Inertia(mass, centre, R @ inertia.tensor @ R.T), fault

    def limit(self, joint: Any, key: str, unknown: float) -> float:
        """Return a number of a joint's `<limit>`, which may be infinite."""
        element = joint.find("limit")
        return float(self.numbers(element, key, (unknown,), infinite=True)[0])


def link_names(joint: Any) -> tuple[str, str]:
    """Return the names of the links that a joint connects: parent and child."""
    return joint.find("parent").get("link"), joint.find("child").get("link")


def _words(values: np.ndarray):
    """Return numbers as they are shown in messages."""
    return " ".join(f"{x:g}" for x in values)
