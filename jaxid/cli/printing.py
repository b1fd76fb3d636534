"""Results in the terminal: tables, remarks, names of files."""

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.text import Text

from jaxid.result_table import Remark, Table


def show(console: Console, *tables: Table) -> None:
    """Print tables, each with an empty line before it."""
    for table in tables:
        console.print()
        # Numbers are not cut where a line is too short for them.
        console.print(table, crop=False)


def show_remarks(console: Console, remarks: Iterable[Remark | str]) -> None:
    """Print remarks, one paragraph each."""
    unique = tuple(dict.fromkeys(remarks))
    if unique:
        show(console, Table("", remarks=unique))


def show_files(console: Console, folder: Path, names: Iterable[str]) -> None:
    """Print the names of written files, and their folder if it is another one."""
    place = "" if folder == Path() else f" {folder}:"
    console.print()
    console.print(Text(f"wrote{place} {', '.join(names)}"))
