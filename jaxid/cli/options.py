"""Options of the commands, the terminal, errors as sentences, and folders of results."""

import errno
import os
import shlex
import stat
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from jaxid.errors import InputError
from jaxid.experiment.progress import Stages, stages
from jaxid.io import read_json, require_writable
from jaxid.report.result_files import SCHEMAS
from jaxid.trajectory.files import load_trajectory

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


def refuse_foreign_folder(target: Path, force: bool) -> None:
    """Reject a folder that holds other things than an earlier report.

    Args:
        target: Folder of the report.
        force: Whether the report may stand beside other files.

    Raises:
        OSError: If nothing can be written there.
        InputError: If there is something else in its place.
    """
    if target.exists() and not target.is_dir():
        raise InputError(f"`{target}` is a file, but a report needs a folder: choose another -o.")
    if force or not target.is_dir() or not any(target.iterdir()) or _holds_report(target):
        require_writable(target)
        return
    raise InputError(
        f"`{target}` holds files but no report: choose another folder with -o, or add --force to "
        "put the report beside them."
    )


def refuse_foreign_table(target: Path) -> None:
    """Reject a table of a motion in whose place are other files than an earlier motion.

    Args:
        target: Table, beside which the trajectory lies with the suffix `.json`, the message for
            ROS, and a folder of pictures.

    Raises:
        OSError: If nothing can be written there.
        InputError: If the name is not that of a table, or something else is in its place.
    """
    if target.suffix.lower() != ".csv":
        raise InputError(f"`{target}` must end in .csv: choose another -o.")
    beside, pictures = target.with_suffix(".json"), target.with_suffix("")
    if _is_trajectory(beside):
        return
    ros = (target.with_suffix(f".ros.{kind}") for kind in ("yaml", "json"))
    drawn = sorted(pictures.iterdir()) if pictures.is_dir() else []
    foreign = next((path for path in (target, beside, *ros, *drawn) if path.exists()), None)
    if foreign is not None:
        raise InputError(
            f"`{foreign}` is there already, and no motion of `jaxid excite`: choose another -o."
        )
    require_writable(target.parent)


def _is_trajectory(path: Path) -> bool:
    try:
        load_trajectory(path)
    except (OSError, ValueError):
        return False
    return True


def _holds_report(folder: Path) -> bool:
    return any(_has_schema(folder / file, schema) for file, schema in SCHEMAS.items())


def _has_schema(path: Path, schema: str) -> bool:
    try:
        content = read_json(path)
        return str(content["schema"]).startswith(schema.split("/")[0])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def output_folder() -> Path | None:
    """Return this folder, or None if the output is redirected into a file of another one."""
    try:
        status = os.fstat(sys.stdout.fileno())
    except (OSError, ValueError):
        return Path()
    if not stat.S_ISREG(status.st_mode):
        return Path()
    here = (entry.stat(follow_symlinks=False) for entry in os.scandir())
    return Path() if any(os.path.samestat(status, one) for one in here) else None
