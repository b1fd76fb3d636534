"""Tables of results: facts, columns with units, remarks; as text and as page rows.

A result returns one by its method `summary()` and prints it by `__str__`. Columns hold
numbers or texts; numbers are formatted by the column's function and aligned at their
decimal points. Estimates and their deviations are rounded together: `values, deviations
= with_deviations(p, s)` are texts for two columns of `kind="number"`.
"""

import dataclasses
import enum
import functools
import html
import importlib.metadata
import io
import math
import platform
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

MISSING = "–"  # noqa: RUF001
"""Text in place of a number that is not known."""
SHORT_DECIMALS = range(-3, 9)
"""Decimals of numbers without exponent; -3 are three digits too many."""
PADDING = 2
"""Blanks between two columns."""
MIN_TEXT_WIDTH = 12
"""Characters of a line to which a column of texts may be folded."""
KINDS = (
    "result",
    "comparison",
    "inspection",
    "payload",
    "gains",
    "states",
    "demo",
    "rollout",
    "agreement",
    "calibration",
)
SCHEMAS = {f"{kind}.json": f"jaxid-{kind}/1" for kind in KINDS}
"""Files that hold results, and the schemas in them."""
UNSEEN_CHARACTERS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)
"""Controls, marks of direction and other invisible ones, and halves of characters."""


class Status(enum.Enum):
    """Judgement of a row or a remark; the value is the mark beside it."""

    GOOD = "✓"
    DOUBTFUL = "!"
    BAD = "✗"
    NEUTRAL = "·"


SEVERITIES = (Status.BAD, Status.DOUBTFUL, Status.GOOD, Status.NEUTRAL)
"""Order of remarks."""
STYLES = {
    Status.GOOD: "green",
    Status.DOUBTFUL: "yellow",
    Status.BAD: "red",
    Status.NEUTRAL: "dim",
}
"""Styles of the marks in a terminal."""


def printable(text: str) -> str:
    """Return a text with control and escape sequences spelled out for terminals."""
    return UNSEEN_CHARACTERS.sub(
        lambda match: match[0].encode("unicode_escape").decode(), text
    )


@dataclasses.dataclass(frozen=True)
class Remark:
    """Sentence below a table, or on a page.

    Attributes:
        text: The sentence; a missing full stop is added.
        status: Judgement that the sentence expresses.
        detail: Explanation that is shown smaller.
        unchecked: Name of a check that was not made, if the sentence says so.
    """

    text: str
    status: Status = Status.NEUTRAL
    detail: str = ""
    unchecked: str = ""

    def __post_init__(self) -> None:
        stop = "" if self.text.endswith((".", "?", "!")) else "."
        object.__setattr__(self, "text", printable(self.text + stop))
        object.__setattr__(self, "detail", printable(self.detail))

    @property
    def line(self) -> str:
        """The sentence, and its explanation in brackets."""
        return f"{self.text} ({self.detail})" if self.detail else self.text


def in_html(macro: str, *arguments: Any) -> str:
    """Return what a macro of `result_table.html` makes of results."""
    return str(getattr(macros(Path(__file__).with_suffix(".html")), macro)(*arguments))


@functools.cache
def macros(template: Path) -> Any:
    """Return the macros of a template for HTML, which escape all texts."""
    # Commands that write no page do not wait for it.
    import jinja2
    from markupsafe import Markup

    def marked_up(text: str) -> Markup:
        # What stands between backticks becomes a name in other letters.
        escaped_text = html.escape(printable(text))
        return Markup(
            re.sub(r"`([^`]+)`", r'<span class="key">\1</span>', escaped_text)
        )

    def aligned(number: str) -> str:
        # Blanks behind a number become as wide as the digits and the point left out.
        padded_number = re.sub(r"^([^. ]*) ", "\\1\N{PUNCTUATION SPACE}", number)
        return padded_number.replace(" ", "\N{FIGURE SPACE}")

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"aligned": aligned, "marked_up": marked_up}
    return environment.get_template(template.name).module


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, and a dash for NaN."""
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    scientific_text = f"{value:.{digits - 1}e}"
    # The exponent after rounding: 9.996 is 10.0.
    rounded_value = float(scientific_text)
    if rounded_value == 0:
        return "0"
    decimals = digits - 1 - _exponent(rounded_value)
    if decimals not in SHORT_DECIMALS:
        return scientific_text
    return f"{rounded_value:.{max(decimals, 0)}f}"


def _exponent(value: float) -> int:
    """Return the power of ten of the first digit."""
    return math.floor(math.log10(abs(value)))


def percent(fraction: float, digits: int = 2) -> str:
    """Return a fraction in percent, without the sign; whole numbers above 100."""
    value = 100.0 * fraction
    if not math.isfinite(value) or abs(value) < 100:
        return significant(value, digits)
    return f"{value:.0f}" if abs(value) < 1e4 else f"{value:.0e}"


def sort_remarks(remarks: Iterable[Remark]) -> list[Remark]:
    """Return remarks with the most severe first; those of one status in their order."""
    return sorted(remarks, key=lambda remark: SEVERITIES.index(remark.status))


def with_deviation(value: float, deviation: float) -> tuple[str, str]:
    """Return an estimate and its standard deviation, to the latter's second digit."""
    if not (math.isfinite(value) and math.isfinite(deviation) and deviation > 0):
        return significant(value, 4), significant(deviation, 2)
    decimals = 1 - _exponent(float(f"{deviation:.1e}"))
    if decimals not in SHORT_DECIMALS:
        return significant(value, 5), significant(deviation, 2)
    digits = max(decimals, 0)
    # Rounded to zero, a negative number has no sign.
    return f"{value:z.{digits}f}", f"{deviation:.{digits}f}"


def with_deviations(values: Any, deviations: Any) -> tuple[list[str], list[str]]:
    """Return estimates and deviations as texts for two columns, rounded together."""
    pairs = [
        with_deviation(float(value), float(deviation))
        for value, deviation in zip(values, deviations, strict=True)
    ]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


class Column:
    """Column of a table.

    Args:
        name: Header; may have several lines.
        values: Sequence or array of numbers or texts, one for each row.
        unit: Unit of all values, shown in brackets below the name.
        format: Function that makes a text of a number.
        kind: Numbers are aligned at their decimal points; `code` is set in a
            fixed-width font on pages. By default `number` if all values are numbers,
            else `text`.
    """

    def __init__(
        self,
        name: str,
        values: Any,
        unit: str = "",
        format: Callable[[float], str] = significant,
        kind: Literal["number", "text", "code", ""] = "",
    ):
        if not isinstance(values, list | tuple):
            values = np.asarray(values).tolist()
        self.name = printable(name)
        self.values = tuple(map(_plain_cell, values))
        self.unit = unit
        self.format = format
        self.kind = kind
        if not kind:
            is_number = [isinstance(x, int | float) for x in self.values]
            self.kind = "number" if is_number and all(is_number) else "text"

    @property
    def header(self) -> list[str]:
        """Lines of the header: the name, and the unit in brackets."""
        lines = self.name.split("\n")
        return [*lines, f"[{self.unit}]"] if self.unit else lines

    @property
    def min_width(self) -> int:
        """Characters of a line that the column needs; texts fold between words only."""
        if self.kind == "number":
            return self.width
        words = " ".join((*self.header, *self.texts)).split()
        return max([min(self.width, MIN_TEXT_WIDTH), *map(len, words)])

    @property
    def width(self) -> int:
        """Characters of a line that the column takes if nothing is folded."""
        return max(map(len, (*self.header, *self.texts)))

    @property
    def texts(self) -> list[str]:
        """Formatted values; blanks behind numbers align their decimal points."""
        texts = [
            self.format(value) if isinstance(value, float) else str(value)
            for value in self.values
        ]
        if self.kind != "number":
            return texts
        # Point and decimals of each number.
        lengths = [len(text) - len(text.split(".")[0]) for text in texts]
        width = max(lengths, default=0)
        return [
            text + " " * (width - length)
            for text, length in zip(texts, lengths, strict=True)
        ]


def estimate_columns(
    estimates: Any, deviations: Any, ends: Any, units: Sequence[str]
) -> list[Column]:
    """Return columns of estimates, rounded to the second digit of their deviations.

    Args:
        estimates: Estimates.
        deviations: Their standard deviations.
        ends: Lower and upper ends of their 95 % intervals.
        units: Their units.
    """
    values, deviation_texts = with_deviations(estimates, deviations)
    lower_ends, upper_ends = (with_deviations(x, deviations)[0] for x in ends)
    return [
        Column("estimate", values, kind="number"),
        Column("±", deviation_texts, kind="number"),
        Column("unit", units),
        Column("95 %\nfrom", lower_ends, kind="number"),
        Column("95 %\nto", upper_ends, kind="number"),
    ]


def _plain_cell(value: Any) -> Any:
    """Return a value of a column as a number of Python, or as a printable text."""
    if isinstance(value, np.generic):
        return value.item()
    return printable(value) if isinstance(value, str) else value


class Summarised:
    """Result with tables, which terminals print and notebooks show."""

    def summary(self) -> "Table":
        """Return the table of the result."""
        raise NotImplementedError

    def tables(self) -> "Sequence[Table]":
        """Return all tables of the result."""
        return (self.summary(),)

    @property
    def verdict(self) -> Remark:
        """The sentence that sums up the result."""
        return self.summary().remarks[0]

    def overview(self) -> "Sequence[Table]":
        """Return what matters most, in few lines: what `print` shows."""
        return self.tables()

    def __str__(self) -> str:
        return "\n\n".join(map(str, self.overview()))

    def _repr_html_(self) -> str:
        return "".join(table._repr_html_() for table in self.tables())


class Table:
    """Table of results with facts above it and remarks below it.

    Args:
        title: Line above everything; may be empty.
        columns: Columns of the same length.
        facts: Pairs of a word and what is said about it, shown above the columns.
        remarks: Sentences, or `Remark`s with a status, shown below the columns.
        status: Judgement of each row; no marks are shown if empty.
        rules: Indices of rows above which a line is drawn.
    """

    def __init__(
        self,
        title: str,
        *columns: Column,
        facts: Iterable[tuple[str, Any]] = (),
        remarks: Iterable[Remark | str] = (),
        status: Sequence[Status] = (),
        rules: Iterable[int] = (),
    ):
        self.title = printable(title)
        self.columns = columns
        self.facts = tuple((word, printable(str(text))) for word, text in facts)
        self.remarks = tuple(Remark(x) if isinstance(x, str) else x for x in remarks)
        self.status = tuple(status)
        self.rules = frozenset(rules)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Rows of formatted texts."""
        return list(zip(*(column.texts for column in self.columns), strict=True))

    def text(self, width: int | None = None) -> str:
        """Return the table as plain text, in lines as wide as the terminal or `width`.

        Columns of texts and remarks are folded to fit; numbers never are.
        """
        from rich.console import Console

        if width is None:
            width = shutil.get_terminal_size((100, 24)).columns
        console = Console(
            file=io.StringIO(), width=width, color_system=None, force_terminal=False
        )
        with console.capture() as capture:
            console.print(self, crop=False)
        return "\n".join(map(str.rstrip, capture.get().splitlines()))

    def __str__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        return in_html("notebook", self)

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        """Yield title, facts, columns and remarks, with empty lines between."""
        from rich.text import Text

        parts = []
        if self.facts:
            facts = [(Text(word, "dim"), text) for word, text in self.facts]
            parts.append(_two_columns(facts))
        if self.columns:
            max_width = options.max_width - (1 + PADDING) * bool(self.status)
            blocks = self._blocks(max_width)
            parts += [self._grid(columns, max_width) for columns in blocks]
        if self.remarks:
            remarks = [(_mark(remark.status), remark.line) for remark in self.remarks]
            parts.append(_two_columns(remarks))

        if self.title:
            yield Text(self.title, "bold")
        for number, part in enumerate(parts):
            if number:
                yield Text()
            yield part

    def _blocks(self, max_width: int) -> list[list[Column]]:
        """Return columns in groups that fit a width; each begins with the names."""
        names, *columns = self.columns
        blocks = [[names]]
        for column in columns:
            block = [*blocks[-1], column]
            if _space(block, max_width) < 0 and len(block) > 2:
                blocks.append([names, column])
            else:
                blocks[-1] = block
        return blocks

    def _grid(self, columns: Sequence[Column], max_width: int) -> Any:
        """Return marks and columns as a table of `rich`, which folds texts to fit."""
        from rich.rule import Rule
        from rich.table import Table as Grid
        from rich.text import Text

        grid = Grid(box=None, padding=(0, PADDING, 0, 0), pad_edge=False)
        cells: list[Any] = []
        widths = []
        if self.status:
            widths.append(1)
            grid.add_column(width=1)
            cells.append(map(_mark, self.status))
        folded_columns = [x for x in columns if x.width > x.min_width]
        share = max(_space(columns, max_width), 0) // (len(folded_columns) or 1)
        for column in columns:
            texts = column.texts
            header = Text("\n".join(column.header), "bold")
            width = min(column.width, column.min_width + share)
            if column.kind == "number":
                header.justify = "right"
                # Blanks before a number, not its justification, which would take
                # those behind it away.
                texts = [text.rjust(width) for text in texts]
            grid.add_column(header, width=width, overflow="fold")
            widths.append(width)
            cells.append(map(Text, texts))

        # Even these few columns may be wider than the terminal: nothing is cut then.
        grid.width = sum(widths) + PADDING * (len(widths) - 1)
        for k, row in enumerate(zip(*cells, strict=True)):
            if k in self.rules:
                grid.add_row(*[Rule(style="dim")] * len(grid.columns))
            grid.add_row(*row)
        return grid


def _space(columns: Sequence[Column], max_width: int) -> int:
    """Return the characters of a line that columns leave if texts are folded."""
    return max_width + PADDING - sum(x.min_width + PADDING for x in columns)


def _two_columns(rows: Iterable[tuple[Any, str]]) -> Any:
    """Return heads, such as words or marks, and texts beside them as a `rich` table."""
    from rich.table import Table as Grid
    from rich.text import Text

    grid = Grid.grid(padding=(0, PADDING, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for head, text in rows:
        grid.add_row(head, Text(text))
    return grid


def _mark(status: Status) -> Any:
    """Return the mark of a status, in its colour."""
    from rich.text import Text

    return Text(status.value, STYLES[status])


def versions() -> dict[str, str]:
    """Return the versions of the software that computed a result."""
    try:
        jaxid_version = importlib.metadata.version("jaxid-robotics")
    except importlib.metadata.PackageNotFoundError:
        jaxid_version = "not installed"
    libraries = {name: importlib.metadata.version(name) for name in ("jax", "numpy")}
    return {"jaxid": jaxid_version, **libraries, "python": platform.python_version()}
