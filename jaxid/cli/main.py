"""The command line `jaxid`, and the commands `init`, `example` and `demo`."""

import importlib.metadata
import io
import sys
from pathlib import Path
from typing import Annotated

import jax
import typer
from rich.text import Text

from jaxid.cli import identify, runs
from jaxid.cli.excite import excite
from jaxid.cli.export import export
from jaxid.cli.options import (
    Force,
    describe_error,
    open_console,
    open_stages,
    output_folder,
    refuse_foreign_folder,
    require_one_log_per_option,
)
from jaxid.errors import InputError
from jaxid.experiment.template import write_template
from jaxid.program.cache import keep_compiled

app = typer.Typer(
    name="jaxid",
    help="Identifies the dynamic parameters of robots: from a log to a model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run a command; an error of a user is one sentence on stderr, with exit code 2."""
    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    if isinstance(sys.stdout, io.TextIOWrapper):  # some terminals know few characters
        sys.stdout.reconfigure(errors="replace")
    try:
        require_one_log_per_option()
        app()
    except (InputError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and type(error) is not RuntimeError:
            raise  # of JAX, not a failed search
        open_console(stderr=True).print(Text(f"jaxid: {describe_error(error)}"), soft_wrap=True)
        raise SystemExit(2) from None


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        try:
            shown = importlib.metadata.version("jaxid-robotics")
        except importlib.metadata.PackageNotFoundError:
            shown = "(not installed)"
        open_console().print(Text(f"jaxid {shown}"))
        raise typer.Exit


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the report.")
    ] = Path("demo"),
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Seed of motions and noise.")
    ] = 0,
    force: Force = False,
) -> None:
    """Do the whole paper on a virtual TX90L on its rail.

    Base parameters, optimal excitation, measurement cold and warm, identification, verification on
    the path of ISO 9283, and how well the path is followed with and without the model.
    """
    from jaxid.demo.results import remarks, tables, write_study
    from jaxid.demo.study import run_study
    from jaxid.report.page import show, show_remarks

    console = open_console()
    refuse_foreign_folder(output, force)
    with open_stages(15) as stage:
        part = stage.part()

        def progress(name: str, fraction: float) -> None:
            nonlocal part
            if fraction == 0.0:
                stage(name)
                part = stage.part()
            else:
                part(fraction)

        study = run_study(seed, progress)
        stage("writing the report")
        files = write_study(output, study)
    show(console, *tables(study))
    show_remarks(console, remarks(study))
    console.print()
    console.print(Text(f"the report: {files[0]}"), soft_wrap=True)


@app.command()
def example(
    folder: Annotated[Path, typer.Argument(help="Folder of the files.", metavar="DIR")],
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Seed of parameters, motion and noise.")
    ] = 0,
) -> None:
    """Write an experiment to try things on.

    An experiment file and two logs of a virtual robot whose parameters are known.
    """
    from jaxid.simulation.example import write_example

    console = open_console()
    with open_stages(1) as stage:
        stage("simulating")
        files = write_example(folder, seed=seed)
    for file in files:
        console.print(Text(f"wrote {file}"), soft_wrap=True)
    console.print(
        Text(
            f"now: jaxid identify {folder}/experiment.toml {folder}/identification.csv "
            f"--verify {folder}/verification.csv -o {folder}/report"
        ),
        soft_wrap=True,
    )


@app.command()
def init(
    urdf: Annotated[Path, typer.Argument(help="The robot's URDF file.", metavar="ARM.URDF")],
    tip: Annotated[
        str | None,
        typer.Option(
            metavar="LINK", help="The end-effector: take only the chain that leads to it."
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="The link on the ground; by default the root."),
    ] = None,
) -> None:
    """Print a commented experiment file for a robot.

    Like this: jaxid init arm.urdf > experiment.toml
    """
    text = write_template(urdf, tip=tip, base=base, folder=output_folder())
    typer.echo(text.encode(), nl=False)  # TOML is UTF-8, whatever the terminal is


for command in (
    excite,
    identify.inspect,
    identify.identify,
    export,
    runs.compare,
    runs.payload,
    runs.gains,
    runs.states,
):
    app.command()(command)
