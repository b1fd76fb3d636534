"""URDF file as a checked tree of links and joints."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.errors import InputError
from jaxid.robot.inertia import Inertia
from jaxid.robot.kinematics import rpy_rotation
from jaxid.robot.plausibility import LARGEST_ANGLE, check_name

_ZERO = (0.0, 0.0, 0.0)


class UrdfJoint(NamedTuple):
    """Joint of a URDF file."""

    name: str
    kind: str
    parent: str
    child: str
    element: Any


class UrdfInertial(NamedTuple):
    """Inertial of a link: about its own frame, which is placed in the link's frame."""

    own: Inertia
    xyz: np.ndarray
    rpy: np.ndarray

    def in_link(self) -> Inertia:
        """Return the inertia in the frame of the link."""
        return self.own.moved(rpy_rotation(self.rpy), self.xyz)

    def fault(self) -> str:
        """Return why no body has this inertial; an empty text if one may, up to rounding."""
        if np.abs(self.rpy).max() > LARGEST_ANGLE:
            return f"its `rpy` is {words(self.rpy)}, which are degrees, not radians"
        return Inertia(self.own.mass, self.xyz, self.own.tensor).fault(rounding=0.01)


class UrdfTree:
    """Links and joints of a URDF file, which must form one tree.

    Only what kinematics and inertias need is read: an error in a mesh, a transmission or the
    element of a simulator does no harm.

    Attributes:
        path: Path of the file, as it reads in messages.
        name: Name of the robot; that of the file if it has none.
        links: Elements of the links, by name.
        children: Joints that start at each link, in the order of the file.
        joint_above: Joint that ends at each link; the root has none.
        root: Name of the link that has no parent.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no URDF, or its joints do not form one tree.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = str(path)
        element = read_xml(path)
        name = element.get("name") or Path(path).stem
        self.name = "".join(c if c.isprintable() else " " for c in name)
        self.links = {self._name(e): e for e in self._unique(element, "link")}
        self.children: dict[str, list[UrdfJoint]] = {link: [] for link in self.links}
        self.joint_above: dict[str, UrdfJoint] = {}
        for joint in map(self._joint, self._unique(element, "joint")):
            self._add(joint)
        self.root = self._find_root()

    def _name(self, element: Any) -> str:
        return check_name(f"a {element.tag} of `{self.path}`", self.attribute(element, "name"))

    def _unique(self, element: Any, tag: str) -> Iterator[Any]:
        names = set()
        for one in element.iterfind(tag):
            if (name := self._name(one)) in names:
                raise InputError(f"`{self.path}` has two {tag}s named `{name}`: rename one.")
            names.add(name)
            yield one

    def _joint(self, element: Any) -> UrdfJoint:
        ends = []
        for tag in ("parent", "child"):
            end = self.child(element, tag)
            if end is None:
                raise InputError(f"{self.place(element)}: the joint has no `<{tag}>`.")
            ends.append(self.attribute(end, "link"))
        name, kind = (self.attribute(element, key) for key in ("name", "type"))
        return UrdfJoint(name, kind, ends[0], ends[1], element)

    def _add(self, joint: UrdfJoint) -> None:
        for end in (joint.parent, joint.child):
            if end not in self.children:
                raise self.error(joint, f"connects link `{end}`, which the file does not define")
        if joint.child in self.joint_above:
            other = self.joint_above[joint.child].name
            raise self.error(
                joint,
                f"moves link `{joint.child}`, which joint `{other}` moves as well; closed loops "
                "are not supported, so open the loop by removing one of the two joints",
            )
        self.joint_above[joint.child] = joint
        self.children[joint.parent].append(joint)

    def _find_root(self) -> str:
        roots = [name for name in self.children if name not in self.joint_above]
        if len(roots) > 1:
            raise InputError(
                f"`{self.path}` has several root links ({_listed(roots)}), but must be one tree: "
                "connect them by fixed joints."
            )
        waiting, reached = list(roots), set(roots)
        while waiting:
            below = [joint.child for joint in self.children[waiting.pop()]]
            waiting += below
            reached.update(below)
        for link in self.children:
            if link not in reached:
                raise self.error(
                    self.joint_above[link],
                    f"is part of a closed loop: no path leads from a root link to `{link}`; "
                    "remove one joint of the loop",
                )
        if not roots:
            raise InputError(f"`{self.path}` has no links.")
        return roots[0]

    def error(self, joint: UrdfJoint, complaint: str) -> InputError:
        """Return an error about a joint: one sentence that names the file and the joint."""
        return InputError(f"`{self.path}`: joint `{joint.name}` {complaint}.")

    def place(self, element: Any) -> str:
        """Return file and line of an element, for messages."""
        return f"`{self.path}`, line {element.sourceline}"

    def attribute(self, element: Any, key: str) -> str:
        """Return an attribute that an element must have."""
        if element.get(key) is None:
            raise InputError(f"{self.place(element)}: `<{element.tag}>` needs the attribute {key}.")
        return element.get(key)

    def child(self, element: Any, tag: str) -> Any:
        """Return the only child element of a name, or None."""
        found = element.findall(tag)
        if len(found) > 1:
            raise InputError(
                f"{self.place(found[1])}: `<{element.tag}>` has a second `<{tag}>`, but only one "
                "is allowed."
            )
        return found[0] if found else None

    def numbers(
        self, element: Any, key: str, default: tuple[float, ...], *, infinite: bool = False
    ) -> np.ndarray:
        """Return the numbers of an attribute, or the default where the element lacks it.

        Raises:
            InputError: If one is not finite, or there are too few or too many.
        """
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

    def require_link(self, name: str, link: str) -> str:
        """Return a link of the file.

        Args:
            name: Name of the argument that holds it, for messages.
            link: Name of the link.

        Raises:
            InputError: If the file does not have it.
        """
        if link not in self.children:
            raise InputError(
                f"`{name}` must be a link of `{self.path}`, but is `{link}`; its links are "
                f"{_listed(list(self.children))}."
            )
        return link

    def chain(self, base: str, tip: str) -> list[UrdfJoint]:
        """Return the joints from one link to another, in this order.

        Raises:
            InputError: If the tip does not lie below the base.
        """
        joints, link = [], tip
        while link != base:
            joint = self.joint_above.get(link)
            if joint is None:
                raise InputError(
                    f"`{self.path}`: no chain leads from `base` `{base}` to `tip` `{tip}`."
                )
            joints.append(joint)
            link = joint.parent
        return joints[::-1]

    def inertial(self, link: str) -> UrdfInertial | None:
        """Return the inertial of a link, or None if it has none."""
        element = self.child(self.links[link], "inertial")
        if element is None:
            return None
        origin = self.child(element, "origin")
        mass = self.numbers(self.child(element, "mass"), "value", (0.0,))[0]
        moments = self.child(element, "inertia")
        xx, xy, xz, yy, yz, zz = (
            self.numbers(moments, f"i{key}", (0.0,))[0]
            for key in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        xyz, rpy = (self.numbers(origin, key, _ZERO) for key in ("xyz", "rpy"))
        return UrdfInertial(Inertia(mass, np.zeros(3), tensor), xyz, rpy)


def read_xml(path: str | Path) -> Any:
    """Return the root element of a URDF file.

    Raises:
        FileNotFoundError: If the file does not exist.
        InputError: If it is no XML, has a DOCTYPE, is a xacro file, or no URDF.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"the URDF file `{path}` does not exist: check its path.")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, remove_comments=True
    )
    try:
        document = etree.parse(str(path), parser)
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        raise InputError(f"`{path}`, line {line}: this is not XML ({error.msg}).") from error
    if document.docinfo.doctype or document.docinfo.internalDTD is not None:
        raise InputError(
            f"`{path}` has a DOCTYPE, which a URDF does not need and which could make a parser "
            "read other files: remove it."
        )
    robot = document.getroot()
    if any("ros.org/" in str(e.tag) and "xacro" in str(e.tag) for e in robot.iter()):
        raise InputError(
            f"`{path}` is a xacro file: expand it first, for example with "
            "`xacro arm.urdf.xacro -o arm.urdf`."
        )
    if robot.tag != "robot":
        raise InputError(f"`{path}` is no URDF: its root is `<{robot.tag}>`, not `<robot>`.")
    return robot


def words(values: Any) -> str:
    """Return numbers as they stand in an attribute."""
    return " ".join(f"{x:g}" for x in values)


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
