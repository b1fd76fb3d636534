"""HTML pages of results, which need nothing else."""

import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from jaxid.result_table import (
    Remark,
    Table,
    in_html,
    macros,
    printable,
    versions,
)

from .browser_figures import charts, library
from .figure_elements import Drawing

Settings = Mapping[str, Any]
"""Origin of a result: facts, command, experiment file."""
Section = tuple[str, Sequence[Any]]
"""Title, which the table of contents shows, and blocks as `render_page` takes them."""
_macros = functools.partial(macros, Path(__file__).parent / "templates" / "page.html")


def render_page(
    title: str,
    sections: Sequence[Section],
    lead: str = "",
    footer: str = "",
) -> str:
    """Return a page: one file that needs no network, for a phone, a desk and paper.

    Its figures are drawn by the browser, from data and a library that the page holds.

    Blocks of a section are texts (paragraphs), tables, figures, a remark (the
    headline), lists of remarks, tuples of blocks beside each other, and what `tiles`,
    `code` and `folded` return. All texts are escaped.
    """
    contents = []
    for name, blocks in sections:
        anchor = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
        contents.append((name, anchor, [_render(block) for block in blocks]))
    # The library is large: pages without figures do without.
    has_figures = any('class="chart"' in "".join(blocks) for _, _, blocks in contents)
    code = library() if has_figures else ""
    return printable(str(_macros().page(title, contents, lead, footer, code)))


def _render(block: Any) -> Markup:
    """Return a block of a page as HTML; a tuple is a row of blocks."""
    macros = _macros()
    match block:
        case Markup():
            return block
        case str():
            return macros.paragraph(block)
        case Remark():
            return Markup(in_html("headline", block))
        case Table():
            return Markup(in_html("table", block))
        case Drawing():
            return picture(block)
        case tuple():
            return macros.abreast(*map(_render, block))
        case _:
            return Markup(in_html("remarks", block))


def picture(figure: Drawing, caption: str = "") -> Markup:
    """Return a block with a figure, and a text below it."""
    return _macros().figure(figure, charts(figure), caption)


def tiles(*numbers: tuple[str, str]) -> Markup:
    """Return a block with large texts, and what each of them is."""
    return _macros().tiles(numbers)


def code(text: str) -> Markup:
    """Return a block with a text in a fixed-width font."""
    return _macros().code(text)


def folded(summary: str, *blocks: Any) -> Markup:
    """Return blocks that are shown when the reader opens them, and on paper."""
    return _macros().folded(summary, *map(_render, blocks))


def provenance(settings: Settings) -> Section:
    """Return the last section of a page: how to get the same result again.

    Of `settings`, `facts` (pairs of a word and a text), `command` and `experiment_text`
    are shown.
    """
    facts = (*settings.get("facts", ()), *versions().items())
    blocks: list[Any] = [Table("", facts=facts)]
    command = settings.get("command")
    if command:
        blocks.append(code(str(command)))
    experiment = settings.get("experiment_text")
    if experiment:
        blocks.append(folded("The experiment file", code(str(experiment))))
    return "To repeat this", blocks
