"""Options that commands share, and what they check before they load JAX."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from jaxid.errors import InputError
from jaxid.experiment_file import (
    parse_tables,
    read_experiment_text,
    require_text_columns,
)
from jaxid.measurement.text_format import TEXT_SUFFIXES
from jaxid.result_table import SCHEMAS

from .terminal import open_console

ROBOT_SUFFIXES = (".urdf", ".xacro", ".xml", ".mjcf")
"""Ends of the names of files that describe robots."""

ExperimentFile = Annotated[
    Path, typer.Argument(help="The experiment file.", metavar="EXPERIMENT")
]
OutputFolder = Annotated[
    Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder of the result.")
]
Force = Annotated[
    bool,
    typer.Option("--force", help="Overwrite files that are there already."),
]
Detail = Annotated[
    bool | None,
    typer.Option(
        "--verbose/--quiet",
        "-v/-q",
        help="Print all tables, or nothing but the verdict.",
    ),
]
Time = Annotated[
    float | None,
    typer.Option("--time", metavar="SECONDS", min=1.0, help="Time for the search."),
]
Seed = Annotated[
    int,
    typer.Option("--seed", metavar="NUMBER", min=0, help="Seed of the random numbers."),
]
Tip = Annotated[
    str | None,
    typer.Option(
        metavar="LINK", help="The end-effector: use only the chain that leads to it."
    ),
]
Base = Annotated[
    str | None,
    typer.Option(metavar="LINK", help="The link on the ground; by default the root."),
]
XacroArguments = Annotated[
    list[str] | None,
    typer.Option(
        "--xacro",
        metavar="NAME:=VALUE",
        help="An argument of a xacro file, like dof:=6; may be repeated.",
    ),
]
Paths = list[Path]
Logs = Annotated[Paths, typer.Argument(help="Logs of the robot.", metavar="LOG")]
OptionalLogs = Annotated[
    Paths | None,
    typer.Argument(help="Logs without the load.", metavar="LOG"),
]
Verified = Annotated[
    Paths | None,
    typer.Option(
        "--verify",
        metavar="LOG",
        help="A log for validation only; may be repeated.",
    ),
]
Loaded = Annotated[
    Paths,
    typer.Option(metavar="LOG", help="A log with the load; may be repeated."),
]


def xacro_arguments(words: list[str] | None) -> dict[str, str]:
    """Return the arguments of a xacro file, as `--xacro` writes them, by name."""
    arguments = {}
    for word in words or []:
        name, mark, text = word.partition(":=")
        if not name or not mark:
            raise InputError(f"`--xacro` must be like dof:=6, but is `{word}`.")
        arguments[name] = text
    return arguments


def require_one_log_per_option() -> None:
    """Reject several logs behind one `--verify` or `--loaded`.

    Otherwise the second log would silently be used for something else.
    """
    words = [word for arg in sys.argv[1:] for word in arg.split("=", 1)]
    for option, _, value in zip(words, words[1:], words[2:], strict=False):
        if option in ("--verify", "--loaded") and not value.startswith("-"):
            raise InputError(f"`{option}` takes one log: repeat it before `{value}`.")


def start(
    *reads: Path,
    experiment: Path | None = None,
    output: Path | None = None,
    force: bool = False,
    needs_load: bool = False,
) -> Console:
    """Turn on double precision and the cache of compiled code; return the terminal.

    Wrong paths, and what is wrong with the experiment file, are refused before JAX is
    loaded, which takes seconds.
    """
    paths = reads if experiment is None else (experiment, *reads)
    require_paths(paths)
    if experiment is not None:
        require_experiment_first(experiment, reads)
        tables = parse_tables(read_experiment_text(experiment), experiment)
        require_text_columns(tables, reads)
        if needs_load and "load" not in tables:
            raise InputError(
                f"{experiment.name}: the table `[load]` is missing: "
                "it describes the load behind `--loaded`."
            )
    if output is not None:
        require_folder_of_report(output, force)
    import jax

    from jaxid.io import require_writable
    from jaxid.program.jax_compilation_cache import enable_compilation_cache

    jax.config.update("jax_enable_x64", True)
    enable_compilation_cache()
    if output is not None:
        require_writable(output)
    return open_console()


def require_folder_of_report(output: Path, force: bool) -> None:
    """Reject a file, and a folder whose files no command has written."""
    if not output.exists():
        return
    if not output.is_dir():
        raise InputError(
            f"`{output}` is a file, but a report needs a folder: choose another -o."
        )
    is_empty = not any(output.iterdir())
    if not (force or is_empty or holds_result(output)):
        raise InputError(
            f"`{output}` holds files but no report: choose another -o, or add --force."
        )


def holds_result(folder: Path) -> bool:
    """Return whether a command has written a result to a folder."""
    for file in SCHEMAS:
        path = folder / file
        if path.is_file() and '"jaxid-' in path.read_text(errors="replace")[:200]:
            return True
    return False


def file_beside(experiment: Path, output: Path | None, name: str, force: bool) -> Path:
    """Return the experiment file to write, which lies beside that of the user."""
    output = experiment.parent / name if output is None else output
    if output.exists() and not force:
        raise InputError(
            f"`{output}` already exists: choose another `--output`, or `--force`."
        )
    if output.parent.resolve() != experiment.parent.resolve():
        raise InputError(
            "`--output` must be in the folder of the experiment file, since its paths "
            "are relative to that folder."
        )
    return output


def require_paths(paths: Sequence[Path]) -> None:
    """Reject paths of files that are not there."""
    missing_paths = [f"`{path}`" for path in paths if not path.exists()]
    if missing_paths:
        verb = "does not exist"
        if len(missing_paths) > 1:
            verb = "do not exist"
        raise InputError(f"{', '.join(missing_paths)} {verb}: check the path.")


def require_reports(paths: Sequence[Path]) -> None:
    """Reject folders that cannot be reports, since they hold no result."""
    require_paths(paths)
    for path in paths:
        if path.is_dir() and not any(path.glob("*.json")):
            raise InputError(
                f"`{path}` must be a folder of `jaxid identify`, `rollout` or "
                "`calibrate`, but holds no result of them."
            )


def require_experiment_first(experiment: Path, logs: Sequence[Path]) -> None:
    """Reject a log, or a robot's file, in the place of the experiment file."""
    suffix = experiment.suffix.lower()
    is_swapped = any(log.suffix.lower() == ".toml" for log in logs)
    is_log = suffix in TEXT_SUFFIXES or experiment.is_dir()
    if is_log or (is_swapped and suffix != ".toml"):
        kind = "folder" if experiment.is_dir() else "log"
        raise InputError(
            f"`{experiment}` is a {kind}; the experiment file comes first, then the "
            "logs."
        )
    if suffix in ROBOT_SUFFIXES:
        raise InputError(
            f"`{experiment}` describes a robot; the experiment file comes first: "
            f"`jaxid init {experiment} > experiment.toml` writes one."
        )


def report_origin(experiment_text: str) -> dict[str, str]:
    """Return command and experiment file of a report, for those who repeat it."""
    return {"command": command_line(), "experiment_text": experiment_text}


def command_line() -> str:
    """Return the command line that gives the same result again."""
    words = (word for word in sys.argv[1:] if word not in ("--force", "--resume"))
    return shlex.join(["jaxid", *words])


def require_table_name(target: Path) -> None:
    """Reject a path of a table that does not end in .csv."""
    if target.suffix.lower() != ".csv":
        raise InputError(f"`{target}` must end in .csv: choose another -o.")


def refuse_foreign_table(target: Path) -> None:
    """Reject a path where files lie that are not those of an earlier motion."""
    from jaxid.io import require_writable
    from jaxid.trajectory.controllers import CONTROLLER_SUFFIXES
    from jaxid.trajectory.files import load_trajectory

    motion_file = target.with_suffix(".json")
    figure_folder = target.with_suffix("")
    try:
        load_trajectory(motion_file)
    except (OSError, ValueError):
        # Without an earlier motion nothing may be there that would be overwritten.
        paths = [target, motion_file]
        paths += [target.with_suffix(suffix) for suffix in CONTROLLER_SUFFIXES]
        if figure_folder.is_dir():
            paths += sorted(figure_folder.iterdir())
        foreign_files = [path for path in paths if path.exists()]
        if foreign_files:
            raise InputError(
                f"`{foreign_files[0]}` already exists, and is not "
                "a motion of `jaxid excite`: choose another -o."
            ) from None
        require_writable(target.parent)
