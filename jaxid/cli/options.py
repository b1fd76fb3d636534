"""Options that commands share, the terminal, and errors as sentences."""

import errno
import shlex
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from jaxid.errors import InputError
from jaxid.experiment.progress import Stages, stages

WIDTH = 100
"""Width of the output where there is no terminal."""

ExperimentFile = Annotated[
    Path, typer.Argument(help="The experiment file.", metavar="EXPERIMENT.TOML")
]

Force = Annotated[
    bool, typer.Option("--force", help="Write into a folder that holds other files too.")
]


def require_one_log_per_option() -> None:
    """Reject several logs behind one `--verify` or `--loaded`, as earlier versions took them.

    Otherwise the second log would silently be used for something else.

    Raises:
        InputError: If two words that are no options follow such an option.
    """
    words = [word for arg in sys.argv[1:] for word in arg.split("=", 1)]
    for option, _, second in zip(words, words[1:], words[2:], strict=False):
        if option in ("--verify", "--loaded") and not second.startswith("-"):
            raise InputError(
                f"`{option}` takes one log: repeat it before `{second}`, and name the logs without "
                "an option first."
            )


def describe_error(error: Exception) -> str:
    """Return what an error says, with the file that it is about.

    Args:
        error: Error of a user, or of the operating system.
    """
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    where = f"`{error.filename}`: " if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (
            f"{where}{error.strerror}: nothing was written; make room, or choose another folder "
            "with -o."
        )
    return f"{where}{error.strerror}."


def open_console(stderr: bool = False) -> Console:
    """Return the terminal, or a console of fixed width where there is none.

    Args:
        stderr: Whether to write to stderr, as errors and bars do.
    """
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in console._environ:
        console.width = WIDTH
    return console


def open_stages(total: int) -> AbstractContextManager[Stages]:
    """Return a progress bar for the stages of a command.

    Args:
        total: Number of stages.
    """
    return stages(open_console(stderr=True), total)


def command_line(
    experiment: Path,
    logs: list[Path],
    verify: list[Path],
    split: float | None,
    output: Path,
    pdf: bool,
) -> str:
    """Return the command line that makes a report of `jaxid identify` again.

    Args:
        experiment: Path of the experiment file.
        logs: Logs to identify with.
        verify: Logs to verify with.
        split: Fraction of each log to identify with.
        output: Folder of the report.
        pdf: Whether figures are written as PDF too.
    """
    words = ["jaxid", "identify", str(experiment), *map(str, logs)]
    words += [word for log in verify for word in ("--verify", str(log))]
    words += ["--split", f"{split:g}"] if split is not None else []
    words += ["-o", str(output), *(["--pdf"] if pdf else [])]
    return shlex.join(words)
