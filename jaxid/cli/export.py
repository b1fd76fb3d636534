"""The command `jaxid export`: an identified model for controllers, simulators and tools."""

import enum
from pathlib import Path
from typing import Annotated

import typer

from jaxid.cli.options import open_console
from jaxid.errors import InputError
from jaxid.export.c_code import export_c
from jaxid.export.feed_forward import export_jax
from jaxid.export.simulators import export_mjcf, export_pinocchio, export_urdf
from jaxid.identification.fit import Fit, load
from jaxid.io import require_writable
from jaxid.report.page import show_files
from jaxid.report.result_files import MODEL


class Target(enum.StrEnum):
    """Formats of an exported model."""

    C = "c"
    URDF = "urdf"
    MJCF = "mjcf"
    JSON = "json"
    PINOCCHIO = "pinocchio"
    JAX = "jax"


DEFAULTS = {
    Target.C: Path("arm.c"),
    Target.URDF: Path("arm.urdf"),
    Target.MJCF: Path("arm.xml"),
    Target.JSON: Path("arm.json"),
    Target.PINOCCHIO: Path("arm_pinocchio.json"),
    Target.JAX: Path("arm.jax"),
}


def export(
    report: Annotated[
        Path,
        typer.Argument(
            help="Report of `jaxid identify`, or a model file (.json).", metavar="REPORT"
        ),
    ],
    to: Annotated[Target, typer.Option("--to", help="What to write.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="The file; `arm` with the usual ending if left."
        ),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", metavar="ARM.URDF", help="The robot's own file, for `--to urdf`."),
    ] = None,
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="As in the experiment file, for `--to urdf`.")
    ] = None,
    base: Annotated[
        str | None, typer.Option(metavar="LINK", help="As in the experiment file, for `--to urdf`.")
    ] = None,
    single: Annotated[
        bool, typer.Option("--float", help="C that computes in single precision.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file that is there already.")
    ] = False,
) -> None:
    """Write an identified model as C, URDF, MJCF, JSON, vectors, or a JAX function.

    C is a feed-forward for controllers: one file and its header, named like the output.
    """
    path = DEFAULTS[to] if output is None else output
    made = [path, path.with_suffix(".h")] if to is Target.C else [path]
    if to is Target.C and path.suffix != ".c":
        raise InputError(f"`--output` must be a C file like arm.c, but is `{path}`.")
    for one in made:
        if one.is_dir():
            raise InputError(f"`{one}` is a folder: choose another `--output`.")
        if one.exists() and not force:
            raise InputError(f"`{one}` is there already: choose another `--output`, or `--force`.")
    require_writable(path.parent)
    fit = load(_model_file(report))
    match to:
        case Target.C:
            export_c(fit, path.parent, name=path.stem, double=not single)
        case Target.URDF:
            export_urdf(fit, _own_file(fit, urdf), path, tip=tip, base=base)
        case Target.MJCF:
            export_mjcf(fit, path)
        case Target.JSON:
            fit.save(path)
        case Target.PINOCCHIO:
            export_pinocchio(fit, path)
        case Target.JAX:
            export_jax(fit, path)
    show_files(open_console(), path.parent, [x.name for x in made])


def _model_file(report: Path) -> Path:
    if not report.exists():
        raise InputError(
            f"`{report}` is not there: give a folder that `jaxid identify` has written, or a model "
            "file."
        )
    if not report.is_dir():
        return report
    if not (report / MODEL).is_file():
        raise InputError(
            f"`{report}` holds no `{MODEL}`: give a folder that `jaxid identify` has written."
        )
    return report / MODEL


def _own_file(fit: Fit, urdf: Path | None) -> Path:
    if urdf is not None:
        return urdf
    source = Path(fit.base.model.robot.source)
    if source.suffix != ".urdf" or not source.is_file():
        raise InputError("`--to urdf` changes the robot's own file: name it with `--urdf`.")
    return source
