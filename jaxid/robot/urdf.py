"""Robots from URDF files, and the inertial parameters that such a file claims."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError

from .inertia import Inertia
from .limits_and_drives import Limits, range_fault
from .robot import GRAVITY, Robot
from .rotations import rpy_rotation, without_rounding

_TURNING = ("revolute", "continuous")
_ZERO = (0.0, 0.0, 0.0)
_ENDLESS = 2e4
"""Range from which a joint turns without end [rad]."""
_LARGEST_ANGLE = 2 * np.pi + 0.01
"""Largest roll, pitch or yaw that can be in radians; a full turn may be rounded [rad]."""


def load_urdf(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    gravity: Numbers = GRAVITY,
    base_rotation: Numbers | None = None,
    base_position: Numbers = _ZERO,
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

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no URDF, is no open tree, has a mimic, floating or planar joint on
            the way, or angles or lengths in other units.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    limits, limit_notes = _limits(tree)
    inertial_notes = _inertial_notes(tree)
    tip_body, tip_rotation, tip_offset = tree.carriers[tree.tip]
    try:
        robot = Robot(
            tree.name,
            parent=tuple(tree.parent),
            revolute=tuple(joint.get("type") in _TURNING for joint in tree.joints),
            axis=tree.axis,
            rotation=tree.rotation,
            offset=tree.offset,
            joint_names=tuple(joint.get("name") for joint in tree.joints),
            gravity=gravity,
            limits=limits,
            tip_body=tip_body,
            tip_rotation=tip_rotation,
            tip_offset=tip_offset,
            source=tree.path,
            notes=(*limit_notes, *inertial_notes),
        )
    except InputError as error:
        raise InputError(f"`{path}`: {error}") from error
    return robot.mounted(base_rotation, base_position)


def urdf_parameters(
    path: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
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
        check: Whether links that cannot exist are rejected; otherwise their numbers are returned
            as they are.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If the file cannot be loaded, an inertia is not finite, or a link cannot exist.
    """
    tree = UrdfTree(path, base=base, tip=tip)
    parameters = np.zeros((len(tree.joints), 10))
    for name, (body, R, r) in tree.carriers.items():
        if body < 0 or (inertial := tree.inertial(name)) is None:
            continue
        inertia, fault = inertial
        if check and fault:
            raise InputError(
                f"`{tree.path}`: the inertial of link `{name}` belongs to no body: {fault}."
            )
        parameters[body] += inertia.moved(R, r).parameters
    return parameters.ravel()


class UrdfTree:
    """Links and joints of a URDF file, with links on fixed joints merged into their bodies.

    Only what kinematics and inertias need is read: an error in a mesh, a transmission or the
    element of a simulator does no harm. Arguments and errors are those of `load_urdf`.

    Attributes:
        links: Elements of the links, by name.
        carriers: For each link its body (-1: ground) and its placement in the body's frame.
        joints: Elements of the moving joints; `parent`, `axis`, `rotation` and `offset` as in
            `Robot`.
        tip: Name of the end-effector's link.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        base: str | None = None,
        tip: str | None = None,
    ) -> None:
        self.path = str(path)
        element = _read_xml(path)
        name = element.get("name") or Path(path).stem
        self.name = "".join(c if c.isprintable() else " " for c in name)
        self.links = self._named(element, "link")
        joints = self._named(element, "joint").values()
        if any(parent.get("link") == "world" for j in joints for parent in j.iterfind("parent")):
            # Simulators know this link, so that many files do not define it.
            self.links.setdefault("world", etree.Element("link", name="world"))
        self._below: dict[str, list[Any]] = {link: [] for link in self.links}
        self._above: dict[str, Any] = {}
        for joint in joints:
            self._add(joint)
        root = self._find_root()
        for argument, link in (("base", base), ("tip", tip)):
            if link is not None and link not in self.links:
                raise InputError(
                    f"`{argument}` must be a link of `{self.path}`, but is `{link}`; its links are "
                    f"{_listed(list(self.links))}."
                )
        self.joints, self.parent = [], []
        self.axis, self.rotation, self.offset = [], [], []
        self._merge(root if base is None else base, tip)

    def _named(self, root: Any, tag: str) -> dict[str, Any]:
        """Return the elements of a tag by their names."""
        found: dict[str, Any] = {}
        for element in root.iterfind(tag):
            if (name := self._attribute(element, "name")) in found:
                raise InputError(f"`{self.path}` has two {tag}s named `{name}`: rename one.")
            found[name] = element
        return found

    def _add(self, joint: Any) -> None:
        """Enter a joint between the links that it connects."""
        self._attribute(joint, "type")
        for tag in ("parent", "child"):
            if (end := joint.find(tag)) is None:
                raise InputError(f"{self.place(joint)}: the joint has no `<{tag}>`.")
            if (link := self._attribute(end, "link")) not in self.links:
                raise self.error(joint, f"connects link `{link}`, which the file does not define")
        parent, child = _ends(joint)
        if child in self._above:
            raise self.error(
                joint,
                f"moves link `{child}`, as `{self._above[child].get('name')}` does: remove one",
            )
        self._above[child] = joint
        self._below[parent].append(joint)

    def _find_root(self) -> str:
        """Return the only link that no joint moves."""
        roots = [link for link in self.links if link not in self._above]
        reached = list(roots)
        for link in reached:
            reached += [_ends(joint)[1] for joint in self._below[link]]
        if link := next((link for link in self.links if link not in reached), None):
            raise self.error(
                self._above[link],
                "is part of a closed loop: remove one joint of the loop",
            )
        if len(roots) != 1:
            raise InputError(
                f"`{self.path}` must have one root link, but has {_listed(roots) or 'none'}: "
                "connect several by fixed joints."
            )
        return roots[0]

    def _merge(self, base: str, tip: str | None) -> None:
        """Merge links on fixed joints into the bodies that carry them, depth first."""
        chain = None if tip is None else self._chain(base, tip)
        self.carriers = {base: (-1, np.eye(3), np.zeros(3))}
        length = {base: (0, 0)}
        waiting = self._below[base][::-1]
        while waiting:
            joint = waiting.pop()
            fixed = joint.get("type") == "fixed"
            if not fixed and chain is not None and joint not in chain:
                continue
            parent, child = _ends(joint)
            rotation, offset = self._origin(joint)
            body, R, r = self.carriers[parent]
            r = r + R @ offset
            R = without_rounding(R @ rotation)
            if fixed:
                self.carriers[child] = (body, R, r)
            else:
                self.axis.append(self._axis(joint))
                self.carriers[child] = (len(self.joints), np.eye(3), np.zeros(3))
                self.joints.append(joint)
                self.parent.append(body)
                self.rotation.append(R)
                self.offset.append(r)
            moving, links = length[parent]
            length[child] = (moving + (not fixed), links + 1)
            waiting += self._below[child][::-1]
        self.tip = max(length, key=lambda link: length[link]) if tip is None else tip
        if self.carriers[self.tip][0] < 0:
            below = f"below link `{base}`" if tip is None else f"between links `{base}` and `{tip}`"
            raise InputError(
                f"`{self.path}` has no moving joint {below}: choose another `base` or `tip`."
            )

    def _chain(self, base: str, tip: str) -> list[Any]:
        """Return the joints between two links."""
        joints, link = [], tip
        while link != base:
            if link not in self._above:
                raise InputError(
                    f"`{self.path}`: no chain leads from `base` `{base}` to `tip` `{tip}`."
                )
            joints.append(self._above[link])
            link, _ = _ends(joints[-1])
        return joints

    def _origin(self, joint: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude and origin of a joint in its parent link."""
        offset, rpy = (self.numbers(joint.find("origin"), key, _ZERO) for key in ("xyz", "rpy"))
        if np.abs(rpy).max() > _LARGEST_ANGLE:
            raise self.error(joint, f"has an `rpy` of {_words(rpy)}: give radians, not degrees")
        return rpy_rotation(rpy), offset

    def _axis(self, joint: Any) -> np.ndarray:
        """Return the unit vector of a moving joint's axis."""
        kind, mimic = joint.get("type"), joint.find("mimic")
        if kind not in (*_TURNING, "prismatic") or mimic is not None:
            fault = f"is {kind}" if mimic is None else f"mimics joint `{mimic.get('joint')}`"
            raise self.error(
                joint,
                f"{fault}, but must turn or slide: avoid it (`tip`, `--tip`), or make it fixed",
            )
        axis = self.numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
        length = np.linalg.norm(axis)
        if length < 1e-9:
            raise self.error(joint, "has the zero vector as its axis: give it a direction")
        return without_rounding(axis / length)

    def inertial(self, link: str) -> tuple[Inertia, str] | None:
        """Return a link's inertia in its own frame, and why no body has it; None if it has none."""
        element = self.links[link].find("inertial")
        if element is None:
            return None
        origin = element.find("origin")
        moments = element.find("inertia")
        (mass,) = self.numbers(element.find("mass"), "value", (0.0,))
        rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        tensor = np.array([[self.numbers(moments, key, (0.0,))[0] for key in row] for row in rows])
        xyz, rpy = (self.numbers(origin, key, _ZERO) for key in ("xyz", "rpy"))
        R = rpy_rotation(rpy)
        fault = Inertia(mass, xyz, tensor).fault(rounding=0.01)
        if np.abs(rpy).max() > _LARGEST_ANGLE:
            fault = f"its `rpy` is {_words(rpy)}, which are degrees, not radians"
        return Inertia(mass, xyz, R @ tensor @ R.T), fault

    def place(self, element: Any) -> str:
        """Return file and line of an element, for messages."""
        return f"`{self.path}`, line {element.sourceline}"

    def error(self, joint: Any, complaint: str) -> InputError:
        """Return an error about a joint: one sentence that names the file and the joint."""
        return InputError(f"`{self.path}`: joint `{joint.get('name')}` {complaint}.")

    def _attribute(self, element: Any, key: str) -> str:
        if element.get(key) is None:
            raise InputError(f"{self.place(element)}: `<{element.tag}>` needs the attribute {key}.")
        return element.get(key)

    def numbers(
        self, element: Any, key: str, default: tuple[float, ...], *, infinite: bool = False
    ) -> np.ndarray:
        """Return the numbers of an attribute, or the default where the element lacks it."""
        text = None if element is None else element.get(key)
        if text is None:
            return np.array(default)
        try:
            array = np.array([float(word) for word in text.split()])
        except ValueError:
            array = np.zeros(0)
        wrong = np.isnan(array) if infinite else ~np.isfinite(array)
        if array.shape != (len(default),) or wrong.any():
            raise InputError(
                f"{self.place(element)}: `{key}` must hold {len(default)} finite "
                f'{"number" if len(default) == 1 else "numbers"}, but is "{text}".'
            )
        return array

    def limit(self, joint: Any, key: str, unknown: float) -> float:
        """Return a number of a joint's `<limit>`, which may be infinite."""
        return float(self.numbers(joint.find("limit"), key, (unknown,), infinite=True)[0])


def _ends(joint: Any) -> tuple[str, str]:
    """Return the names of the links that a joint connects: parent and child."""
    return joint.find("parent").get("link"), joint.find("child").get("link")


def _limits(tree: UrdfTree) -> tuple[Limits, list[str]]:
    values, notes = np.full((4, len(tree.joints)), np.inf), []
    values[0] = -np.inf
    for i, joint in enumerate(tree.joints):
        name = joint.get("name")
        turns = joint.get("type") in _TURNING
        low, high = (tree.limit(joint, key, np.nan) for key in ("lower", "upper"))
        # A missing bound is zero if the other one is given, as the URDF standard says.
        bounded = np.isfinite(low) or np.isfinite(high)
        low = (0.0 if bounded else -np.inf) if np.isnan(low) else low
        high = (0.0 if bounded else np.inf) if np.isnan(high) else high
        if low == high == 0.0 and joint.get("type") != "continuous":
            notes.append(f"joint `{name}`: a range from 0 to 0 is taken as unknown.")
        elif joint.get("type") != "continuous" and not (turns and high - low >= _ENDLESS):
            if fault := range_fault(low, high, turns):
                unit = "radians, not degrees" if turns else "metres"
                raise tree.error(joint, f"{fault}: limits in a URDF are in {unit}")
            if low >= high:
                raise tree.error(joint, f"ranges from {low:g} to {high:g}: exchange the ends")
            values[:2, i] = low, high
        for k, key in enumerate(("velocity", "effort"), 2):
            value = tree.limit(joint, key, np.inf)
            if value > 0.0:
                values[k, i] = value
            else:
                notes.append(f"joint `{name}`: {key} {value:g} is taken as unknown.")
    low, high, speed, force = values
    limits = Limits(position_min=low, position_max=high, velocity=speed, force=force)
    return limits, notes


def _inertial_notes(tree: UrdfTree) -> Iterator[str]:
    """Yield notes on bodies without mass, and on links that cannot exist."""
    inertials = {n: tree.inertial(n) for n, (body, _, _) in tree.carriers.items() if body >= 0}
    massive = {tree.carriers[name][0] for name in inertials if inertials[name] is not None}
    for i, joint in enumerate(tree.joints):
        if i not in massive:
            yield (
                f"joint `{joint.get('name')}`: its body has no mass; `urdf_parameters` takes zero."
            )
    for name, inertial in inertials.items():
        if inertial is not None and inertial[1]:
            yield (
                f"link `{name}`: its inertial, which identification does not need, belongs to no "
                f"body: {inertial[1]}."
            )


def _read_xml(path: str | Path) -> Any:
    """Return the root element of a URDF file."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"the URDF file `{path}` does not exist: check its path.")
    # No entity of a file makes the parser read other files.
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, remove_comments=True
    )
    try:
        document = etree.parse(str(path), parser)
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        raise InputError(f"`{path}`, line {line}: this is not XML ({error.msg}).") from error
    robot = document.getroot()
    if any("ros.org/" in str(e.tag) and "xacro" in str(e.tag) for e in robot.iter()):
        raise InputError(
            f"`{path}` is a xacro file: expand it (`xacro arm.urdf.xacro -o arm.urdf`)."
        )
    if robot.tag != "robot":
        raise InputError(f"`{path}` is no URDF: its root is `<{robot.tag}>`, not `<robot>`.")
    return robot


def _words(values: np.ndarray) -> str:
    return " ".join(f"{x:g}" for x in values)


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
