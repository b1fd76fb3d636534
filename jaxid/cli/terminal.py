"""The terminal of the commands: tables, remarks, names of files, progress, errors."""

import contextlib
import errno
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.text import Text

from jaxid.result_table import Remark, Status, Summarised, Table, printable

from .command_help import UNUSABLE_CODE

LINE_INTERVAL = 10.0
"""Time between two lines of progress where there is no terminal [s]."""

LONG_STAGES = re.compile("best so far|round|effects|mistakes|measuring|writing")
"""Words in the names of stages that take most of the time left, or come last."""
LONG_PART = 0.9
"""Part of the time left that such a stage takes.

Measured (CPU time) on the example, the UR10 and the KR300: the search for mistakes
takes 83 to 97 % of the time left, the rounds of `choose` 89 %, other stages mostly 1 to
12 %.
"""
SHORT_PART = 0.07
"""Part of the time left that another stage takes."""
MIN_SHARE = 0.1
"""Share of the work below which nothing is said of the time left."""
Progress = Callable[[str, float], None]
"""Function that shows the completed fraction (0 to 1) of a stage."""


class Terminal(Console):
    """Terminal on which the names of files and joints cannot be control sequences."""

    def print(self, *objects: Any, **arguments: Any) -> None:  # noqa: D102
        for text in objects:
            if isinstance(text, Text):
                text.plain = printable(text.plain)
        super().print(*objects, **arguments)


def open_console(stderr: bool = False) -> Console:
    """Return the terminal, or a console of fixed width where there is none."""
    console = Terminal(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in console._environ:
        console.width = 100
    return console


def show(console: Console, *tables: Table) -> None:
    """Print tables, each with an empty line before it."""
    for table in tables:
        console.print()
        # Numbers are not cut where a line is too short for them.
        console.print(table, crop=False)


def show_result(
    console: Console,
    detail: bool | None,
    result: Summarised,
    folder: Path,
    files: Iterable[Path] = (),
    lines: Sequence[str] = (),
) -> None:
    """Print a result in few lines, all of it (`-v`), or the verdict alone (`-q`).

    Args:
        console: The terminal.
        detail: True for `-v`, False for `-q`, None without either.
        result: The result.
        folder: Folder of the files that were written.
        files: These files.
        lines: Lines to paste into the experiment file.

    Raises:
        typer.Exit: With a code of its own if the result must not be used.
    """
    is_unusable = result.verdict.status is Status.BAD
    if detail is False:
        console.print(Table("", remarks=[result.verdict]))
    else:
        show(console, *(result.tables() if detail else result.overview()))
        if lines and not is_unusable:
            show_text(console, "\n".join(["", *lines]))
        if files:
            show_files(console, folder, files)
    if is_unusable:
        raise typer.Exit(UNUSABLE_CODE)


def show_remarks(console: Console, remarks: Sequence[Remark | str]) -> None:
    """Print remarks, one paragraph each."""
    if remarks:
        show(console, Table("", remarks=dict.fromkeys(remarks)))


def show_files(console: Console, folder: Path, files: Iterable[Path]) -> None:
    """Print the names of written files, and their folder if it is another one."""
    place = "" if folder == Path() else f" {folder}:"
    names = ", ".join(str(file.relative_to(folder)) for file in files)
    console.print(Text(f"\nwrote{place} {names}"))


def show_text(console: Console, text: str) -> None:
    """Print a text that may be copied: no line of it is broken."""
    console.print(Text(text), soft_wrap=True)


@contextlib.contextmanager
def progress_bar(counts_all: bool = False) -> Iterator[Progress]:
    """Show one bar over all stages, and a line each ten seconds without a terminal.

    Each stage takes a part of what is left, so that the bar only grows.

    Args:
        counts_all: Whether fractions are of all stages together, not of each.
    """
    # Not needed by `--help`, which must answer at once.
    from rich.progress import Progress as Bar, SpinnerColumn

    console = open_console(stderr=True)
    columns = Bar.get_default_columns()
    bar = Bar(SpinnerColumn(), *columns, console=console, transient=True)
    bar.add_task("starting", total=1.0)
    (task,) = bar.tasks
    stage_start = stage_fraction = 0.0

    def show_stage(stage: str, fraction: float) -> None:
        nonlocal stage_start, stage_fraction
        if fraction < stage_fraction:
            stage_start = task.completed
        stage_fraction = fraction
        part = LONG_PART if LONG_STAGES.search(stage) else SHORT_PART
        share = stage_start + part * (1.0 - stage_start) * fraction
        if counts_all:
            share = fraction
        bar.update(task.id, description=stage, completed=share)

    if console.is_terminal:
        with bar:
            yield show_stage
        return
    end = threading.Event()
    # A thread: some stages compile for longer than ten seconds.
    printer = threading.Thread(
        target=_print_lines, args=(console, task, end), daemon=True
    )
    printer.start()
    try:
        yield show_stage
    finally:
        end.set()
        printer.join()


def _print_lines(console: Console, task: Any, end: threading.Event) -> None:
    """Print a line of progress each ten seconds until the end."""
    start_time = time.monotonic()
    while not end.wait(LINE_INTERVAL):
        share = task.completed
        elapsed_time = time.monotonic() - start_time
        words = f"{task.description}: {100 * share:.0f} %"
        if share > MIN_SHARE:
            time_left = elapsed_time * (1.0 / share - 1.0)
            words += f", about {time_left:.0f} s left"
        console.print(Text(words))


def describe_error(error: Exception) -> str:
    """Return what an error of a user or of the operating system says, with its file."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    place = f"`{error.filename}`: " if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (
            f"{place}{error.strerror}: nothing was written; "
            "make room, or choose another -o."
        )
    return f"{place}{error.strerror}."
