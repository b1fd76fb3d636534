"""Tables and remarks in the terminal, in colour where it has colours."""

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.text import Text

from jaxid.table import Remark, Status, Table

STYLES = {
    Status.GOOD: "green",
    Status.DOUBTFUL: "yellow",
    Status.BAD: "red",
    Status.NEUTRAL: "dim",
    "title": "bold",
    "header": "bold",
    "dim": "dim",
    "": "",
}


def show(console: Console, *tables: Table) -> None:
    """Print tables, each with an empty line before it."""
    for table in tables:
        console.print()
        for line in table.lines(console.width):
            text = Text.assemble(*((part, STYLES[style]) for part, style in line))
            console.print(text, soft_wrap=True)


def show_remarks(console: Console, remarks: Iterable[Remark | str]) -> None:
    """Print remarks, one paragraph each."""
    unique = tuple(dict.fromkeys(remarks))
    if unique:
        show(console, Table("", remarks=unique))


def show_files(console: Console, folder: Path, names: Iterable[str]) -> None:
    """Print the names of files that were written, and their folder."""
    console.print()
    console.print(Text(f"wrote {folder}: {', '.join(names)}"))
