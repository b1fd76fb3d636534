"""Links and joints of URDF, xacro and MJCF files."""

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Float, Numbers
from jaxid.errors import InputError

from .inertia import Inertia
from .limits_and_drives import listed
from .mjcf import Loop, mjcf_as_urdf
from .robot import GRAVITY
from .rotations import axis_rotation, rpy_rotation, without_rounding

TURNING = ("revolute", "continuous")
"""Types of joints that turn."""
_ZERO = (0.0, 0.0, 0.0)
_LARGEST_ANGLE = 2 * np.pi + 0.01
"""Largest roll, pitch or yaw that can be in radians; a full turn may be rounded [rad]."""


class UrdfTree:
    """Links and joints of a URDF or MJCF file; fixed and held links are merged into their bodies.

    Only what kinematics and inertias need is read: an error in a mesh, a transmission
    or the element of a simulator does no harm. Arguments and errors are those of
    `load_urdf`.

    Attributes:
        links: Elements of the links, by name.
        carriers: For each link its body (-1: ground) and its placement in the body's
            frame.
        joints: Elements of the moving joints; `parent`, `axis`, `rotation` and `offset`
            as in `Robot`.
        held: Elements of joints that mimic others.
        left_out: Elements of joints on moving bodies that lead to no link of the chain.
        loose: Names of links that float and move no joint, which are left out.
        tip: Name of the end-effector's link.
        compiled: Whether the file is MJCF, whose shapes are no elements of the links.
    """

    def __init__(
        self, path: str | Path, *, base: str | None = None, tip: str | None = None
    ) -> None:
        self.path = str(path)
        self.root, self.gravity, loops = read_description(path)
        self.compiled = is_mjcf(path)
        element = self.root
        name = element.get("name") or Path(path).stem
        self.name = "".join(c if c.isprintable() else " " for c in name)
        self.links = self._named(element, "link")
        self._joints = self._named(element, "joint")
        joints = self._joints.values()
        if any(
            parent.get("link") == "world"
            for j in joints
            for parent in j.iterfind("parent")
        ):
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
                    f"`{argument}` must be a link of `{self.path}`, but is `{link}`; "
                    "its links are "
                    f"{listed(list(self.links))}."
                )
        self.joints, self.parent = [], []
        self.axis, self.rotation, self.offset = [], [], []
        self.held, self.left_out, self.loose = [], [], []
        self._merge(root if base is None else base, tip)
        self._refuse(loops)

    def _named(self, root: Any, tag: str) -> dict[str, Any]:
        """Return the elements of a tag by their names."""
        found: dict[str, Any] = {}
        for element in root.iterfind(tag):
            if (name := self._attribute(element, "name")) in found:
                raise InputError(
                    f"`{self.path}` has two {tag}s named `{name}`: rename one."
                )
            found[name] = element
        return found

    def _add(self, joint: Any) -> None:
        """Enter a joint between the links that it connects."""
        self._attribute(joint, "type")
        for tag in ("parent", "child"):
            if (end := joint.find(tag)) is None:
                raise InputError(f"{self.place(joint)}: the joint has no `<{tag}>`.")
            if (link := self._attribute(end, "link")) not in self.links:
                raise self.error(
                    joint, f"connects link `{link}`, which the file does not define"
                )
        parent, child = link_names(joint)
        if child in self._above:
            raise self.error(
                joint,
                f"moves link `{child}`, as `{self._above[child].get('name')}` does: "
                "remove one",
            )
        self._above[child] = joint
        self._below[parent].append(joint)

    def _find_root(self) -> str:
        """Return the only link that no joint moves."""
        roots = [link for link in self.links if link not in self._above]
        reached = list(roots)
        for link in reached:
            reached += [link_names(joint)[1] for joint in self._below[link]]
        if link := next((link for link in self.links if link not in reached), None):
            raise self.error(
                self._above[link],
                "is part of a closed loop: remove one joint of the loop",
            )
        if len(roots) != 1:
            raise InputError(
                f"`{self.path}` must have one root link, but has "
                f"{listed(roots) or 'none'}: "
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
            fixed, mimic = joint.get("type") == "fixed", joint.find("mimic")
            parent, child = link_names(joint)
            body, R, r = self.carriers[parent]
            if not fixed and chain is not None and joint not in chain:
                self.left_out += [joint] * (body >= 0)
                continue
            if joint.get("type") == "floating" and not self._moves_below(joint):
                self.loose.append(child)
                continue
            rotation, offset = self._origin(joint)
            if mimic is not None and not fixed:
                fixed, (rotation, offset) = True, self.held_pose(joint)
                self.held.append(joint)
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
            below = (
                f"below link `{base}`"
                if tip is None
                else f"between links `{base}` and `{tip}`"
            )
            raise InputError(
                f"`{self.path}` has no moving joint {below}: choose another `base` or "
                "`tip`."
            )

    def placed_links(self) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
        """Return `carriers` with all links below them, whose joints are held where left out."""
        placed = dict(self.carriers)
        waiting = list(placed)
        for link in waiting:
            body, R, r = placed[link]
            for joint in self._below[link]:
                child = link_names(joint)[1]
                if child not in placed and joint.get("type") in (
                    *TURNING,
                    "prismatic",
                    "fixed",
                ):
                    rotation, offset = self.held_pose(joint)
                    placed[child] = body, R @ rotation, r + R @ offset
                    waiting.append(child)
        return placed

    def _refuse(self, loops: Iterable[Loop]) -> None:
        """Reject constraints that close a loop between bodies of the robot."""
        for name, *ends in loops:
            if (
                all(e in self.carriers for e in ends)
                and len({self.carriers[e][0] for e in ends}) > 1
            ):
                raise InputError(
                    f"`{self.path}`: the constraint `{name}` between `{ends[0]}` and "
                    f"`{ends[1]}` "
                    "closes a loop: avoid it (`tip`, `--tip`), or remove it."
                )

    def branch(self, joint: Any) -> Iterator[Any]:
        """Yield a joint and all joints below it."""
        yield joint
        for lower in self._below[link_names(joint)[1]]:
            yield from self.branch(lower)

    def _moves_below(self, joint: Any) -> bool:
        """Return whether the link that a joint carries carries moving joints itself."""
        return any(
            lower.get("type") != "fixed"
            for lower in self.branch(joint)
            if lower is not joint
        )

    def held_at(self, joint: Any) -> float:
        """Return the coordinate nearest to zero that range and mimicked joint allow [rad or m]."""
        factor, offset, passed = 1.0, 0.0, []
        while (mimic := joint.find("mimic")) is not None:
            passed.append(joint)
            offset += factor * float(self.numbers(mimic, "offset", (0.0,))[0])
            if (name := mimic.get("joint")) is None:
                return offset
            factor *= float(self.numbers(mimic, "multiplier", (1.0,))[0])
            if (joint := self._joints.get(name)) is None or joint in passed:
                return offset
        low, high = self.range(joint)
        return offset + factor * min(max(0.0, low), high)

    def held_pose(self, joint: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude and origin [m] in its parent of the link that a held joint carries."""
        R, r = self._origin(joint)
        value = self.held_at(joint)
        if value == 0.0:
            return R, r
        axis = self._axis(joint)
        turns = joint.get("type") in TURNING
        return (
            (R @ axis_rotation(axis, value), r) if turns else (R, r + R @ axis * value)
        )

    def range(self, joint: Any) -> tuple[float, float]:
        """Return the ends of a joint's range, infinite where unknown [rad or m]."""
        low, high = (self.limit(joint, key, np.nan) for key in ("lower", "upper"))
        if joint.get("type") == "continuous" or not (
            np.isfinite(low) or np.isfinite(high)
        ):
            return -np.inf, np.inf
        # A missing bound is zero if the other one is given, as the URDF standard says.
        return 0.0 if np.isnan(low) else low, 0.0 if np.isnan(high) else high

    def _chain(self, base: str, tip: str) -> list[Any]:
        """Return the joints between two links."""
        joints, link = [], tip
        while link != base:
            if link not in self._above:
                raise InputError(
                    f"`{self.path}`: no chain leads from `base` `{base}` to `tip` "
                    f"`{tip}`."
                )
            joints.append(self._above[link])
            link, _ = link_names(joints[-1])
        return joints

    def _origin(self, joint: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude and origin of a joint in its parent link."""
        offset, rpy = (
            self.numbers(joint.find("origin"), key, _ZERO) for key in ("xyz", "rpy")
        )
        if np.abs(rpy).max() > _LARGEST_ANGLE:
            raise self.error(
                joint, f"has an `rpy` of {_words(rpy)}: give radians, not degrees"
            )
        return rpy_rotation(rpy), offset

    def _axis(self, joint: Any) -> np.ndarray:
        """Return the unit vector of a moving joint's axis."""
        kind = joint.get("type")
        if kind not in (*TURNING, "prismatic"):
            cure = "make it fixed"
            if kind == "floating":
                cure = (
                    "hold the robot at its base (`base`, `--base "
                    f"{link_names(joint)[1]}`)"
                )
            raise self.error(
                joint,
                f"is {kind}, but must turn or slide: avoid it (`tip`, `--tip`), or "
                f"{cure}",
            )
        axis = self.numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
        length = np.linalg.norm(axis)
        if length < 1e-9:
            raise self.error(
                joint, "has the zero vector as its axis: give it a direction"
            )
        return without_rounding(axis / length)

    def bodies(self, *, check: bool = False) -> Float[np.ndarray, "joints 10"]:
        """Return the parameters of all bodies; reject links that cannot exist if asked to."""
        parameters = np.zeros((len(self.joints), 10))
        for name, (body, R, r) in self.carriers.items():
            if body < 0 or (inertial := self.inertial(name)) is None:
                continue
            inertia, fault = inertial
            if check and fault:
                raise InputError(
                    f"`{self.path}`: the inertial of link `{name}` belongs to no "
                    f"body: {fault}."
                )
            parameters[body] += inertia.moved(R, r).parameters
        return parameters

    def inertial(self, link: str) -> tuple[Inertia, str] | None:
        """Return a link's inertia in its own frame, and why no body has it; None if it has none."""
        element = self.links[link].find("inertial")
        if element is None:
            return None
        origin = element.find("origin")
        moments = element.find("inertia")
        (mass,) = self.numbers(element.find("mass"), "value", (0.0,))
        rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        tensor = np.array(
            [[self.numbers(moments, key, (0.0,))[0] for key in row] for row in rows]
        )
        xyz, rpy = (self.numbers(origin, key, _ZERO) for key in ("xyz", "rpy"))
        R = rpy_rotation(rpy)
        fault = Inertia(mass, xyz, tensor).fault(rounding=0.01)
        if np.abs(rpy).max() > _LARGEST_ANGLE:
            fault = f"its `rpy` is {_words(rpy)}, which are degrees, not radians"
        return Inertia(mass, xyz, R @ tensor @ R.T), fault

    def place(self, element: Any) -> str:
        """Return file and line of an element, for messages."""
        line = element.sourceline  # None if the file is MJCF
        return f"`{self.path}`, line {line}" if line else f"`{self.path}`"

    def error(self, joint: Any, complaint: str) -> InputError:
        """Return an error about a joint: one sentence that names the file and the joint."""
        return InputError(f"`{self.path}`: joint `{joint.get('name')}` {complaint}.")

    def _attribute(self, element: Any, key: str) -> str:
        if element.get(key) is None:
            raise InputError(
                f"{self.place(element)}: `<{element.tag}>` needs the attribute {key}."
            )
        return element.get(key)

    def numbers(
        self,
        element: Any,
        key: str,
        default: tuple[float, ...],
        *,
        infinite: bool = False,
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
        return float(
            self.numbers(joint.find("limit"), key, (unknown,), infinite=True)[0]
        )


def link_names(joint: Any) -> tuple[str, str]:
    """Return the names of the links that a joint connects: parent and child."""
    return joint.find("parent").get("link"), joint.find("child").get("link")


def read_description(path: str | Path) -> tuple[Any, Numbers, list[Loop]]:
    """Return the URDF element of a URDF, xacro or MJCF file, its gravity, and its closed loops."""
    robot = _parse(path)
    if robot.tag == "mujoco":
        return mjcf_as_urdf(path)
    if any("ros.org/" in e.tag and "xacro" in e.tag for e in robot.iter("*")):
        robot = _parse(path, _expanded(Path(path)))
    if robot.tag != "robot":
        raise InputError(
            f"`{path}` is no URDF: its root is `<{robot.tag}>`, not `<robot>`."
        )
    return robot, GRAVITY, []


def is_mjcf(path: str | Path) -> bool:
    """Return whether a file describes its robot as MJCF."""
    return _parse(path).tag == "mujoco"


def _parse(path: str | Path, text: bytes | None = None) -> Any:
    """Return the root element of a file, or of a text made from it."""
    if not Path(path).is_file():
        raise FileNotFoundError(
            f"the robot's file `{path}` does not exist: check its path."
        )
    # No entity of a file makes the parser read other files.
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    try:
        return etree.fromstring(
            Path(path).read_bytes() if text is None else text, parser
        )
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        raise InputError(
            f"`{path}`, line {line}: this is not XML ({error.msg})."
        ) from error


def _expanded(path: Path) -> bytes:
    """Return a xacro file as the program `xacro` expands it."""
    command = f"`xacro {path} -o {path.name.split('.')[0]}.urdf`"
    if (program := shutil.which("xacro")) is None:
        raise InputError(
            f"`{path}` is a xacro file: expand it by {command} (`pip install xacro`)."
        )
    done = subprocess.run([program, str(path)], capture_output=True)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines() or [
            "no reason given"
        ]
        raise InputError(
            f"`{path}`: {command} fails: {said[0]}: give a file that it has expanded."
        )
    return done.stdout


def _words(values: np.ndarray) -> str:
    return " ".join(f"{x:g}" for x in values)
