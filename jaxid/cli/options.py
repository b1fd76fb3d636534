"""What the commands share: options, the terminal, and how far a command is."""

import shlex
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from typer.core import TyperCommand

from jaxid.errors import InputError
from jaxid.experiment.progress import Stages, stages

WIDTH = 100
"""Of what is written where there is no terminal."""

ExperimentFile = Annotated[
    Path, typer.Argument(help="The experiment file.", metavar="EXPERIMENT.TOML")
]

Force = Annotated[
    bool, typer.Option("--force", help="Write into a folder that holds other files too.")
]


class SpreadLogs(TyperCommand):
    """Takes `--verify b.csv c.csv` for `--verify b.csv --verify c.csv`; `--loaded` alike.

    Otherwise the second log would silently be used for something else.
    """

    SPREAD = ("--verify", "--loaded")

    def parse_args(self, ctx, args):
        """Repeats the option before each log that follows it.

        Raises:
            InputError: If none follows.
        """
        spread, option = [], None
        for arg, after in zip(args, [*args[1:], "-"], strict=True):
            if arg in self.SPREAD:
                option = arg
                if after.startswith("-"):
                    raise InputError(f"`{arg}` needs at least one log behind it, but has none.")
            elif arg.startswith("-"):
                name, given, _ = arg.partition("=")
                option = name if given and name in self.SPREAD else None
                spread.append(arg)
            else:
                spread += [option, arg] if option else [arg]
        return super().parse_args(ctx, spread)


def open_console(stderr: bool = False) -> Console:
    """The terminal, or what stands for it.

    Args:
        stderr: Whether errors and bars go there.
    """
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in console._environ:
        console.width = WIDTH
    return console


def open_stages(total: int) -> AbstractContextManager[Stages]:
    """A bar for the stages of a command.

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
    """The line that makes a report of `jaxid identify` again.

    Args:
        experiment: The experiment file.
        logs: To identify with.
        verify: To verify with.
        split: Share of a log to identify with.
        output: The report's folder.
        pdf: Whether figures are written as PDF too.
    """
    words = ["jaxid", "identify", str(experiment), *map(str, logs)]
    words += ["--verify", *map(str, verify)] if verify else []
    words += ["--split", f"{split:g}"] if split is not None else []
    words += ["-o", str(output), *(["--pdf"] if pdf else [])]
    return shlex.join(words)
