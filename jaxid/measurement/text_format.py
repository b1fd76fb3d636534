"""Format of a table of text: where its rows begin, and what separates their cells.

This module imports neither JAX nor NumPy: a text without a column is refused at once.
"""

import codecs
import csv
import functools
import itertools
import re
import statistics
from collections.abc import Sequence
from typing import NamedTuple

from jaxid.errors import InputError

from .log_columns import (
    AbstractLogColumns,
    Names,
    Selections,
    has_column,
    selected_names,
)

TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
"""Suffixes of text files."""
HEAD_SIZE = 65536
"""Bytes from which the format is detected."""
SEPARATORS = (";", "\t", ",", " ")
"""Characters that separate cells; a space is any number of spaces or tabs."""
COMMENT_MARKS = "#% "
"""Characters with which some programs begin the line of the header."""
MAX_LINES_BELOW_HEADER = 5
"""Lines between header and first row, such as one of units."""
STAMP = (
    r"^(?:(?:\d{4}[-/]\d\d?[-/]\d\d?[T ]|\d+ days? )?"
    r"\d\d?:\d\d:\d\d(?:[.,]\d+)? ?(?:Z|[+-]\d\d:?\d\d)?|\d\d?:\d\d[.,]\d+)$"
)
"""Dates of ISO 8601, times since midnight or the hour, and durations of pandas."""
EXPONENT = r"(?:[eEdD][+-]?\d+)?"
NUMBER = rf"[+-]?(?:(?:\d+\.?\d*|\.\d+){EXPONENT}|(?i:nan|inf|infinity))"
"""Numbers with a decimal point."""


class TextFormat(NamedTuple):
    """Format of a table of text."""

    names: Names  # names of the columns, none twice; positions without a header
    columns: int  # cells that a row must have; further ones have no name
    has_header: bool
    separator: str
    has_decimal_commas: bool
    first_line: int  # number of the line with the first row


class TextColumns(AbstractLogColumns):
    """The columns of a text file, by its first lines."""

    @functools.cached_property
    def format(self) -> TextFormat:
        """Format of the text."""
        return detect_format(self.path.name, self.head(), self.selections)

    @property
    def names(self):  # noqa: D102
        return self.format.names

    @property
    def has_header(self):  # noqa: D102
        return self.format.has_header

    def head(self) -> bytes:
        """Return lines from the beginning of the file."""
        with self.path.open("rb") as file:
            head = file.read(HEAD_SIZE)
        is_cut = len(head) == HEAD_SIZE
        head = with_line_feeds(head)
        # The last line of a cut text is no row, unless there is no other.
        return head.rpartition(b"\n")[0] if is_cut and b"\n" in head else head


def with_line_feeds(block: bytes) -> bytes:
    """Return text whose lines end as on Unix; also those that end twice."""
    return re.sub(rb"\r+\n?", b"\n", block) if b"\r" in block else block


Header = tuple[int, str]
"""Position of the line with the names, or of the first row; and its separator."""


def detect_format(source: str, head: bytes, selections: Selections) -> TextFormat:
    """Detect the format of a text file by its first bytes and the wanted columns."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"`{source}` is text in UTF-16: save it again in UTF-8.")
    if b"\0" in head:
        raise InputError(
            f"`{source}` is not text, as its suffix says, or is in UTF-16: give it "
            "the suffix of its format, or save it again in UTF-8."
        )
    text = decoded(head)
    if not text.strip(COMMENT_MARKS + "\n"):
        raise InputError(
            f"`{source}` must start with a header or with numbers, but is empty."
        )
    lines = [*text.split("\n"), ""]
    wanted_names = selected_names(selections)
    header = find_header(lines, wanted_names) or find_header(lines, ())
    first_row, separator = header or first_filled_line(lines)
    cells = split_line(lines[first_row], separator)
    has_header = not is_row(cells)
    if has_header:
        refuse_repeated_names(source, cells, wanted_names)
        first_row = row_below(lines, first_row, separator)
    rows = [split_line(line, separator) for line in lines[first_row:]]
    row_length = statistics.mode([len(row) for row in rows if row] or [len(cells)])
    named_cells = len(without_empty_end(cells))
    # Header or rows may end with separators, and rows without the last columns.
    has_extra_cells = any(rows[0][len(cells) :])
    width = len(cells) if has_extra_cells else max(named_cells, row_length)
    cells = (cells + width * [""])[:width]
    return TextFormat(
        names=unique_names(cells) if has_header else tuple(map(str, range(width))),
        columns=min(named_cells, row_length),
        has_header=has_header,
        separator=separator,
        has_decimal_commas=have_decimal_commas(rows),
        first_line=first_row + 1,
    )


def decoded(head: bytes) -> str:
    """Return a text in UTF-8, or in the encoding of Western Windows, as of Excel."""
    try:
        return head.decode("utf-8-sig")
    except UnicodeDecodeError:
        return head.decode("cp1252", errors="replace")


def find_header(lines: Sequence[str], names: Sequence[str]) -> Header | None:
    """Return the first line that names all wanted columns and has rows below it.

    If no column is wanted by its name, it is the first one with numbers below it.
    """
    for k, line in enumerate(lines[:-1]):
        for separator in separators_of(line):
            cells = split_line(line, separator)
            row = split_line(lines[row_below(lines, k, separator)], separator)
            is_header = names_row(cells, row, names) if names else fits(cells, row)
            if is_header:
                return k, separator
    return None


def names_row(cells: Sequence[str], row: Sequence[str], names: Sequence[str]) -> bool:
    """Return whether cells are names, the wanted ones included, and fit to a row."""
    # A title may have the same words, but its separator does not divide the rows.
    min_cells = max(len(names), min(2, len(cells)))
    has_names = all(has_column(cells, name) for name in names)
    has_cells = not row or len(row) >= min_cells
    return has_names and has_cells and not is_row(cells)


def fits(cells: Sequence[str], row: Sequence[str]) -> bool:
    """Return whether cells are those of a header or a row, above a row of numbers."""
    has_cells = len(without_empty_end(row)) <= len(without_empty_end(cells))
    are_names = not any(map(is_number, cells))
    return has_cells and is_row(row) and (are_names or is_row(cells))


def first_filled_line(lines: Sequence[str]) -> Header:
    """Return the first line that is not empty."""
    line = next(k for k, text in enumerate(lines) if text.strip(COMMENT_MARKS))
    return line, separators_of(lines[line])[0]


def separators_of(line: str) -> list[str]:
    """Return the separators that a line has; a comma if there is none."""
    text = line.strip(COMMENT_MARKS)
    return [separator for separator in SEPARATORS if separator in text] or [","]


def row_below(lines: Sequence[str], header: int, separator: str) -> int:
    """Return the position of the first row, behind units, comments and empty lines."""
    next_line = header + 1
    for k in range(next_line, min(next_line + MAX_LINES_BELOW_HEADER, len(lines))):
        cells = split_line(lines[k], separator)
        is_empty_row = bool(cells) and not any(cells)
        if is_empty_row or any(map(is_number, cells)):
            return k
    return next_line


def split_line(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without quotation marks."""
    text = line.lstrip(COMMENT_MARKS).rstrip(" ")
    if separator == " ":
        text = " ".join(text.split())
    cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def without_empty_end(cells: Sequence[str]) -> list[str]:
    """Return cells without the empty ones at their end."""
    end = max((k for k, cell in enumerate(cells, 1) if cell), default=0)
    return list(cells[:end])


def refuse_repeated_names(
    source: str, names: Sequence[str], wanted_names: Sequence[str]
) -> None:
    """Refuse columns that are wanted, but have the name of another one."""
    repeated_names = sorted({name for name in names if names.count(name) > 1})
    for name in repeated_names:
        if any(has_column([name], wanted_name) for wanted_name in wanted_names):
            raise InputError(
                f"the header of `{source}` names the column `{name}` twice: rename one "
                "of them, or give their positions from 0."
            )


def unique_names(names: Sequence[str]) -> Names:
    """Return names, with the positions of columns without one or with another's."""
    columns = []
    for k, name in enumerate(names):
        is_unique = bool(name) and names.count(name) == 1
        columns.append(name if is_unique else f"{name} (column {k})".strip())
    return tuple(columns)


def is_row(cells: Sequence[str]) -> bool:
    """Return whether the first two cells that are not empty hold numbers."""
    texts = [cell for cell in cells if cell]
    return bool(texts) and all(map(is_number, texts[:2]))


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or a time."""
    number = re.fullmatch(NUMBER, cell.replace(",", "."))
    return bool(number or re.match(STAMP, cell))


def have_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether numbers have decimal commas, and none has a decimal point."""
    cells = list(itertools.chain(*rows))
    comma_cells = [cell for cell in cells if "," in cell]
    has_commas = any(
        re.fullmatch(rf"[+-]?\d*,\d+{EXPONENT}", cell) for cell in comma_cells
    )
    return has_commas and not any(
        re.fullmatch(rf"[+-]?\d*\.\d+{EXPONENT}", cell) for cell in cells
    )
