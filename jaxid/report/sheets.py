"""Tables of the terminal as tables of a page, and the table of base parameters."""

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxid.identification.fit import Fit, Trust
from jaxid.report.blocks import Cell, Column, Sheet, Tone
from jaxid.report.numbers import MISSING, aligned, percent, significant, with_deviation

TONES = {"green": Tone.GOOD, "yellow": Tone.DOUBTFUL, "red": Tone.BAD}
"""Of the terminal's colours."""
TRUST = {Trust.GOOD: Tone.GOOD, Trust.DOUBTFUL: Tone.DOUBTFUL, Trust.NONE: Tone.BAD}
DIGIT, POINT = "\N{FIGURE SPACE}", "\N{PUNCTUATION SPACE}"
"""Blanks as wide as a digit, and as a point."""


def sheet_of(table: Table, caption: str | None = None) -> Sheet:
    """A table of the terminal as one of a page.

    Args:
        table: Whose cells are texts.
        caption: Above it; the table's title if None.
    """
    columns = tuple(Column(str(c.header), number=c.justify == "right") for c in table.columns)
    cells = [
        [_cell(cell, column.number) for cell in c.cells]
        for c, column in zip(table.columns, columns, strict=True)
    ]
    title = "" if table.title is None else str(table.title)
    return Sheet(columns, tuple(zip(*cells, strict=True)), title if caption is None else caption)


def _cell(cell: object, number: bool) -> str | Cell:
    text = widened(str(cell)) if number else str(cell)
    style = str(cell.style) if isinstance(cell, Text) else ""
    tone = next((TONES[word] for word in style.split() if word in TONES), Tone.PLAIN)
    return text if tone is Tone.PLAIN else Cell(text, tone)


def widened(number: str) -> str:
    """A number whose blanks behind it are as wide as the digits and the point they stand for."""
    bare = number.rstrip(" ")
    blanks = len(number) - len(bare)
    if not blanks or "." in bare:
        return bare + DIGIT * blanks
    return bare + POINT + DIGIT * (blanks - 1)


def parameter_sheet(fit: Fit) -> Sheet:
    """The base parameters with all that is known of them.

    Args:
        fit: The estimates.
    """
    base = fit.base
    pairs = [
        with_deviation(float(p), float(s))
        for p, s in zip(fit.parameters, fit.standard_deviations, strict=True)
    ]
    ends = [_like(pair[1], interval) for pair, interval in zip(pairs, fit.intervals(), strict=True)]
    shares = [percent(float(r)) for r in fit.relative_standard_deviations]
    numbers = [*zip(*pairs, strict=True), *zip(*ends, strict=True), shares]
    cells = [[widened(x) for x in aligned(column)] for column in numbers]
    columns = (
        Column("#", number=True),
        Column("parameter"),
        Column("estimate", number=True),
        Column("±", number=True),
        Column("unit"),
        Column("95 %\nfrom", number=True),
        Column("95 %\nto", number=True),
        Column("± [%]", number=True),
        Column("trust"),
        Column("combination", code=True),
    )
    rows = [
        (
            str(k + 1),
            base.names[k],
            cells[0][k],
            cells[1][k],
            base.units[k],
            *(column[k] for column in cells[2:]),
            Cell(trust.value, TRUST[trust]),
            base.expressions[k],
        )
        for k, trust in enumerate(fit.trust)
    ]
    return Sheet(columns, tuple(rows))


def _like(deviation: str, interval: np.ndarray) -> tuple[str, str]:
    """Both ends of an interval, to the digits of its standard deviation."""
    if not np.isfinite(interval).all():
        return MISSING, MISSING
    if "e" in deviation:
        return significant(float(interval[0]), 5), significant(float(interval[1]), 5)
    decimals = len(deviation.partition(".")[2])
    return f"{interval[0]:.{decimals}f}", f"{interval[1]:.{decimals}f}"
