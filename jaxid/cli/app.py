"""The command line `jaxid`: names, options, help and work of the commands.

The package is imported when a command runs, so that `jaxid --help` answers at once.
"""

import dataclasses
import functools
import io
import sys
from pathlib import Path
from time import monotonic
from typing import Annotated, Literal

import typer
from rich.text import Text

import jaxid as jid
from jaxid.errors import InputError
from jaxid.experiment_file import within
from jaxid.result_table import Remark, Status, versions
from jaxid.robot.xml_files import read_xml

from . import options, payload_gains_states_rollout, report_commands, terminal
from .command_help import EXIT_CODES, Command

app = typer.Typer(
    name="jaxid",
    help="Identifies the dynamic parameters of robots: from a log to a model.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run a command in this thread; a user's error is one sentence with exit code 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # some terminals know few characters
        sys.stdout.reconfigure(errors="replace")
    try:
        options.require_one_log_per_option()
        app(prog_name="jaxid")
    except (InputError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and type(error) is not RuntimeError:
            raise  # of JAX, not a failed search
        message = Text(f"jaxid: {terminal.describe_error(error)}")
        terminal.open_console(stderr=True).print(message, soft_wrap=True)
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


def demo(
    output: options.OutputFolder = Path("demo"),
    seed: options.Seed = 0,
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Run the whole method on a virtual seven-axis robot.

    Base parameters, optimal excitation, measurement cold and warm, identification, and
    verification on the path of ISO 9283.
    """
    console = options.start(output=output, force=force)
    from jaxid.demo.results import DemoResult, write_study
    from jaxid.demo.study import run_study

    with terminal.progress_bar(counts_all=True) as progress:
        study = run_study(seed, progress)
        progress("writing the report", 0.95)
        files = write_study(output, study)
    terminal.show_result(console, detail, DemoResult(study), output, files)


def example(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the files.", metavar="FOLDER")
    ],
) -> None:
    """Write an experiment to try things on.

    An experiment file and two logs of a virtual robot whose parameters are known.
    """
    console = options.start()
    from jaxid.simulation.example import write_example

    terminal.show_files(console, folder, write_example(folder))
    terminal.show_text(
        console,
        f"now: jaxid identify {folder}/experiment.toml {folder}/identification.csv "
        f"--verify {folder}/verification.csv -o {folder}/report",
    )


def init(
    urdf: Annotated[
        Path,
        typer.Argument(help="The robot's URDF, xacro or MJCF file.", metavar="ROBOT"),
    ],
    tip: options.Tip = None,
    base: options.Base = None,
    xacro: options.XacroArguments = None,
) -> None:
    """Print a commented experiment file for a robot.

    Like this: jaxid init arm.urdf > experiment.toml
    """
    options.require_paths([urdf])
    read_xml(urdf)
    options.start()
    arguments = options.xacro_arguments(xacro)
    chain = {"tip": tip, "base": base, "xacro_arguments": arguments}
    text = jid.experiment.write_template(urdf, **chain)
    remarks = jid.load_urdf(urdf, **chain).remarks
    terminal.show_remarks(terminal.open_console(stderr=True), remarks)
    typer.echo(text.encode(), nl=False)  # TOML is UTF-8, whatever the terminal is


def excite(
    experiment: options.ExperimentFile,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Table of the motion (.csv)."
        ),
    ] = Path("trajectory.csv"),
    time: options.Time = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue from the motion in the output file."),
    ] = False,
    detail: options.Detail = None,
) -> None:
    """Design the motion to record, within the limits of the joints.

    Floor, self-collision and forces count as far as the robot's file describes them. A
    first motion is written after seconds, and every better one replaces it: the table,
    the trajectory itself (.json) and the same for ROS (.ros.yaml) or other controllers;
    at the end also a page with pictures. Ctrl-C keeps the best motion so far. The exit
    code is 3 if something was not checked.
    """
    start_time = monotonic()
    options.require_table_name(output)
    earlier_design = output.with_suffix(".json") if resume else None
    if earlier_design is not None and not earlier_design.is_file():
        raise InputError(
            f"`{earlier_design}` does not exist: `--resume` needs it to continue."
        )
    console = options.start(experiment=experiment)
    from .best_result import BestResult

    options.refuse_foreign_table(output)
    content = jid.experiment.load_experiment(experiment)
    with within("excitation", experiment.name), terminal.progress_bar() as progress:
        progress("finding base parameters", 0.0)
        task = jid.workflow.prepare_motion(
            content.setup, content.excitation, content.surroundings, earlier_design
        )
    seconds = content.excitation.time if time is None else time
    if seconds is not None:
        # What was read and prepared counts, too.
        seconds -= monotonic() - start_time
    faults = [Remark(text, Status.BAD) for text in task.faults]
    terminal.show_remarks(terminal.open_console(stderr=True), faults)
    note = f"; NOT CHECKED: {'; '.join(task.faults)}" if task.faults else ""
    best_motion = BestResult(
        output,
        lambda motion: jid.workflow.write_best_motion(task, motion, output),
        f"stopped: `{output}` and the files beside it hold the best motion so far, "
        f"which keeps all limits that were checked{note}; `--resume` continues from it",
        "stopped before a motion kept all limits, and nothing was written",
    )
    with best_motion, terminal.progress_bar() as progress:
        with within("excitation", experiment.name):
            design = jid.workflow.design_motion(
                task, progress, best_motion.keep, seconds
            )
        progress("writing the report", 0.0)
        origin = options.report_origin(content.text)
        files = jid.workflow.write_design(task, design, output, **origin)
    terminal.show_result(console, detail, design, output.parent, files)


def inspect(
    experiment: options.ExperimentFile,
    logs: Annotated[
        options.Paths | None, typer.Argument(help="Logs to examine.", metavar="LOG")
    ] = None,
    output: options.OutputFolder = Path("inspection"),
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Show what can be identified, and check logs for mistakes.

    Joints, motors and limits; base parameters and what becomes of each standard
    parameter; ranges, speeds and forces of each log beside the limits, and what the log
    does not determine. Of logs there is a page, too.
    """
    logs = logs or []
    folder = output if logs else None
    console = options.start(*logs, experiment=experiment, output=folder, force=force)
    content = jid.experiment.load_experiment(experiment)
    with terminal.progress_bar() as progress:
        progress("finding base parameters", 0.0)
        inspection = jid.workflow.Inspection(content.setup)
        files = []
        if logs:
            setup, columns = content.identification(logs)
            inspection = jid.workflow.inspect_logs(setup, logs, columns, progress)
            progress("writing the report", 0.0)
            files = inspection.save(output, options.report_origin(content.text))
    terminal.show_result(console, detail, inspection, output, files)


def identify(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    verify: options.Verified = None,
    split: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Fit the first share of each log, like 0.6, validate with the rest.",
        ),
    ] = None,
    output: options.OutputFolder = Path("report"),
    figures: Annotated[
        Literal["svg", "png", "pdf"] | None,
        typer.Option(help="Also write each figure to a file of this format."),
    ] = None,
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Estimate the parameters and write a report.

    A page for the browser, with figures and a verdict; the same numbers for programs.
    """
    if split is not None and not 0 < split < 1:
        raise InputError(
            f"`--split` must lie between 0 and 1, like 0.6, but is {split:g}."
        )
    unseen_logs = verify or []
    console = options.start(
        *logs, *unseen_logs, experiment=experiment, output=output, force=force
    )
    held_out = None if split is None else 1.0 - split
    content = jid.experiment.load_experiment(experiment)
    setup, columns = content.identification([*logs, *unseen_logs])
    with terminal.progress_bar() as progress:
        report = jid.identify_logs(
            setup, logs, columns, held_out, unseen_logs, progress
        )
        settings = {
            "experiment": str(experiment),
            **options.report_origin(content.text),
            **report.settings,
        }
        report = dataclasses.replace(report, settings=settings)
        progress("writing the report", 0.0)
        files = report.save(output, figures or "")
    terminal.show_result(console, detail, report, output, files)


def choose(
    experiment: options.ExperimentFile,
    logs: options.Logs,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="The experiment file to write; by default chosen.toml beside yours.",
        ),
    ] = None,
    seconds: options.Time = None,
    force: options.Force = False,
    detail: options.Detail = None,
) -> None:
    """Choose the effects of the model by errors on unseen data.

    A table of the models, a page with figures, and a copy of the experiment file with
    those effects that the logs need. Ctrl-C keeps the best file so far.
    """
    output = options.file_beside(experiment, output, "chosen.toml", force)
    console = options.start(*logs, experiment=experiment)
    from jaxid.io import write_text
    from jaxid.report.model_choice_page import write_model_choice

    from .best_result import BestResult

    content = jid.experiment.load_experiment(experiment)
    page = output.with_suffix(".html")
    best_file = BestResult(
        output,
        functools.partial(write_text, output),
        f"stopped: `{output}` holds the best model so far",
        "stopped before a change lowered the errors: nothing was written",
    )
    with best_file, terminal.progress_bar() as progress:
        choice = jid.experiment.choose_model(
            content, logs, seconds=seconds, keep=best_file.keep, progress=progress
        )
        best_file.keep(choice.text)
        progress("writing the page", 0.0)
        origin = options.report_origin(content.text)
        write_model_choice(page, choice, content.setup.robot, origin)
    terminal.show_result(console, detail, choice, output.parent, [output, page])


for command in (
    demo,
    example,
    init,
    excite,
    inspect,
    identify,
    choose,
    report_commands.export,
    report_commands.compare,
    report_commands.agree,
    payload_gains_states_rollout.payload,
    payload_gains_states_rollout.gains,
    payload_gains_states_rollout.states,
    payload_gains_states_rollout.rollout,
    payload_gains_states_rollout.calibrate,
):
    app.command(cls=Command, epilog=EXIT_CODES)(command)
