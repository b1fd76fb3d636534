"""HTML pages: texts, tables and figures in one file that needs nothing else."""

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from matplotlib.figure import Figure

from jaxid.report.result_json import versions
from jaxid.report.style import svg_text
from jaxid.table import Table

if TYPE_CHECKING:
    import jinja2


class Section(NamedTuple):
    """Part of a page with a title, which the table of contents shows.

    Attributes:
        title: Title of the section.
        blocks: Blocks in their order, made by `block` and `picture`.
    """

    title: str
    blocks: Sequence[str]

    @property
    def anchor(self) -> str:
        """Target of links to the section."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


def block(kind: str, *content: Any, **options: Any) -> str:
    """Return a block of a page as HTML; all texts are escaped.

    Kinds and their content: `paragraph(text)`, `code(text)`, `table(table, titled=True)`,
    `remarks(remarks)`, `headline(remark)`, `abreast(*blocks)`, `folded(summary, *blocks)`.

    Args:
        kind: Name of a macro in `templates/page.html`.
        *content: Content of the block.
        **options: Options of the macro.
    """
    return getattr(_macros(), kind)(*content, **options)


def facts(rows: Iterable[tuple[str, Any]]) -> str:
    """Return a block of words and what is said about each."""
    return block("table", Table("", facts=rows))


def picture(figure: Figure, caption: str = "") -> str:
    """Return a block that shows a figure, as the plotting library draws it.

    Args:
        figure: Figure to show.
        caption: Text below the figure.
    """
    svg = svg_text(figure)
    # Names of groups are the same in every figure of a page, and nothing refers to them.
    svg = re.sub(r'<g id="[^"]*"', "<g", svg[svg.index("<svg") :])
    title = figure.get_suptitle()
    return block("picture", svg, title, caption)


def provenance(settings: Mapping[str, Any]) -> Section:
    """Return the last section of a page: how to get the same result again.

    Args:
        settings: Origin of the result, as far as it is known: `facts` (pairs of a word and a
            text), `command` and `experiment_text`.
    """
    blocks = [facts((*settings.get("facts", ()), *versions().items()))]
    if settings.get("command"):
        blocks.append(block("code", str(settings["command"])))
    if settings.get("experiment_text"):
        text = block("code", str(settings["experiment_text"]))
        blocks.append(block("folded", "The experiment file", text))
    return Section("To repeat this", blocks)


def render_page(title: str, sections: Sequence[Section], lead: str = "", footer: str = "") -> str:
    """Return a page: readable without network and script, on a phone, on a desk and on paper.

    Args:
        title: Title of the page and of the browser's window.
        sections: Sections in their order.
        lead: Text below the title.
        footer: Text below everything.
    """
    return str(block("page", title, sections, lead, footer))


@functools.cache
def _macros() -> "jinja2.environment.TemplateModule":
    # Commands that write no page do not wait for it.
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["aligned"] = _align
    return environment.get_template("page.html").module


def _align(number: str) -> str:
    """Replace blanks behind a number by blanks as wide as the digits and the point left out."""
    bare = number.rstrip(" ")
    blanks = len(number) - len(bare)
    if not blanks or "." in bare:
        return bare + "\N{FIGURE SPACE}" * blanks
    return bare + "\N{PUNCTUATION SPACE}" + "\N{FIGURE SPACE}" * (blanks - 1)
