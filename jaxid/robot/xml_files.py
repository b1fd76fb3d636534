"""XML of robots' files, with the faults that other programs allow.

This module imports neither JAX nor NumPy: a file that is no XML is refused at once.
"""

import math
import re
from pathlib import Path
from typing import Any

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.errors import InputError

MAX_PARTS = {"hfield": 10_000_000, "replicate": 2_000}
"""Largest numbers of heights of a field, and of copies of a body, in an MJCF file."""
HARMLESS_FAULTS = ("NS_ERR_UNDEFINED_NAMESPACE", "ERR_UNKNOWN_VERSION")
"""Faults of XML that change no element, by the names of the parser."""


def read_xml(path: str | Path) -> Any:
    """Return the root element of a URDF, xacro or MJCF file."""
    root = parse_xml(path)
    if root.tag == "mujoco":
        _refuse_huge(path, root)
        _refuse_nan(path, root)
    elif not has_xacro(root):
        require_urdf(path, root)
    return root


def require_urdf(path: str | Path, root: Any) -> None:
    """Reject a file whose root is none of URDF."""
    if root.tag != "robot":
        raise InputError(
            f"`{path}` is not a URDF file: its root is `<{root.tag}>`, not `<robot>`."
        )


def _refuse_huge(path: str | Path, root: Any):
    """Reject elements of an MJCF file of which MuJoCo makes gigabytes."""
    for element in root.iter(*MAX_PARTS):
        # Copies of copies multiply. MuJoCo names what is no number.
        counts = element.xpath("@nrow | @ncol | ancestor-or-self::replicate/@count")
        size = math.prod(int(text) for text in counts if text.isdecimal())
        if size > MAX_PARTS[element.tag]:
            raise InputError(
                f"`{path}`, line {element.sourceline}: `<{element.tag}>` makes {size} "
                f"parts, but at most {MAX_PARTS[element.tag]} are allowed: lower its "
                "numbers."
            )


def _refuse_nan(path: str | Path, root: Any):
    """Reject properties of bodies that are NaN, which MuJoCo takes as not given."""
    for text in root.xpath("//@mass | //@density | //@diaginertia | //@fullinertia"):
        if "nan" in text.lower():
            line = text.getparent().sourceline
            raise InputError(
                f"`{path}`, line {line}: `{text.attrname}` must hold finite numbers, "
                f'but is "{text}".'
            )


def has_xacro(root: Any) -> bool:
    """Return whether there are elements of xacro below a root."""
    return any("xacro" in element.tag for element in root.iter("*"))


def parse_xml(path: str | Path, text: bytes | None = None) -> Any:
    """Return the root element of a file, or of a text made from it."""
    if not Path(path).is_file():
        raise FileNotFoundError(
            f"the robot's file `{path}` does not exist: check its path."
        )
    if text is None:
        text = Path(path).read_bytes()
    # No entity of a file makes the parser read other files.
    parser = etree.XMLParser(
        recover=True, resolve_entities=False, no_network=True, load_dtd=False
    )
    try:
        return _tolerant_root(text, parser)
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        # Then come the place again, and advice for programmers.
        fault, *_ = error.msg.split(", ")
        raise InputError(
            f"`{path}`, line {line}: this is not XML ({fault})."
        ) from error


def _tolerant_root(text: bytes, parser: Any):
    """Return the root element of a text with the faults that other programs allow.

    These are double hyphens in comments, blank lines or comments before `<?xml`, and
    attributes without a blank between them.
    """
    try:
        return _root(text, parser)
    except etree.XMLSyntaxError:
        # Line breaks stay, so that messages name the lines of the file. Beyond the last
        # end of a comment the search would be slow.
        head, end, rest = text.rpartition(b"-->")
        content = re.sub(rb"(?s)<!--.*?-->", _line_breaks, head + end) + rest
        spaced_content = re.sub(
            rb"""(=\s*(?:"[^"<]*"|'[^'<]*'))(?=\w)""", rb"\1 ", content
        )
        declaration_first = re.sub(
            rb"\A(?:\xef\xbb\xbf)?(\s+)(<\?xml[^>]*>)", rb"\2\1", spaced_content
        )
        return _root(declaration_first, parser)


def _root(text: bytes, parser: Any):
    """Return the root element of a text; raise the first fault that is not harmless."""
    root = etree.fromstring(text, parser)
    for fault in parser.error_log:
        if fault.type_name not in HARMLESS_FAULTS:
            raise etree.XMLSyntaxError(
                fault.message, fault.type, fault.line, fault.column
            )
    return root


def _line_breaks(match: re.Match[bytes]):
    """Return the line breaks of a match."""
    return b"\n" * match.group().count(b"\n")
