"""The command line `jaxid`: names, options and help of the commands.

Their work is imported when they run, so that `jaxid --help` answers at once.
"""

import io
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.text import Text

from jaxid.errors import InputError
from jaxid.result_table import versions

from . import options

app = typer.Typer(
    name="jaxid",
    help="Identifies the dynamic parameters of robots: from a log to a model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run a command in this thread; a user's error is one sentence with exit code 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # some terminals know few characters
        sys.stdout.reconfigure(errors="replace")
    try:
        options.require_one_log_per_option()
        app()
    except (InputError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and type(error) is not RuntimeError:
            raise  # of JAX, not a failed search
        message = Text(f"jaxid: {options.describe_error(error)}")
        options.open_console(stderr=True).print(message, soft_wrap=True)
        raise SystemExit(2) from None


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.")
    ] = False,
) -> None:
    if version:
        typer.echo(f"jaxid {versions()['jaxid']}")
        raise typer.Exit


@app.command()
def demo(
    output: options.OutputFolder = Path("demo"),
    seed: options.Seed = 0,
    force: options.Force = False,
) -> None:
    """Run the whole method on a virtual seven-axis robot.

    Base parameters, optimal excitation, measurement cold and warm, identification, and
    verification on the path of ISO 9283.
    """
    from jaxid.demo.results import remarks, tables, write_study
    from jaxid.demo.study import run_study

    from .printing import show, show_remarks
    from .progress_bar import progress_bar

    console = options.start(output=output, force=force)
    with progress_bar(options.open_console(stderr=True)) as progress:
        study = run_study(seed, progress)
        progress("writing the report", 0.0)
        files = write_study(output, study)
    show(console, *tables(study))
    show_remarks(console, remarks(study))
    console.print()
    console.print(Text(f"the report: {files[0]}"), soft_wrap=True)


@app.command()
def example(
    folder: Annotated[Path, typer.Argument(help="Folder of the files.", metavar="DIR")],
    seed: options.Seed = 0,
) -> None:
    """Write an experiment to try things on.

    An experiment file and two logs of a virtual robot whose parameters are known.
    """
    from jaxid.simulation.example import write_example

    console = options.start()
    for file in write_example(folder, seed=seed):
        console.print(Text(f"wrote {file}"), soft_wrap=True)
    words = f"now: jaxid identify {folder}/experiment.toml {folder}/identification.csv "
    words += f"--verify {folder}/verification.csv -o {folder}/report"
    console.print(Text(words), soft_wrap=True)


@app.command()
def init(
    urdf: Annotated[
        Path,
        typer.Argument(
            help="The robot's URDF, xacro or MJCF file.", metavar="ARM.URDF"
        ),
    ],
    tip: options.Tip = None,
    base: options.Base = None,
) -> None:
    """Print a commented experiment file for a robot.

    Like this: jaxid init arm.urdf > experiment.toml
    """
    options.start(urdf)
    from jaxid.experiment.template import write_template
    from jaxid.robot.urdf import load_urdf

    from .printing import show_remarks

    text = write_template(urdf, tip=tip, base=base)
    show_remarks(
        options.open_console(stderr=True), load_urdf(urdf, tip=tip, base=base).notes
    )
    typer.echo(text.encode(), nl=False)  # TOML is UTF-8, whatever the terminal is


@app.command()
def excite(
    experiment: options.ExperimentFile,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE.CSV", help="Table of the motion."),
    ] = Path("trajectory.csv"),
    time: Annotated[
        float | None,
        typer.Option("--time", metavar="S", min=1.0, help="Time for the search [s]."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the motion that was written.")
    ] = False,
) -> None:
    """Design the motion to record, within the limits of the joints.

    Floor, self-collision and forces count as far as the robot's file describes them. A
    first motion is written after seconds, and every better one replaces it: the table,
    the trajectory itself (.json) and the same for ROS (.ros.yaml) or other controllers;
    at the end also a page with pictures. Ctrl-C keeps the best motion so far. The exit
    code is 3 if something was not checked.
    """
    console = options.start(experiment)
    from . import commands

    options.refuse_foreign_table(output)
    commands.excite(console, experiment, output, resume, time)


@app.command()
def inspect(
    experiment: options.ExperimentFile,
    logs: Annotated[
        list[Path] | None, typer.Argument(help="Logs to examine.", metavar="LOG")
    ] = None,
) -> None:
    """Show what can be identified, and check logs for mistakes.

    Joints, motors and limits; base parameters and what becomes of each standard
    parameter; ranges, speeds and forces of each log beside the limits, and what the log
    does not determine.
    """
    console = options.start(experiment, *(logs or []))
    from . import commands

    commands.inspect(console, experiment, logs or [])


@app.command()
def identify(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    verify: options.Verified = None,
    split: Annotated[
        float | None,
        typer.Option(
            metavar="F",
            help="Fit the first fraction F (0-1) of each log, validate with the rest.",
        ),
    ] = None,
    output: options.OutputFolder = Path("report"),
    figures: Annotated[
        Literal["svg", "png", "pdf"] | None,
        typer.Option(help="Also write each figure to a file of this format."),
    ] = None,
    force: options.Force = False,
) -> None:
    """Estimate the parameters and write a report.

    A page for the browser, with figures and a verdict; the same numbers for programs.
    """
    console = options.start(
        experiment, *logs, *(verify or []), output=output, force=force
    )
    from . import commands

    commands.identify(console, experiment, logs, verify or [], split, output, figures)


@app.command()
def choose(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="FILE", help="The experiment file to write."
        ),
    ] = Path("chosen.toml"),
    force: options.Force = False,
) -> None:
    """Choose friction and estimator by errors on unseen data.

    A table of all models, and an experiment file with the simplest that is about as
    good as any.
    """
    if output.exists() and not force:
        raise InputError(
            f"`{output}` is there already: choose another `--output`, or `--force`."
        )
    console = options.start(experiment, *logs)
    from . import commands

    commands.choose(console, experiment, logs, output)


@app.command()
def export(
    report: Annotated[
        Path, typer.Argument(help="Report, or a model file (.json).", metavar="REPORT")
    ],
    to: Annotated[
        Literal["c", "urdf", "mjcf", "json", "pinocchio", "jax"],
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
        typer.Option(metavar="ARM.URDF", help="The robot's file, for `--to urdf`."),
    ] = None,
    tip: options.Tip = None,
    base: options.Base = None,
    single: Annotated[
        bool, typer.Option("--float", help="C that computes in single precision.")
    ] = False,
    force: options.Force = False,
) -> None:
    """Write a model as C, URDF, MJCF, JSON, vectors or JAX.

    C is a feed-forward for controllers: one file and its header, named like the output.
    """
    console = options.start(report, *([urdf] if urdf else []))
    from . import commands

    path = output or Path(commands.EXPORTS[to])
    files = commands.export(report, to, path, urdf, tip, base, not single, force)
    console.print()
    names = ", ".join(file.name for file in files)
    console.print(Text(f"wrote {path.parent}: {names}"))


@app.command()
def compare(
    first: Annotated[
        Path,
        typer.Argument(
            help="Report of one run, like that of the cold robot.", metavar="COLD"
        ),
    ],
    second: Annotated[
        Path,
        typer.Argument(help="Report of another run of the same robot.", metavar="WARM"),
    ],
    output: options.OutputFolder = Path("comparison"),
    force: options.Force = False,
) -> None:
    """Decide which parameters have changed between two runs.

    Each argument is a folder that `jaxid identify` has written.
    """
    console = options.start(first, second, output=output, force=force)
    from . import commands

    if first.resolve() == second.resolve():
        raise InputError(f"`{first}` is given twice: compare two different runs.")
    commands.compare(console, (first, second), output)


@app.command()
def payload(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    loaded: options.Loaded,
    body: Annotated[
        str | None,
        typer.Option(metavar="JOINT", help="The joint that moves the payload."),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(metavar="KG", min=1e-6, help="Its mass, if a scale told it."),
    ] = None,
    output: options.OutputFolder = Path("payload"),
    force: options.Force = False,
) -> None:
    """Find a payload's mass, centre of mass and moments of inertia.

    From logs without it and logs with it. Friction may differ between them.
    """
    console = options.start(experiment, *logs, *loaded, output=output, force=force)
    from . import commands

    commands.payload(console, experiment, logs, loaded, body, mass, output)


@app.command()
def gains(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    loaded: options.Loaded,
    output: options.OutputFolder = Path("gains"),
    force: options.Force = False,
) -> None:
    """Find the drives' true forces with a load that is known.

    From logs without it and logs with it; the table `[load]` of the experiment file
    describes it.
    """
    console = options.start(experiment, *logs, *loaded, output=output, force=force)
    from . import commands

    commands.gains(console, experiment, logs, loaded, output)


@app.command()
def states(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    output: options.OutputFolder = Path("states"),
    force: options.Force = False,
) -> None:
    """Fit several states at once: one inertia, friction for each.

    One log or report for each, like cold and warm. Friction and offsets are each
    state's own, all else is shared.
    """
    console = options.start(experiment, *logs, output=output, force=force)
    from . import commands

    commands.states(console, experiment, logs, output)


@app.command()
def rollout(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    verify: options.Verified = None,
    output: options.OutputFolder = Path("rollout"),
    force: options.Force = False,
) -> None:
    """Identify from commands alone or torques, so that simulations move like the robot.

    If the experiment file names the columns of commands, joints behind position servos,
    with numbers for simulators and MJCF; otherwise the model of `identify`, with errors
    beside those of other methods. A page shows measured and simulated motion.
    """
    console = options.start(
        experiment, *logs, *(verify or []), output=output, force=force
    )
    from . import commands

    commands.rollout(console, experiment, logs, verify or [], output)
