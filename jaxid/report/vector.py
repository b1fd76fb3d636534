"""Figures as parts of a page: drawn in SVG once, cut into panels that a phone can show."""

import html
import io
import itertools
import re
from collections.abc import Iterable, Mapping

import equinox as eqx
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Bbox

from jaxid.report.style import (
    BLUE,
    GREY,
    HEADING,
    INK,
    LETTERS_AS_TEXT,
    PALE,
    as_it_was,
    heading_of,
    house_style,
    settle,
)

PAD = 3.0
"""Around a panel [pt]."""
READABLE, LARGE = 0.8, 1.6
"""Pixels for a point below which a panel does not shrink: it scrolls instead. And to which one that
stands alone grows."""
POINTS = 72.0
"""Of an inch."""
VARIABLES = {
    INK.lower(): "var(--ink)",
    GREY.lower(): "var(--grey)",
    PALE.lower(): "var(--pale)",
    BLUE.lower(): "var(--blue)",
    "#ffffff": "var(--paper)",
}
"""Colours that follow the page's, light or dark."""
NUMBERS = itertools.count()


class Entry(eqx.Module):
    """A line of a legend.

    Attributes:
        label: What it says.
        colour: Of its sign.
        dashed: Whether the sign is a dashed line.
    """

    label: str
    colour: str
    dashed: bool


class Drawing(eqx.Module):
    """A figure as a page holds it.

    Attributes:
        panels: SVG elements.
        legend: What the colours mean; empty where the panels say so themselves.
        heading: What stood above the figure.
        width: Of one panel [pt].
    """

    panels: tuple[str, ...]
    legend: tuple[Entry, ...]
    heading: str
    width: float


def drawing(figure: Figure) -> Drawing:
    """Draws a figure for a page.

    Axes that share a name (`set_gid`) are one panel; a figure without names is one
    panel. Identifiers are unique among all drawings of a process.

    Args:
        figure: The figure.
    """
    settle(figure)
    root = _svg(figure)
    whole = next(iter(root.iterfind("{*}g")))
    named: dict[str, list] = {}
    boxes: dict[str, list[Bbox]] = {}
    scale = POINTS / figure.dpi
    with as_it_was(figure):
        renderer = FigureCanvasAgg(figure).get_renderer()
        for axes in figure.axes:
            box = axes.get_tightbbox(renderer) if axes.get_gid() else None
            if box is not None:
                boxes.setdefault(str(axes.get_gid()), []).append(box)
    groups = list(whole.iterfind("{*}g"))
    for group in groups:
        gid = group.get("id", "")
        if gid in boxes:
            named.setdefault(gid, []).append(group)
    height = POINTS * figure.get_figheight()
    title = heading_of(figure)
    if not named:
        for group in groups:
            if group.get("id") == "heading":
                whole.remove(group)
        top = POINTS * HEADING if title else 0.0
        width = POINTS * figure.get_figwidth()
        svg = _panel(
            [whole, *root.iterfind("{*}defs")], (0.0, top, width, height - top), title, True
        )
        return Drawing((svg,), (), title, width)
    cut = {gid: Bbox.union(found) for gid, found in boxes.items()}
    widest = scale * max(box.width for box in cut.values()) + 2 * PAD
    defs = list(root.iterfind("{*}defs"))
    panels = []
    for gid, box in cut.items():
        right = scale * box.x1 + PAD
        frame = (
            right - widest,
            height - scale * box.y1 - PAD,
            widest,
            scale * box.height + 2 * PAD,
        )
        panels.append(_panel([*named[gid], *defs], frame, title, len(cut) == 1))
        # Definitions are common to the whole page: the first panel brings them along.
        defs = []
    return Drawing(tuple(panels), tuple(_entries(figure)), title, widest)


def _svg(figure: Figure) -> etree._Element:
    file = io.StringIO()
    with house_style(LETTERS_AS_TEXT), as_it_was(figure):
        FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
    parser = etree.XMLParser(remove_comments=True, remove_blank_text=True, resolve_entities=False)
    root = etree.fromstring(file.getvalue().encode(), parser)
    prefix = f"f{next(NUMBERS)}-"
    text = etree.tostring(root, encoding="unicode")
    # By their order: Matplotlib makes them of coordinates to the last digit, and its layout differs
    # there from process to process, though not in what is seen.
    used = dict.fromkeys(re.findall(r'(?:url\(#|href="#)([^)"]+)', text))
    new = {name: f"{prefix}{k}" for k, name in enumerate(used)}
    for element in root.iter():
        _tidy(element, new)
    return root


def _tidy(element: etree._Element, new: Mapping[str, str]) -> None:
    """Short numbers, the page's colours and letters, and identifiers of its own."""
    attributes = element.attrib
    name = attributes.get("id")
    if name in new:
        attributes["id"] = new[name]
    for key in list(attributes):
        value = attributes[key]
        if key.endswith("href"):
            del attributes[key]
            # What begins otherwise is an image, which stands in the reference itself.
            attributes["href"] = f"#{new[value[1:]]}" if value.startswith("#") else value
        elif key == "clip-path":
            attributes[key] = f"url(#{new[value[5:-1]]})"
        elif key == "d":
            attributes[key] = " ".join(re.sub(r"(\.\d)\d+", r"\1", value).split())
        elif key in {"x", "y", "width", "height", "transform"}:
            attributes[key] = re.sub(r"(\.\d\d)\d+", r"\1", value)
        elif key == "style":
            attributes[key] = _styled(value)


def _styled(style: str) -> str:
    style = re.sub(r"'DejaVu Sans'[^;]*", "var(--sans)", style)
    style = re.sub(r"font: ([^;]*)", _font, style)
    return re.sub(r"#[0-9a-f]{6}", lambda m: VARIABLES.get(m[0], m[0]), style)


def _font(match: re.Match[str]) -> str:
    """The shorthand with a variable in it is taken apart: not all that read SVG know it."""
    weight = "font-weight: bold; " if "bold" in match[1] or "700" in match[1] else ""
    size = re.search(r"[\d.]+px", match[1])
    return f"{weight}font-size: {size[0] if size else '9px'}; font-family: var(--sans)"


def _panel(
    parts: Iterable[etree._Element],
    frame: tuple[float, float, float, float],
    title: str,
    alone: bool,
) -> str:
    for part in parts:
        for element in part.iter():
            name = element.get("id")
            if name is not None and not re.match(r"f\d+-", name):
                del element.attrib["id"]
    inner = "".join(etree.tostring(part, encoding="unicode", with_tail=False) for part in parts)
    inner = re.sub(r' xmlns(:\w+)?="[^"]*"', "", inner)
    box = " ".join(f"{x:.1f}" for x in frame)
    least, most = READABLE * frame[2], LARGE * frame[2]
    label = html.escape(title or "figure")
    size = f"min-width: {least:.0f}px" + (f"; max-width: {most:.0f}px" if alone else "")
    shown = f'viewBox="{box}" role="img" aria-label="{label}" style="{size}"'
    return f"<svg {shown}>{inner}</svg>"


def _entries(figure: Figure) -> Iterable[Entry]:
    for legend in figure.legends:
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
            # Asked one by one: matplotlib keeps an artist, and its figure, once `properties` was.
            seen, dashed = GREY, False
            if isinstance(handle, Line2D):
                seen, dashed = handle.get_color(), handle.get_linestyle() == "--"
            elif isinstance(handle, Patch):
                seen = handle.get_facecolor()
            colour = to_hex(seen)
            yield Entry(text.get_text(), VARIABLES.get(colour, colour), dashed)
