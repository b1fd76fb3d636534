"""What a page is made of: paragraphs, facts, remarks, tables, figures; texts, never markup."""

import enum
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
from matplotlib.figure import Figure

from jaxid.errors import InputError
from jaxid.report.vector import Drawing, drawing

NUMBER = "number"


class Tone(enum.Enum):
    """How a remark or a number is meant; the value is the sign that stands beside it."""

    GOOD = "✓"
    DOUBTFUL = "!"
    BAD = "✗"
    PLAIN = "·"

    @property
    def word(self) -> str:
        """The tone's name in the style sheet."""
        return self.name.lower()


class AbstractBlock(eqx.Module):
    """A part of a section; the template of its name in `templates/` writes it."""

    template: ClassVar[str]


class Prose(AbstractBlock):
    """A paragraph.

    Attributes:
        text: Its sentences.
    """

    template: ClassVar[str] = "prose.html"
    text: str


class Code(AbstractBlock):
    """A text whose line breaks and blanks matter, like a file.

    Attributes:
        text: The text.
    """

    template: ClassVar[str] = "code.html"
    text: str


class Facts(AbstractBlock):
    """Words, and what is said about each.

    Attributes:
        rows: Pairs of a word and a text.
    """

    template: ClassVar[str] = "facts.html"
    rows: tuple[tuple[str, str], ...]


class Remark(eqx.Module):
    """A sentence with a sign before it.

    Attributes:
        tone: The sign.
        text: The sentence.
        detail: Said in small letters below it, like the threshold that decides.
    """

    tone: Tone
    text: str
    detail: str = ""


class Remarks(AbstractBlock):
    """Sentences with signs.

    Attributes:
        remarks: The sentences.
    """

    template: ClassVar[str] = "remarks.html"
    remarks: tuple[Remark, ...]


class Column(eqx.Module):
    """A column of a table.

    Attributes:
        title: At its head.
        number: Whether its cells are numbers, which stand at the right.
        code: Whether its cells are formulas, which may break anywhere.
    """

    title: str
    number: bool = False
    code: bool = False


class Cell(eqx.Module):
    """A cell that says how its content is meant.

    Attributes:
        text: Its content.
        tone: How it is meant.
    """

    text: str
    tone: Tone = Tone.PLAIN

    def __str__(self) -> str:
        return self.text


class Sheet(AbstractBlock):
    """A table, which scrolls in a box of its own where it is too wide.

    Attributes:
        columns: Their heads.
        rows: Texts or `Cell`s, as many as there are columns.
        caption: Above the table.
    """

    template: ClassVar[str] = "sheet.html"
    columns: tuple[Column, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    caption: str = ""

    def __check_init__(self) -> None:
        wrong = next((row for row in self.rows if len(row) != len(self.columns)), None)
        if wrong is not None:
            raise InputError(
                f"each of the `rows` must have {len(self.columns)} cells, but one has "
                f"{len(wrong)}: {', '.join(map(str, wrong))}."
            )


class Picture(AbstractBlock):
    """A figure, drawn into the page; panel by panel where it names its panels.

    Attributes:
        drawing: What the page draws.
        caption: Below it.
    """

    template: ClassVar[str] = "picture.html"
    drawing: Drawing
    caption: str = ""

    def __init__(self, figure: Figure, caption: str = "") -> None:
        """Draws a figure.

        Args:
            figure: The figure.
            caption: Below it.
        """
        self.drawing = drawing(figure)
        self.caption = caption


class Headline(AbstractBlock):
    """One remark that counts more than all others.

    Attributes:
        remark: The remark.
    """

    template: ClassVar[str] = "headline.html"
    remark: Remark


class Abreast(AbstractBlock):
    """Blocks beside each other, below each other where the page is narrow.

    Attributes:
        blocks: The blocks.
    """

    template: ClassVar[str] = "abreast.html"
    blocks: tuple[AbstractBlock, ...]


class Folded(AbstractBlock):
    """Blocks behind a line that opens them; in print they are open.

    Attributes:
        summary: The line.
        blocks: What it opens.
    """

    template: ClassVar[str] = "folded.html"
    summary: str
    blocks: tuple[AbstractBlock, ...]


def beside_paper(rows: Sequence[Sequence[str]], caption: str = "") -> Sheet:
    """A table of what the paper prints beside what was found.

    Args:
        rows: Quantity, the paper's number and ours; a fourth text, if one has it, is a remark.
        caption: Above the table.
    """
    remarked = any(len(row) > 3 for row in rows)
    columns = (Column("quantity"), Column("paper", number=True), Column("here", number=True))
    filled = tuple((*row, "") if remarked and len(row) == 3 else tuple(row) for row in rows)
    return Sheet((*columns, Column("remark")) if remarked else columns, filled, caption)
