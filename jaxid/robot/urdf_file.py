"""A URDF file as a checked tree of links and joints; what cannot be trusted stops here."""

from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from urdf_parser_py.urdf import URDF

from jaxid.arrays import Numbers
from jaxid.errors import InputError
from jaxid.robot.names import cleaned, control_characters

_LARGEST_FILE = 64 * 2**20

# What the kinematics and the inertias need, attributes and children. Meshes, transmissions and
# simulators' own elements go unread, so that an error in one of them cannot stop anybody.
_READ: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "robot": (("name",), ("link", "joint")),
    "link": (("name",), ("inertial",)),
    "inertial": ((), ("origin", "mass", "inertia")),
    "mass": (("value",), ()),
    "inertia": (("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), ()),
    "joint": (("name", "type"), ("origin", "axis", "parent", "child", "limit", "mimic")),
    "origin": (("xyz", "rpy"), ()),
    "axis": (("xyz",), ()),
    "parent": (("link",), ()),
    "child": (("link",), ()),
    "limit": (("lower", "upper", "effort", "velocity"), ()),
    "mimic": (("joint",), ()),
}
_ONCE = {"origin", "axis", "parent", "child", "limit", "mimic", "inertial", "mass", "inertia"}


class UrdfTree:
    """The links and joints of a file, which form one tree.

    Attributes:
        path: The file, as it reads in messages.
        urdf: What `urdf_parser_py` made of it.
        root: Name of the link that has no parent.
        children: Joints that start at each link, in the order of the file.
        joint_above: The joint that ends at each link; the root has none.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = str(path)
        element = _read_xml(Path(path))
        for name in ("link", "joint"):
            _require_names(self.path, name, [e.get("name") for e in element.iterfind(name)])
        try:
            self.urdf = URDF.from_xml_string(etree.tostring(element))
        except Exception as error:  # the library raises bare exceptions, among others
            reason = " ".join(str(error).split())
            raise InputError(f"`{self.path}` is not a URDF that can be read: {reason}.") from error
        self.children: dict[str, list[Any]] = {link.name: [] for link in self.urdf.links}
        self.joint_above: dict[str, Any] = {}
        for joint in self.urdf.joints:
            self._add(joint)
        self.root = self._find_root()

    def _add(self, joint: Any) -> None:
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

    def error(self, joint: Any, complaint: str) -> ValueError:
        """A complaint about a joint, as one sentence that names the file and the joint."""
        return ValueError(f"`{self.path}`: joint `{joint.name}` {complaint}.")

    def require_link(self, what: str, link: str) -> str:
        """Returns the name of a link if the file has it.

        Raises:
            InputError: If it has not.
        """
        if link not in self.children:
            raise InputError(
                f"`{what}` must be a link of `{self.path}`, but is `{link}`; its links are "
                f"{_listed(list(self.children))}."
            )
        return link

    def chain(self, base: str, tip: str) -> list[Any]:
        """The joints from one link to another, in this order.

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

    def numbers(
        self, joint: Any, what: str, values: Numbers | None, default: tuple[float, ...]
    ) -> np.ndarray:
        """Numbers of a joint as an array.

        Raises:
            InputError: If one is not finite, or there are too few or too many.
        """
        array = np.array(default if values is None else values, dtype=np.float64)
        if array.shape != (len(default),) or not np.isfinite(array).all():
            raise self.error(
                joint, f"must have {len(default)} finite numbers as `{what}`, but has {values}"
            )
        return array


def _read_xml(path: Path) -> etree._Element:
    if not path.is_file():
        raise FileNotFoundError(f"the URDF file `{path}` does not exist: check its path.")
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(
            f"`{path}` is larger than {_LARGEST_FILE // 2**20} MiB: this is no URDF of a robot."
        )
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
            f"`{path}` has a DOCTYPE, which a URDF needs not and which could make a parser read "
            "other files: remove it."
        )
    robot = document.getroot()
    if any("ros.org/" in str(e.tag) and "xacro" in str(e.tag) for e in robot.iter()):
        raise InputError(
            f"`{path}` is a xacro file: expand it first, for example with "
            "`xacro arm.urdf.xacro -o arm.urdf`."
        )
    if robot.tag != "robot":
        raise InputError(f"`{path}` is no URDF: its root is `<{robot.tag}>`, not `<robot>`.")
    robot.set("name", cleaned(robot.get("name") or path.stem))
    _keep_what_is_read(path, robot)
    for limit in robot.iter("limit"):
        for unlimited in ("effort", "velocity"):
            limit.set(unlimited, limit.get(unlimited, "inf"))
        for bound, other, infinite in (("lower", "upper", "-inf"), ("upper", "lower", "inf")):
            if bound not in limit.attrib:
                # A single bound means what the standard says: the missing one is zero.
                limit.set(bound, "0" if np.isfinite(_number(limit.get(other))) else infinite)
    return robot


def _keep_what_is_read(path: Path, element: etree._Element) -> None:
    attributes, children = _READ[str(element.tag)]
    for name in set(element.attrib) - set(attributes):
        del element.attrib[name]
    element.text = element.tail = None
    seen: set[str] = set()
    for child in list(element):
        if child.tag not in children:
            element.remove(child)
            continue
        if child.tag in _ONCE and child.tag in seen:
            raise InputError(
                f"`{path}`, line {child.sourceline}: `<{element.tag}>` has a second "
                f"`<{child.tag}>`, and only one can hold."
            )
        seen.add(str(child.tag))
        _keep_what_is_read(path, child)


def _number(text: str | None) -> float:
    try:
        return float(text or "inf")
    except ValueError:
        return np.inf  # the library reports it, with its place


def _require_names(path: str, what: str, names: list[str | None]) -> None:
    seen: set[str | None] = set()
    for name in names:
        if name is not None and (sign := control_characters(name)):
            raise InputError(
                f"`{path}`: the name of {what} `{cleaned(name)}` holds the control character "
                f"{sign}: rename it."
            )
        if name is not None and name in seen:
            raise InputError(f"`{path}` has two {what}s named `{name}`: rename one.")
        seen.add(name)


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
