"""Tables of results: facts, columns with units, remarks; as text, and as rows for pages.

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
import math
import platform
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

Lines = Iterator[list[tuple[str, "Status | str"]]]
"""Lines of text, as parts with a style each."""
MISSING = "–"  # noqa: RUF001
"""Text in place of a number that is not known."""

_CONTROLS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)
"""Controls, marks of direction and others that nobody sees, and halves of characters."""


class Status(enum.Enum):
    """Judgement of a row or a remark; the value is the mark beside it."""

    GOOD = "✓"
    DOUBTFUL = "!"
    BAD = "✗"
    NEUTRAL = "·"


def printable(text: str) -> str:
    """Return a text whose control and escape sequences are spelled out: no terminal obeys them."""
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


@dataclasses.dataclass(frozen=True)
class Remark:
    """Sentence below a table, or on a page.

    Attributes:
        text: The sentence; a missing full stop is added.
        status: Judgement that the sentence expresses.
        detail: Explanation that is shown smaller.
    """

    text: str
    status: Status = Status.NEUTRAL
    detail: str = ""

    def __post_init__(self) -> None:
        stop = "" if self.text.endswith((".", "?", "!")) else "."
        object.__setattr__(self, "text", printable(self.text + stop))
        object.__setattr__(self, "detail", printable(self.detail))


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
        escaped = html.escape(printable(text))
        return Markup(re.sub(r"`([^`]+)`", r'<span class="key">\1</span>', escaped))

    def aligned(number: str) -> str:
        # Blanks behind a number become as wide as the digits and the point left out.
        pointed = re.sub(r"^([^. ]*) ", "\\1\N{PUNCTUATION SPACE}", number)
        return pointed.replace(" ", "\N{FIGURE SPACE}")

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
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else "-∞")
    value = float(f"{value:.{digits - 1}e}")
    if value == 0:
        return "0"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    if not -3 <= decimals <= 8:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(decimals, 0)}f}"


def percent(fraction: float, digits: int = 2) -> str:
    """Return a fraction in percent, without the sign; whole numbers above 100."""
    value = 100.0 * fraction
    if math.isfinite(value) and abs(value) >= 100:
        return f"{value:.0f}" if abs(value) < 1e4 else f"{value:.0e}"
    return significant(value, digits)


def with_deviation(value: float, deviation: float) -> tuple[str, str]:
    """Return an estimate and its standard deviation, both to the deviation's second digit."""
    if not (math.isfinite(deviation) and deviation > 0 and math.isfinite(value)):
        return significant(value, 4), significant(deviation, 2)
    decimals = 1 - math.floor(math.log10(float(f"{deviation:.1e}")))
    if not -3 <= decimals <= 8:
        return significant(value, 5), significant(deviation, 2)
    decimals = max(decimals, 0)
    return f"{value:.{decimals}f}", f"{deviation:.{decimals}f}"


def with_deviations(values: Any, deviations: Any) -> tuple[list[str], list[str]]:
    """Return estimates and their deviations as texts for two columns, rounded together."""
    pairs = [
        with_deviation(float(v), float(d))
        for v, d in zip(values, deviations, strict=True)
    ]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def shortened(text: str, longest: int) -> str:
    """Return a text whose middle is left out if it is longer than its place."""
    if len(text) <= longest:
        return text
    head = (longest - 1) * 2 // 3
    return f"{text[:head]}…{text[head + 1 - longest :]}"


@dataclasses.dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        name: Header; may have several lines.
        values: Sequence or array of numbers or texts, one for each row.
        unit: Unit of all values, shown in brackets below the name.
        format: Function that makes a text of a number.
        kind: Numbers are aligned at their decimal points; `code` is set in a
            fixed-width font on pages. By default `number` if all values are numbers,
            else `text`.
    """

    name: str
    values: Any
    unit: str = ""
    format: Callable[[float], str] = significant
    kind: Literal["number", "text", "code", ""] = ""

    def __post_init__(self) -> None:
        listed = isinstance(self.values, list | tuple)
        values = self.values if listed else np.asarray(self.values).tolist()
        values = tuple(x.item() if isinstance(x, np.generic) else x for x in values)
        values = tuple(printable(x) if isinstance(x, str) else x for x in values)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "name", printable(self.name))
        if not self.kind:
            numeric = bool(values) and all(isinstance(x, int | float) for x in values)
            object.__setattr__(self, "kind", "number" if numeric else "text")

    @property
    def header(self) -> list[str]:
        """Lines of the header: the name, and the unit in brackets."""
        return [*self.name.split("\n"), *([f"[{self.unit}]"] if self.unit else [])]

    @property
    def texts(self) -> list[str]:
        """Formatted values; numbers have blanks behind them so that their points are aligned."""
        texts = [
            self.format(x) if isinstance(x, float) else str(x) for x in self.values
        ]
        if self.kind != "number":
            return texts
        tails = [len(s) - s.index(".") if "." in s else 0 for s in texts]
        longest = max(tails, default=0)
        return [
            s + " " * (longest - tail) for s, tail in zip(texts, tails, strict=True)
        ]


class Summarised:
    """Result with tables, which terminals print and notebooks show."""

    def summary(self) -> "Table":
        """Return the table of the result."""
        raise NotImplementedError

    def tables(self) -> "Sequence[Table]":
        """Return all tables of the result."""
        return (self.summary(),)

    def __str__(self) -> str:
        return "\n\n".join(map(str, self.tables()))

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

        The widest columns of texts are shortened to fit, remarks are wrapped.
        """
        return "\n".join(
            "".join(part for part, _ in line).rstrip() for line in self.lines(width)
        )

    def __str__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        return in_html("notebook", self)

    def lines(self, width: int | None = None) -> Lines:
        """Yield the lines of the text as parts with a style each, for renderers with colours.

        A style is a `Status`, `title`, `header`, `dim`, or empty.
        """
        width = shutil.get_terminal_size((100, 24)).columns if width is None else width
        indent = max((len(word) for word, _ in self.facts), default=0) + 2
        facts = [(word.ljust(indent), "dim", text) for word, text in self.facts]
        remarks = [
            (
                f"{r.status.value}  ",
                r.status,
                f"{r.text} ({r.detail})" if r.detail else r.text,
            )
            for r in self.remarks
        ]
        groups = (_hanging(facts, width), self._grid(width), _hanging(remarks, width))
        filled = [lines for lines in map(list, groups) if lines]
        for line in _wrapped(self.title, width) if self.title else ():
            yield [(line, "title")]
        for k, lines in enumerate(filled):
            if k:
                yield []
            yield from lines

    def _grid(self, width: int) -> Lines:
        if not self.columns:
            return
        texts, headers = zip(*((c.texts, c.header) for c in self.columns), strict=True)
        widths = [
            max(map(len, (*h, *cells))) for h, cells in zip(headers, texts, strict=True)
        ]
        right = [column.kind == "number" for column in self.columns]
        margin = 3 if self.status else 0
        _shrink(widths, right, width - margin)

        def line(cells: Sequence[str]) -> str:
            places = zip(map(shortened, cells, widths), widths, right, strict=True)
            return "  ".join(
                s.rjust(w) if number else s.ljust(w) for s, w, number in places
            )

        height = max(map(len, headers))
        padded = ([""] * (height - len(header)) + header for header in headers)
        for head in zip(*padded, strict=True):
            yield [(" " * margin + line(head), "header")]
        for k, row in enumerate(zip(*texts, strict=True)):
            if k in self.rules:
                yield [
                    (
                        "─" * min(width, margin + sum(widths) + 2 * len(widths) - 2),
                        "dim",
                    )
                ]
            mark = self.status[k] if self.status else Status.NEUTRAL
            yield [(f"{mark.value}  "[:margin], mark), (line(row), "")]


def _hanging(entries: Iterable[tuple[str, Any, str]], width: int) -> Lines:
    """Yield texts, each beside its head of some style."""
    for head, style, text in entries:
        for k, line in enumerate(_wrapped(text, width - len(head))):
            yield [(" " * len(head) if k else head, style), (line, "")]


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, max(width, 20), break_on_hyphens=False) or [""]


def _shrink(widths: list[int], numbers: Sequence[bool], available: int) -> None:
    """Shorten the widest columns of texts until a line fits, to 12 characters at least."""
    texts = [k for k, number in enumerate(numbers) if not number]
    while sum(widths) + 2 * (len(widths) - 1) > available and texts:
        widest = max(texts, key=lambda k: widths[k])
        if widths[widest] <= 12:
            return
        widths[widest] -= 1


def versions() -> dict[str, str]:
    """Return the versions of the software that computed a result."""
    try:
        own = importlib.metadata.version("jaxid-robotics")
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    others = {name: importlib.metadata.version(name) for name in ("jax", "numpy")}
    return {"jaxid": own, **others, "python": platform.python_version()}
