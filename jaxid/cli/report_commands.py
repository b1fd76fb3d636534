"""Commands that take reports: `export`, `compare` and `agree`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

import jaxid as jid
from jaxid.errors import InputError
from jaxid.result_table import Remark, Status

from . import options, terminal

EXPORTS = {
    "c": "arm.c",
    "urdf": "arm.urdf",
    "mjcf": "arm.xml",
    "json": "arm.json",
    "jax": "arm.jax",
}
"""Formats of `jaxid export`, and the file where none is named."""


def export(
    report: Annotated[
        Path, typer.Argument(help="Report, or a model file (.json).", metavar="REPORT")
    ],
    to: Annotated[
        Literal["c", "urdf", "mjcf", "json", "jax"],
        typer.Option("--to", help="What to write."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="The file; by default `arm`."
        ),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option(metavar="ROBOT", help="The robot's file, for `--to urdf`."),
    ] = None,
    tip: options.Tip = None,
    base: options.Base = None,
    single: Annotated[
        bool, typer.Option("--float", help="C that computes in single precision.")
    ] = False,
    force: options.Force = False,
) -> None:
    """Write a model as C, URDF, MJCF, JSON or JAX.

    C is a feed-forward for controllers: one file and its header, named like the output.
    """
    path = output or Path(EXPORTS[to])
    files = [path, path.with_suffix(".h")] if to == "c" else [path]
    require_no_files(files, to, force)
    options.require_reports([report])
    console = options.start(report, *([urdf] if urdf else []))
    from jaxid.io import require_writable
    from jaxid.report.result_files import read_faults, read_fit

    require_writable(path.parent)
    faults = read_faults(report)
    if faults and not force:
        raise InputError(
            f"by its verdict, the model of `{report}` must not be used: {faults[0]} "
            "Correct that first, or write the file anyway with `--force`."
        )
    fit = read_fit(report)
    match to:
        case "c":
            jid.export_c(fit, path.parent, name=path.stem, double=not single)
        case "urdf":
            source = urdf or source_urdf(fit)
            jid.export_urdf(fit, source, path, tip=tip, base=base)
            show_omissions(console, path, fit, is_urdf=True)
        case "mjcf":
            jid.export_mjcf(fit, path)
            show_omissions(console, path, fit, is_urdf=False)
        case "jax":
            jid.export.export_jax(fit, path)
        case "json":
            fit.save(path)
    terminal.show_files(console, path.parent, files)


def show_omissions(console: Console, path: Path, fit: "jid.Fit", is_urdf: bool) -> None:
    """Print which effects of a model a file of a simulator cannot hold."""
    from jaxid.export.bodies_and_joint_dynamics import joint_dynamics

    dynamics = joint_dynamics(fit)
    names = dynamics.missing_in_urdf if is_urdf else dynamics.omissions
    if names:
        # C code is for fixed bases only.
        is_floating = fit.base.model.robot.floating
        complete_files = "`--to json` keeps"
        if not is_floating:
            complete_files = "`--to c` and `--to json` keep"
        text = (
            f"`{path}` cannot hold {', '.join(names)}: a simulation with this file "
            f"lacks these effects; {complete_files} them."
        )
        terminal.show_remarks(console, [Remark(text, Status.DOUBTFUL)])


def require_no_files(files: Sequence[Path], to: str, force: bool) -> None:
    """Reject files of an export that are there already, or have a wrong suffix."""
    if to == "c" and files[0].suffix != ".c":
        raise InputError(
            f"`--output` must be a C file like arm.c, but is `{files[0]}`."
        )
    for file in files:
        if file.is_dir():
            raise InputError(f"`{file}` is a folder: choose another `--output`.")
        if file.exists() and not force:
            raise InputError(
                f"`{file}` already exists: choose another `--output`, or `--force`."
            )


def source_urdf(fit: "jid.Fit") -> Path:
    """Return the file that the robot of a fit was read from."""
    source = Path(fit.base.model.robot.source)
    if source.suffix not in (".urdf", ".xacro", ".xml") or not source.is_file():
        raise InputError(
            "`--to urdf` changes the robot's own file: name it with `--urdf`."
        )
    return source


def compare(
    first: Annotated[
        Path,
        typer.Argument(
            help="Report of one run, such as that of the cold robot.", metavar="FIRST"
        ),
    ],
    second: Annotated[
        Path,
        typer.Argument(
            help=("Report of another run, or of another model."), metavar="SECOND"
        ),
    ],
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="LOG",
            help=("A log on which to compare the predictions of both models."),
        ),
    ] = None,
    output: options.OutputFolder = Path("comparison"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Compare two reports: what has changed, or errors on one log.

    Each report is a folder that `jaxid identify` has written. With `--log`, the models
    may have different effects; the log is read as the first report's was.
    """
    if first.resolve() == second.resolve():
        raise InputError(f"`{first}` is given twice: compare two different runs.")
    options.require_reports([first, second])
    logs = [] if log is None else [log]
    console = options.start(first, second, *logs, output=output, force=force)
    with terminal.progress_bar() as progress:
        report = jid.experiment.compare_reports((first, second), log, progress)
        settings = {"command": options.command_line()}
        files = dataclasses.replace(report, settings=settings).save(output)
    terminal.show_result(console, detail, report, output, files)


def agree(
    reports: Annotated[
        list[Path],
        typer.Argument(
            help="Reports of one robot, in the order of the runs.", metavar="REPORTS"
        ),
    ],
    output: options.OutputFolder = Path("agreement"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Compare several runs: which ones differ, and why.

    Each report is a folder that `jaxid identify`, `rollout` or `calibrate` has written.
    The others are pooled into one estimate, whose intervals include the differences
    between runs.
    """
    options.require_reports(reports)
    console = options.start(*reports, output=output, force=force)
    report = jid.workflow.agree_reports(reports)
    settings = {"command": options.command_line()}
    files = dataclasses.replace(report, settings=settings).save(output)
    terminal.show_result(console, detail, report, output, files)
