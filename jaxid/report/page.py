"""A page that needs nothing else: one HTML file with its style and figures in it."""

import functools
import re
from pathlib import Path
from typing import TYPE_CHECKING

import equinox as eqx

from jaxid.report.blocks import AbstractBlock

if TYPE_CHECKING:
    import jinja2

TEMPLATES = Path(__file__).parent / "templates"


class Section(eqx.Module):
    """A part of a page with a title of its own, which the table of contents shows.

    Attributes:
        title: The title.
        blocks: What stands below it.
    """

    title: str
    blocks: tuple[AbstractBlock, ...]

    @property
    def anchor(self) -> str:
        """Where links to the section lead."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


class Page(eqx.Module):
    """A page: readable without network and script, on a phone, on a desk and on paper.

    Attributes:
        title: At its top, and of the browser's window.
        sections: In their order.
        lead: Below the title.
        footer: Below everything.
    """

    title: str
    sections: tuple[Section, ...]
    lead: str = ""
    footer: str = ""

    def html(self) -> str:
        """The whole file. All texts are escaped."""
        return _environment().get_template("page.html").render(page=self)


def write_page(path: Path, page: Page) -> None:
    """Writes a page.

    Args:
        path: Of the file.
        page: The page.
    """
    path.write_text(page.html(), encoding="utf-8")


@functools.cache
def _environment() -> "jinja2.Environment":
    # Commands that write no page shall not wait for it.
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
